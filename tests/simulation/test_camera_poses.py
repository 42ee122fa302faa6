"""Poses with a SLAM system's errors: as large as stated, smooth, repeatable; the first one is true."""

import numpy as np
import pytest

from simtrack.contracts import NANOSECONDS
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import difference
from simtrack.simulation.oracles.camera_poses import NoisyPoses, PoseErrors


def errors_of(count: int, settings: PoseErrors, seed: int = 0) -> list[np.ndarray | None]:
    oracle, T = NoisyPoses(np.random.default_rng(seed), settings), np.eye(4)
    poses = [oracle.pose(round(k * NANOSECONDS / 30), T) for k in range(count)]
    return [None if pose is None else difference(pose, T) for pose in poses]


def test_errors_are_as_large_as_stated_and_drift_smoothly() -> None:
    settings = PoseErrors(jitter=(0.0, 0.0), lost=0.0, jumps=0.0, correlation=0.5)
    off = np.array(errors_of(3000, settings))
    np.testing.assert_array_equal(off[0], 0.0)
    np.testing.assert_allclose(off.std(axis=0), np.repeat(settings.drift, 3), rtol=0.35)
    assert np.abs(np.diff(off[1:, :3], axis=0)).mean() < 0.35 * off[:, :3].std()


def test_images_are_lost_and_poses_jump_as_often_as_stated() -> None:
    off = errors_of(2000, PoseErrors(lost=0.1, jumps=0.05))
    known = np.array([each for each in off if each is not None])
    assert 0.07 < 1.0 - len(known) / 2000 < 0.13
    assert 0.02 < (np.linalg.norm(known[:, :3], axis=1) > 0.2).mean() < 0.07


def test_one_seed_gives_the_same_errors() -> None:
    first, again, other = (errors_of(50, PoseErrors(), seed) for seed in (3, 3, 4))
    assert str(first) == str(again) != str(other)


@pytest.mark.parametrize("wrong", [{"lost": 2.0}, {"correlation": 0.0}, {"jump": -1.0}])
def test_errors_outside_their_domain_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(wrong))):
        PoseErrors(**wrong)  # type: ignore[arg-type]
