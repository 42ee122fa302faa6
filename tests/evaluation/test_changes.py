"""Changes between two states, and what an evaluator makes of beliefs that notice them, miss them, or make them up."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import CameraIntrinsics
from simtrack.evaluation.changes import ChangeEvaluator, Thing, changes_between
from simtrack.simulation.changes import UnseenChange

TENTH = 100_000_000
SIZES = {name: np.full(3, 0.1) for name in ("relay-a", "relay-b", "meter")}
places = st.tuples(*[st.floats(-2.0, 2.0)] * 3)
things = st.lists(st.builds(Thing, st.sampled_from(["relay", "meter"]), places), max_size=6)


@settings(max_examples=60)
@given(things, things)
def test_changes_lead_from_one_state_to_the_other(before, after) -> None:
    changes = changes_between(before, after)
    counts = {kind: sum(c.kind == kind for c in changes) for kind in ("moved", "removed", "added")}
    assert len(before) - counts["removed"] + counts["added"] == len(after)
    for name in ("relay", "meter"):  # one class is either gone or new, never both: then it was moved
        kinds = {c.kind for c in changes if c.class_name == name}
        assert not {"removed", "added"} <= kinds


@settings(max_examples=30)
@given(things)
def test_equal_states_have_no_changes_whatever_their_order(state) -> None:
    assert changes_between(state, state[::-1]) == []


def test_equal_things_that_change_places_do_not_change() -> None:
    a, b = Thing("relay", (0.0, 0.0, 0.0)), Thing("relay", (1.0, 0.0, 0.0))
    assert changes_between([a, b], [b, a]) == []
    (moved,) = changes_between([a, b], [b, Thing("relay", (0.0, 2.0, 0.0))])
    assert (moved.kind, moved.before, moved.after) == ("moved", (0.0, 0.0, 0.0), (0.0, 2.0, 0.0))


@pytest.fixture
def rounds(world):
    """Play: all is seen for a second; then the meter is taken away and a relay moved; then all is seen again."""

    def play(believed_later, seen_later=1.0, place_open=True):
        hits = SimpleNamespace(distances=np.full(7, 9.0 if place_open else 0.1))
        rays = SimpleNamespace(scene=SimpleNamespace(cast_rays=lambda *_, **__: hits))
        truth: Any = SimpleNamespace(class_of=lambda name: world.truth(0).objects[name].class_name, rays=lambda _: rays)
        camera = CameraIntrinsics(width=8000, height=8000, fx=400.0, fy=400.0, cx=4000.0, cy=4000.0)
        evaluator = ChangeEvaluator(truth, camera, SIZES)
        first = [world.track(name, k) for k, name in enumerate(SIZES)]
        for k in range(1, 11):
            evaluator.observe(first, world.truth(k * TENTH), dict.fromkeys(SIZES, 1.0), [])
        old = {name: T.copy() for name, T in world.poses.items()}
        world.poses["relay-b"] = world.poses["relay-b"].copy()
        world.poses["relay-b"][:3, 3] += (0.0, 0.3, 0.0)
        done = [
            UnseenChange(10 * TENTH, "meter", old["meter"], None),
            UnseenChange(10 * TENTH, "relay-b", old["relay-b"], world.poses["relay-b"]),
        ]
        for k in range(11, 31):
            now = world.truth(k * TENTH)
            left: Any = SimpleNamespace(
                stamp=now.stamp, T_map_camera=now.T_map_camera,
                objects={name: thing for name, thing in now.objects.items() if name != "meter"},
            )  # fmt: skip
            visible = {"relay-a": 1.0, "relay-b": seen_later}
            evaluator.observe(believed_later(k, first), left, visible, done)
        return {name: metric.value for name, metric in evaluator.metrics(0).items()}

    return play


def test_a_belief_that_follows_has_noticed_everything(rounds, world) -> None:
    def believed(k, first):
        return first if k < 16 else [world.track(name, k) for name in ("relay-a", "relay-b")]

    result = rounds(believed)
    assert result["changes.knowable"] == 2
    assert result["changes.f1"] == result["changes.recall"] == result["changes.precision"] == 1.0
    assert result["changes.time_to_notice.median"] == pytest.approx(0.5, abs=0.11)


def test_a_belief_that_stays_has_noticed_nothing(rounds) -> None:
    result = rounds(lambda k, first: first)
    assert (result["changes.knowable"], result["changes.f1"], result["changes.recall"]) == (2, 0.0, 0.0)
    assert result["changes.precision"] is None


def test_what_was_forgotten_though_it_stands_there_is_a_false_change(rounds, world) -> None:
    result = rounds(lambda k, first: [world.track("relay-b", k)])
    assert result["changes.recall"] == 1.0
    assert result["changes.precision"] == pytest.approx(2 / 3)


def test_nobody_can_notice_what_was_not_seen_again(rounds) -> None:
    result = rounds(lambda k, first: first, seen_later=0.0, place_open=False)
    assert result["changes.knowable"] == 0
    assert result["changes.f1"] is None


def test_where_only_the_old_place_is_seen_the_thing_is_gone(rounds, world) -> None:
    result = rounds(lambda k, first: [world.track("relay-a", k)], seen_later=0.0)
    assert (result["changes.knowable"], result["changes.f1"]) == (2, 1.0)
