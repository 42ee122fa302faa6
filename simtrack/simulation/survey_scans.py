"""A survey by simulated scans: stations in every room, fused to one surface by the volume that maps are made of.

This is how the tracking paper's map came about: terrestrial scans become a mesh (there by LVR2), which the robot is
then localized in. Unlike `simtrack.simulation.survey.survey`, which displaces the true surface, the mesh has what
scanning gives it: noise, rounded edges, and holes where no station looked.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh, decimate
from simtrack.geometry.transforms import perturb, transform
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.simulation.building.parts import StaticPart, StaticWorld

_SIDES = tuple(
    np.array(rows, float)
    for rows in (
        [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[0, 0, -1], [1, 0, 0], [0, -1, 0]], [[-1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, -1]], [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    )
)  # fmt: skip
"""Rotations of the six pinhole images (optical frames) that together look everywhere."""


@dataclass(frozen=True, slots=True)
class ScanSurveyConfig:
    """How the stations stand and measure."""

    voxel: float = 0.04
    """Metres, of the volume."""
    height: float = 1.6
    """Metres of the scanner above the floor."""
    area: float = 8.0
    """Square metres of floor for each station, of which every room has three at least."""
    clearance: float = 0.5
    """Metres from a station to the nearest surface."""
    pixels: int = 420
    """Of a side of each of a station's six images."""
    reach: float = 12.0
    """Metres."""
    noise: float = 0.004
    """Metres, standard deviation of a range."""
    registration: tuple[float, float] = (0.003, 0.0005)
    """Metres and radians: standard deviations of a station's registered pose, for each axis."""

    def __post_init__(self) -> None:
        for name in ("voxel", "height", "area", "clearance", "reach"):
            if not 0.0 < getattr(self, name) < 100.0:
                raise InvalidValueError(f"ScanSurveyConfig.{name}", getattr(self, name), "above 0 and below 100")
        if not 32 <= self.pixels <= 4096:
            raise InvalidValueError("ScanSurveyConfig.pixels", self.pixels, "32 to 4096")
        if not 0.0 <= min(self.noise, *self.registration) <= max(self.noise, *self.registration) <= 0.1:
            value = (self.noise, self.registration)
            raise InvalidValueError("ScanSurveyConfig.noise, registration", value, "0 to 0.1")


def scanned_parts(
    world: StaticWorld,
    parts: Sequence[StaticPart],
    rng: np.random.Generator,
    max_faces: int,
    config: ScanSurveyConfig | None = None,
) -> list[tuple[StaticPart, Mesh]]:
    """What scans show of the parts of a world.

    Args:
        world: whose rooms the stations stand in.
        parts: as they stood when the survey was made.
        rng: of the noise and the stations.
        max_faces: about the largest number of triangles, of all parts together.
        config: settings, the defaults if None.

    Returns:
        Parts that were seen, each with its surface in the map frame.
    """
    from simtrack.perception.mapping.panoptic.entities import extract_surface
    from simtrack.perception.mapping.panoptic.volume import Volume, VolumeConfig

    config = config or ScanSurveyConfig()
    volume = Volume(VolumeConfig(voxel=config.voxel, max_blocks=2_000_000))
    half = config.pixels / 2
    camera = CameraIntrinsics(config.pixels, config.pixels, half, half, half - 0.5, half - 0.5)
    bundle = RayBundle.from_camera(camera)
    with RayScene() as scene:
        for number, part in enumerate(parts):
            scene.add(TriangleMesh(part.mesh.vertices, part.mesh.faces), part.T_map_part, instance=number)
        for station in stations(world, scene, config, rng):
            deviations = np.repeat(config.registration, 3)
            T_true = perturb(transform(None, station), rng.standard_normal(6) * deviations)
            for side in _SIDES:
                T = T_true @ transform(side)
                hits = scene.cast(bundle, T, config.reach)
                depth, labels = _image(hits.distances, hits.instances, hits.hit, bundle, config, rng)
                stated = transform(None, station) @ transform(side)
                volume.integrate(depth, None, labels, camera, stated)
    volume.order()
    surface = extract_surface(volume, 1e-3)
    whole, owners = surface.mesh, surface.labels
    share = min(1.0, max_faces / max(len(whole.faces), 1))
    found = []
    for number, part in enumerate(parts, start=1):
        chosen = np.flatnonzero(owners == number)
        if len(chosen) < 4:
            continue
        used, faces = np.unique(whole.faces[chosen], return_inverse=True)
        mesh = Mesh(whole.vertices[used], faces.reshape(-1, 3).astype(np.int32))
        found.append((part, decimate(mesh, max(int(share * len(mesh.faces)), 4))))
    return found


def stations(world: StaticWorld, scene: RayScene, config: ScanSurveyConfig, rng: np.random.Generator) -> list[Float64]:
    """(3,) places of scanners: in every room, clear of what stands there, each as far as can be from those before."""
    import shapely

    found: list[Float64] = []
    for room in world.rooms:
        outline = shapely.Polygon(room.polygon)
        x0, y0, x1, y1 = outline.bounds
        grid = np.stack(np.meshgrid(np.arange(x0 + 0.25, x1, 0.5), np.arange(y0 + 0.25, y1, 0.5)), axis=-1)
        flat = grid.reshape(-1, 2)
        inside = shapely.contains_xy(outline, flat[:, 0], flat[:, 1])
        points = np.column_stack([flat[inside], np.full(int(inside.sum()), room.floor + config.height)])
        if not len(points):
            continue
        clear = np.asarray(scene.closest_points(points, 2.0 * config.clearance).distances) > config.clearance
        points = points[clear] if clear.any() else points
        count = min(max(3, round(outline.area / config.area)), len(points))
        chosen = [int(rng.integers(len(points)))]
        while len(chosen) < count:
            away = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(axis=1)
            chosen.append(int(away.argmax()))
        found += [points[k] for k in chosen]
    return found


def _image(
    distances: Float32, instances: Int32, hit: np.ndarray, bundle: RayBundle, config: ScanSurveyConfig,
    rng: np.random.Generator,
) -> tuple[Float32, Int32]:  # fmt: skip
    """Depth along the optical axis (H, W) with noise along the rays, and labels (H, W) from 1."""
    shape = (config.pixels, config.pixels)
    lengths = np.linalg.norm(bundle.directions, axis=1)
    ranges = distances * lengths + config.noise * rng.standard_normal(len(distances)).astype(np.float32)
    depth = np.where(hit, ranges / lengths, 0.0).astype(np.float32).reshape(shape)
    return depth, np.where(hit, instances + 1, 0).astype(np.int32).reshape(shape)
