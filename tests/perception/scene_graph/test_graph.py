from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import Float64, Relation, StaticMap, Status, Track, TrackStatus
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.transforms import exp_so3, inverse, transform
from simtrack.perception.scene_graph import (
    Layer,
    ModelLike,
    RelationConfig,
    SceneGraph,
    SceneGraphConfig,
    model_shape,
)
from simtrack.perception.scene_graph.motion import stacked

Models = dict[str, ModelLike]
TrackMaker = Callable[..., Track]
BENCH_TOP = 0.8
RELAY, TRAY, TUB = 0.025, 0.015, 0.075
"""Half heights."""


def upright(x: float, y: float, z: float, yaw: float = 0.0) -> Float64:
    return transform(exp_so3(np.array([0.0, 0.0, yaw])), (x, y, z))


def on_bench(half: float, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Float64:
    return upright(x, y, BENCH_TOP + half, yaw)


@pytest.fixture
def graph(static_map: StaticMap, models: Models) -> SceneGraph:
    return SceneGraph(static_map, models)


# --------------------------------------------------------------------------------------------------- layers and support


def test_layers_and_support_tree(graph: SceneGraph, track: TrackMaker) -> None:
    graph.update(1, [track("tray", 1, on_bench(TRAY), 1), track("relay", 2, on_bench(RELAY + 2 * TRAY), 1)])
    parents = {entity.name: (entity.layer, entity.parent) for entity in graph.entities.values()}
    assert parents == {
        "lab": (Layer.ROOM, ""),
        "hall": (Layer.ROOM, ""),
        "floor": (Layer.STATIC, "lab"),
        "workbench": (Layer.STATIC, "floor"),
        "shelf": (Layer.STATIC, "floor"),
        "tray-1": (Layer.OBJECT, "workbench"),
        "relay-2": (Layer.OBJECT, "tray-1"),
    }
    assert {entity.name for entity in graph.children("workbench")} == {"tray-1"}
    for entity in graph.entities.values():
        if entity.parent:
            chain = graph.entity(entity.parent).T_map @ entity.T_parent_entity
            np.testing.assert_allclose(chain, entity.T_map, atol=1e-12)


def test_a_thin_supporter_hides_what_it_stands_on(graph: SceneGraph, track: TrackMaker, models: Models) -> None:
    """The floor of the tub is 1 cm thick: the relay is within reach of the bench, but it stands on the tub."""
    tub, relay = track("tub", 1, on_bench(TUB), 1), track("relay", 2, on_bench(RELAY + 0.01), 1)
    relations = graph.update(1, [tub, relay])
    assert Relation("relay-2", "on", "tub-1") in relations
    assert Relation("relay-2", "in", "tub-1") in relations
    assert Relation("relay-2", "on", "workbench") not in relations
    assert graph.entity("relay-2").parent == "tub-1"
    assert Relation("relay-2", "on", "workbench") in graph.update(2, [replace(relay, stamp=2, last_seen=2)])


def test_meshes_tell_containers_from_boxes(models: Models) -> None:
    interior = model_shape(models["tub"]).interior
    assert interior is not None
    np.testing.assert_allclose(interior.extents, [0.388, 0.288, 0.14], atol=0.012)
    np.testing.assert_allclose(interior.centre, [0.0, 0.0, 0.005], atol=0.004)
    assert model_shape(models["relay"]).interior is None


def test_things_are_in_the_room_they_stand_in(graph: SceneGraph, track: TrackMaker) -> None:
    relations = graph.update(1, [track("relay", 1, upright(1.9, 0, 1.0), 1)])
    assert Relation("relay-1", "in", "lab") in relations
    assert Relation("relay-1", "in", "hall") in graph.update(2, [track("relay", 1, upright(2.1, 0, 1.0), 2)])
    assert graph.entity("relay-1").room == "hall"
    assert graph.margin("relay-1", "in", "hall") == pytest.approx(0.1)
    assert not graph.query("in", "lab", "relay-1")


def test_only_believed_tracks_enter_and_refuted_ones_leave(graph: SceneGraph, track: TrackMaker) -> None:
    doubtful = track("relay", 1, on_bench(RELAY), 1, status=TrackStatus.TENTATIVE)
    graph.update(1, [doubtful])
    assert "relay-1" not in graph.entities
    graph.update(2, [track("relay", 1, on_bench(RELAY), 2)])
    assert "relay-1" in graph.entities
    relations = graph.update(3, [track("relay", 1, on_bench(RELAY), 3, status=TrackStatus.LOST)])
    assert "relay-1" not in graph.entities
    assert not any("relay-1" in (r.subject, r.reference) for r in relations)
    assert graph.history("relay-1", "on", "workbench") == ((2, 3),)


def test_what_was_in_a_container_that_left_has_another_parent(graph: SceneGraph, track: TrackMaker) -> None:
    """A relay that leans in a tub, on nothing: once the tub is gone, it is in the room."""
    relay = transform(exp_so3(np.array([0.9, 0.4, 0.0])), (0.1, 0.05, BENCH_TOP + 0.09))
    tub = track("tub", 1, on_bench(TUB), 1)
    graph.update(1, [tub, track("relay", 2, relay, 1)])
    assert graph.entity("relay-2").parent == "tub-1"
    graph.update(2, [track("relay", 2, relay, 2)])
    assert graph.entity("relay-2").parent == "lab"
    assert_history_is_sound(graph)


def test_relations_handed_out_keep_while_the_graph_goes_on(graph: SceneGraph, track: TrackMaker) -> None:
    before = graph.update(1, [track("relay", 1, on_bench(RELAY), 1)])
    held = frozenset(before)
    assert Relation("relay-1", "on", "workbench") in held
    graph.update(2, [track("relay", 1, upright(0, 0, 1.2), 2), track("tray", 2, on_bench(TRAY, y=0.5), 2)])
    assert before == held
    assert len(before) == len(held)
    assert graph.relations != before


def test_tracks_come_back_and_come_in_any_order(graph: SceneGraph, track: TrackMaker) -> None:
    places = {n: on_bench(RELAY, y=0.12 * n) for n in range(-4, 5)}
    for stamp, numbers in enumerate(([0, 1, 2], [0, 1, 2], [2, 1, 0], [4, 0], [-4, 4, 0, 1], []), start=1):
        relations = graph.update(stamp, [track("relay", n, places[n], stamp) for n in numbers])
        on = {r.subject for r in relations if r.name == "on" and r.reference == "workbench"}
        assert on == {f"relay-{n}" for n in numbers}
        for n in numbers:
            np.testing.assert_array_equal(graph.entity(f"relay-{n}").T_map, places[n])


# ------------------------------------------------------------------------------------------------------------- carrying


def random_motion(seed: int) -> Float64:
    rng = np.random.default_rng(seed)
    return transform(exp_so3(np.array([0, 0, rng.uniform(-2, 2)])), rng.uniform((-0.3, -0.3, 0.1), (0.3, 0.3, 0.7)))


@settings(max_examples=8)
@given(motions=st.lists(st.integers(0, 2**32 - 1).map(random_motion), min_size=1, max_size=4))
def test_unseen_children_move_with_their_supporter(models: Models, track: TrackMaker, motions: list[Float64]) -> None:
    """T_map_child = T_map_supporter T_supporter_child, through two levels, until the child itself is seen."""
    graph = SceneGraph(None, models)
    T_tray, T_tub, T_relay = upright(0, 0, TRAY), upright(0, 0, 2 * TRAY + TUB), upright(0.05, 0, 2 * TRAY + 0.035)
    graph.update(1, [track("tray", 1, T_tray, 1), track("tub", 2, T_tub, 1), track("relay", 3, T_relay, 1)])
    assert (graph.entity("relay-3").parent, graph.entity("tub-2").parent) == ("tub-2", "tray-1")
    stamp = 1
    T = np.eye(4)
    for motion in motions:
        T, stamp = motion @ T, stamp + 1
        unseen = [track("tub", 2, T_tub, stamp, seen=False), track("relay", 3, T_relay, stamp, seen=False)]
        relations = graph.update(stamp, [track("tray", 1, T @ T_tray, stamp), *unseen])
        for name, start in (("tub-2", T_tub), ("relay-3", T_relay)):
            assert graph.entity(name).carried
            np.testing.assert_allclose(graph.entity(name).T_map, T @ start, atol=1e-9)
            carried = graph.carried_pose(name)
            assert carried is not None
            np.testing.assert_allclose(carried, T @ start, atol=1e-9)
        assert {Relation("relay-3", "on", "tub-2"), Relation("tub-2", "on", "tray-1")} <= relations
    seen = upright(2.0, 2.0, RELAY)
    graph.update(stamp + 1, [track("tray", 1, T @ T_tray, stamp + 1), track("relay", 3, seen, stamp + 1)])
    np.testing.assert_array_equal(graph.entity("relay-3").T_map, seen)
    assert not graph.entity("relay-3").carried


def test_jitter_of_a_supporter_does_not_move_its_unseen_child(graph: SceneGraph, track: TrackMaker) -> None:
    T_relay = on_bench(RELAY + 2 * TRAY)
    graph.update(1, [track("tray", 1, on_bench(TRAY), 1), track("relay", 2, T_relay, 1)])
    graph.update(2, [track("tray", 1, on_bench(TRAY, x=0.003), 2), track("relay", 2, T_relay, 2, seen=False)])
    np.testing.assert_array_equal(graph.entity("relay-2").T_map, T_relay)


def test_a_carried_child_stays_where_its_supporter_vanished(graph: SceneGraph, track: TrackMaker) -> None:
    T_relay, T_far = on_bench(RELAY + 2 * TRAY), on_bench(TRAY, y=0.5)
    graph.update(1, [track("tray", 1, on_bench(TRAY), 1), track("relay", 2, T_relay, 1)])
    graph.update(2, [track("tray", 1, T_far, 2), track("relay", 2, T_relay, 2, seen=False)])
    graph.update(3, [track("relay", 2, T_relay, 3, seen=False)])
    expected = T_far @ inverse(on_bench(TRAY)) @ T_relay
    np.testing.assert_allclose(graph.entity("relay-2").T_map, expected, atol=1e-12)


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64])
@pytest.mark.parametrize("order", ["C", "F"])
def test_poses_of_any_kind_are_stacked(kind: type, order: str) -> None:
    poses = [np.asarray(transform(None, (n, 2.0, 3.0)), dtype=kind, order=order) for n in range(3)]  # type: ignore[call-overload]
    for chosen in (poses, [*poses, np.full((4, 4), np.nan)], []):
        result = stacked(chosen)
        assert result.dtype == np.float64
        np.testing.assert_array_equal(result, np.array(chosen).reshape(-1, 4, 4))


