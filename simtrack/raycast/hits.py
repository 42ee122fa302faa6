"""What queries of a ray scene answer."""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Bool, Float32, Int32
from simtrack.errors import InvalidValueError


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """What rays met, in the caller's order of rays."""

    distances: Float32
    """(N,), in multiples of the direction's length (metres for unit directions; depth for z = 1), inf = miss."""
    normals: Float32
    """(N, 3), unit, map frame, on the side that the mesh's winding faces; zero for a miss.

    Normals move with the inverse transpose of the instance's transform, so the outside of a closed mesh stays its
    outside under a mirroring transform too (as if the mirrored mesh's faces had been flipped, which trimesh does).
    """
    faces: Int32
    """(N,), face index in the instance's mesh, -1 = miss."""
    instances: Int32
    """(N,), instance id, -1 = miss."""

    @staticmethod
    def empty(count: int) -> "RayHits":
        """Uninitialised arrays for `count` rays, to be handed to `cast(..., out=)` again and again."""
        return RayHits(
            np.empty(count, np.float32),
            np.empty((count, 3), np.float32),
            np.empty(count, np.int32),
            np.empty(count, np.int32),
        )

    @staticmethod
    def reuse(out: "RayHits | None", count: int) -> "RayHits":
        """`out` if it is given and holds `count` rays, else new arrays; InvalidValueError if it holds others."""
        if out is None:
            return RayHits.empty(count)
        if len(out.distances) != count:
            raise InvalidValueError("out", len(out.distances), f"results for {count} rays")
        return out

    @property
    def hit(self) -> Bool:
        """(N,), whether the ray met anything."""
        return self.instances >= 0


@dataclass(frozen=True, slots=True, eq=False)
class ClosestPoints:
    """The nearest surface points, in the order of the query points."""

    points: Float32
    """(N, 3), map frame, metres; the query point itself where nothing lies within the maximum distance."""
    distances: Float32
    """(N,), metres, inf = nothing within the maximum distance; negative inside closed meshes if signs are asked for."""
    instances: Int32
    """(N,), instance id, -1 = nothing."""
    faces: Int32
    """(N,), face index in the instance's mesh, -1 = nothing."""

    @staticmethod
    def empty(count: int) -> "ClosestPoints":
        """Uninitialised arrays for `count` points."""
        return ClosestPoints(
            np.empty((count, 3), np.float32),
            np.empty(count, np.float32),
            np.empty(count, np.int32),
            np.empty(count, np.int32),
        )


@dataclass(frozen=True, slots=True, eq=False)
class SelectedHits:
    """The rays of a bundle that met certain instances, in an order that is the same for the same bundle."""

    rays: Int32
    """(M,), ray of each hit, once at most."""
    hits: RayHits
    """Of M rays."""

    def __len__(self) -> int:
        return len(self.rays)
