"""A human hand with forearm: its shape in three rigid parts, and the poses of the parts for a grip.

Hand frame: origin between the finger tips, z up away from what is gripped, the forearm leaves towards -x. Fingers lie
at +x, the thumb at -x; opening moves them apart along x.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import Mesh, concatenate, painted

if TYPE_CHECKING:
    import manifold3d

PARTS = ("hand/palm", "hand/fingers", "hand/thumb")
"""Names of the bodies; the palm also carries the forearm."""
SIDES = (0.0, 1.0, -1.0)
"""Direction along x in which opening the hand moves each part, by half the opening."""
SKIN, SLEEVE, CUFF = (222, 168, 134), (58, 92, 150), (235, 235, 230)
MAX_OPENING = 0.13
"""Metres between the tips of fingers and thumb."""
FINGER_FRONT = 0.04
"""Metres from the finger pads to the outside of the bent fingers: what a push makes contact with."""
FINGER_WIDTH = 0.08
"""Metres across the four fingers."""
FINGERS = (
    # y, length factor
    (0.031, 0.92),
    (0.0105, 1.0),
    (-0.0105, 0.97),
    (-0.031, 0.84),
)


@dataclass(frozen=True, slots=True, eq=False)
class HandPose:
    """Where the hand is and how wide it is open."""

    T_map_hand: Float64
    """(4, 4)."""
    opening: float
    """Metres between the pads."""


def _ball(centre: Float64, radius: float, segments: int = 14) -> Float64:
    """Points of a sphere."""
    polar = np.linspace(0.0, np.pi, segments // 2 + 1)
    azimuth = np.arange(segments) * (2 * np.pi / segments)
    sin, cos = np.sin(polar)[:, None], np.cos(polar)[:, None]
    points = np.stack([sin * np.cos(azimuth), sin * np.sin(azimuth), np.broadcast_to(cos, (len(polar), segments))], -1)
    return points.reshape(-1, 3) * radius + centre


def _hull(balls: Sequence[tuple[tuple[float, float, float], float]]) -> "manifold3d.Manifold":
    import manifold3d

    points = np.concatenate([_ball(np.array(centre), radius) for centre, radius in balls])
    return manifold3d.Manifold.hull_points(np.ascontiguousarray(points))


def _mesh(solids: "list[manifold3d.Manifold]", color: tuple[int, int, int]) -> Mesh:
    """Union of solids as one coloured mesh."""
    import manifold3d

    data = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).to_mesh()
    vertices = np.asarray(data.vert_properties, dtype=np.float64)[:, :3]
    return painted(Mesh(vertices, np.asarray(data.tri_verts)), color)


def _chain(points: list[tuple[float, float, float]], radii: list[float]) -> "list[manifold3d.Manifold]":
    """Capsules along a polyline."""
    balls = list(zip(points, radii, strict=True))
    return [_hull([a, b]) for a, b in pairwise(balls)]


@cache
def hand_meshes() -> tuple[Mesh, Mesh, Mesh]:
    """Meshes of the parts in the order of `PARTS`, each in its own frame, metres."""
    fingers: list[manifold3d.Manifold] = []
    for y, length in FINGERS:
        reach = 0.088 - 0.088 * length
        points = [(-0.05, 0.85 * y, 0.09), (0.018, y, 0.082), (0.03, y, 0.042), (0.0095, y, reach)]
        fingers += _chain(points, [0.012, 0.011, 0.0095, 0.0085])
    thumb = _chain([(-0.015, 0.03, 0.085), (-0.032, 0.02, 0.05), (-0.0105, 0.006, 0.006)], [0.016, 0.0125, 0.0105])
    back = ((-0.075, 0.026, 0.094, 0.017), (0.012, 0.031, 0.092, 0.014))
    palm = [
        _hull([((x, s * y, z), r) for s in (-1, 1) for x, y, z, r in back]),
        _hull([((-0.07, 0.012, 0.094), 0.022), ((-0.07, -0.012, 0.094), 0.022), ((-0.125, 0.0, 0.115), 0.026)]),
    ]
    along = np.array([-np.cos(0.5), 0.0, np.sin(0.5)])
    wrist = np.array([-0.12, 0.0, 0.112])

    def at(distance: float) -> tuple[float, float, float]:
        x, y, z = wrist + distance * along
        return float(x), float(y), float(z)

    palm += [_hull([(at(0.0), 0.027), (at(0.07), 0.03)])]
    cuff = _mesh([_hull([(at(0.065), 0.036), (at(0.085), 0.037)])], CUFF)
    sleeve = _mesh([_hull([(at(0.08), 0.041), (at(0.2), 0.05), (at(0.4), 0.056)])], SLEEVE)
    return concatenate([_mesh(palm, SKIN), cuff, sleeve]), _mesh(fingers, SKIN), _mesh(thumb, SKIN)
