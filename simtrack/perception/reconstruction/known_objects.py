"""Tracked objects are their own CAD: the model that tracks an object stands for it, with its data sheet's physics.

Matching and alignment (sections 4.2 and 4.3 of the reconstruction paper) have nothing left to find for them.
"""

from collections.abc import Mapping

import numpy as np

from simtrack.objects import ObjectModel
from simtrack.objects.cad.builder import assembled
from simtrack.objects.cad.model import CadModel, CadPart, CadSupport
from simtrack.perception.reconstruction.candidates import CadCandidate
from simtrack.perception.scene_graph.contact.nodes import EntityNode

PART = "body"
LEVEL = 0.9
"""Cosine off the vertical up to which a plane can be stood on: -a_th of Eq. 1."""


def known_candidates(
    nodes: Mapping[str, EntityNode], models: Mapping[str, ObjectModel]
) -> dict[str, tuple[CadCandidate, ...]]:
    """The only candidate of each node that is an object with a model, where it was tracked and in its true size.

    Args:
        nodes: by name; the frame of a tracked node is that of its model.
        models: name of a node -> model. Names that are not among the nodes are passed over.
    """
    made: dict[int, CadModel] = {}
    found = {}
    for name, model in models.items():
        if name not in nodes:
            continue
        if id(model) not in made:
            made[id(model)] = cad_model_of(model, nodes[name])
        found[name] = (CadCandidate(made[id(model)], nodes[name].T_map_entity, 1.0),)
    return found


def cad_model_of(model: ObjectModel, node: EntityNode) -> CadModel:
    """An object's model as a rigid CAD model in the object's own frame.

    Args:
        model: with convex parts.
        node: any entity of that model; its planes are the faces that things can stand on.
    """
    part = CadPart(
        name=PART,
        mesh=model.visual,
        convex=model.collision,
        mass=model.mass,
        centre_of_mass=model.centre_of_mass,
        inertia=model.inertia,
        friction=model.friction,
        material="",
    )
    supports = tuple(_supports(node))
    return assembled(
        model.name, model.semantic_class, (part,), (), model.extents, supports, (), (), model.description or model.name
    )


def _supports(node: EntityNode) -> list[CadSupport]:
    """Rectangles around the planes that look up where the object stands as it is modelled."""
    assert node.shape is not None
    found = []
    for plane, outline in zip(node.shape.planes, node.shape.outlines, strict=True):
        if plane.normal[2] < LEVEL:
            continue
        low, high = outline.min(axis=0), outline.max(axis=0)
        centre = np.array([*(low[:2] + high[:2]) / 2, np.median(outline[:, 2])])
        found.append(CadSupport(PART, centre, np.maximum(high - low, 1e-4)[:2], np.inf))
    return found
