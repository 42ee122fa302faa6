"""The static map as the localizer sees it: a ray-cast surface with denoised normals."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from simtrack.contracts import Bool, Float32, Float64, Int32, StaticMap
from simtrack.errors import MeshError
from simtrack.perception.localization.measurement import Measurement
from simtrack.raycast import RayBundle, RayHits, RayScene, TriangleMesh

MAX_BACK_FACES = 3
"""Surfaces in a row that a ray passes from behind."""

PASSED_OVER = 0.15
"""m: a shot that reaches through a surface is attributed to the next if it ends so close to that."""

_PADDING = 1024
"""Numbers of rays are rounded up to multiples of this, so that their packing is made seldom."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Shots aimed from a pose, and what each would have met; overwritten when the surface casts again."""

    origins: Float32
    """(N, 3), map frame, metres."""
    directions: Float32
    """(N, 3), map frame, unit."""
    ranges: Float32
    """(N,), metres, as measured."""
    sigmas: Float32
    """(N,), metres, standard deviation of the ranges."""
    hits: RayHits
    """Of N rays."""
    passed: Bool
    """(N,), True where the first surface was passed over."""

    def __len__(self) -> int:
        return len(self.ranges)


class _Room:
    """Arrays for a number of rays that casts use again and again."""

    def __init__(self, capacity: int) -> None:
        from simtrack.perception.localization.correspondences import ROWS
        from simtrack.perception.localization.kernels import Follow

        self.capacity = capacity
        self.origins, self.directions = np.empty((2, capacity, 3), np.float32)
        self.ranges, self.sigmas = np.empty((2, capacity), np.float32)
        self.hits = RayHits.empty(capacity)
        self.passed = np.empty(capacity, np.bool_)
        self.onward_origins, self.onward_directions = np.empty((2, capacity, 3), np.float32)
        self.onward = RayHits.empty(capacity)
        self.follow = Follow(
            np.empty(capacity, np.int32),
            np.empty(capacity, np.float32),
            np.empty(capacity, np.int8),
            np.empty(capacity, np.int8),
        )
        self.pairs = np.empty((ROWS, capacity), np.float32)
        self.patches = np.empty(capacity, np.int32)


