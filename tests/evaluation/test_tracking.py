"""Tracking metrics on a small world where every number is known beforehand."""

import numpy as np
import pytest

from simtrack.contracts import TrackStatus
from simtrack.evaluation.floor import FloorEvaluator
from simtrack.evaluation.tracking import TrackingEvaluator, match_tracks

TENTH = 100_000_000
SEEN = {"relay-a": 1.0, "relay-b": 1.0, "meter": 1.0}


def all_tracks(world, stamp=0, **changes):
    return [world.track(name, i + 1, stamp, **changes) for i, name in enumerate(world.poses)]


def values(evaluator):
    return {name: metric.value for name, metric in evaluator.metrics().items()}


def test_perfect_tracks_have_no_error(world, scorers) -> None:
    evaluator = TrackingEvaluator(scorers)
    for k in range(5):
        evaluator.observe(all_tracks(world, k * TENTH), world.truth(k * TENTH), SEEN)
    result = values(evaluator)
    assert result["tracking.recall"] == result["tracking.add_s_auc"] == result["world.known_share"] == 1.0
    assert result["tracking.static.translation_error.p95"] == pytest.approx(0.0, abs=1e-12)
    assert result["tracking.moving.translation_error.median"] is None
    assert result["tracking.false_tracks"] == result["tracking.id_switches"] == 0


def test_static_and_moving_are_told_apart_by_true_speed(world, scorers) -> None:
    evaluator = TrackingEvaluator(scorers)
    world.velocities["meter"] = np.array([0, 0, 0, 0, 0, np.radians(2.1)])
    tracks = [
        world.track("relay-a", 1, xi=(0.001, 0, 0, 0, 0, 0)),
        world.track("relay-b", 2, xi=(0.001, 0, 0, 0, 0, 0)),
        world.track("meter", 3, xi=(0, 0.004, 0, 0, 0, 0.01)),
    ]
    evaluator.observe(tracks, world.truth(0), SEEN)
    result = values(evaluator)
    assert result["tracking.static.translation_error.median"] == pytest.approx(0.001)
    assert result["tracking.moving.translation_error.median"] == pytest.approx(0.004)
    assert result["tracking.moving.rotation_error.median"] == pytest.approx(0.01)


def test_untracked_objects_are_misses_only_where_they_can_be_seen(world, scorers) -> None:
    evaluator = TrackingEvaluator(scorers)
    tracks = [world.track("relay-a", 1), world.track("meter", 3, status=TrackStatus.TENTATIVE)]
    evaluator.observe(tracks, world.truth(0), {"relay-a": 0.9, "relay-b": 0.29, "meter": 0.3})
    result = values(evaluator)
    assert result["tracking.recall"] == 0.5
    assert result["tracking.add_s_auc"] == 0.5
    assert result["world.known_share"] == pytest.approx(1 / 3)


def test_half_hidden_objects_are_told_apart(world, scorers) -> None:
    evaluator = TrackingEvaluator(scorers)
    tracks = [world.track("relay-a", 1), world.track("relay-b", 2, xi=(0, 0.004, 0, 0, 0, 0))]
    evaluator.observe(tracks, world.truth(0), {"relay-a": 0.9, "relay-b": 0.5, "meter": 0.6})
    result = values(evaluator)
    assert result["tracking.occluded.object_frames"] == 2
    assert result["tracking.occluded.recall"] == 0.5
    assert result["tracking.occluded.translation_error.median"] == pytest.approx(0.004)
    evaluator = TrackingEvaluator(scorers)
    evaluator.observe(tracks, world.truth(0), SEEN)
    assert values(evaluator)["tracking.occluded.recall"] is None


