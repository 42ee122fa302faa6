"""A robot like PAL Robotics' TIAGo with a VLP-16, written from public facts; shared by simulation and self-filter.

Published figures used: base 0.54 m wide and 1 m/s; torso lift 0.35 m; head pan +-1.24 rad, tilt -0.98 to 0.72 rad;
7-DoF arm with a parallel gripper; camera 1.10 to 1.45 m above the floor; 72 kg. Shapes, link lengths of the arm and the
lidar's mast behind the torso (1.15 m, where torso and head hide a sector from it) are this project's own.
"""

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.kinematics import Joint, KinematicTree, Link
from simtrack.geometry.transforms import transform, transform_xyz_rpy

TORSO, HEAD_PAN, HEAD_TILT = "torso_lift_joint", "head_1_joint", "head_2_joint"
"""Names of the joints that a `Command` moves."""

GRIPPER = "gripper"
"""Name of the link that holds things."""
CAMERA, LIDAR = "camera", "lidar"
"""Names of the links that are sensor frames."""

TUCKED: Mapping[str, float] = MappingProxyType(
    {
        "arm_1_joint": -1.57,
        "arm_2_joint": 1.05,
        "arm_3_joint": 0.0,
        "arm_4_joint": 2.44,
        "arm_5_joint": 0.0,
        "arm_6_joint": -0.25,
        "arm_7_joint": 1.57,
        "gripper_left_finger_joint": 0.02,
        "gripper_right_finger_joint": 0.02,
    }
)
"""Posture of the arm while it is not used: folded across the chest, below the camera's view. Radians, metres."""

WHITE, GREY, DARK, BLUE = (0.93, 0.93, 0.92), (0.55, 0.57, 0.6), (0.13, 0.13, 0.15), (0.1, 0.33, 0.62)
X, Y, Z = np.eye(3)

_Shape = tuple[Float64, Float64]
"""Vertices (V, 3) and faces (F, 3)."""


def _hull(points: Float64) -> _Shape:
    """Convex hull of (N, 3) points."""
    import manifold3d

    mesh = manifold3d.Manifold.hull_points(np.ascontiguousarray(points)).to_mesh()
    return np.asarray(mesh.vert_properties, dtype=np.float64)[:, :3], np.asarray(mesh.tri_verts)


def _ring(radius: float, z: float, segments: int = 28) -> Float64:
    angle = np.arange(segments) * (2 * np.pi / segments)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(segments, z)], axis=1)


def _lathe(*profile: tuple[float, float], at: tuple[float, float] = (0.0, 0.0), segments: int = 28) -> _Shape:
    """Convex solid of revolution about z through ``(radius, z)`` points."""
    return _hull(np.concatenate([_ring(radius, z, segments) + np.array([*at, 0.0]) for radius, z in profile]))


def _rounded(low: tuple[float, float, float], high: tuple[float, float, float], radius: float) -> _Shape:
    """Box between two corners with rounded edges."""
    polar = np.deg2rad([0.0, 35.0, 65.0, 90.0])
    azimuth = np.deg2rad([0.0, 30.0, 60.0, 90.0])
    octant = np.array([(np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)) for p in polar for a in azimuth])
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    corners = np.where(signs > 0, np.array(high) - radius, np.array(low) + radius)
    return _hull(np.concatenate([corner + radius * sign * octant for corner, sign in zip(corners, signs, strict=True)]))


def _limb(length: float, radius_near: float, radius_far: float) -> _Shape:
    """Capsule-like limb along x from the origin."""
    shape = []
    for centre, radius in ((0.0, radius_near), (length, radius_far)):
        for share in (-1.0, -0.8, -0.4, 0.4, 0.8, 1.0):
            ring = _ring(radius * float(np.sqrt(1 - share**2)), 0.0, 14)
            shape.append(np.stack([np.full(14, centre + share * radius), ring[:, 0], ring[:, 1]], axis=1))
    return _hull(np.concatenate(shape))


def _link(
    name: str,
    parent: str,
    joint: Joint | None,
    T: Float64,
    shape: _Shape | None = None,
    mass: float = 0.1,
    color: tuple[float, float, float] = WHITE,
) -> Link:
    vertices, faces = (np.zeros((0, 3)), np.zeros((0, 3))) if shape is None else shape
    return Link(name, parent, joint, T, vertices.astype(np.float32), faces.astype(np.int32), mass, color)


def _fixed(name: str) -> Joint:
    return Joint(f"{name}_joint", "fixed", Z, 0.0, 0.0, 0.0)


