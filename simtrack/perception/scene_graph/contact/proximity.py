"""Proximal relations E: pairs whose boxes overlap, and the volume in which their meshes do."""

import numpy as np

from simtrack.perception.scene_graph.contact.evidence import Posed
from simtrack.perception.scene_graph.contact.kernels import covered
from simtrack.perception.scene_graph.contact.nodes import EntityNode

LEAST_DEPTH = 1e-6
"""Metres: boxes that overlap by less only touch."""
_RECTANGLE = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def box_overlap(first: EntityNode, second: EntityNode) -> float:
    """Vol(B1 and B2) of two upright boxes, cubic metres."""
    height = min(first.top, second.top) - max(first.bottom, second.bottom)
    if height <= LEAST_DEPTH:
        return 0.0
    base = second.box.corners[[0, 1, 3, 2]] * [1.0, 1.0, 0.0]
    T, half = first.box.T_map_box, 0.5 * first.box.extents[:2]
    origin = np.array([T[0, 3], T[1, 3], 0.0])
    area = covered(base, _RECTANGLE, origin, float(T[0, 0]), float(T[1, 0]), half, 0.0, -1.0, 1.0)[1]
    side = min(float(first.box.extents[:2].min()), float(second.box.extents[:2].min()))
    return float(area * height) if area > LEAST_DEPTH * side else 0.0


def interpenetration(first: Posed, second: Posed) -> tuple[float, bool]:
    """Vol(M1 and M2) in cubic metres, and whether it is exact: the hull stands in for a mesh that is open."""
    exact = first.shape.closed and second.shape.closed
    if first.shape.solid is None or second.shape.solid is None:  # a flat sheet encloses nothing
        return 0.0, True
    solids = [body.shape.solid.transform(body.node.T_map_entity[:3]) for body in (first, second)]
    return max(float((solids[0] ^ solids[1]).volume()), 0.0), exact