def test_matching_is_one_to_one_and_within_ten_centimetres(world) -> None:
    near_both = world.track("relay-a", 1, xi=(0, 0.04, 0, 0, 0, 0))
    duplicate = world.track("relay-a", 2, xi=(0, 0.01, 0, 0, 0, 0))
    far = world.track("meter", 3, xi=(0.11, 0, 0, 0, 0, 0))
    matches = match_tracks([near_both, duplicate, far], world.truth(0))
    assert {name: track.id for name, track in matches.items()} == {"relay-a": 2}


def test_neighbours_of_a_class_get_the_assignment_of_least_distance(world) -> None:
    world.poses["relay-b"] = world.poses["relay-a"].copy()
    world.poses["relay-b"][1, 3] += 0.08
    tracks = [world.track("relay-b", 1), world.track("relay-a", 2)]
    assert {n: t.id for n, t in match_tracks(tracks, world.truth(0)).items()} == {"relay-a": 2, "relay-b": 1}


def test_swapped_identities_are_two_switches(world, scorers) -> None:
    evaluator = TrackingEvaluator(scorers)
    evaluator.observe([world.track("relay-a", 1), world.track("relay-b", 2)], world.truth(0), SEEN)
    evaluator.observe([], world.truth(TENTH), SEEN)
    evaluator.observe([world.track("relay-a", 2), world.track("relay-b", 1)], world.truth(2 * TENTH), SEEN)
    evaluator.observe([world.track("relay-a", 2), world.track("relay-b", 1)], world.truth(3 * TENTH), SEEN)
    assert values(evaluator)["tracking.id_switches"] == 2
    assert evaluator.switches == [(2 * TENTH, "relay-a"), (2 * TENTH, "relay-b")]


@pytest.mark.parametrize(("tenths", "expected"), [(10, 0), (11, 1)])
def test_a_ghost_is_false_after_a_second(world, scorers, tenths: int, expected: int) -> None:
    evaluator = TrackingEvaluator(scorers)
    for k in range(tenths):
        ghost = world.track("meter", 9, k * TENTH, xi=(0.5, 0, 0, 0, 0, 0))
        evaluator.observe([*all_tracks(world), ghost], world.truth(k * TENTH), SEEN)
    assert values(evaluator)["tracking.false_tracks"] == expected


def test_a_stale_track_that_is_not_confirmed_is_no_false_track(world, scorers) -> None:
    evaluator = TrackingEvaluator(scorers)
    for k in range(20):
        stale = world.track("meter", 9, xi=(0.5, 0, 0, 0, 0, 0), status=TrackStatus.OUT_OF_VIEW)
        evaluator.observe([stale], world.truth(k * TENTH), SEEN)
    assert values(evaluator)["tracking.false_tracks"] == 0


def reacquisition_times(world, scorers, visible: list[float], tracked: list[bool]):
    evaluator = TrackingEvaluator(scorers)
    for k, (fraction, found) in enumerate(zip(visible, tracked, strict=True)):
        tracks = [world.track("meter", 1, k * TENTH)] if found else []
        evaluator.observe(tracks, world.truth(k * TENTH), {"meter": fraction})
    result = values(evaluator)
    return result["tracking.reacquisitions"], result["tracking.reacquisition_time.p95"]


def test_reacquisition_runs_from_sight_to_a_good_track(world, scorers) -> None:
    visible = [1.0] * 2 + [0.1] * 5 + [0.8] * 6
    tracked = [True] * 2 + [False] * 5 + [False] * 4 + [True] * 2
    assert reacquisition_times(world, scorers, visible, tracked) == (1, pytest.approx(0.4))


def test_first_sight_and_flicker_are_no_reacquisitions(world, scorers) -> None:
    visible = [0.0, 0.0, 0.0, 0.9, 0.2, 0.9, 0.9]
    assert reacquisition_times(world, scorers, visible, [False] * 7) == (0, None)


def test_an_object_never_found_again_counts_with_the_time_waited(world, scorers) -> None:
    visible = [1.0] + [0.0] * 4 + [1.0] * 21
    assert reacquisition_times(world, scorers, visible, [True] + [False] * 25) == (1, pytest.approx(2.0))


