"""Models find themselves, whatever their place, scale and turn; and what has no models has no candidates."""

from dataclasses import replace

import numpy as np
import pytest
from test_matching import graph_of

from simtrack.contracts import Float64
from simtrack.geometry.meshes import box_mesh, transformed
from simtrack.geometry.transforms import rotation_from_rpy, transform, yaw_of
from simtrack.objects.cad import CadModel, cad_model, cad_models
from simtrack.perception.reconstruction.shortlist import ShortlistConfig, shortlist
from simtrack.perception.scene_graph.contact import EntityMesh, build_contact_graph, entity_nodes

ALONE = ShortlistConfig(upright=8, tipped=1, opened=0)


def turned_apart(model: CadModel, T: Float64, yaw: float) -> float:
    """Radians from a yaw to the nearest turn that looks the same."""
    apart = (yaw_of(T) - yaw - model.yaw_symmetries + np.pi) % (2.0 * np.pi) - np.pi
    return float(np.abs(apart).min())


@pytest.mark.parametrize("name", ["fridge-french_doors", "bottle-square", "chair-slat_back"])
def test_a_model_finds_itself(name: str) -> None:
    model = cad_model(name)
    scale, yaw = 1.15, 2.0
    graph = graph_of(model, scale, yaw)
    best, *others = shortlist(graph.nodes["thing"], graph, cad_models(model.semantic_class), ALONE)
    assert best.model is model
    assert best.upright
    assert best.scale == pytest.approx(scale, rel=2e-3)
    assert turned_apart(model, best.T_map_model, yaw) < 5e-3
    assert np.allclose(best.T_map_model[:3, 3], [2.0, -1.0, 0.7], atol=3e-3)
    assert best.alignment_error < 1e-3
    assert all(other.alignment_error > best.alignment_error for other in others if other.model is not model)
    assert not best.positions


def test_an_open_door_is_seen() -> None:
    model = cad_model("fridge-french_doors")
    joint = model.joints[0]
    T = transform(rotation_from_rpy(0.0, 0.0, 0.4), np.array([1.0, 0.0, 0.9]))
    mesh = transformed(model.mesh({joint.name: 0.5 * joint.upper}), T)
    nodes, _ = entity_nodes([EntityMesh("thing", "fridge", mesh)], np.random.default_rng(0))
    graph = build_contact_graph(nodes)
    best = shortlist(graph.nodes["thing"], graph, [model], replace(ALONE, opened=2))[0]
    assert turned_apart(model, best.T_map_model, 0.4) < np.radians(15.0)
    assert best.positions.get(joint.name, 0.0) == pytest.approx(0.5 * joint.upper)


@pytest.mark.parametrize(("name", "lies"), [("bottle-square", True), ("cabinet-sideboard", False)])
def test_what_has_doors_never_lies_on_its_side(name: str, lies: bool) -> None:
    model = cad_model(name)
    mesh = transformed(model.mesh(), transform(rotation_from_rpy(np.pi / 2, 0.0, 0.3)))
    mesh = transformed(mesh, transform(None, (0.0, 0.0, -float(mesh.bounds[0, 2]))))
    nodes, _ = entity_nodes([EntityMesh("thing", model.semantic_class, mesh)], np.random.default_rng(0))
    graph = build_contact_graph(nodes)
    found = shortlist(graph.nodes["thing"], graph, [model], replace(ALONE, tipped=4))
    assert any(not candidate.upright for candidate in found) == lies


def test_nothing_to_match() -> None:
    floor = EntityMesh("floor", "floor", box_mesh((4.0, 4.0, 0.1)))
    crate = EntityMesh("crate", "crate", transformed(box_mesh((0.4, 0.3, 0.2)), transform(None, (0.0, 0.0, 0.15))))
    nodes, _ = entity_nodes([floor, crate], np.random.default_rng(0))
    graph = build_contact_graph(nodes)
    assert shortlist(graph.nodes["crate"], graph, []) == ()
    assert shortlist(graph.nodes["floor"], graph, cad_models("box")) == ()
    assert len(shortlist(graph.nodes["crate"], graph, cad_models("box"), ALONE, top=3)) == 3