# ---------------------------------------------------------------------------------------------------------- live update

EXACT = SceneGraphConfig(
    RelationConfig(leave_margin=0.0), move_translation=0.0, move_rotation=0.0, carry_translation=1e6, carry_rotation=4.0
)


def test_surfaces_are_farther_apart_than_boxes(graph: SceneGraph, track: TrackMaker) -> None:
    """A relay in the middle of a tub: within its box, and 8 cm from its walls."""
    relay = on_bench(RELAY + 0.03)
    graph.update(1, [track("tub", 1, on_bench(TUB), 1), track("relay", 2, relay, 1)])
    assert graph.distance("tub-1", "relay-2").signed < 0.0
    found = graph.mesh_distance("tub-1", "relay-2")
    assert found.distance == pytest.approx(0.02, abs=1e-6)  # above the floor of the tub, which is 1 cm thick
    assert not found.crossing
    assert graph.mesh_distance("relay-2", "workbench").distance == pytest.approx(0.03, abs=1e-6)
    assert graph.mesh_distance("relay-2", "shelf", max_distance=0.5).distance == np.inf
    graph.update(2, [track("tub", 1, on_bench(TUB), 2), track("relay", 2, on_bench(RELAY, y=0.16), 2)])
    assert graph.mesh_distance("tub-1", "relay-2").crossing
    with pytest.raises(UnknownNameError, match="workbench"):
        graph.mesh_distance("relay-2", "lab")
    with pytest.raises(UnknownNameError, match="workbench"):
        graph.mesh_distance("banana", "relay-2")


