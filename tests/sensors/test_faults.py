"""Feed and calibration faults."""

import numpy as np
import pytest

from simtrack.contracts import JointState, Odometry, RgbdFrame
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import difference, transform_planar
from simtrack.sensors.camera import XTION
from simtrack.sensors.faults import CalibrationFaults, FaultyFeed, FeedFaults, apply_feed_faults

DEPTH = np.zeros((480, 640), np.float32)


def frames(count: int) -> list[RgbdFrame | Odometry]:
    out: list[RgbdFrame | Odometry] = []
    for i in range(count):
        out.append(RgbdFrame(i * 33_000_000, DEPTH, None, XTION.intrinsics, np.eye(4), i))
        out.append(Odometry(i * 33_000_000 + 1, np.eye(4), 0.0, 0.0))
    return out


def test_a_faultless_feed_changes_nothing() -> None:
    sent = frames(20)
    assert apply_feed_faults(sent, {}, np.random.default_rng(0)) == sent


def test_faults_strike_their_sensor_with_their_probability() -> None:
    sent = frames(1000)
    faults = {"camera": FeedFaults(drop=0.1, late=0.2, delay=0.05, duplicate=0.1)}
    arrived = apply_feed_faults(sent, faults, np.random.default_rng(0))
    again = apply_feed_faults(sent, faults, np.random.default_rng(0))
    assert all(a is b for a, b in zip(arrived, again, strict=True))
    assert [f for f in arrived if isinstance(f, Odometry)] == [f for f in sent if isinstance(f, Odometry)]
    sequence = [f.sequence for f in arrived if isinstance(f, RgbdFrame)]
    assert len(set(sequence)) == pytest.approx(900, abs=30)
    assert len(sequence) - len(set(sequence)) == pytest.approx(90, abs=30)
    assert np.mean(np.diff(sequence) < 0) > 0.1  # late ones arrive after their successors


def test_late_frames_wait_until_they_arrive() -> None:
    feed = FaultyFeed({"camera": FeedFaults(late=1.0, delay=0.1, duplicate=1.0)}, np.random.default_rng(0))
    feed.send(frames(1)[0], arrival=1_000)
    assert feed.receive(99_000_000) == []
    assert len(feed.receive(100_001_000)) == 1
    assert len(feed.receive(10**12)) == 1
    assert feed.receive(10**13) == []


def test_calibration_faults() -> None:
    xi = (0.01, 0.0, -0.02, 0.0, 0.03, 0.0)
    faults = CalibrationFaults(camera=xi, camera_time_offset=0.005, encoder_bias={"head_pan": 0.02})
    T = transform_planar(0.2, 0.1, 0.4)
    frame = RgbdFrame(10, DEPTH, None, XTION.intrinsics, T)
    told = faults.apply(frame)
    assert isinstance(told, RgbdFrame)
    np.testing.assert_allclose(difference(told.T_base_camera, T), xi, atol=1e-12)
    assert told.stamp == 5_000_010
    joints = faults.apply(JointState(0, ("head_pan", "lift"), np.array([1.0, 2.0])))
    assert isinstance(joints, JointState)
    np.testing.assert_allclose(joints.positions, [1.02, 2.0])
    odometry = Odometry(0, np.eye(4), 0.0, 0.0)
    assert faults.apply(odometry) is odometry


@pytest.mark.parametrize("change", [{"drop": 1.1}, {"late": -0.1}, {"duplicate": float("nan")}, {"delay": -1.0}])
def test_impossible_feed_faults_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(change))):
        FeedFaults(**change)


def test_impossible_calibration_faults_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="six"):
        CalibrationFaults(camera=(1.0, 2.0))
    with pytest.raises(InvalidValueError, match="lidar_time_offset"):
        CalibrationFaults(lidar_time_offset=float("inf"))
    with pytest.raises(InvalidValueError, match="camera, lidar, odometry, joints"):
        FaultyFeed({"sonar": FeedFaults()}, np.random.default_rng(0))
