"""Small scenes of boxes, right and wrong in one known way."""

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import box_mesh, transformed
from simtrack.geometry.transforms import transform
from simtrack.perception.reconstruction.body_tree import Body, BodyJoint, BodyTree, JointKind, Shape


def at(x: float, y: float, z: float) -> Float64:
    return transform(None, (x, y, z))


def block(
    name: str,
    size: tuple[float, float, float],
    mass: float,
    joint: BodyJoint | None,
    *,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
    convex: bool = False,
) -> Body:
    """A box with its centre at `centre`, as a primitive or as a convex mesh."""
    x, y, z = size
    inertia = mass / 12.0 * np.diag([y * y + z * z, x * x + z * z, x * x + y * y])
    T = at(*centre)
    shape = Shape("convex", mesh=box_mesh(size), T_body_shape=T) if convex else Shape("box", size, T_body_shape=T)
    visual = transformed(box_mesh(size, (180, 120, 60)), T)
    return Body(name, joint, visual, (shape,), mass, np.array(centre), inertia)


def on(parent: str, name: str, T: Float64, kind: JointKind = "floating") -> BodyJoint:
    return BodyJoint(f"{parent}-{name}", kind, parent, T)


def floor() -> Body:
    return block("floor", (4.0, 4.0, 0.1), 0.0, None, centre=(0.0, 0.0, -0.05))


def cabinet(T: Float64) -> Body:
    """Carcass of five boards, 0.6 x 0.5 x 0.8 m, origin in its middle, open towards -y."""
    boards = [
        ((0.6, 0.02, 0.8), (0.0, 0.24, 0.0)),
        ((0.02, 0.48, 0.8), (-0.29, -0.01, 0.0)),
        ((0.02, 0.48, 0.8), (0.29, -0.01, 0.0)),
        ((0.56, 0.48, 0.02), (0.0, -0.01, 0.39)),
        ((0.56, 0.48, 0.02), (0.0, -0.01, -0.39)),
    ]
    shapes = tuple(Shape("convex", mesh=box_mesh(size), T_body_shape=at(*centre)) for size, centre in boards)
    return Body(
        "cabinet", on("floor", "cabinet", T, "fixed"), None, shapes, 25.0, np.zeros(3), np.diag([2.0, 2.2, 1.5])
    )


def door(axis_z: float = 1.0, upper: float = 1.5) -> Body:
    """Hung at the left front edge of the cabinet; a positive turn about -z opens it."""
    joint = BodyJoint(
        "hinge", "revolute", "cabinet", at(-0.3, -0.262, 0.0), np.array([0.0, 0.0, axis_z]), 0.0, upper, 0.2
    )
    return block("door", (0.6, 0.02, 0.8), 5.0, joint, centre=(0.3, 0.0, 0.0), convex=True)


def kitchen(*, cup_above: float = 0.0, door_axis: float = -1.0) -> BodyTree:
    """Floor, cabinet with a door, a cup on top of it, a stool beside it."""
    cup_z = 0.45 + cup_above
    return BodyTree(
        "kitchen",
        (
            floor(),
            cabinet(at(0.0, 0.0, 0.4)),
            door(door_axis),
            block("cup", (0.08, 0.08, 0.1), 0.3, on("cabinet", "cup", at(0.1, 0.0, cup_z)), convex=True),
            block("stool", (0.4, 0.4, 0.45), 4.0, on("floor", "stool", at(1.2, 0.0, 0.225))),
        ),
    )