def test_static_surfaces_are_what_the_survey_shows(static_map: StaticMap, models: Models, track: TrackMaker) -> None:
    """Of the bench only a board at 0.7 m was surveyed, and beside it something else."""
    board = np.array([[-0.5, -1, 0.7], [0.5, -1, 0.7], [0.5, 1, 0.7], [-0.5, 1, 0.7]])
    vertices = np.concatenate([board, board + (5.0, 0.0, 0.0)]).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], dtype=np.int32)
    graph = SceneGraph(replace(static_map, vertices=vertices, faces=faces), models)
    graph.update(1, [track("relay", 1, on_bench(RELAY), 1)])
    assert graph.mesh_distance("relay-1", "workbench").distance == pytest.approx(0.1, abs=1e-6)


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_incremental_equals_from_scratch(static_map: StaticMap, models: Models, track: TrackMaker, seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = ["relay", "multimeter", "tray"]
    models = {name: models[name] for name in names}
    classes = {number: names[rng.integers(len(names))] for number in range(25)}
    poses: dict[int, Float64] = {}
    live = SceneGraph(static_map, models, EXACT)
    for stamp in range(1, 7):
        for number in rng.choice(25, 6, replace=False).tolist():
            if number in poses and rng.random() < 0.3:
                del poses[number]
            else:
                half = 0.5 * models[classes[number]].extents[2]
                tilt = rng.uniform(-2, 2, 3) if rng.random() < 0.3 else np.array([0, 0, rng.uniform(-3, 3)])
                poses[number] = transform(
                    exp_so3(tilt), (*rng.uniform(-0.4, 0.4, 2), BENCH_TOP + half * rng.choice([1, 3]))
                )
        tracks = [track(classes[n], n, T, stamp) for n, T in poses.items()]
        fresh = SceneGraph(static_map, models, EXACT)
        assert live.update(stamp, tracks) == fresh.update(stamp, tracks)
        assert live.at(stamp) == live.relations
        assert_history_is_sound(live)


def assert_history_is_sound(graph: SceneGraph) -> None:
    open_now = set()
    for relation, spans in graph.recorded:
        for span, following in zip(spans, [*spans[1:], None], strict=True):
            assert span.end is None or span.begin < span.end
            if following is None:
                open_now |= {relation} if span.end is None else set()
            else:
                assert span.end is not None
                assert span.end < following.begin
    assert open_now == graph.relations


def test_history_answers_for_any_time(graph: SceneGraph, track: TrackMaker) -> None:
    lifted = upright(0.0, 0.0, 1.2)
    for stamp, T in ((10, on_bench(RELAY)), (20, lifted), (30, on_bench(RELAY)), (40, on_bench(RELAY))):
        graph.update(stamp, [track("relay", 1, T, stamp)])
    assert graph.history("relay-1", "on", "workbench") == ((10, 20), (30, None))
    fact = Relation("relay-1", "on", "workbench")
    assert [fact in graph.at(stamp) for stamp in (9, 10, 19, 20, 29, 30, 99)] == [0, 1, 1, 0, 0, 1, 1]
    assert graph.query("on", "workbench", at=15) == [fact]
    assert Relation("workbench", "on", "floor") in graph.at(0)


def test_hysteresis_keeps_a_relation_through_small_motions(
    static_map: StaticMap, models: Models, track: TrackMaker
) -> None:
    rules = RelationConfig(leave_margin=0.004)
    graph = SceneGraph(static_map, models, SceneGraphConfig(rules))
    near = [Relation("relay-1", "near", "relay-2"), Relation("relay-2", "near", "relay-1")]
    for stamp, gap, expected in (
        (1, 0.24, True),
        (2, 0.253, True),
        (3, 0.2545, False),
        (4, 0.253, False),
        (5, 0.249, True),
    ):
        tracks = [track("relay", 1, on_bench(RELAY), stamp), track("relay", 2, on_bench(RELAY, y=0.06 + gap), stamp)]
        assert [r in graph.update(stamp, tracks) or r in graph.relations for r in near] == [expected] * 2


def test_growth_beyond_the_first_capacity(graph: SceneGraph, track: TrackMaker) -> None:
    tracks = [track("relay", n, on_bench(RELAY, 0.4 * np.sin(n), 0.9 * np.cos(n)), 1) for n in range(100)]
    assert len([r for r in graph.update(1, tracks) if r.name == "on" and r.reference == "workbench"]) == 100
    graph.update(2, [])
    assert len(graph.entities) == 5
    assert_history_is_sound(graph)


# ------------------------------------------------------------------------------------------------------------ bad input


def test_stale_stamps_change_nothing(graph: SceneGraph, track: TrackMaker) -> None:
    before = graph.update(10, [track("relay", 1, on_bench(RELAY), 10)])
    for stamp in (10, 5):
        assert graph.update(stamp, []) == before
        assert graph.status is Status.STALE
    graph.update(11, [])
    assert graph.status is Status.OK


def test_a_pose_that_is_not_finite_keeps_the_last_one(graph: SceneGraph, track: TrackMaker) -> None:
    good = on_bench(RELAY)
    before = graph.update(1, [track("relay", 1, good, 1)])
    after = graph.update(
        2, [track("relay", 1, np.full((4, 4), np.nan), 2), track("relay", 2, np.full((4, 4), np.inf), 2)]
    )
    assert graph.status is Status.DEGRADED
    assert after == before
    assert "relay-2" not in graph.entities
    np.testing.assert_array_equal(graph.entity("relay-1").T_map, good)


def test_unknown_names_list_the_known(graph: SceneGraph, track: TrackMaker) -> None:
    with pytest.raises(UnknownNameError, match="multimeter"):
        graph.update(1, [track("banana", 1, np.eye(4), 1)])
    with pytest.raises(UnknownNameError, match="workbench"):
        graph.entity("banana")
    with pytest.raises(UnknownNameError, match="workbench"):
        graph.carried_pose("banana")
    with pytest.raises(UnknownNameError, match="workbench"):
        graph.body("lab")


def test_names_in_the_map_are_unique(static_map: StaticMap, models: Models) -> None:
    twice = replace(static_map, entities=(*static_map.entities, static_map.entities[0]))
    with pytest.raises(InvalidValueError, match="workbench"):
        SceneGraph(twice, models)


def test_distances_and_margins_between_entities(graph: SceneGraph, track: TrackMaker) -> None:
    graph.update(1, [track("relay", 1, on_bench(RELAY), 1), track("relay", 2, on_bench(RELAY, y=0.16), 1)])
    found = graph.distance("relay-1", "relay-2")
    assert found.distance == pytest.approx(0.1)
    assert found.maximum == pytest.approx(np.linalg.norm([0.08, 0.22, 0.05]))
    assert graph.margin("relay-1", "near", "relay-2") == pytest.approx(0.15)
    assert graph.distance("relay-1", "relay-2", measure=lambda a, b: found) is found
