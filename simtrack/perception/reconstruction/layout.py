"""Floors, walls and ceilings as static bodies: their seen surface, and slabs that collide.

A slab lies behind a plane, under the convex outline of what was seen on it: furniture hides much of floor and wall.
Doors and windows are closed by it, as far as collisions are concerned.
"""

from collections.abc import Collection

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import Mesh, convex_hull, decimate, transformed
from simtrack.geometry.planes import SurfacePlane
from simtrack.geometry.transforms import apply
from simtrack.perception.scene_graph.contact.graph import ContactGraph, SupportKind
from simtrack.perception.scene_graph.contact.nodes import EntityNode

DEPTH = 0.1
"""Metres."""
MARGIN = 0.05
"""Metres that a slab goes beyond the outline, so that corners of rooms are closed."""
LEVEL = np.cos(np.radians(3.0))
"""From here on a floor is taken for level: its planes carry noise, and water finds no slope in rooms."""
SHOWN_FACES = 20_000


def layout_slabs(node: EntityNode, used: Collection[int] = ()) -> tuple[Mesh, ...]:
    """Convex slabs behind the largest plane of a layout node and behind those that support something (`used`), map.

    One whose mesh has no plane has its box.
    """
    if node.shape is None or not node.planes:
        return (convex_hull(node.box.corners),)
    outlines = node.shape.outlines
    largest = max(range(len(outlines)), key=lambda k: node.planes[k].area, default=None)
    chosen = {k for k in used if 0 <= k < len(outlines)} | (set() if largest is None else {largest})
    slabs = [_slab(node.planes[k], apply(node.T_map_entity, outlines[k])) for k in sorted(chosen)]
    return tuple(slabs) if slabs else (convex_hull(node.box.corners),)


def used_planes(graph: ContactGraph, name: str) -> set[int]:
    """Indices of the planes of a node that something stands on or hangs on."""
    return {s.plane for s in graph.supports.values() if s.parent == name and s.kind is not SupportKind.ROOT}


def layout_mesh(node: EntityNode) -> Mesh | None:
    """The seen surface in the map, decimated; None for a node without a mesh."""
    if node.shape is None:
        return None
    return decimate(transformed(node.shape.mesh, node.T_map_entity), SHOWN_FACES)


def _slab(plane: SurfacePlane, outline: Float64) -> Mesh:
    normal, centre = plane.normal, outline.mean(axis=0)
    if abs(normal[2]) > LEVEL:
        normal = np.array([0.0, 0.0, np.sign(normal[2])])
        outline = outline * [1.0, 1.0, 0.0] + [0.0, 0.0, plane.height_at(float(centre[0]), float(centre[1]))]
    elif abs(normal[2]) < 1.0 - LEVEL:  # the same for walls: upright
        upright = normal * [1.0, 1.0, 0.0]
        normal = upright / np.linalg.norm(upright)
        outline = outline - np.outer((outline - centre) @ normal, normal)
    away = outline - centre
    length = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    grown = outline + away / length * MARGIN
    return convex_hull(np.concatenate([grown, grown - DEPTH * normal]))
