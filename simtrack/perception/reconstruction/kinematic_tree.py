"""Kinematic tree of a functional scene (section 4.5 of the reconstruction paper).

Nodes are the scene root, layout, rigid objects and the rigid parts of articulated ones. The CAD models' own joints are
kept and scaled with alpha. Supporting edges become fixed joints of what a hand does not lift, floating joints of the
rest. The zero of every joint is where it was seen, so that the scene at rest is the scene that was seen.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import transformed
from simtrack.geometry.transforms import inverse, transform
from simtrack.objects.cad.model import CadJoint, CadPart
from simtrack.perception.reconstruction.body_tree import Body, BodyJoint, BodyTree, JointKind, Shape
from simtrack.perception.reconstruction.candidates import CadCandidate
from simtrack.perception.reconstruction.layout import layout_mesh, layout_slabs
from simtrack.perception.scene_graph.contact.graph import ContactGraph, SupportKind, is_far_above, is_layout
from simtrack.perception.scene_graph.contact.nodes import SCENE

FIXED_CLASSES = frozenset(
    {"bathtub", "bed", "cabinet", "column", "counter", "cupboard", "desk", "dishwasher", "door", "door-frame"}
    | {"fridge", "oven", "radiator", "shelf", "sink", "sofa", "stove", "table", "toilet", "wardrobe"}
    | {"washing-machine", "whiteboard", "window", "workbench"}
)
"""Furniture and fittings: their place is fixed."""
LIFTABLE = 23.0
"""Kilograms: load constant of the revised NIOSH lifting equation (Waters et al., 1993); what is heavier is fixed."""
LAYOUT_FRICTION = 0.6
ROOT, GROUND = "scene", "ground"
"""Bodies that stand for no entity."""


def kinematic_tree(
    name: str,
    graph: ContactGraph,
    chosen: Mapping[str, CadCandidate],
    ground: float | None = None,
    parts: Mapping[str, str] | None = None,
    resting: Collection[str] = (),
    fixed: Collection[str] = (),
) -> BodyTree:
    """The tree of a scene.

    Args:
        name: of the scene.
        graph: what supports what.
        chosen: entity -> its aligned model, for all entities but layout.
        ground: height in metres of a level ground that nobody saw; none if None.
        parts: entity -> part of its supporter's model that it stands on; the base if it is not told.
        resting: entities that rest on something, though the support that the graph guesses is far below.
        fixed: entities that do not float, whatever they are.
    """
    of_entity = body_names(graph)
    taken = {*of_entity.values(), GROUND}
    root = Body(ROOT, semantic_class="scene")
    bodies, poses = [root], {ROOT: np.eye(4)}
    links: dict[tuple[str, str], str] = {}
    if ground is not None:
        bodies.append(_ground(GROUND, ROOT, ground))
        poses[GROUND] = np.eye(4)
    for entity in graph.descendants():
        node, body_name = graph.nodes[entity], of_entity[entity]
        parent = of_entity[graph.supports[entity].parent]
        if is_layout(node):
            joint = BodyJoint(f"{body_name}/fixed", "fixed", parent, inverse(poses[parent]))
            shapes = tuple(Shape("convex", mesh=slab.mesh) for slab in layout_slabs(graph, entity))
            poses[body_name] = np.eye(4)
            bodies.append(
                Body(body_name, joint, layout_mesh(node), shapes, friction=LAYOUT_FRICTION,
                     semantic_class=node.semantic_class)
            )  # fmt: skip
            continue
        candidate = chosen[entity]
        grounded = ground is not None and graph.supports[entity].kind is SupportKind.ROOT
        if grounded:
            parent = bodies[1].name
        floats = entity not in fixed and _floats(graph, entity, candidate, grounded, resting)
        kind: JointKind = "floating" if floats else "fixed"
        T_map_base = np.asarray(candidate.T_map_model, float)
        parent = links.get((graph.supports[entity].parent, (parts or {}).get(entity, "")), parent)
        joint = BodyJoint(f"{body_name}/{kind}", kind, parent, inverse(poses[parent]) @ T_map_base)
        made = bodies_of(candidate, body_name, joint, node.semantic_class, taken)
        bodies += made
        for part, body in zip(_parts_in_order(candidate), made, strict=True):
            assert body.joint is not None
            links[entity, part] = body.name
            poses[body.name] = poses[body.joint.parent] @ body.joint.T_parent_body
    return BodyTree(_printable(name), tuple(bodies))


def body_names(graph: ContactGraph) -> dict[str, str]:
    """Entity -> the body in the tree that is all of it, or its base; the scene node's is the root."""
    taken = {ROOT, GROUND}
    return {SCENE: ROOT} | {entity: _unique(_printable(entity), taken) for entity in graph.descendants()}


def _floats(
    graph: ContactGraph, entity: str, candidate: CadCandidate, grounded: bool, resting: Collection[str]
) -> bool:
    held = is_far_above(graph.nodes[entity], graph.supports[entity]) and entity not in resting
    return not held and is_free(graph, entity, candidate, grounded=grounded)


