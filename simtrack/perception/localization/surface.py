"""The static map as the localizer sees it: a ray-cast surface with denoised normals."""

import numpy as np

from simtrack.contracts import Bool, Float32, Float64, Int32, StaticMap
from simtrack.errors import MeshError
from simtrack.geometry.transforms import apply
from simtrack.perception.localization.measurement import Measurement
from simtrack.raycast import RayHits, RayScene, TriangleMesh

MAX_BACK_FACES = 3
"""Surfaces in a row that a ray passes from behind."""

PASSED_OVER = 0.15
"""m: a shot that reaches through a surface is attributed to the next if it ends so close to that."""


class MapSurface:
    """A static map in a ray-cast scene, which may hold other things too."""

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
        self.normals = smoothed_normals(static_map.vertices, static_map.faces)
        self.patches, count = surface_patches(static_map.vertices, static_map.faces, self.normals, correlation)
        self.patch_variance = static_map.noise**2
        """m^2, of the error that a patch's planes share."""
        self.counts = np.zeros(count, np.int32)
        self.floor = float(np.median([room.floor for room in static_map.rooms])) if static_map.rooms else 0.0
        """m, height of the map's floor."""

    def cast(self, T_map_base: Float64, shots: Measurement) -> tuple[RayHits, Bool]:
        """What each shot would have met from `T_map_base`.

        That is the first surface that faces the sensor, unless the shot was measured to reach through it and ends at
        the next one: then the first is something that has been taken away since the survey. Surfaces seen from behind
        do not count (the sensor would stand in a thing that is gone).

        Returns:
            The hits, and (N,) True where the first surface was passed over.
        """
        origins, directions = apply(T_map_base, shots.origins), shots.directions @ T_map_base[:3, :3].T
        hits = self._first_facing(origins, directions)
        passed = np.zeros(len(shots), bool)
        through = np.flatnonzero(shots.ranges > hits.distances + 2.0 * PASSED_OVER)
        if len(through):
            start = hits.distances[through] + 1e-3
            onward = self._first_facing(origins[through] + start[:, None] * directions[through], directions[through])
            second = start + onward.distances
            ends = np.abs(shots.ranges[through] - second) < PASSED_OVER
            rows = through[ends]
            passed[rows] = True
            hits.distances[rows] = second[ends]
            hits.normals[rows], hits.faces[rows] = onward.normals[ends], onward.faces[ends]
            hits.instances[rows] = onward.instances[ends]
        return hits, passed

    def _first_facing(self, origins: Float64, directions: Float64) -> RayHits:
        hits = self.scene.cast_rays(origins, directions)
        for _ in range(MAX_BACK_FACES):
            behind = np.flatnonzero(np.einsum("ij,ij->i", hits.normals, directions) > 0.0)
            if not len(behind):
                break
            passed = hits.distances[behind] + 1e-3
            onward = self.scene.cast_rays(origins[behind] + passed[:, None] * directions[behind], directions[behind])
            hits.distances[behind] = passed + onward.distances
            hits.normals[behind], hits.faces[behind] = onward.normals, onward.faces
            hits.instances[behind] = onward.instances
        return hits


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
