"""Evaluation of reconstruction: the truth scores perfectly, known faults score as such, runs carry on."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simtrack.errors import InvalidValueError
from simtrack.evaluation import reconstruction_rooms
from simtrack.evaluation.cad_errors import chamfer_distance, rotation_error, symmetries
from simtrack.evaluation.reconstruction import (
    BodyOutcome,
    JointOutcome,
    ModelOutcome,
    RoomOutcome,
    outcome_from_json,
    outcome_to_json,
    summary,
)
from simtrack.evaluation.reconstruction_rooms import (
    RoomTask,
    evaluate_rooms,
    parse_rooms,
    table_5,
    write_results,
)
from simtrack.geometry.meshes import box_mesh, transformed
from simtrack.geometry.transforms import rotation_from_rpy, transform
from simtrack.simulation.building.rooms.families import FAMILIES


def model(name: str, seen: float = 1.0, yaw: float = 0.0, height: float = 1.0) -> ModelOutcome:
    return ModelOutcome(name, "chair", seen, "chair-a", True, 0.0, yaw, 1.0, height, 0.004, 0.006)


def room(name: str = "rooms:1", entities: str = "true", **changes: object) -> RoomOutcome:
    outcome = RoomOutcome(
        room=name, kind="study", entities="partial" if entities == "partial" else "true", nodes=10,
        wrong_support=("cup1",), missing=("book1", "book2"), extra=(), general=6, leaning=(2, 1, 1),
        models=(model("chair1"), model("chair2", seen=0.4, yaw=1.0, height=1.3)),
        bodies=(BodyOutcome("chair1", True, 0.001, 0.002), BodyOutcome("chair2", False, 0.003, None)),
        joints=(JointOutcome("door", True, 1.0, 0.05), JointOutcome("drawer", False, 1.0, 1.0)),
        fixed=("board1",), verdict="not plausible", problems=("problem: chair2: fell",), margin=0.001, agreement=0.5,
        graph_seconds=1.0, seconds=10.0, cpu_seconds=9.0,
    )  # fmt: skip
    return replace(outcome, **changes)


@pytest.mark.parametrize(("family", "orders"), [("chair", 1), ("cabinet", 1), ("book", 4), ("bottle", 6)])
def test_turns_that_map_a_model_onto_itself_are_no_errors(family: str, orders: int) -> None:
    thing = FAMILIES[family](np.random.default_rng(2)).finish(family)
    turns = symmetries(thing)
    assert len(turns) >= orders, "the turns of its construction are among them"
    pose = transform(rotation_from_rpy(0.4, -0.3, 1.1), np.array([1.0, 2.0, 3.0]))
    for turn in turns:
        error = rotation_error(thing, pose, thing, pose @ transform(turn))
        assert max(error.up, error.yaw) < 1e-6
    for yaw in (-2.0 * np.pi / 90.0, np.pi / 60.0):
        error = rotation_error(thing, pose, thing, pose @ transform(rotation_from_rpy(0.0, 0.0, yaw)))
        assert error.yaw == pytest.approx(abs(yaw), abs=1e-9)
        assert error.up < 1e-6


def test_a_chair_on_its_back_or_turned_round_is_wrong() -> None:
    chair = FAMILIES["chair"](np.random.default_rng(2)).finish("chair")
    back = rotation_error(chair, np.eye(4), chair, transform(rotation_from_rpy(np.pi / 2, 0.0, 0.0)))
    assert back.up == pytest.approx(np.pi / 2)
    round_ = rotation_error(chair, np.eye(4), chair, transform(rotation_from_rpy(0.0, 0.0, 2.5)))
    assert (round_.up, round_.yaw) == (pytest.approx(0.0), pytest.approx(2.5))


def test_the_distance_between_surfaces_is_that_of_parallel_sheets() -> None:
    cube = box_mesh((1.0, 1.0, 0.001))
    rng = np.random.default_rng(0)
    assert chamfer_distance(cube, cube, rng) < 0.02
    away = chamfer_distance(cube, transformed(cube, transform(None, np.array([0.0, 0.0, 0.3]))), rng)
    assert away == pytest.approx(0.3, abs=0.005)


def test_figures_are_those_of_the_rooms() -> None:
    second = room("rooms:2", wrong_support=(), missing=(), nodes=30, verdict="plausible",
                  bodies=(BodyOutcome("a", True, 0.0, 0.0),) * 2, agreement=1.0)  # fmt: skip
    figures = {name: metric.value for name, metric in summary([room(), second]).items()}
    assert figures["graph.distance.mean"] == pytest.approx(2.0), "2 x 1 wrong + 2 missing in the first, 0 in the other"
    assert figures["graph.distance_of_nodes"] == pytest.approx(4 / 40)
    assert figures["graph.wrong_support"] == pytest.approx(1 / 40)
    assert (figures["graph.leaning.recall"], figures["graph.leaning.precision"]) == (0.5, 1.0)
    assert (figures["cad.seen_60_to_100.yaw"], figures["cad.seen_30_to_60.yaw"]) == (1.0, 0.0)
    assert figures["cad.seen_30_to_60.height"] == 0.0
    assert figures["cad.seen_0_to_30.yaw"] is None
    assert (figures["physics.stable_scenes"], figures["physics.stable_bodies"]) == (0.5, 0.75)
    joints = [figures[f"physics.joints.{name}"] for name in ("full_range", "can_open", "free")]
    assert joints == [0.5, 0.0, 0.5], "the first is sound but obstructed, the other one is not sound"
    assert figures["physics.agreement"] == pytest.approx(0.75), "each body counts the same"
    unchecked = summary([replace(room(), verdict="not checked", bodies=())])
    assert not any(name.startswith("physics") for name in unchecked)


def test_table_5_stands_both_graphs_of_a_scene_side_by_side() -> None:
    columns, rows = table_5([room(), room(entities="partial", missing=()), room("rooms:2")])
    assert len(columns) == len(rows[0]) == 10
    assert rows[0] == ["rooms:1", "10", "2", "4", "1", "1", "0", "2", "0", "0"]
    assert rows[1][2] == "-"
    assert rows[2][:4] == ["mean", "10.00", "2.00", "4.00"]


def test_outcomes_survive_their_file(tmp_path: Path) -> None:
    assert outcome_from_json(json.loads(json.dumps(outcome_to_json(room())))) == room()
    names = write_results([room(), room(entities="partial")], tmp_path)
    document = json.loads((tmp_path / names[0]).read_text())
    assert document["figures"]["true.graph.distance.mean"]["value"] == 4.0
    assert [outcome_from_json(row) for row in document["rooms"]] == [room(), room(entities="partial")]
    assert "rooms:1" in (tmp_path / names[1]).read_text()


def test_rooms_that_are_done_are_not_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tasks = [RoomTask(seed, False, "true", "graph") for seed in (1, 2)]
    ran: list[str] = []

    def results(tasks: list[RoomTask], _run: object, _workers: int):
        for task in tasks:
            ran.append(task.room)
            yield task, room(task.room)
            if len(ran) == 1:
                raise KeyboardInterrupt

    monkeypatch.setattr(reconstruction_rooms, "as_done", results)
    with pytest.raises(KeyboardInterrupt):
        evaluate_rooms(tasks, tmp_path, 1)
    told: list[tuple[int, int]] = []
    outcomes = evaluate_rooms(tasks, tmp_path, 1, lambda done, of, _: told.append((done, of)))
    assert ran == ["rooms:1", "rooms:2"]
    assert [outcome.room for outcome in outcomes.done] == ["rooms:1", "rooms:2"]
    assert told == [(1, 2), (2, 2)]
    monkeypatch.setattr(reconstruction_rooms, "code_digest", lambda: "other")
    evaluate_rooms(tasks, tmp_path, 1)
    assert ran[2:] == ["rooms:1", "rooms:2"], "results of other code are made anew"
    (tmp_path / tasks[0].file).write_text("{")
    evaluate_rooms(tasks, tmp_path, 1)
    assert ran[4:] == ["rooms:1"]


def test_rooms_are_named_by_seeds_and_ranges() -> None:
    assert parse_rooms("3,rooms:5-6,kitchen:2,3") == [(3, False), (5, False), (6, False), (2, True)]
    assert len(parse_rooms("all")) == 20
    for wrong in ("", "cellar:1", "5-2", "1-x", "kitchen:all"):
        with pytest.raises(InvalidValueError, match="rooms"):
            parse_rooms(wrong)
