"""The frames in which an entity is compared with models, beyond the reconstruction paper, which has its box alone.

A smallest box around a fridge with an open door is neither as large as the fridge nor turned as it is: what has joints
is compared in the box of its carcass, too. What leans is compared as it would stand if it did not, and put back.
"""

from dataclasses import replace

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.boxes import OrientedBox
from simtrack.geometry.transforms import exp_so3, inverse, transform
from simtrack.perception.reconstruction.surfaces import SurfacePoints
from simtrack.perception.scene_graph.contact import ContactGraph, EntityKind, EntityNode

POINTS = 4000
UPRIGHT = 0.5
"""|z| of a normal below which a surface stands upright."""
PARALLEL = float(np.cos(np.radians(12.0)))
"""Between upright surfaces of a carcass and its box; what is turned more is a door that stands open."""
LEANS = float(np.sin(np.radians(4.0)))
"""Sine of the angle off upright and off level from which a plane leans."""
TRIANGLES = 10
"""Of a mesh from which it tells how a thing leans; a whole box has twelve."""
FLAT = 0.6
"""Share of the largest side of its box that a plane must fill for a thing to be turned that was not seen to lean."""
LEVEL, BESIDE = float(np.cos(np.radians(3.0))), 0.1
"""|z| of the normal of a level plane, and the share of the largest plane's area from which it counts."""
SLICE = 0.02
"""Metres by which open doors are peeled off."""
MIDDLE, FILLED = 0.35, 0.1
"""Half the share of a slice's width that is its middle, and the share of its points there from which on it is carcass:
doors that stand open leave the middle empty."""
FEW = 0.1
"""Share of the points that an even slice would have, below which a slice is empty."""
LEAST = 0.35
"""Share of a side that has to be left."""
CHANGE = 0.05
"""Metres that the carcass has to be smaller than the box, to be another frame."""


def frames(node: EntityNode, graph: ContactGraph) -> tuple[tuple[EntityNode, Float64], ...]:
    """The node as it is compared, and (4, 4) what puts a model that was found so back into the map."""
    assert node.shape is not None
    T_back = leaning_turn(node) if node.kind is EntityKind.RIGID else None
    leans = any(lean.child == node.name for lean in graph.leaning)
    if T_back is not None and (leans or _flat(node)):
        righted = node.moved(inverse(T_back) @ node.T_map_entity), T_back
        return (righted,) if leans else ((node, np.eye(4)), righted)
    if node.kind is EntityKind.ARTICULATED:
        carcass = carcass_box(node)
        if carcass is not None:
            return (node, np.eye(4)), (replace(node, box=carcass), np.eye(4))
    return ((node, np.eye(4)),)


def _flat(node: EntityNode) -> bool:
    """Whether a thing is known by a broad face, not by a strip or a round side that one plane happens to fit."""
    x, y, z = node.box.extents
    return max(plane.area for plane in node.planes) >= FLAT * max(x * y, y * z, z * x)


def leaning_turn(node: EntityNode) -> Float64 | None:
    """(4, 4) turn about the middle of its box by which a thing leans, seen by its largest plane.

    None if that is nearly upright or level, if the thing has a level plane, too (monitors have slanting screens), or if
    only a few triangles of it were seen.
    """
    if not node.planes or node.shape is None or len(node.shape.mesh.faces) < TRIANGLES:
        return None
    largest = max(node.planes, key=lambda plane: plane.area)
    leaning = largest.normal
    level = any(abs(p.normal[2]) > LEVEL and p.area > BESIDE * largest.area for p in node.planes)
    if level or min(abs(leaning[2]), np.sqrt(1.0 - min(leaning[2] ** 2, 1.0))) < LEANS:
        return None
    straight = leaning * [1.0, 1.0, 0.0] if abs(leaning[2]) < np.sqrt(0.5) else leaning * [0.0, 0.0, 1.0]
    straight = straight / np.linalg.norm(straight)
    axis = np.cross(straight, leaning)
    angle = float(np.arctan2(np.linalg.norm(axis), straight @ leaning))
    middle = transform(None, node.box.T_map_box[:3, 3])
    return middle @ transform(exp_so3(angle * axis / np.linalg.norm(axis))) @ inverse(middle)


def carcass_box(node: EntityNode) -> OrientedBox | None:
    """The box around what is left of an entity without doors that stand open; None if that is its box."""
    assert node.shape is not None
    surface = SurfacePoints.of(node.shape.mesh, POINTS)
    T = node.T_map_entity
    points, normals = surface.points @ T[:3, :3].T + T[:3, 3], surface.normals @ T[:3, :3].T
    upright = np.abs(normals[:, 2]) < UPRIGHT
    if not upright.any():
        return None
    yaw = _main_direction(normals[upright])
    across = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    local, facing = points[:, :2] @ across.T, normals[:, :2] @ across.T
    parallel = np.abs(facing).max(axis=1) > PARALLEL * np.linalg.norm(facing, axis=1)
    low, high = _peeled(local[parallel | ~upright])
    if ((high - low) < LEAST * np.ptp(local, axis=0)).any():
        return None
    extents = np.array([*(high - low), node.box.extents[2]])
    if (np.sort(node.box.extents[:2]) - np.sort(extents[:2])).max() < CHANGE:
        return None
    middle = (*(0.5 * (low + high) @ across), node.box.T_map_box[2, 3])
    return OrientedBox(transform(exp_so3(np.array([0.0, 0.0, yaw])), middle), extents)


def _main_direction(normals: Float64) -> float:
    """Yaw in [-pi/4, pi/4) to which most of (N, 3) normals are parallel or at right angles."""
    angles = np.arctan2(normals[:, 1], normals[:, 0])
    turns = np.radians(np.arange(-45.0, 45.0, 1.0))
    off = (angles - turns[:, None] + np.pi / 4) % (np.pi / 2) - np.pi / 4
    most = int((np.abs(off) < np.radians(3.0)).sum(axis=1).argmax())
    return float(turns[most] + np.median(off[most][np.abs(off[most]) < np.radians(6.0)]))


def _peeled(points: Float64) -> tuple[Float64, Float64]:
    """Lower and upper corner (2,) of what is left of (N, 2) points without slices that only doors reach into."""
    low, high = points.min(axis=0), points.max(axis=0)
    changed = True
    while changed:
        changed = False
        for axis in (0, 1):
            for corner, sign in ((low, 1.0), (high, -1.0)):
                while high[axis] - low[axis] > SLICE and _only_doors(points, low, high, axis, corner[axis], sign):
                    corner[axis] += sign * SLICE
                    points = points[(points[:, axis] - corner[axis]) * sign >= 0.0]
                    low[1 - axis], high[1 - axis] = points[:, 1 - axis].min(), points[:, 1 - axis].max()
                    changed = True
    return low, high


def _only_doors(points: Float64, low: Float64, high: Float64, axis: int, edge: float, sign: float) -> bool:
    """Whether the slice at an edge has nothing in the middle of its width."""
    inwards = (points[:, axis] - edge) * sign
    across = points[inwards < SLICE, 1 - axis]
    if len(across) < FEW * len(points) * SLICE / (high[axis] - low[axis]):
        return len(points) > len(across)
    middle = 0.5 * (low + high)[1 - axis]
    return bool((np.abs(across - middle) < MIDDLE * (high - low)[1 - axis]).mean() < FILLED)
