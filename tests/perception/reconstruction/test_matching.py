"""Laws of ranking-based matching: Eqs. 7-10 of the reconstruction paper."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import transformed
from simtrack.geometry.transforms import rotation_from_rpy, transform
from simtrack.objects.cad import CadModel, cad_model, cad_models
from simtrack.perception.reconstruction.matching import (
    ORIENTATIONS,
    SUPPORTING,
    UPRIGHT,
    BoxFeatures,
    MatchingConfig,
    assign,
    distinct_orientations,
    matches,
    oriented_costs,
)
from simtrack.perception.scene_graph.contact import (
    ContactGraph,
    EntityMesh,
    SupportKind,
    build_contact_graph,
    entity_nodes,
)


def graph_of(model: CadModel, scale: float = 1.0, yaw: float = 0.0) -> ContactGraph:
    """A model alone in space, scaled and turned."""
    T = transform(scale * rotation_from_rpy(0.0, 0.0, yaw), np.array([2.0, -1.0, 0.7]))
    entity = EntityMesh("thing", model.semantic_class, transformed(model.mesh(), T))
    nodes, _ = entity_nodes([entity], np.random.default_rng(0))
    return build_contact_graph(nodes)


def test_orientations_are_the_turns_of_a_cube() -> None:
    assert ORIENTATIONS.shape == (24, 3, 3)
    assert len({tuple(np.round(R).astype(int).ravel()) for R in ORIENTATIONS}) == 24
    assert np.allclose(np.linalg.det(ORIENTATIONS), 1.0)
    assert np.allclose(ORIENTATIONS @ ORIENTATIONS.transpose(0, 2, 1), np.eye(3))
    assert [k for k in range(24) if ORIENTATIONS[k, 2, 2] > 0.5] == list(UPRIGHT)
    assert np.allclose(ORIENTATIONS[0], np.eye(3))


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(0, 4))
@settings(max_examples=50)
def test_assignment_is_optimal(seed: int, rows: int, columns: int) -> None:
    cost = np.random.default_rng(seed).uniform(0.0, 2.0, (rows, columns))
    pairs, total = assign(cost, unmatched=1.0)
    options = [*range(columns), *([None] * rows)]
    best = min(
        sum(1.0 if j is None else cost[i, j] for i, j in enumerate(choice))
        for choice in itertools.permutations(options, rows)
    )
    assert total == pytest.approx(best)
    assert total == pytest.approx(sum(cost[i, j] for i, j in pairs) + rows - len(pairs))


def test_a_model_finds_itself_upright() -> None:
    model = cad_model("chair-slat_back")
    graph = graph_of(model)
    features = BoxFeatures.of_model(model)
    costs, bounds = oriented_costs(features, features, np.array([0], np.int32), MatchingConfig())
    assert assign(costs[0], 1.0)[1] == pytest.approx(0.0, abs=1e-9)
    assert bounds[0] == pytest.approx(0.0, abs=1e-9)
    found = matches(graph.nodes["thing"], graph, cad_models("chair"))
    assert (found[0].model.name, found[0].orientation) == (model.name, 0)
    # planes of the entity are found by RANSAC, so that a small rest remains
    assert found[0].error < 0.1


@pytest.mark.parametrize(("scale", "turns"), [(0.5, 0), (2.0, 0), (1.0, 1), (1.0, 2), (0.7, 3)])
def test_error_knows_neither_scale_nor_quarter_turns(scale: float, turns: int) -> None:
    model = cad_model("sofa-" + sorted(m.name for m in cad_models("sofa"))[0].partition("-")[2])
    features = BoxFeatures.of_entity((graph := graph_of(model)).nodes["thing"], graph)
    R = ORIENTATIONS[turns]
    moved = BoxFeatures(
        scale * np.abs(R) @ features.extents, features.normals @ R.T, scale * features.offsets, features.supports
    )
    other = BoxFeatures.of_model(cad_models("sofa")[-1])
    upright = np.array(UPRIGHT, np.int32)
    first, _ = oriented_costs(features, other, upright, MatchingConfig())
    second, _ = oriented_costs(moved, other, upright, MatchingConfig())
    assert np.allclose(np.roll(first, turns, axis=0), second)


def test_every_turn_of_a_symmetric_model_counts_once() -> None:
    def symmetric(turns: list[float]) -> CadModel:
        return replace(cad_model("chair-slat_back"), yaw_symmetries=np.array(turns))

    assert len(distinct_orientations(symmetric([0.0]))) == 24
    assert len(distinct_orientations(symmetric([0.0, np.pi]))) == 12
    assert len(distinct_orientations(symmetric([0.0, np.pi / 2, np.pi, -np.pi / 2]))) == 6
    assert len(distinct_orientations(symmetric([0.0, np.pi / 3]))) == 24
    assert distinct_orientations(symmetric([0.0, np.pi / 2, np.pi, -np.pi / 2]))[0] == 0


def test_pruning_loses_nothing() -> None:
    model = cad_model("chair-slat_back")
    graph = graph_of(model, 1.1, 0.3)
    node = graph.nodes["thing"]
    everything = matches(node, graph, cad_models("chair"), top=None)
    shortest = matches(node, graph, cad_models("chair"), top=10)
    assert [m.error for m in everything] == sorted(m.error for m in everything)
    assert np.allclose([m.error for m in shortest], [m.error for m in everything[:10]])
    leaning = matches(node, graph, cad_models("chair"), top=None, upright=False)
    assert {m.orientation for m in leaning}.isdisjoint(UPRIGHT)


def test_support_planes_keep_supporting() -> None:
    model = cad_models("table")[0]
    top = float(model.extents[2]) / 2 + 0.7
    cup = EntityMesh("cup", "cup", transformed(cad_models("cup")[0].mesh(), transform(None, (2.0, -1.0, top + 0.05))))
    table = EntityMesh("table", "table", transformed(model.mesh(), transform(None, (2.0, -1.0, 0.7))))
    nodes, _ = entity_nodes([table, cup], np.random.default_rng(0))
    graph = build_contact_graph(nodes)
    assert graph.supports["cup"].parent == "table" and graph.supports["cup"].kind is SupportKind.ON
    features = BoxFeatures.of_entity(graph.nodes["table"], graph)
    assert features.supports.any()
    for match in matches(graph.nodes["table"], graph, cad_models("table"), top=None):
        given = dict(match.planes.tolist())
        for i in np.flatnonzero(features.supports):
            if int(i) in given:
                normal = ORIENTATIONS[match.orientation] @ match.model.planes[given[int(i)]].normal
                assert normal[2] >= SUPPORTING


def test_config_is_validated() -> None:
    with pytest.raises(InvalidValueError, match=r"MatchingConfig\.up_weight"):
        MatchingConfig(up_weight=-1.0)
