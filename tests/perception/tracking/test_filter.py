import numpy as np

from simtrack.contracts import NANOSECONDS
from simtrack.geometry.transforms import difference, perturb, transform_xyz_rpy
from simtrack.perception.tracking.filter import FilterConfig, Measurement, PoseFilter

PERIOD = NANOSECONDS // 30
R = np.diag([1e-6] * 3 + [1e-4] * 3)
NO_DRIFT = np.zeros((6, 6))
START = transform_xyz_rpy((1.0, 2.0, 0.9), (0.1, -0.2, 2.0))


def _noisy(T: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return perturb(T, np.sqrt(np.diag(R)) * rng.standard_normal(6))


def test_a_still_object_is_averaged() -> None:
    rng = np.random.default_rng(0)
    f = PoseFilter(0, _noisy(START, rng), R)
    for k in range(1, 91):
        f.update(Measurement(k * PERIOD, _noisy(START, rng), R, NO_DRIFT))
    assert not f.state.moving
    error = difference(f.state.T_map_object, START)
    assert np.abs(error[:3]).max() < 0.0006
    assert np.abs(error[3:]).max() < 0.006
    assert np.all(np.diag(f.state.covariance)[:6] < np.diag(R))


def test_a_moving_object_is_followed_and_comes_to_rest() -> None:
    rng = np.random.default_rng(1)
    f = PoseFilter(0, START, R)
    T, seen_moving = START, False
    for k in range(1, 150):
        speed = 0.4 * np.clip(np.sin((k - 40) / 60 * np.pi), 0, None) if 40 <= k <= 100 else 0.0
        T = perturb(T, np.array([speed / 30, 0, 0, 0, 0, 1.5 * speed / 30 / 0.4]))
        f.update(Measurement(k * PERIOD, _noisy(T, rng), R, NO_DRIFT))
        seen_moving |= f.state.moving and 60 < k < 90
        assert np.linalg.norm(difference(f.state.T_map_object, T)[:3]) < 0.006
    assert seen_moving
    assert not f.state.moving


def test_late_measurements_are_fused_at_their_own_stamp() -> None:
    rng = np.random.default_rng(2)
    measurements = [Measurement(k * PERIOD, _noisy(START, rng), R, NO_DRIFT) for k in range(1, 10)]
    in_time, late = PoseFilter(0, START, R), PoseFilter(0, START, R)
    for m in measurements:
        in_time.update(m)
    for m in [m for i, m in enumerate(measurements) if i != 4] + [measurements[4]]:
        late.update(m)
    assert late.state.stamp == in_time.state.stamp
    np.testing.assert_allclose(late.state.T_map_object, in_time.state.T_map_object, atol=1e-9)
    np.testing.assert_allclose(late.state.covariance, in_time.state.covariance, atol=1e-12)


def test_a_measurement_older_than_the_memory_changes_nothing() -> None:
    f = PoseFilter(0, START, R, FilterConfig(memory=0.1))
    for k in range(1, 30):
        f.update(Measurement(k * PERIOD, START, R, NO_DRIFT))
    before = f.state
    f.update(Measurement(PERIOD // 2, perturb(START, np.full(6, 0.1)), R, NO_DRIFT))
    np.testing.assert_array_equal(f.state.T_map_object, before.T_map_object)


def test_wandering_of_the_map_loosens_the_hold_on_the_past() -> None:
    f, g = PoseFilter(0, START, R), PoseFilter(0, START, R)
    for k in range(1, 30):
        f.update(Measurement(k * PERIOD, START, R, NO_DRIFT))
        g.update(Measurement(k * PERIOD, START, R, 1e-5 * np.eye(6)))
    shifted = perturb(START, np.array([0.002, 0, 0, 0, 0, 0]))
    f.update(Measurement(30 * PERIOD, shifted, R, NO_DRIFT))
    g.update(Measurement(30 * PERIOD, shifted, R, 1e-5 * np.eye(6)))
    assert g.state.T_map_object[0, 3] - START[0, 3] > 2 * (f.state.T_map_object[0, 3] - START[0, 3]) > 0


def test_an_unobserved_object_comes_to_rest() -> None:
    f = PoseFilter(0, START, R)
    for k in range(1, 20):
        f.update(Measurement(k * PERIOD, perturb(START, np.array([0.01 * k, 0, 0, 0, 0, 0])), R, NO_DRIFT))
    for k in range(20, 80):
        f.skip(k * PERIOD)
    assert np.linalg.norm(f.state.velocity) < 1e-3
    assert f.state.T_map_object[0, 3] - START[0, 3] < 0.19 + 0.06