def is_free(graph: ContactGraph, entity: str, candidate: CadCandidate, *, grounded: bool = False) -> bool:
    """Whether a hand can lift the entity: not hung, not furniture, not heavy, and standing on something.

    Children of the scene stand on something if they are `grounded`, on a floor that nobody saw.
    """
    support = graph.supports[entity]
    if support.kind is SupportKind.HUNG or (support.kind is SupportKind.ROOT and not grounded):
        return False
    return graph.nodes[entity].semantic_class not in FIXED_CLASSES and scaled_mass(candidate) <= LIFTABLE


def scaled_mass(candidate: CadCandidate) -> float:
    """Kilograms of an aligned model: material grows with the cube of alpha."""
    return candidate.model.mass * candidate.scale**3


def _parts_in_order(candidate: CadCandidate) -> list[str]:
    """Names of the parts as `bodies_of` makes bodies of them."""
    return [candidate.model.parts[0].name, *(joint.child for joint in candidate.model.joints)]


def bodies_of(candidate: CadCandidate, name: str, joint: BodyJoint, semantic_class: str, taken: set[str]) -> list[Body]:
    """Base and moving parts; the frame of a moving part is at the anchor of its joint."""
    model, scale = candidate.model, candidate.scale
    poses = model.part_poses(candidate.positions)
    anchors = {model.parts[0].name: np.zeros(3)} | {j.child: j.anchor for j in model.joints}
    frames = {part: _frame(poses[part], anchors[part], scale) for part in anchors}
    names = {model.parts[0].name: name}
    bodies = [replace(_body(model.parts[0], np.zeros(3), scale, name, semantic_class), joint=joint)]
    for own in model.joints:
        names[own.child] = _unique(f"{name}/{_printable(own.child)}", taken)
        T_parent_body = inverse(frames[own.parent]) @ frames[own.child]
        body = _body(model.part(own.child), own.anchor, scale, names[own.child], semantic_class)
        moving = _scaled_joint(
            own, scale, candidate.positions.get(own.name, 0.0), name, names[own.parent], T_parent_body
        )
        bodies.append(replace(body, joint=moving))
    return bodies


def _frame(pose: Float64, anchor: Float64, scale: float) -> Float64:
    """(4, 4) T_base_part of the scaled model, its origin at the anchor."""
    return transform(pose[:3, :3], scale * (pose[:3, :3] @ anchor + pose[:3, 3]))


def _body(part: CadPart, anchor: Float64, scale: float, name: str, semantic_class: str) -> Body:
    """A scaled part: mass with alpha^3, inertia with alpha^5."""
    T = np.eye(4)
    T[:3, :3] *= scale
    T[:3, 3] = -scale * anchor
    return Body(
        name=name,
        visual=transformed(part.mesh, T),
        collision=tuple(Shape("convex", mesh=transformed(convex, T)) for convex in part.convex),
        mass=part.mass * scale**3,
        centre_of_mass=scale * (part.centre_of_mass - anchor),
        inertia=part.inertia * scale**5,
        friction=part.friction,
        semantic_class=semantic_class,
    )


def _scaled_joint(
    joint: CadJoint, scale: float, position: float, entity: str, parent: str, T_parent_body: Float64
) -> BodyJoint:
    """A model's own joint: lengths with alpha, forces as weights with alpha^3, torques with alpha^4."""
    slides = joint.kind == "prismatic"
    length = scale if slides else 1.0
    lower, upper = sorted((length * (joint.lower - position), length * (joint.upper - position)))
    return BodyJoint(
        name=f"{entity}/{_printable(joint.name)}",
        kind=joint.kind,
        parent=parent,
        T_parent_body=T_parent_body,
        axis=joint.axis,
        lower=min(lower, 0.0) if joint.kind != "continuous" else 0.0,
        upper=max(upper, 0.0) if joint.kind != "continuous" else 0.0,
        friction=joint.friction * (scale**3 if slides else scale**4),
        damping=joint.damping * (scale**3 if slides else scale**5),
    )


def _ground(name: str, parent: str, height: float) -> Body:
    slab = Shape("box", (20.0, 20.0, 0.1), T_body_shape=transform(None, (0.0, 0.0, height - 0.05)))
    joint = BodyJoint(f"{name}/fixed", "fixed", parent, np.eye(4))
    return Body(name, joint, None, (slab,), friction=LAYOUT_FRICTION, semantic_class="floor")


def _printable(name: str) -> str:
    text = "".join(letter if ord(letter) >= 32 else "_" for letter in name).strip()
    return text or "unnamed"


def _unique(name: str, taken: set[str]) -> str:
    """The name, with a number if it is taken; it is taken from now on."""
    found, number = name, 2
    while found in taken:
        found, number = f"{name}-{number}", number + 1
    taken.add(found)
    return found
