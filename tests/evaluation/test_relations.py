"""Relation metrics on stacked and neighbouring boxes."""

from dataclasses import replace

import numpy as np
import pytest

from simtrack.contracts import Relation
from simtrack.evaluation.relations import RelationEvaluator
from simtrack.evaluation.tracking import TrackingEvaluator
from simtrack.geometry.transforms import transform
from simtrack.objects import load_object

SEEN = {"relay-a": 1.0, "relay-b": 1.0, "meter": 1.0}


@pytest.fixture(scope="module")
def models():
    return {"relay": load_object("relay"), "meter": load_object("multimeter")}


def score(world, scorers, models, believed, contacts=()):
    """Metrics of one frame in which every object is tracked."""
    tracks = [world.track(name, k + 1) for k, name in enumerate(world.poses)]
    truth = replace(world.truth(0), contacts=frozenset(contacts))
    frames = TrackingEvaluator(scorers).observe(tracks, truth, SEEN)
    evaluator = RelationEvaluator(models)
    evaluator.observe(frozenset(believed), frames, truth)
    return {name: metric.value for name, metric in evaluator.metrics().items()}


def test_contacts_decide_what_is_on_what(world, scorers, models) -> None:
    on = Relation("relay-1", "on", "meter-3")
    contact = ("relay-a", "meter")
    world.poses["relay-a"] = world.poses["meter"] @ transform(translation=(0.0, 0.0, 0.2))
    gap = 0.2 - (models["relay"].extents[2] + models["meter"].extents[2]) / 2
    world.poses["relay-a"][2, 3] -= gap
    assert score(world, scorers, models, [on], [contact])["relations.f1.on"] == 1.0
    assert score(world, scorers, models, [], [contact])["relations.f1.on"] == 0.0
    assert score(world, scorers, models, [on])["relations.f1.on"] == 0.0


def test_relations_between_neighbours_are_those_of_the_true_poses(world, scorers, models) -> None:
    near = {Relation(a, "near", b) for a in ("relay-1", "relay-2") for b in ("relay-1", "relay-2") if a != b}
    world.poses["relay-b"] = world.poses["relay-a"] @ transform(translation=(0.0, 0.2, 0.0))
    left = {Relation("relay-2", "left-of", "relay-1"), Relation("relay-1", "right-of", "relay-2")}
    figures = score(world, scorers, models, near | left)
    assert figures["relations.f1.left-of"] == figures["relations.f1.right-of"] == 1.0
    assert figures["relations.f1"] == pytest.approx(np.mean([v for n, v in figures.items() if n.count(".") == 2 and v
                                                             is not None and "support" not in n]))  # fmt: skip
    assert score(world, scorers, models, near | left | {Relation("relay-1", "left-of", "relay-2")})[
        "relations.f1.left-of"
    ] == pytest.approx(2 / 3)


def test_pairs_at_a_boundary_are_not_counted(world, scorers, models) -> None:
    world.poses["meter"][:3, 3] = (5.0, 0.0, 0.8)
    for gap, expected in ((0.244, None), (0.22, 0.0)):  # near reaches 0.25 m
        shift = models["relay"].extents[1] + gap
        world.poses["relay-b"] = world.poses["relay-a"] @ transform(translation=(0.0, shift, 0.0))
        assert score(world, scorers, models, [])["relations.f1.near"] == expected


def test_support_by_furniture_is_scored_apart(world, scorers, models) -> None:
    believed = [Relation("relay-1", "on", "shelf/board2"), Relation("meter-3", "on", "workbench")]
    contacts = [("relay-a", "shelf/board1"), ("meter", "workbench"), ("relay-b", "workbench")]
    figures = score(world, scorers, models, believed, contacts)
    assert figures["relations.support.f1"] == pytest.approx(2 * 2 / (2 * 2 + 1))
    assert figures["relations.f1.on"] is None


def test_untracked_objects_have_no_pairs(world, scorers, models) -> None:
    frames = TrackingEvaluator(scorers).observe([], world.truth(0), SEEN)
    evaluator = RelationEvaluator(models)
    evaluator.observe(frozenset(), frames, world.truth(0))
    metric = evaluator.metrics()["relations.f1"]
    assert metric.value is None
    assert metric.reason
