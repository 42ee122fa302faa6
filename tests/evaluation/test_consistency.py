"""NEES: honest covariances lie within the bounds as often as they should, others do not."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.stats import chi2

from simtrack.contracts import Float64, Localization, Status
from simtrack.evaluation.consistency import Consistency, ConsistencyEvaluator, bounds, nees, pose_nees
from simtrack.evaluation.tracking import TrackingEvaluator
from simtrack.geometry.transforms import exp_so3, perturb, transform
from tests.evaluation.conftest import Symmetries, World


@dataclass(frozen=True)
class Axis:
    axis: Float64 = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    offset: Float64 = field(default_factory=lambda: np.zeros(3))


def random_covariance(rng: np.random.Generator, size: int = 6) -> Float64:
    root = rng.normal(size=(size, size)) * np.geomspace(1e-3, 1e-2, size)
    return root @ root.T + 1e-8 * np.eye(size)


def test_bounds_are_those_of_the_chi_square_distribution() -> None:
    for freedom in (1, 3, 6):
        lower, upper = bounds(freedom)
        assert chi2.cdf(upper, freedom) - chi2.cdf(lower, freedom) == pytest.approx(0.95)
        assert chi2.cdf(lower, freedom) == pytest.approx(0.025)


@pytest.mark.parametrize(("scale", "inside"), [(1.0, (0.93, 0.97)), (0.25, (0.0, 0.75)), (9.0, (0.0, 0.75))])
def test_honest_covariances_lie_inside_and_others_outside(scale: float, inside: tuple[float, float]) -> None:
    rng = np.random.default_rng(1)
    found = Consistency("x", "")
    for _ in range(2000):
        P = random_covariance(rng)
        found.add(*nees(rng.multivariate_normal(np.zeros(6), P), scale * P))
    metrics = found.metrics()
    value = metrics["x.nees.inside_share"].value
    assert value is not None
    assert inside[0] <= value <= inside[1]
    assert metrics["x.nees.per_freedom.mean"].value == pytest.approx(1.0 / scale, rel=0.05)
    below, above = metrics["x.nees.below_share"].value, metrics["x.nees.above_share"].value
    assert below + value + above == pytest.approx(1.0)  # type: ignore[operator]
    if scale != 1.0:
        assert (above > below) == (scale < 1.0)  # type: ignore[operator]


def test_nees_does_not_depend_on_the_frame_of_its_coordinates() -> None:
    rng = np.random.default_rng(2)
    P, error, turn = random_covariance(rng), rng.normal(size=6), np.linalg.qr(rng.normal(size=(6, 6)))[0]
    assert nees(turn @ error, turn @ P @ turn.T)[0] == pytest.approx(nees(error, P)[0], rel=1e-6)


def test_what_is_given_is_no_freedom() -> None:
    P = np.diag([1e-4, 1e-4, 0.0, 0.0, 0.0, 1e-6])
    value, freedom = nees(np.array([0.01, 0, 0, 0, 0, 0.001]), P)
    assert freedom == 3
    assert value == pytest.approx(2.0)


def test_a_pose_off_by_a_perturbation_has_its_nees() -> None:
    rng = np.random.default_rng(3)
    P, xi = random_covariance(rng), rng.normal(size=6) * 0.01
    T = perturb(np.eye(4), rng.normal(size=6))
    assert pose_nees(T, P, perturb(T, xi))[0] == pytest.approx(xi @ np.linalg.solve(P, xi), rel=1e-6)


def test_turns_about_an_axis_of_symmetry_are_no_error() -> None:
    rng = np.random.default_rng(4)
    P, T = random_covariance(rng), perturb(np.eye(4), rng.normal(size=6))
    symmetries = Symmetries(axes=(Axis(),))
    turned = T @ transform(exp_so3(np.array([0.0, 0.0, 1.3])))
    value, freedom = pose_nees(T, P, turned, symmetries)
    assert freedom == 5
    assert value == pytest.approx(0.0, abs=1e-9)
    across = T @ transform(exp_so3(np.array([0.02, 0.0, 0.0])))
    assert pose_nees(T, P, across, symmetries)[0] > 0.01
    assert pose_nees(T, P, turned, Symmetries(axes=(Axis(), Axis(np.array([1.0, 0, 0])))))[1] == 3


def test_the_evaluator_takes_what_is_seen_and_tracked(world: World, scorers) -> None:
    tracking = TrackingEvaluator(scorers)
    evaluator = ConsistencyEvaluator({name: scorer.symmetries for name, scorer in scorers.items()})
    truth = world.truth(0)
    tracks = [world.track("relay-a", 1, xi=(0.003, 0, 0, 0, 0, 0)), world.track("meter", 2, xi=(0.5e-3, 0, 0, 0, 0, 0))]
    frames = tracking.observe(tracks, truth, {"relay-a": 0.9, "relay-b": 0.9, "meter": 0.1})  # type: ignore[arg-type]
    evaluator.observe_objects(frames, {name: thing.T_map_object for name, thing in truth.objects.items()})
    evaluator.observe_robot(Localization(0, np.eye(4), np.eye(6), Status.OK), np.eye(4))
    metrics = evaluator.metrics()
    assert metrics["tracking.nees.per_freedom.mean"].value == pytest.approx(9.0 / 6.0), "3 mm at a sigma of 1 mm"
    assert metrics["localization.nees.below_share"].value == 1.0
    assert metrics["localization.nees.lower_bound"].value == pytest.approx(1.2373, abs=1e-4)


def test_nothing_seen_has_a_reason() -> None:
    metrics = ConsistencyEvaluator({}).metrics()
    assert metrics["tracking.nees.inside_share"].reason == "no object was scored and tracked"
