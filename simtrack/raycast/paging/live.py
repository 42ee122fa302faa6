"""The part of a world that is live: whose instance is which in the scene that rays are cast at."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Bool, Float32, Float64, Int32
from simtrack.errors import RaycastError
from simtrack.raycast.hits import RayHits
from simtrack.raycast.mesh import TriangleMesh
from simtrack.raycast.scene import MAX_INSTANCE, RayScene

_FREE = -1


@dataclass(frozen=True, slots=True, eq=False)
class PagedHits:
    """What rays met, in the caller's order of rays. Valid whatever happens to the world afterwards."""

    hits: RayHits
    """As of a `RayScene`; `instances` are numbers of the live scene, which say nothing from one update to the next."""
    owners: npt.NDArray[np.int64]
    """(L,) object id of each live instance, or -2 - portal for the panel that closes a portal."""

    @property
    def distances(self) -> Float32:
        """(N,), see `RayHits.distances`."""
        return self.hits.distances

    @property
    def normals(self) -> Float32:
        """(N, 3), see `RayHits.normals`."""
        return self.hits.normals

    @property
    def faces(self) -> Int32:
        """(N,), see `RayHits.faces`."""
        return self.hits.faces

    @property
    def hit(self) -> Bool:
        """(N,), whether the ray met anything."""
        return self.hits.hit

    @property
    def objects(self) -> npt.NDArray[np.int64]:
        """(N,) ids of the objects that were met, -1 for a miss or a closed portal."""
        return np.maximum(self._owner(), -1)

    @property
    def portals(self) -> npt.NDArray[np.int64]:
        """(N,) closed portals that were met, -1 for a miss or an object."""
        return np.maximum(-2 - self._owner(), -1)

    def _owner(self) -> npt.NDArray[np.int64]:
        return np.where(self.hit, self.owners[self.hits.instances], _FREE)


class LiveInstances:
    """Gives instances of a scene to owners, objects or panels (-2 - portal), and takes them back."""

    def __init__(self, scene: RayScene) -> None:
        self.scene = scene
        self._slots: dict[int, int] = {}
        self._free: list[int] = []
        self._owners = np.full(256, _FREE, np.int64)
        self._shared = False

    def __len__(self) -> int:
        return len(self._slots)

    def __contains__(self, owner: int) -> bool:
        return owner in self._slots

    @property
    def owners(self) -> list[int]:
        """All that have an instance, in the order of `place`."""
        return list(self._slots)

    def place(self, owners: Sequence[int], meshes: Sequence[TriangleMesh], poses: Float64) -> None:
        """Give instances to owners that have none, with their poses (K, 4, 4) in the frame of the scene.

        Raises:
            RaycastError: the scene is full; nothing was placed.
        """
        if len(self._slots) + len(owners) > MAX_INSTANCE:
            raise RaycastError(f"more than {MAX_INSTANCE} instances within reach of the rays; cast less far")
        reused = min(len(owners), len(self._free))
        first = len(self._slots) + len(self._free)
        slots = [*self._free[len(self._free) - reused :], *range(first, first + len(owners) - reused)]
        self.scene.add_many(meshes, poses, slots)
        del self._free[len(self._free) - reused :]
        self._slots.update(zip(owners, slots, strict=True))
        self._own_table(first + len(owners))
        self._owners[slots] = owners

    def retire(self, owners: Iterable[int]) -> int:
        """Take the instances of those owners that have one; returns how many."""
        gone = [owner for owner in owners if owner in self._slots]
        if gone:
            slots = [self._slots.pop(owner) for owner in gone]
            self.scene.remove_many(slots)
            self._own_table(0)
            self._owners[slots] = _FREE
            self._free.extend(slots)
        return len(gone)

    def move(self, owners: Sequence[int], poses: Float64) -> None:
        """Set the poses (K, 4, 4) of owners that have an instance."""
        self.scene.set_poses([self._slots[owner] for owner in owners], poses)

    def signed(self, hits: RayHits) -> PagedHits:
        """Hits with the owners as they are now."""
        self._shared = True
        return PagedHits(hits, self._owners)

    def _own_table(self, size: int) -> None:
        """Make the table of owners long enough, and its own copy if results hold on to it."""
        if size > len(self._owners):
            self._owners = np.concatenate([self._owners, np.full(size, _FREE, np.int64)])
        elif self._shared:
            self._owners = self._owners.copy()
        self._shared = False
