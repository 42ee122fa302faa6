"""What leans: tilted bodies whose centre of mass no support below carries, and that touch another one higher up."""

from collections.abc import Mapping

import numpy as np

from simtrack.geometry.transforms import apply
from simtrack.perception.scene_graph.contact.evidence import ContactConfig, Posed
from simtrack.perception.scene_graph.contact.graph import Leaning, Support, SupportKind
from simtrack.perception.scene_graph.contact.nodes import EntityKind
from simtrack.perception.scene_graph.contact.selection import distance_outside


def find_leaning(
    bodies: Mapping[str, Posed], supports: Mapping[str, Support], config: ContactConfig
) -> tuple[Leaning, ...]:
    """Every leaning body with everything that it leans against."""
    return tuple(
        lean
        for name, support in supports.items()
        if support.kind in (SupportKind.ON, SupportKind.INSIDE) and _needs_hold(bodies[name], config)
        for lean in _against(name, bodies, supports, config)
    )


def _needs_hold(body: Posed, config: ContactConfig) -> bool:
    """Whether a body is tilted and would topple; kept with the body, since it depends on nothing else."""
    if body.needs_hold is None:
        body.needs_hold = is_tilted(body, config) and topples(body, config)
    return body.needs_hold


def is_tilted(body: Posed, config: ContactConfig) -> bool:
    """Whether the body's largest plane is neither level nor upright; without planes, its longest axis."""
    if body.node.kind is EntityKind.LAYOUT:
        return False
    if body.node.planes:
        axis = max(body.node.planes, key=lambda plane: plane.area).normal
    else:
        axis = np.linalg.svd(body.hull - body.hull.mean(axis=0), full_matrices=False)[2][0]
    upright = abs(float(axis[2]))
    return np.sin(config.lean_angle) < upright < np.cos(config.lean_angle)


def topples(body: Posed, config: ContactConfig) -> bool:
    """Whether the centre of mass is beside the hull of what touches the ground."""
    from simtrack.geometry.upright_boxes import horizontal_hull

    mesh = body.shape.mesh  # the coarse one's lowest points may be missing
    lowest = apply(body.node.T_map_entity, mesh.vertices[np.unique(mesh.faces)])
    lowest = lowest[lowest[:, 2] <= body.node.bottom + min(config.touch, 0.1 * float(body.node.box.extents[2]))]
    return distance_outside(horizontal_hull(lowest), body.centre_of_mass[:2]) > 0.005


def _against(
    name: str, bodies: Mapping[str, Posed], supports: Mapping[str, Support], config: ContactConfig
) -> list[Leaning]:
    """Bodies that a body touches in the upper seven tenths of its height, other than its parent and its children."""
    from simtrack.raycast.distance import mesh_distance

    body = bodies[name]
    low, high = body.hull.min(axis=0) - config.touch, body.hull.max(axis=0) + config.touch
    least = body.node.bottom + 0.3 * float(body.node.box.extents[2])
    found = []
    for other, posed in bodies.items():
        if other in (name, supports[name].parent) or supports[other].parent == name:
            continue
        if (posed.hull.min(axis=0) > high).any() or (posed.hull.max(axis=0) < low).any():
            continue
        poses = body.node.T_map_entity, posed.node.T_map_entity
        near = mesh_distance(body.shape.surface, poses[0], posed.shape.surface, poses[1], config.touch)
        if near.distance <= config.touch and near.first[2] >= least:
            found.append(Leaning(name, other, np.asarray(near.first, float)))
    return found