class MapSurface:
    """A static map in a ray-cast scene, which may hold other things too. Used by one thread at a time."""

    def __init__(
        self, static_map: StaticMap, scene: RayScene | None = None, instance: int = 0, correlation: float = 0.6
    ) -> None:
        """Put the map into a scene of its own, or use one that holds it already.

        Args:
            static_map: the survey.
            scene: a scene that holds the map's mesh in the map frame; other instances in it occlude the map, but the
                pose is never corrected by them.
            instance: the map's instance id in `scene`.
            correlation: m, side of the patches of the map whose errors count as one. A surface error with a Gaussian
                correlation of standard deviation s has one independent value per 2 pi s^2: 2.5 s.

        Raises:
            MeshError: the map's mesh is empty or not finite.
        """
        if not len(static_map.faces) or not np.isfinite(static_map.vertices).all():
            raise MeshError("static map", "needs at least one face, and finite vertices")
        self.static_map = static_map
        if scene is None:
            scene = RayScene()
            scene.add(TriangleMesh(static_map.vertices, static_map.faces, source="static map"), instance=instance)
        self.scene = scene
        self.instance = instance
        normals = smoothed_normals(static_map.vertices, static_map.faces)
        patches, count = surface_patches(static_map.vertices, static_map.faces, normals, correlation)
        self._planes = np.column_stack([normals, patches]).astype(np.float32)  # side by side: one look-up a ray
        self._counts = np.zeros(count, np.int32)
        self._room: _Room | None = None
        self.patch_variance = static_map.noise**2
        """m^2, of the error that a patch's planes share."""
        self.floor = float(np.median([room.floor for room in static_map.rooms])) if static_map.rooms else 0.0
        """m, height of the map's floor."""

    def cast(self, T_map_base: Float64, shots: Measurement, stride: int = 1, reach: float = 2.0 * PASSED_OVER) -> View:
        """What every `stride`-th block of shots would have met from `T_map_base`.

        That is the first surface that faces the sensor, unless the shot was measured to reach through it, by more than
        `reach` metres, and ends at the next one: then the first is something that has been taken away since the survey.
        Surfaces seen from behind do not count (the sensor would stand in a thing that is gone).
        """
        from simtrack.perception.localization.kernels import aim, thinned_count, unsettled

        count = thinned_count(len(shots), stride)
        room, padded = self._room_for(count), -(-count // _PADDING) * _PADDING
        aimed = room.origins[:padded], room.directions[:padded], room.ranges[:padded], room.sigmas[:padded]
        aim(T_map_base, shots.origins, shots.directions, shots.ranges, shots.sigmas, stride, aimed)
        self.scene.cast_rays(aimed[0], aimed[1], packing=_in_order(padded), out=_first(room.hits, padded))
        shots_aimed = room.origins[:count], room.directions[:count], room.ranges[:count], room.sigmas[:count]
        view = View(*shots_aimed, _first(room.hits, count), room.passed[:count])
        hits = view.hits
        seen = view.directions, view.ranges, hits.distances, hits.normals
        going_on = unsettled(count, *seen, reach, MAX_BACK_FACES, room.follow, view.passed)
        while going_on:
            going_on = self._go_on(view, room, going_on, reach)
        return view

    def _go_on(self, view: View, room: _Room, count: int, reach: float) -> int:
        """Cast the rays of `room.follow` once more; returns how many are left."""
        from simtrack.perception.localization.kernels import advance, aim_onward

        origins, directions = room.onward_origins[:count], room.onward_directions[:count]
        aim_onward(count, room.follow, view.origins, view.directions, origins, directions)
        onward = self.scene.cast_rays(origins, directions, out=_first(room.onward, count))
        rules = reach, PASSED_OVER, MAX_BACK_FACES
        met = _arrays(view.hits), _arrays(onward)
        return advance(count, view.directions, view.ranges, *met, *rules, room.follow, view.passed)

    def pair(self, T_map_base: Float64, view: View, gate: float, pointing_sigma: float) -> tuple[Float32, int]:
        """Correspondences of a view that was cast from `T_map_base` (4, 4), overwritten by the next ones.

        Args:
            T_map_base: pose of the cast.
            view: what was met.
            gate: m, the largest distance from the plane.
            pointing_sigma: rad, of a shot's direction.

        Returns:
            (`correspondences.ROWS`, N) correspondences, and how many columns of them are filled.
        """
        from simtrack.perception.localization.correspondences import pair

        room = self._room_for(len(view))
        shots = view.origins, view.directions, view.ranges, view.sigmas
        limits = gate, pointing_sigma, self.patch_variance
        space = self._counts, room.patches, room.pairs
        count = pair(T_map_base, shots, _arrays(view.hits), self._planes, self.instance, *limits, *space)
        return room.pairs, int(count)

    def _room_for(self, count: int) -> _Room:
        if self._room is None or self._room.capacity < count:
            self._room = _Room(-(-count // _PADDING) * _PADDING)
        return self._room


def _first(hits: RayHits, count: int) -> RayHits:
    return RayHits(hits.distances[:count], hits.normals[:count], hits.faces[:count], hits.instances[:count])


def _arrays(hits: RayHits) -> tuple[Float32, Float32, Int32, Int32]:
    return hits.distances, hits.normals, hits.faces, hits.instances


@lru_cache(maxsize=64)
def _in_order(count: int) -> RayBundle:
    """Packing of rays that lie side by side in memory already."""
    return RayBundle.from_directions(np.zeros((count, 3), np.float32))


def surface_patches(vertices: Float32, faces: Int32, normals: Float64, size: float) -> tuple[Int32, int]:
    """(F,) number of the patch that each face belongs to, and how many there are.

    Faces share a patch if their centres lie in the same cube of side `size` and they face the same way by and large.
    """
    centres = np.asarray(vertices, dtype=np.float64)[faces].mean(axis=1)
    cells = np.floor((centres - centres.min(axis=0)) / size).astype(np.int64)
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0)
    extent = cells.max(axis=0) + 1
    keys = ((cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]) * 6 + side
    unique, patches = np.unique(keys, return_inverse=True)
    return patches.astype(np.int32), len(unique)


def smoothed_normals(vertices: Float32, faces: Int32, rounds: int = 3, crease: float = 0.8) -> Float64:
    """(F, 3) unit face normals, averaged by area over neighbouring faces that point about the same way.

    A survey's noise tilts every face at random, which would feign information about directions along a wall.
    Bilateral: faces whose normals differ by more than ``acos(crease)`` are not averaged.
    """
    from simtrack.perception.localization.kernels import average_normals

    corners = np.asarray(vertices, dtype=np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.sqrt((normals * normals).sum(axis=1))
    normals /= np.maximum(areas, 1e-15)[:, None]
    for _ in range(rounds):
        normals = average_normals(normals, areas, np.asarray(faces, np.int64), len(vertices), crease)
    return normals
