"""Candidates: what a detection's hypotheses become in the depth image."""

from collections.abc import Iterator

import numpy as np
import pytest

from simtrack.contracts import Float32, Float64, PoseHypothesis
from simtrack.geometry.transforms import angle_between, exp_so3, transform
from simtrack.objects import load_object
from simtrack.perception.detection.pnp import project_points
from simtrack.perception.tracking.birth import FitConfig, Prober, cost
from simtrack.perception.tracking.registration import RegistrationResult
from simtrack.perception.tracking.registration_config import RegistrationConfig
from simtrack.perception.tracking.target import tracked_model
from tests.perception.tracking.scenes import INTRINSICS, BenchWorld, in_camera, on_bench

DRILL = load_object("powerdrill")
T_TRUE = in_camera(on_bench(DRILL, 0.0, -0.15, 0.6))


@pytest.fixture(scope="module")
def free() -> Float32:
    world = BenchWorld()
    world.add(DRILL, on_bench(DRILL, 0.0, -0.15, 0.6))
    return world.depth()


@pytest.fixture(scope="module")
def held(free: Float32) -> Float32:
    """Fingers, 18 mm thick, over the upper part of the drill but for stripes between them."""
    pixels = project_points(T_TRUE, np.asarray(DRILL.mesh.vertices, float), INTRINSICS)
    (u0, v0), (u1, v1) = pixels.min(axis=0).astype(int), pixels.max(axis=0).astype(int)
    depth = free.copy()
    part = depth[v0 : v0 + 6 * (v1 - v0) // 10, u0 : u1 + 1]
    stripes = (np.arange(part.shape[1]) * 6 // part.shape[1]) % 3 < 2
    part[(part < T_TRUE[2, 3] + 0.15) & stripes] -= 0.018
    return depth


@pytest.fixture(scope="module")
def prober() -> Iterator[Prober]:
    made = Prober(RegistrationConfig(), FitConfig())
    yield made
    made.close()


def hypotheses(rng: np.random.Generator, count: int) -> list[PoseHypothesis]:
    found = []
    for _ in range(count):
        off = transform(exp_so3(rng.normal(0.0, 0.1, 3)), rng.normal(0.0, 0.004, 3))
        found.append(PoseHypothesis("powerdrill", 0, T_TRUE @ off, np.eye(6), 1.0, 0.9))
    return found


def off(T: Float64) -> tuple[float, float]:
    """Metres and degrees."""
    return float(np.linalg.norm(T[:3, 3] - T_TRUE[:3, 3])), float(np.rad2deg(angle_between(T[:3, :3], T_TRUE[:3, :3])))


def test_candidates_are_registered(free: Float32, prober: Prober) -> None:
    found = prober.best(hypotheses(np.random.default_rng(1), 2), tracked_model(DRILL), free, INTRINSICS, {})
    assert found is not None
    assert off(found.T_camera_object)[0] < 0.002


def test_what_is_in_a_hand_is_not_registered_to_the_hand(held: Float32, prober: Prober) -> None:
    rng, model, wide, found = np.random.default_rng(2), tracked_model(DRILL), [], []
    for _ in range(6):
        (h,) = hypotheses(rng, 1)
        result = prober.best([h], model, held, INTRINSICS, {})
        found.append(result)
        near = prober._near([h], held, INTRINSICS)
        wide.append(prober._settled(near, held, INTRINSICS) if near else prober._searched([h], held, INTRINSICS))
    right = [result for result in found if result is not None]
    assert len(right) >= 3
    assert all(off(result.T_camera_object)[0] < 0.005 and off(result.T_camera_object)[1] < 3.0 for result in right)
    assert sum(result is not None for result in wide) < len(right), "wide gates take the hand for the object"


@pytest.mark.parametrize("distance", [0.8, 1.0, 2.0, 3.5])
def test_a_fit_that_is_seen_through_costs_as_much_at_any_distance(distance: float) -> None:
    """Beside one that is not: depth errors grow with the square of the distance, costs with its fourth power."""

    def fit(missing: int) -> RegistrationResult:
        residual = 0.0015 * max(1.0, distance) ** 2
        T = transform(translation=(0.0, 0.0, distance))
        return RegistrationResult(T, np.eye(6), 6, 400, 400 - missing, 0, missing, 0, 1, residual, 0.8, 40)

    assert cost(fit(40)) / cost(fit(12)) == pytest.approx(2.5, abs=0.1)


def test_what_was_not_seen_at_all_costs_everything() -> None:
    nothing = RegistrationResult(np.eye(4), np.eye(6), 0, 10, 0, 10, 0, 0, 1, 0.0, 0.0, 0)
    assert cost(nothing) == np.inf
