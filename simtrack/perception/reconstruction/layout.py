"""Floors, walls and ceilings as static bodies: their seen surface, and slabs that collide.

A slab lies behind a plane, under the convex outline of what was seen on it and of what stands on it: furniture hides
much of floor and wall. Doors and windows are closed by it, as far as collisions are concerned.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import Mesh, convex_hull, decimate, transformed
from simtrack.geometry.planes import SurfacePlane
from simtrack.geometry.transforms import apply
from simtrack.perception.scene_graph.contact.graph import ContactGraph, SupportKind, is_layout
from simtrack.perception.scene_graph.contact.nodes import EntityNode

DEPTH = 0.1
"""Metres."""
MARGIN = 0.05
"""Metres that a slab goes beyond the outline, so that corners of rooms are closed."""
LEVEL = np.cos(np.radians(3.0))
"""From here on a floor is taken for level: its planes carry noise, and water finds no slope in rooms."""
SHOWN_FACES = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class Slab:
    """A part of the layout that collides."""

    mesh: Mesh
    """Closed and convex, in the map."""
    normal: Float64
    """(3,), unit: where the room is."""


@lru_cache(maxsize=4096)
def layout_slabs(graph: ContactGraph, name: str) -> tuple[Slab, ...]:
    """Slabs behind the planes of a layout node: those that support something and the main one.

    The main one is the largest that looks at the middle of the scene (a wall may be known from both sides). A node
    whose mesh has no plane has its box.
    """
    node = graph.nodes[name]
    outlines = () if node.shape is None else node.shape.outlines
    if not outlines:
        return (Slab(convex_hull(node.box.corners), node.box.T_map_box[:3, int(np.argmin(node.box.extents))]),)
    middle = _middle(graph)
    towards = [k for k in range(len(outlines)) if float(node.planes[k].distance(middle[None])[0]) > 0.0]
    chosen = {s.plane for s in graph.supports.values() if s.parent == name and 0 <= s.plane < len(outlines)}
    chosen.add(max(towards or range(len(outlines)), key=lambda k: node.planes[k].area))
    return tuple(
        _slab(node.planes[k], np.concatenate([apply(node.T_map_entity, outlines[k]), *_footprints(graph, name, k)]))
        for k in sorted(chosen)
    )


def _footprints(graph: ContactGraph, name: str, plane: int) -> list[Float64]:
    """(4, 3) bottoms of what stands on a plane: there it goes on, though it may not have been seen."""
    children = [
        s.child for s in graph.supports.values() if (s.parent, s.plane, s.kind) == (name, plane, SupportKind.ON)
    ]
    bottoms = [graph.nodes[child].box.corners[:4] for child in children]
    surface = graph.nodes[name].planes[plane]
    return [corners - surface.distance(corners)[:, None] * surface.normal for corners in bottoms]


@lru_cache(maxsize=2)
def _middle(graph: ContactGraph) -> Float64:
    """(3,) middle of the boxes of all that is no layout; of all, if there is nothing else."""
    things = [node for node in graph.nodes.values() if not is_layout(node)] or list(graph.nodes.values())
    return np.mean([node.box.T_map_box[:3, 3] for node in things], axis=0)


@lru_cache(maxsize=4096)
def layout_mesh(node: EntityNode) -> Mesh | None:
    """The seen surface in the map, decimated; None for a node without a mesh."""
    if node.shape is None:
        return None
    return decimate(transformed(node.shape.mesh, node.T_map_entity), SHOWN_FACES)


def _slab(plane: SurfacePlane, outline: Float64) -> Slab:
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
    return Slab(convex_hull(np.concatenate([grown, grown - DEPTH * normal])), normal)
