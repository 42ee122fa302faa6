"""What an RGB-D camera sees of a settled room on a walk through it: entity meshes with holes and noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh, area, face_areas, subdivide_to
from simtrack.geometry.transforms import transform
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.simulation.building.rooms.physics import SettledRoom
from simtrack.simulation.building.rooms.visibility import visible_faces

CAMERA = CameraIntrinsics(320, 240, 288.5, 288.5, 159.5, 119.5)
"""An Xtion at half its resolution: rays 3.5 mm apart at a metre."""


@dataclass(frozen=True, slots=True)
class WalkConfig:
    """How the walk is made."""

    frames: int = 60
    edge: float = 0.03
    """Metres: mean edge of the triangles that are seen or not."""
    near: float = 0.4
    far: float = 4.0
    """Metres along the optical axis between which there are readings."""
    height: float = 1.35
    """Metres of the camera above the floor."""
    least_readings: int = 2
    """Readings that a triangle needs to be kept."""
    axial_noise: float = 0.0019
    """1/m: the depth's standard deviation is this times the squared depth (Nguyen et al., 3DIMPVT 2012)."""

    def __post_init__(self) -> None:
        if self.frames < 1 or not self.edge > 0 or not 0 < self.near < self.far or self.least_readings < 1:
            raise InvalidValueError("WalkConfig", self, "frames, least_readings >= 1, edge > 0, 0 < near < far")


@dataclass(frozen=True, slots=True, eq=False)
class SeenEntity:
    """What was seen of an entity."""

    name: str
    semantic_class: str
    mesh: Mesh
    """The seen triangles, their vertices where the fused readings put them, map frame; empty if nothing was seen."""
    seen: float
    """Share of the surface that was seen, of what can be seen at all from outside the entity (`visible_faces`)."""


def walk_poses(room: SettledRoom, config: WalkConfig, rng: np.random.Generator) -> list[Float64]:
    """T_map_camera (4, 4) along an ellipse in the room, looking across it, up and down by turns."""
    low, high = room.plan.room.polygon.min(axis=0), room.plan.room.polygon.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2 * 0.62
    start = rng.uniform(0.0, 2.0 * np.pi)
    poses = []
    for k in range(config.frames):
        angle = start + 4.0 * np.pi * k / config.frames
        eye = np.array([*(middle + half * [np.cos(angle), np.sin(angle)]), config.height + rng.normal(0.0, 0.1)])
        # The first turn looks inwards, the second outwards along the walls.
        heading = angle + (np.pi if k < config.frames / 2 else 0.9) + rng.normal(0.0, 0.25)
        pitch = -0.45 + 0.3 * np.sin(5.0 * angle)
        forward = np.array([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)])
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        poses.append(transform(np.stack([right, np.cross(forward, right), forward], axis=1), eye))
    return poses


def partial_entities(
    room: SettledRoom,
    rng: np.random.Generator,
    config: WalkConfig | None = None,
    poses: Sequence[Float64] | None = None,
) -> tuple[SeenEntity, ...]:
    """The entities of a room as fused from the depth images of a walk.

    Every reading hits one small triangle; a triangle with enough readings is kept and its corners move along the
    viewing rays by the mean error of the readings around them, as they would in a fused map.

    Args:
        room: the room at rest.
        rng: draws the walk and the noise.
        config: of the walk.
        poses: (4, 4) T_map_camera each, instead of the walk's own.
    """
    config = WalkConfig() if config is None else config
    meshes = [
        subdivide_to(entity.mesh, max(len(entity.mesh.faces), round(area(entity.mesh) / (0.43 * config.edge**2))))
        for entity in room.entities
    ]
    scene, bundle = RayScene(), RayBundle.from_camera(CAMERA)
    for number, mesh in enumerate(meshes):
        scene.add(TriangleMesh(mesh.vertices, mesh.faces, room.entities[number].name), instance=number)
    counts = [np.zeros(len(mesh.faces)) for mesh in meshes]
    errors = [np.zeros((len(mesh.faces), 3)) for mesh in meshes]
    for T_map_camera in walk_poses(room, config, rng) if poses is None else poses:
        hits = scene.cast(bundle, T_map_camera, config.far)
        depth = np.where(hits.hit, hits.distances, 0.0).astype(np.float64)
        noise = rng.normal(0.0, 1.0, len(depth)) * config.axial_noise * depth**2
        shift = noise[:, None] * (bundle.directions @ T_map_camera[:3, :3].T)
        read = hits.hit & (depth >= config.near)
        for number in np.unique(hits.instances[read]).tolist():
            own = read & (hits.instances == number)
            faces = hits.faces[own]
            counts[number] += np.bincount(faces, minlength=len(counts[number]))
            for axis in range(3):
                errors[number][:, axis] += np.bincount(faces, shift[own, axis], len(counts[number]))
    scene.close()
    seen = zip(room.entities, meshes, counts, errors, strict=True)
    return tuple(_fused(e.name, e.semantic_class, mesh, n, error, config) for e, mesh, n, error in seen)


def _fused(
    name: str, semantic_class: str, mesh: Mesh, counts: np.ndarray, errors: Float64, config: WalkConfig
) -> SeenEntity:
    kept = counts >= config.least_readings
    if not kept.any():
        return SeenEntity(name, semantic_class, Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32)), 0.0)
    corners = mesh.faces[kept].ravel()
    weights = np.bincount(corners, np.repeat(counts[kept], 3), len(mesh.vertices))
    moved = np.stack(
        [np.bincount(corners, np.repeat(errors[kept, axis], 3), len(mesh.vertices)) for axis in range(3)], axis=1
    )
    vertices = mesh.vertices + moved / np.maximum(weights, 1.0)[:, None]
    used, faces = np.unique(corners, return_inverse=True)
    colors = None if mesh.face_colors is None else mesh.face_colors[kept]
    areas = face_areas(mesh)
    share = areas[kept].sum() / areas[kept | visible_faces(mesh)].sum()
    seen = Mesh(vertices[used], faces.reshape(-1, 3).astype(np.int32), colors)
    return SeenEntity(name, semantic_class, seen, float(share))
