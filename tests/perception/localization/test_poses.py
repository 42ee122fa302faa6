"""The pose between corrections: what is stated about it follows from how well odometry has led so far."""

import numpy as np
import pytest

from simtrack.contracts import NANOSECONDS, Float64, Odometry
from simtrack.geometry.transforms import transform_planar
from simtrack.perception.localization.config import MotionConfig
from simtrack.perception.localization.poses import PoseTrack

CORRECTED = 1e-6 * np.eye(6)


def driven(poses: PoseTrack, scans: range, off: float) -> None:
    """Half a metre a second, corrected ten times a second to poses that odometry misses by `off` metres, in turns."""
    for scan in scans:
        for k in range(5 * scan, 5 * scan + 6):
            T = transform_planar(0.01 * k, 0.0, 0.0)
            poses.odometry.add(Odometry(k * NANOSECONDS // 50, T, 0.5, 0.0))
        x = 0.05 * (scan + 1)
        poses.anchor((scan + 1) * NANOSECONDS // 10, transform_planar(x, off * (-1) ** scan, 0.0), CORRECTED)


def stated(poses: PoseTrack, *, cautious: bool) -> Float64:
    return poses.at(poses.anchors[-1].stamp + NANOSECONDS // 10, cautious)[1]


def test_odometry_that_leads_well_is_stated_to_and_still_handled_with_caution() -> None:
    poses = PoseTrack(MotionConfig())
    driven(poses, range(1), 0.0)
    assumed = stated(poses, cautious=True)
    driven(poses, range(1, 40), 0.0001)
    assert stated(poses, cautious=False)[0, 0] < 0.1 * assumed[0, 0]
    assert stated(poses, cautious=True) == pytest.approx(assumed, rel=1e-6)


def test_the_factor_is_the_mean_square_of_what_corrections_show() -> None:
    poses, config = PoseTrack(MotionConfig()), MotionConfig()
    driven(poses, range(80), 0.001)
    variance = (0.05 * config.translation_per_metre + config.drift_translation * np.sqrt(0.1)) ** 2
    assert poses.odometry_factor == pytest.approx(0.002**2 / variance / 3, rel=0.01), "one of three directions is off"


def test_a_slippery_floor_is_believed_at_once_and_copies_learn_for_themselves() -> None:
    poses = PoseTrack(MotionConfig())
    driven(poses, range(40), 0.0)
    before, copy = poses.odometry_factor, poses.copy()
    driven(copy, range(40, 41), 0.05)
    assert copy.odometry_factor > 1.0 > before == poses.odometry_factor
    poses.adopt(copy)
    assert poses.odometry_factor == copy.odometry_factor


def test_standing_still_shows_nothing() -> None:
    poses = PoseTrack(MotionConfig())
    for k in range(10):
        poses.odometry.add(Odometry(k * NANOSECONDS // 50, np.eye(4), 0.0, 0.0))
        poses.anchor(k * NANOSECONDS // 50, transform_planar(0.001 * k, 0.0, 0.0), CORRECTED)
    assert poses.odometry_factor == 1.0