def first_track_times(world, scorers, visible: list[float], tracked: list[bool], **changes):
    evaluator = TrackingEvaluator(scorers)
    for k, (fraction, found) in enumerate(zip(visible, tracked, strict=True)):
        tracks = [world.track("meter", 1, k * TENTH, **changes)] if found else []
        evaluator.observe(tracks, world.truth(k * TENTH), {"meter": fraction})
    result = values(evaluator)
    return result["tracking.first_tracks"], result["tracking.first_track_time.max"]


def test_the_first_track_is_waited_for_while_the_object_can_be_seen(world, scorers) -> None:
    visible, tracked = [0.2] * 3 + [0.8] * 5, [False] * 6 + [True] * 2
    assert first_track_times(world, scorers, visible, tracked) == (1, pytest.approx(0.3))
    # The time out of sight does not count, and what is lost later is no first track any more.
    visible, tracked = [0.8] * 3 + [0.0] * 20 + [0.8] * 6, [False] * 25 + [True] + [False] * 3
    assert first_track_times(world, scorers, visible, tracked) == (1, pytest.approx(0.4))


def test_who_is_too_far_away_for_the_camera_waits_for_no_track(world, scorers) -> None:
    evaluator = TrackingEvaluator(scorers)
    near = world.poses["meter"].copy()
    for k in range(30):
        world.poses["meter"] = near.copy()
        if k < 12:
            world.poses["meter"][:3, 3] += (0.0, 0.0, 10.0)
        tracks = [world.track("meter", 1, k * TENTH)] if k >= 16 else []
        evaluator.observe(tracks, world.truth(k * TENTH), {"meter": 1.0})
    assert values(evaluator)["tracking.first_track_time.max"] == pytest.approx(0.4)


def test_a_first_track_is_confirmed_and_in_place(world, scorers) -> None:
    visible, tracked = [0.8] * 16, [True] * 16
    assert first_track_times(world, scorers, visible, tracked) == (1, 0.0)
    for change in ({"status": TrackStatus.OCCLUDED}, {"xi": (0.09, 0, 0, 0, 0, 0)}):
        assert first_track_times(world, scorers, visible, tracked, **change) == (1, pytest.approx(1.5))


def test_objects_without_a_track_count_once_they_were_in_sight_for_a_second(world, scorers) -> None:
    assert first_track_times(world, scorers, [0.8] * 11, [False] * 11) == (0, None)
    assert first_track_times(world, scorers, [0.8] * 12, [False] * 12) == (1, pytest.approx(1.1))


def test_floor_ratio_compares_with_the_registration_from_the_truth(world, scorers) -> None:
    evaluator = TrackingEvaluator(scorers)
    tracks = all_tracks(world, xi=(0.003, 0, 0, 0, 0, 0))
    frames = evaluator.observe(tracks, world.truth(0), {"relay-a": 1.0, "relay-b": 0.2, "meter": 1.0})

    def register(frame, starts):
        assert set(starts) == set(world.poses)
        moved = {name: T.copy() for name, (_, T) in starts.items()}
        for T in moved.values():
            T[0, 3] += 0.002
        return moved

    floor = FloorEvaluator(register, scorers)
    floor.observe(None, frames)  # type: ignore[arg-type]  # the stand-in needs no image
    metrics = floor.metrics()
    assert metrics["tracking.floor_ratio"].value == pytest.approx(1.5)
    assert metrics["tracking.floor.static.translation_error.median"].value == pytest.approx(0.002)
    assert metrics["tracking.floor.moving.translation_error.median"].value is None
    assert metrics["tracking.floor.moving.translation_error.median"].reason


def test_nothing_observed_gives_reasons_not_numbers(scorers) -> None:
    metrics = TrackingEvaluator(scorers).metrics()
    assert metrics["tracking.recall"].value is None
    assert metrics["tracking.recall"].reason
