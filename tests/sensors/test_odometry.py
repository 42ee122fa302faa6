"""Wheel odometry and encoders: exact without noise, drift of the stated size with it."""

import numpy as np
import pytest

from simtrack.contracts import Odometry
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import transform_planar, yaw_of
from simtrack.sensors.odometry import EncoderNoiseConfig, OdometryNoiseConfig, OdometrySensor, read_encoders

QUIET = OdometryNoiseConfig(0.0, 0.0, 0.0, 0.0)


def drive(config: OdometryNoiseConfig, seed: int, rate_hz: float = 50.0, metres: float = 10.0) -> Odometry:
    """A straight line at 0.5 m/s."""
    sensor = OdometrySensor(config, np.random.default_rng(seed), rate_hz)
    reading = None
    for stamp in range(0, round(metres / 0.5 * 1e9) + 1, sensor.period):
        reading = sensor.read(stamp, transform_planar(1.0 + 0.5 * stamp / 1e9, 2.0, 0.0))
    assert reading is not None
    return reading


def test_without_noise_it_is_the_motion_since_the_start() -> None:
    sensor = OdometrySensor(QUIET, np.random.default_rng(0))
    start = transform_planar(3.0, -2.0, 1.0)
    angles = 0.02 * np.arange(400)  # an arc of radius 0.5 m
    poses = [start @ transform_planar(0.5 * np.sin(a), 0.5 * (1 - np.cos(a)), a) for a in angles]
    reading, T = [sensor.read(i * sensor.period, pose) for i, pose in enumerate(poses)][-1], poses[-1]
    np.testing.assert_allclose(reading.T_odom_base, np.linalg.inv(start) @ T, atol=1e-3)
    assert reading.linear == pytest.approx(0.5, rel=1e-3) and reading.angular == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("rate_hz", [5.0, 20.0])
def test_drift_has_the_stated_size_at_any_rate(rate_hz: float) -> None:
    config = OdometryNoiseConfig(travel_from_travel=1e-4, turn_from_travel=1e-4, travel_from_turn=0, turn_from_turn=0)
    ends = [drive(config, seed, rate_hz).T_odom_base for seed in range(60)]
    turn = np.std([yaw_of(T) for T in ends])
    along = np.std([T[0, 3] for T in ends])
    assert turn == pytest.approx(np.sqrt(1e-4 * 10), rel=0.3)
    assert along == pytest.approx(np.sqrt(1e-4 * 10), rel=0.3)


def test_scale_and_scheduled_slip_are_exact_and_random_slip_happens() -> None:
    assert drive(OdometryNoiseConfig(0, 0, 0, 0, scale_error=0.01), 0).T_odom_base[0, 3] == pytest.approx(10.1)
    slipped = drive(OdometryNoiseConfig(0, 0, 0, 0, slips=((20_000_000_000, 0.25, 0.1),)), 0).T_odom_base
    assert slipped[0, 3] == pytest.approx(10.25, abs=1e-3)
    assert yaw_of(slipped) == pytest.approx(0.1)
    often = [drive(OdometryNoiseConfig(0, 0, 0, 0, slip_rate=0.5), seed, 10.0).T_odom_base[0, 3] for seed in range(10)]
    assert np.std(often) > 0.02


def test_standing_still_reads_nothing_and_time_may_not_run_back() -> None:
    sensor = OdometrySensor(OdometryNoiseConfig(slip_rate=10.0), np.random.default_rng(0))
    for i in range(10):
        reading = sensor.read(i * sensor.period, transform_planar(1.0, 1.0, 0.3))
        np.testing.assert_allclose(reading.T_odom_base, np.eye(4), atol=1e-9)
        assert abs(reading.linear) < 1e-9
    with pytest.raises(InvalidValueError, match="stamp"):
        sensor.read(0, np.eye(4))


def test_encoders_have_bias_noise_and_resolution() -> None:
    config = EncoderNoiseConfig(sigma=1e-3, resolution=1e-4, bias={"head_pan": 0.01})
    generator = np.random.default_rng(0)
    values = np.array(
        [read_encoders(5, {"head_pan": 0.5, "lift": 0.2}, config, generator).positions for _ in range(500)]
    )
    np.testing.assert_allclose(values.mean(0), [0.51, 0.2], atol=2e-4)
    np.testing.assert_allclose(values.std(0), 1e-3, rtol=0.15)
    state = read_encoders(5, {"head_pan": 0.5}, EncoderNoiseConfig(0.0, 0.0), generator)
    assert state.names == ("head_pan",) and state.positions[0] == 0.5 and state.stamp == 5


def test_impossible_noise_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="turn_from_turn"):
        OdometryNoiseConfig(turn_from_turn=-1.0)
    with pytest.raises(InvalidValueError, match="rate_hz"):
        OdometrySensor(QUIET, np.random.default_rng(0), 0.0)
    with pytest.raises(InvalidValueError, match="bias"):
        EncoderNoiseConfig(bias={"head_pan": float("nan")})
