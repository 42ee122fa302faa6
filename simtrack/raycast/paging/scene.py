"""A world of any size to cast rays at: what rays can reach is live in Embree, the rest rests in the index."""

from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType

import numpy as np
import numpy.typing as npt
from numba import njit

from simtrack.contracts import Float32, Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.raycast.bundle import RayBundle
from simtrack.raycast.hits import RayHits
from simtrack.raycast.mesh import TriangleMesh
from simtrack.raycast.paging.live import LiveInstances, PagedHits
from simtrack.raycast.paging.objects import EVERYWHERE, ObjectIndex
from simtrack.raycast.scene import RayScene

_FAR = 128.0
"""Metres from the live scene's origin at which it is moved: float32 still resolves 15 um there."""
_ORIGIN_STEP = 64.0
"""The origin is a multiple of this, metres."""


@dataclass(frozen=True, slots=True)
class PagingConfig:
    """Settings of `PagedScene`."""

    reach: float = 30.0
    """Length of the rays to get ready for, metres; casting further works, and loads what it needs at once."""
    ahead: float = 3.0
    """Regions are loaded before the sensor has come nearer than this to where it needs them, metres."""
    budget: int = 64
    """Instances to load, and as many to unload, in one update; a region is loaded whole, and one at least."""
    linger: int = 90
    """Updates for which a region stays live after it was last within reach: turning on the spot costs nothing."""

    def __post_init__(self) -> None:
        for name in ("reach", "ahead"):
            if not 0 < getattr(self, name) < np.inf:
                raise InvalidValueError(name, getattr(self, name), "a finite number > 0, in metres")
        for name in ("budget", "linger"):
            if getattr(self, name) < 1:
                raise InvalidValueError(name, getattr(self, name), ">= 1")


@dataclass(frozen=True, slots=True)
class PagingReport:
    """What an update did."""

    loaded: int
    """Instances."""
    unloaded: int
    waiting: int
    """Regions ahead that the budget left for later updates."""


