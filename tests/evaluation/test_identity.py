"""Fragmentation and HOTA on histories whose values are known by hand."""

from collections.abc import Sequence

import numpy as np
import pytest

from simtrack.contracts import TrackStatus
from simtrack.evaluation.identity import IdentityEvaluator
from simtrack.evaluation.tracking import TrackingEvaluator
from tests.evaluation.conftest import World


def follow(world: World, scorers, history: Sequence[int | None], xi=(0.0,) * 6, **changes) -> IdentityEvaluator:
    """One relay and the id of its track, frame by frame; `changes` to a further track that stands for nothing."""
    evaluator, tracking = IdentityEvaluator(), TrackingEvaluator(scorers)
    for stamp, number in enumerate(history):
        tracks = [] if number is None else [world.track("relay-a", number, stamp, xi)]
        if changes:
            tracks.append(world.track("meter", 99, stamp, (0.0, 5.0, 0, 0, 0, 0), **changes))
        frames = tracking.observe(tracks, world.truth(stamp), {"relay-a": 1.0})  # type: ignore[arg-type]
        evaluator.observe(frames, tracks)
    return evaluator


def test_a_perfect_history_has_hota_one(world: World, scorers) -> None:
    evaluator = follow(world, scorers, [1] * 10)
    assert evaluator.hota() == pytest.approx((1.0, 1.0, 1.0))
    assert evaluator.fragments() == 0


def test_a_switch_in_the_middle_halves_association(world: World, scorers) -> None:
    hota, detection, association = follow(world, scorers, [1] * 5 + [2] * 5).hota()
    assert (detection, association) == pytest.approx((1.0, 0.5))
    assert hota == pytest.approx(np.sqrt(0.5))


@pytest.mark.parametrize(
    ("history", "fragments"),
    [([None, 1, 1], 0), ([1, None, 1, None, None, 2], 2), ([1, 1, None], 0), ([None, None], 0)],
)
def test_fragments_are_interruptions_that_end(history, fragments: int, world: World, scorers) -> None:
    assert follow(world, scorers, history).fragments() == fragments


def test_misses_and_ghosts_count_into_detection(world: World, scorers) -> None:
    assert follow(world, scorers, [1, 1, None, None]).hota()[1] == pytest.approx(0.5)
    assert follow(world, scorers, [1, 1], status=TrackStatus.CONFIRMED).hota()[1] == pytest.approx(0.5)
    assert follow(world, scorers, [1, 1], status=TrackStatus.OCCLUDED).hota()[1] == pytest.approx(1.0)


def test_a_distance_costs_the_thresholds_above_it(world: World, scorers) -> None:
    """At 4.2 cm of 10 the similarity is 0.58: eleven of the nineteen thresholds are met."""
    evaluator = follow(world, scorers, [1] * 4, (0.042, 0, 0, 0, 0, 0))
    hota, _, association = evaluator.hota()
    assert association == pytest.approx(11 / 19)
    assert hota == pytest.approx(11 / 19)


def test_nothing_seen_has_a_reason() -> None:
    assert IdentityEvaluator().metrics()["tracking.hota"].reason == "no object was visible enough"
