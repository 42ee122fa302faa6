"""The arm's kinematics: compiled and plain agree, the Jacobian is a derivative, answers reach what was asked for."""

import numpy as np
import pytest

from simtrack.envs.arm import ARM, ArmKinematics
from simtrack.envs.arm_kernels import linearised
from simtrack.objects.tiago import TORSO, tiago


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_the_jacobian_is_the_derivative_of_a_pose_that_the_tree_has_too(rng: np.random.Generator) -> None:
    arm, q = ArmKinematics(tiago()), rng.uniform(-1.0, 1.0, 8)
    T, J = linearised(*arm._chain, q, 7)
    np.testing.assert_allclose(T, arm.cup(dict(zip((*ARM, TORSO), q.tolist(), strict=True))), atol=1e-12)
    for k in range(7):
        step = np.zeros(8)
        step[k] = 1e-6
        after, before = (linearised(*arm._chain, q + sign * step, 7)[0] for sign in (1.0, -1.0))
        change = (after - before) / 2e-6
        spin = change[:3, :3] @ T[:3, :3].T
        np.testing.assert_allclose(change[:3, 3], J[:3, k], atol=1e-8)
        np.testing.assert_allclose([spin[2, 1], spin[0, 2], spin[1, 0]], J[3:, k], atol=1e-8)


@pytest.mark.parametrize("level", [False, True])
def test_the_cup_gets_where_it_is_sent_and_says_so_where_it_cannot(level: bool) -> None:
    arm, place, direction = ArmKinematics(tiago()), np.array([0.75, 0.1, 0.9]), np.array([np.cos(0.2), np.sin(0.2), 0])
    joints = arm.solve(place, 0.25, direction=direction, level=level)
    assert joints is not None
    T = arm.cup({**joints, TORSO: 0.25})
    assert np.linalg.norm(T[:3, 3] - place) < arm.config.translation and T[:3, 0] @ direction > np.cos(arm.config.tilt)
    assert not level or T[2, 2] > np.cos(arm.config.tilt)
    assert arm.solve(place + (1.0, 0.0, 0.0), 0.25, direction=direction, level=level) is None