def _body() -> list[Link]:
    at = transform_xyz_rpy
    column = _rounded((-0.13, -0.11, 0.28), (0.05, 0.11, 0.72), 0.04)
    inner = _rounded((-0.055, -0.09, -0.48), (0.095, 0.09, -0.15), 0.03)
    badge = _rounded((0.12, -0.06, -0.02), (0.142, 0.06, 0.05), 0.01)
    return [
        _link("base", "", None, np.eye(4), _lathe((0.25, 0.09), (0.27, 0.12), (0.27, 0.24), (0.21, 0.3)), 38.0),
        _link("skirt", "base", _fixed("skirt"), np.eye(4), _lathe((0.235, 0.015), (0.245, 0.09)), 2.0, DARK),
        _link("column", "base", _fixed("column"), np.eye(4), column, 8.0, GREY),
        _link(
            "torso", "base", Joint(TORSO, "prismatic", Z, 0.0, 0.35, 0.07), at((-0.062, 0.0, 0.79)),
            _rounded((-0.08, -0.135, -0.20), (0.135, 0.135, 0.11), 0.06), 9.0,
        ),
        _link("lift_column", "torso", _fixed("lift_column"), np.eye(4), inner, 0.5, DARK),
        _link("badge", "torso", _fixed("badge"), np.eye(4), badge, 0.1, BLUE),
        _link(
            "neck", "torso", Joint(HEAD_PAN, "revolute", Z, -1.24, 1.24, 2.0), at((0.06, 0.0, 0.10)),
            _lathe((0.06, 0.0), (0.05, 0.07), segments=20), 0.8, DARK,
        ),
        # TIAGo's tilt is positive upwards here, so that negative looks down.
        _link(
            "head", "neck", Joint(HEAD_TILT, "revolute", -Y, -0.98, 0.72, 2.0), at((0.0, 0.0, 0.12)),
            _rounded((-0.09, -0.1, -0.06), (0.085, 0.1, 0.15), 0.045), 1.2,
        ),
        _link(
            "visor", "head", _fixed("visor"), np.eye(4), _rounded((0.06, -0.085, 0.055), (0.098, 0.085, 0.125), 0.015),
            0.2, DARK,
        ),
        _link(CAMERA, "head", _fixed(CAMERA), transform(np.stack([-Y, -Z, X], axis=1), (0.102, 0.0, 0.09)), None, 0.1),
    ]  # fmt: skip


def _lidar() -> list[Link]:
    """The VLP-16 (103.3 mm wide, 71.7 mm high) on a mast, open where the laser leaves it."""
    mast, centre = (-0.23, 0.0), 1.15
    base = _lathe((0.0516, centre - 0.036), (0.0516, centre - 0.017), at=mast)
    cap = _lathe((0.0516, centre + 0.017), (0.0516, centre + 0.036), at=mast)
    fixed = np.eye(4)
    return [
        _link(
            "mast",
            "base",
            _fixed("mast"),
            fixed,
            _lathe((0.022, 0.28), (0.018, 1.114), at=mast, segments=14),
            1.0,
            GREY,
        ),
        _link("vlp16_base", "base", _fixed("vlp16_base"), fixed, base, 0.5, GREY),
        _link("vlp16_cap", "base", _fixed("vlp16_cap"), fixed, cap, 0.3, DARK),
        _link(LIDAR, "base", _fixed(LIDAR), transform(translation=(*mast, centre)), None, 0.1),
    ]


def _arm() -> list[Link]:
    at = transform_xyz_rpy
    rows = [
        # name, axis, lower, upper, max velocity, origin in the parent, shape, mass, colour
        (
            "arm_1",
            Z,
            -1.7,
            2.75,
            1.95,
            (0.2, 0.0, -0.13),
            _lathe((0.062, -0.05), (0.062, 0.05), segments=20),
            2.2,
            GREY,
        ),
        ("arm_2", Y, -1.1, 1.5, 1.95, (0.075, 0.0, 0.0), _limb(0.06, 0.052, 0.05), 1.8, WHITE),
        ("arm_3", X, -3.5, 3.5, 2.35, (0.06, 0.0, 0.0), _limb(0.19, 0.05, 0.045), 1.7, WHITE),
        ("arm_4", Y, -0.3, 2.6, 2.35, (0.21, 0.0, 0.0), _limb(0.07, 0.047, 0.043), 1.4, GREY),
        ("arm_5", X, -2.1, 2.1, 1.95, (0.07, 0.0, 0.0), _limb(0.15, 0.043, 0.038), 1.2, WHITE),
        ("arm_6", Y, -1.4, 1.4, 1.76, (0.17, 0.0, 0.0), _limb(0.03, 0.038, 0.036), 0.6, GREY),
        ("arm_7", X, -2.1, 2.1, 1.76, (0.05, 0.0, 0.0), _limb(0.03, 0.036, 0.034), 0.4, WHITE),
    ]
    links, parent = [], "torso"
    for name, axis, lower, upper, speed, origin, shape, mass, color in rows:
        links.append(
            _link(
                name,
                parent,
                Joint(f"{name}_joint", "revolute", axis, lower, upper, speed),
                at(origin),
                shape,
                mass,
                color,
            )
        )
        parent = name
    palm = _rounded((0.02, -0.055, -0.025), (0.09, 0.055, 0.025), 0.012)
    links.append(_link("gripper", "arm_7", _fixed("gripper"), at((0.03, 0.0, 0.0)), palm, 0.7, DARK))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        name = f"gripper_{side}_finger"
        finger = _rounded((0.085, -0.006, -0.011), (0.155, 0.006, 0.011), 0.004)
        joint = Joint(f"{name}_joint", "prismatic", sign * Y, 0.0, 0.045, 0.05)
        links.append(_link(name, "gripper", joint, np.eye(4), finger, 0.1, GREY))
    return links


@cache
def tiago() -> KinematicTree:
    """The robot: links with meshes below 400 faces, joints with limits, frames ``camera`` (optical) and ``lidar``."""
    return KinematicTree((*_body(), *_lidar(), *_arm()))
