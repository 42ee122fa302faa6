"""A floor with simple things on it, to be labelled and rendered."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64
from simtrack.datasets.annotate import Owners
from simtrack.datasets.content import Content, Light, Material, Placed, Shape
from simtrack.geometry.meshes import Mesh, box_mesh, concatenate, cylinder_mesh, painted, transformed
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.objects import box_keypoints
from simtrack.raycast import RayScene, TriangleMesh

REPOSITORY = Path(__file__).resolve().parents[2]
CAMERA = CameraIntrinsics(160, 120, 150.0, 150.0, 79.5, 59.5)
FLOOR = Mesh(box_mesh((4.0, 4.0, 0.1)).vertices - [0.0, 0.0, 0.05], box_mesh((4.0, 4.0, 0.1)).faces)
"""Its upper side is z = 0."""
BRACKET = concatenate(
    [
        transformed(box_mesh((0.3, 0.1, 0.04), (180, 60, 40)), transform(None, (0.0, 0.0, -0.08))),
        transformed(box_mesh((0.04, 0.1, 0.16), (60, 160, 60)), transform(None, (-0.13, 0.0, 0.02))),
    ]
)
"""An L, which hides parts of itself; its box is 0.3 x 0.1 x 0.2 m."""
BOX = box_mesh((0.2, 0.12, 0.08), (40, 80, 200))
CAN = cylinder_mesh(0.05, 0.16, 48, (220, 200, 60))


def look_at(eye: Sequence[float], target: Sequence[float]) -> Float64:
    """(4, 4) T_map_camera, upper edge of the image up."""
    z = np.asarray(target, float) - np.asarray(eye, float)
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return transform(np.stack([x, np.cross(z, x), z], axis=1), np.asarray(eye, float))


def placed(instance: int, mesh: Mesh, T: Float64, category: int | None = 1, scale: float = 1.0) -> Placed:
    """A thing whose ray instance is its id."""
    extents = scale * mesh.extents
    keypoints = box_keypoints(extents) if category is not None else np.empty((0, 3))
    surface = TriangleMesh(mesh.vertices, mesh.faces)
    factors = np.full(3, scale)
    return Placed(instance, instance, f"thing-{instance}", "box", category, surface, T, factors, extents, keypoints)


def standing(mesh: Mesh, x: float, y: float, yaw: float = 0.0, scale: float = 1.0) -> Float64:
    """(4, 4), on the floor."""
    return transform(exp_so3(np.array([0.0, 0.0, yaw])), (x, y, 0.5 * scale * mesh.extents[2]))


def ray_scene(things: Sequence[Placed], floor: bool = True) -> RayScene:
    """The things, and the floor as instance 0."""
    scene = RayScene()
    if floor:
        scene.add(TriangleMesh(FLOOR.vertices, FLOOR.faces), instance=0)
    for thing in things:
        scene.add(thing.mesh, thing.T_map_mesh, instance=thing.ray_instance)
    return scene


def owners(things: Sequence[Placed]) -> Owners:
    """Every ray instance is its own id."""
    return Owners({0: 0} | {thing.ray_instance: thing.instance for thing in things})


def tabletop() -> tuple[Placed, ...]:
    """Two targets and a scaled distractor that hide parts of one another."""
    return (
        placed(1, BRACKET, standing(BRACKET, 0.0, 0.0, 0.4)),
        placed(2, CAN, standing(CAN, 0.16, 0.14, 0.0), 2),
        placed(3, BOX, standing(BOX, -0.15, -0.12, 1.0, 1.3), None, 1.3),
    )


def lamp(x: float, y: float, z: float, strength: float = 0.7, radius: float = 0.0) -> Light:
    """A white point light over the origin's neighbourhood, of its nominal intensity at the origin."""
    position = np.array([x, y, z])
    distance = float(np.linalg.norm(position))
    return Light(position, -position / distance, np.full(3, strength), False, distance, radius)


def content(
    lights: Sequence[Light] = (lamp(0.5, -0.4, 1.2),),
    floor: Material | None = None,
    surface: Material | None = None,
    scene: int = 0,
) -> Content:
    """The tabletop with lights."""
    things = tabletop()
    meshes = (BRACKET, CAN, BOX)
    surface = surface or Material()
    shapes = [Shape(painted(FLOOR, (200, 200, 200)), np.eye(4), floor or Material())]
    shapes += [Shape(mesh, thing.T_map_mesh, surface) for mesh, thing in zip(meshes, things, strict=True)]
    return Content(
        scene, tuple(shapes), things, ray_scene(things), tuple(lights), np.full(3, 0.25), np.array([0.6, 0.7, 0.8]),
        names=("floor", *(thing.name for thing in things)),
    )  # fmt: skip
