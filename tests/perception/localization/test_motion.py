import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import NANOSECONDS, LidarScan, Odometry
from simtrack.geometry.transforms import (
    difference,
    exp_so3,
    interpolate,
    inverse,
    perturb,
    transform,
    transform_planar,
)
from simtrack.perception.localization.config import MotionConfig
from simtrack.perception.localization.measurement import deskew
from simtrack.perception.localization.motion import OdometryTrack, propagate


def reading(seconds: float, T: np.ndarray, linear: float = 0.0, angular: float = 0.0) -> Odometry:
    return Odometry(round(seconds * NANOSECONDS), T, linear, angular)


def circle(seconds: float, v: float = 0.9, w: float = 1.0) -> np.ndarray:
    return transform_planar(v / w * np.sin(w * seconds), v / w * (1 - np.cos(w * seconds)), w * seconds)


def track(*, until: float = 1.0, rate: float = 50.0) -> OdometryTrack:
    odometry = OdometryTrack(MotionConfig())
    for k in range(round(until * rate) + 1):
        odometry.add(reading(k / rate, circle(k / rate), 0.9, 1.0))
    return odometry


def test_interpolates_between_readings_and_carries_on_beyond() -> None:
    odometry = track()
    assert np.abs(odometry.pose(500_000_000) - circle(0.5)).max() < 1e-12
    assert np.abs(odometry.pose(507_000_000) - circle(0.507)).max() < 1e-4
    assert np.abs(odometry.pose(1_100_000_000) - circle(1.1)).max() < 1e-12
    limit = MotionConfig().max_extrapolation
    assert np.abs(odometry.pose(9_000_000_000) - circle(1.0 + limit)).max() < 1e-12


@pytest.mark.parametrize(
    "bad",
    [
        reading(0.9, np.eye(4)),
        reading(1.0, np.eye(4)),
        reading(2.0, np.full((4, 4), np.nan)),
        reading(2.0, np.diag([2.0, 1.0, 1.0, 1.0])),
        reading(2.0, np.eye(4), linear=np.nan),
    ],
)
def test_ignores_readings_that_are_stale_or_malformed(bad: Odometry) -> None:
    odometry = track()
    before = odometry.pose(1_200_000_000)
    assert not odometry.add(bad)
    assert np.array_equal(odometry.pose(1_200_000_000), before)


def test_old_readings_are_forgotten_but_the_travel_is_not() -> None:
    odometry = track(until=30.0)
    assert len(odometry) < 50 * 8
    assert odometry.travel(30 * NANOSECONDS)[0] == pytest.approx(27.0, rel=1e-3)


def test_uncertainty_grows_with_motion_and_with_silence() -> None:
    odometry = track()
    short = odometry.noise(0, 100_000_000)
    longer = odometry.noise(0, 1_000_000_000)
    silent = odometry.noise(0, 3_000_000_000)
    assert (np.diag(short) > 0).all()
    assert (np.diag(longer) > np.diag(short)).all()
    assert (np.diag(silent) > 4 * np.diag(longer)).all()


@settings(max_examples=40)
@given(st.integers(0, 2**31))
def test_propagated_covariance_is_that_of_sampled_poses(seed: int) -> None:
    """To first order: push small perturbations through the motion itself."""
    rng = np.random.default_rng(seed)
    T = transform(exp_so3(rng.normal(size=3)), rng.normal(size=3))
    motion = transform(exp_so3(0.5 * rng.normal(size=3)), rng.normal(size=3))
    A, B = rng.normal(size=(6, 6)) * 1e-4, rng.normal(size=(6, 6)) * 1e-4
    after, covariance = propagate(T, A @ A.T, motion, B @ B.T)
    F, G = np.empty((6, 6)), np.empty((6, 6))
    step = 1e-6
    for k in range(6):
        xi = np.eye(6)[k] * step
        F[:, k] = difference(perturb(T, xi) @ motion, after) / step
        G[:, k] = difference(T @ perturb(motion, xi), after) / step
    expected = F @ A @ A.T @ F.T + G @ B @ B.T @ G.T
    assert np.abs(covariance - expected).max() < 1e-4 * np.abs(expected).max()


def test_deskew_moves_every_shot_by_the_interpolated_odometry() -> None:
    rng = np.random.default_rng(0)
    odometry = track()
    count = 200
    times = np.sort(rng.uniform(0, 0.1, count)).astype(np.float32)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    mount = transform(exp_so3(np.array([0.1, -0.2, 0.3])), (0.1, 0.2, 1.0))
    scan = LidarScan(
        stamp=333_000_000,
        directions=directions.astype(np.float32),
        ranges=np.full(count, 3.0, np.float32),
        times=times,
        rings=rng.integers(0, 16, count).astype(np.uint8),
        intensities=np.zeros(count, np.float32),
        T_base_lidar=mount,
    )
    measurement = deskew(scan, odometry, 0.01, 0.3, 100.0)
    assert len(measurement) == count
    end = inverse(odometry.pose(measurement.stamp))
    for row, shot in enumerate(measurement.shots):
        stamp = scan.stamp + float(times[shot]) * NANOSECONDS
        low, high = 20_000_000 * int(stamp // 20_000_000), 20_000_000 * (int(stamp // 20_000_000) + 1)
        first, second = max(low, scan.stamp), min(high, measurement.stamp)
        share = (stamp - first) / (second - first)
        T = end @ interpolate(odometry.pose(first), odometry.pose(second), share) @ mount
        assert np.abs(measurement.origins[row] - T[:3, 3]).max() < 1e-6
        assert np.abs(measurement.directions[row] - T[:3, :3] @ scan.directions[shot].astype(float)).max() < 2e-6
    assert (np.diff(scan.rings[measurement.shots].astype(int)) >= 0).all()


def test_deskew_without_odometry_leaves_shots_where_they_are() -> None:
    scan = LidarScan(
        0,
        np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0]], np.float32),
        np.array([1.0, np.inf, np.nan, 0.1], np.float32),
        np.array([0, 0.01, 0.02, 0.03], np.float32),
        np.zeros(4, np.uint8),
        np.zeros(4, np.float32),
        np.eye(4),
    )
    measurement = deskew(scan, OdometryTrack(MotionConfig()), 0.01, 0.3, 100.0)
    assert measurement.shots.tolist() == [0]
    assert measurement.stamp == pytest.approx(30_000_000, abs=2)
    assert np.array_equal(measurement.points, [[1.0, 0.0, 0.0]])
