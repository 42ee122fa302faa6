"""What is before the upright sides of an entity: walls that a model cannot go into, furniture that blocks a front."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.boxes import OrientedBox
from simtrack.geometry.transforms import apply, inverse
from simtrack.perception.scene_graph.contact import ContactGraph, EntityKind, EntityNode

SIDES: Float64 = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""(4, 2) directions of the upright sides of a box."""
_WALL_AREA = 0.5
"""Square metres of the planes that count as walls."""
_COVERED = 0.3
"""Share of a side's width and height from which it counts as covered by what stands before it."""


def wall_clearances(box: OrientedBox, graph: ContactGraph) -> Float64:
    """(4,) metres from each of `SIDES` of an upright box to the wall before it; inf where there is none."""
    T, half = box.T_map_box, 0.5 * box.extents
    directions = np.column_stack([SIDES, np.zeros(4)]) @ T[:3, :3].T
    middles = T[:3, 3] + (np.abs(SIDES) @ half[:2])[:, None] * directions
    free = np.full(4, np.inf)
    walls = _wall_planes(graph)
    facing = (directions @ walls.normals.T < -0.7) & (T[:3, 3] @ walls.normals.T + walls.offsets > 0.0)
    distances = middles @ walls.normals.T + walls.offsets
    for side, wall in np.argwhere(facing).tolist():
        at = (middles[side] - distances[side, wall] * walls.normals[wall])[:2]
        if (at >= walls.low[wall] - 0.05).all() and (at <= walls.high[wall] + 0.05).all():
            free[side] = min(free[side], max(float(distances[side, wall]), 0.0))
    return free


def furniture_clearances(node: EntityNode, graph: ContactGraph) -> Float64:
    """(4,) metres from the sides to what is articulated and covers a good part of a side's width and height."""
    free = np.full(4, np.inf)
    extents = node.box.extents
    half = 0.5 * extents
    for other in graph.nodes.values():
        shared = min(node.top, other.top) - max(node.bottom, other.bottom)
        if other.kind is not EntityKind.ARTICULATED or other.name == node.name or shared < _COVERED * extents[2]:
            continue
        corners = apply(inverse(node.box.T_map_box), other.box.corners)[:, :2]
        for side, normal in enumerate(SIDES):
            out, width = float(np.abs(normal) @ half[:2]), float(np.abs(normal[::-1]) @ half[:2])
            near, across = float((corners @ normal).min()) - out, corners @ np.abs(normal[::-1])
            covered = min(width, float(across.max())) - max(-width, float(across.min()))
            if near > -_COVERED * out and covered > _COVERED * 2.0 * width:
                free[side] = min(free[side], max(near, 0.0))
    return free


@dataclass(frozen=True, slots=True)
class _WallPlanes:
    """Upright planes of layout: (N, 3) normals, (N,) offsets, (N, 2) lower and upper corners of x, y."""

    normals: Float64
    offsets: Float64
    low: Float64
    high: Float64


@lru_cache(maxsize=2)
def _wall_planes(graph: ContactGraph) -> _WallPlanes:
    found = [
        (plane, apply(wall.T_map_entity, outline)[:, :2])
        for wall in graph.nodes.values()
        if wall.kind is EntityKind.LAYOUT and wall.shape is not None
        for plane, outline in zip(wall.planes, wall.shape.outlines, strict=False)
        if abs(plane.normal[2]) < 0.1 and plane.area > _WALL_AREA
    ]
    return _WallPlanes(
        np.array([plane.normal for plane, _ in found]).reshape(-1, 3),
        np.array([plane.offset for plane, _ in found]),
        np.array([corners.min(axis=0) for _, corners in found]).reshape(-1, 2),
        np.array([corners.max(axis=0) for _, corners in found]).reshape(-1, 2),
    )