class PagedScene:
    """Casts rays at a world of regions as if all of it were live.

    Before every cast the regions that its rays can reach are made live, so no ray meets a region that is not there.
    `update`, called once a frame, does so ahead of need and within a budget, and retires what was left behind; casts
    then find everything in place. Structure (walls, floor, furniture) is objects like any other. A closed portal is
    filled by a panel. Results do not depend on what happens to be live: they equal those of a `RayScene` that holds
    everything, up to the rounding of float32, which stays small here however far from the map's origin.

    Not to be used by several threads at a time.
    """

    def __init__(
        self,
        index: ObjectIndex,
        meshes: Sequence[TriangleMesh],
        config: PagingConfig | None = None,
        use_fallback: bool | None = None,
    ) -> None:
        """Take over an index; from here on objects and portals are to be changed through the scene.

        Args:
            index: the objects and, in ``index.regions``, the regions.
            meshes: of the models, in the order of the index.
            config: settings.
            use_fallback: see `RayScene`.

        Raises:
            InvalidValueError: not one mesh for each model.
        """
        if len(meshes) != len(index.bounds):
            raise InvalidValueError("meshes", len(meshes), f"{len(index.bounds)}, one for each model of the index")
        self.index, self.regions, self.config = index, index.regions, config or PagingConfig()
        self.meshes = tuple(meshes)
        self._panel = TriangleMesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]], "panel")
        self._scene = RayScene(use_fallback)
        self._origin = np.zeros(3)
        self._clock = 0
        self._reached: dict[int, int] = {}
        """Live regions, and the update at which each was last within reach."""
        self._live = LiveInstances(self._scene)
        if not self._scene.fallback:
            for mesh in (*self.meshes, self._panel):
                _ = mesh.scene_handle  # hierarchies are built now, not when a room comes into reach
        self._place(index.members(EVERYWHERE).tolist())

    # ------------------------------------------------------------------------------------------------ what is in it

    @property
    def live_regions(self) -> Int32:
        """(K,) regions that are live, ascending."""
        return np.array(sorted(self._reached), np.int32)

    @property
    def live_instances(self) -> int:
        """Number of instances in the live scene, closed portals' panels included."""
        return len(self._live)

    def move(self, number: int, T_map_object: npt.ArrayLike) -> None:
        """Give an object the rigid pose (4, 4), in whatever region that is; see `ObjectIndex.move`."""
        region = self.index.move(number, T_map_object)
        if region != EVERYWHERE and region not in self._reached:
            self._live.retire([number])
        elif number in self._live:
            self._live.move([number], self._poses([number]))
        else:
            self._place([number])

    def add(self, model: int, T_map_object: npt.ArrayLike) -> int:
        """Add an object at a rigid pose (4, 4); returns its id. See `ObjectIndex.add`."""
        number = self.index.add(model, T_map_object)
        region = self.index.region(number)
        if region == EVERYWHERE or region in self._reached:
            self._place([number])
        return number

    def remove(self, number: int) -> None:
        """Take an object out of the world."""
        self.index.remove(number)
        self._live.retire([number])

    def set_open(self, portal: int, is_open: bool) -> None:
        """Open a portal, or close it with a panel."""
        self.regions.set_open(portal, is_open)
        if is_open:
            self._live.retire([-2 - portal])
        elif any(int(region) in self._reached for region in self.regions.sides[portal]):
            self._place([-2 - portal])

    # ------------------------------------------------------------------------------------------------------- paging

    def update(self, positions: npt.ArrayLike) -> PagingReport:
        """Load ahead of the sensors, within the budget, and retire what they left behind. Once a frame.

        Args:
            positions: (3,) or (S, 3) where the sensors are, map frame, metres.
        """
        sensors = np.atleast_2d(np.asarray(positions, np.float64))
        if sensors.ndim != 2 or sensors.shape[1] != 3 or not len(sensors) or not np.isfinite(sensors).all():
            raise InvalidValueError("positions", sensors.shape, "finite (3,) or (S, 3), S >= 1")
        self._clock += 1
        self._keep_origin_near(sensors[0])
        reach, radius = self.config.reach, self.config.ahead + self.index.overhang
        ahead = [self.regions.reachable(sensor, reach, radius) for sensor in sensors]
        regions = np.concatenate([found for found, _ in ahead])
        order = np.argsort(np.concatenate([ways for _, ways in ahead]), kind="stable")
        loaded = waiting = 0
        for region in dict.fromkeys(regions[order].tolist()):
            if region in self._reached:
                self._reached[region] = self._clock
            elif loaded < self.config.budget:
                loaded += self._load(region)
            else:
                waiting += 1
        unloaded = 0
        for region in [r for r, seen in self._reached.items() if seen < self._clock - self.config.linger]:
            if unloaded >= self.config.budget:
                break
            unloaded += self._unload(region)
        self._scene.commit()
        return PagingReport(loaded, unloaded, waiting)

    def require(self, position: npt.ArrayLike, reach: float, radius: float = 0.0) -> int:
        """Make live at once whatever rays can reach; returns the number of instances loaded.

        Args:
            position: (3,) where the rays start, map frame.
            reach: length of the rays, metres.
            radius: rays may start this far from the position, metres.
        """
        regions, _ = self.regions.reachable(position, reach, radius + self.index.overhang)
        loaded = 0
        for region in regions.tolist():
            if region in self._reached:
                self._reached[region] = self._clock
            else:
                loaded += self._load(region)
        return loaded

    # ------------------------------------------------------------------------------------------------------ queries

    def cast(
        self,
        bundle: RayBundle,
        T_map_sensor: npt.ArrayLike,
        max_distance: float | None = None,
        *,
        min_distance: float = 0.0,
        out: RayHits | None = None,
    ) -> PagedHits:
        """Cast a bundle from one sensor pose.

        Args:
            bundle: the rays.
            T_map_sensor: (4, 4).
            max_distance: farthest hit, in multiples of the directions' length; None takes what brings the longest
                direction to ``config.reach``. A large number makes large parts of the world live.
            min_distance: nearest hit, likewise.
            out: results to overwrite.

        Raises:
            InvalidValueError: `max_distance` is not finite.
        """
        T = np.array(T_map_sensor, np.float64)
        if T.shape != (4, 4):
            raise InvalidValueError("T_map_sensor", T.shape, "(4, 4)")
        limit = self._reach_for(bundle.directions, T[:3, 3], 0.0, max_distance)
        T[:3, 3] -= self._origin
        hits = self._scene.cast(bundle, T, limit, min_distance=min_distance, out=out)
        return self._live.signed(hits)

    def cast_rays(
        self,
        origins: npt.ArrayLike,
        directions: npt.ArrayLike,
        max_distance: float | None = None,
        *,
        min_distance: float = 0.0,
        packing: RayBundle | None = None,
        out: RayHits | None = None,
    ) -> PagedHits:
        """Cast rays that each have their own origin, such as those of a lidar under way; see `RayScene.cast_rays`.

        All regions that rays from anywhere in the ball around the origins could reach are made live, so the origins
        should lie near one another.

        Args:
            origins: (N, 3), map frame, metres.
            directions: (N, 3), map frame.
            max_distance: see `cast`.
            min_distance: see `cast`.
            packing: see `RayScene.cast_rays`.
            out: results to overwrite.
        """
        starts, rays = np.asarray(origins, np.float64), np.ascontiguousarray(directions, np.float32)
        if rays.ndim != 2 or rays.shape[1] != 3 or starts.shape != rays.shape:
            raise InvalidValueError("origins, directions", (starts.shape, rays.shape), "two arrays (N, 3)")
        usable = starts[np.isfinite(starts).all(axis=1)]
        if not len(usable):
            usable = np.zeros((1, 3))
        middle = usable.min(axis=0) + 0.5 * np.ptp(usable, axis=0)
        radius = float(np.linalg.norm(usable - middle, axis=1).max())
        limit = self._reach_for(rays, middle, radius, max_distance)
        arguments = {"min_distance": min_distance, "packing": packing, "out": out}
        return self._live.signed(self._scene.cast_rays(starts - self._origin, rays, None, limit, **arguments))

    # -------------------------------------------------------------------------------------------------- life and end

    def close(self) -> None:
        """Release the live scene; using it afterwards raises RaycastError."""
        self._scene.close()

    def __enter__(self) -> "PagedScene":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # ------------------------------------------------------------------------------------------------------ internals

    def _reach_for(self, directions: Float32, position: Float64, radius: float, max_distance: float | None) -> float:
        """Make live what rays along `directions` can meet; returns their limit in multiples of the direction."""
        longest = float(_longest(directions))
        limit = self.config.reach / max(longest, 1e-12) if max_distance is None else max_distance
        if not 0 <= limit < np.inf:
            raise InvalidValueError("max_distance", max_distance, "a finite number >= 0")
        self._keep_origin_near(position)
        self.require(position, limit * longest, radius)
        return limit

    def _keep_origin_near(self, position: Float64) -> None:
        if np.abs(position - self._origin).max() > _FAR:
            self._origin = np.round(position / _ORIGIN_STEP) * _ORIGIN_STEP
            self._live.move(self._live.owners, self._poses(self._live.owners))

    def _poses(self, owners: Sequence[int]) -> Float64:
        """(K, 4, 4) of objects and panels in the frame of the live scene."""
        numbers = np.array(owners, np.int64)
        out = np.empty((len(numbers), 4, 4))
        out[numbers >= 0] = self.index.poses(numbers[numbers >= 0])
        for k in np.flatnonzero(numbers < 0):
            out[k] = self.regions.rectangle(-2 - int(numbers[k]))
        out[:, :3, 3] -= self._origin
        return out

    def _load(self, region: int) -> int:
        portals = self.regions.portals_of(region)
        panels = -2 - portals[~self.regions.is_open[portals]]
        loaded = self._place([*self.index.members(region).tolist(), *panels.tolist()])
        self._reached[region] = self._clock
        return loaded

    def _unload(self, region: int) -> int:
        del self._reached[region]
        portals = self.regions.portals_of(region)
        unseen = [p for p in portals.tolist() if self._reached.keys().isdisjoint(self.regions.sides[p].tolist())]
        return self._live.retire([*self.index.members(region).tolist(), *(-2 - p for p in unseen)])

    def _place(self, owners: Sequence[int]) -> int:
        """Make objects and panels live that are not so yet; returns how many."""
        new = [owner for owner in owners if owner not in self._live]
        models = iter(self.index.models([owner for owner in new if owner >= 0]).tolist())
        meshes = [self._panel if owner < 0 else self.meshes[next(models)] for owner in new]
        self._live.place(new, meshes, self._poses(new))
        return len(new)


@njit(cache=True, nogil=True)
def _longest(directions):
    """Largest length of (N, 3) vectors; those that are not finite do not count."""
    largest = np.float32(0.0)
    for i in range(directions.shape[0]):
        squared = directions[i, 0] ** 2 + directions[i, 1] ** 2 + directions[i, 2] ** 2
        if squared > largest and squared < np.inf:
            largest = squared
    return np.sqrt(largest)
