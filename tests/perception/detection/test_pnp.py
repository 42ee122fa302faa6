import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import CameraIntrinsics, Detection
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import angle_between, exp_so3, perturb, transform
from simtrack.objects import load_object
from simtrack.perception.detection import pnp_kernels as kernels
from simtrack.perception.detection.pnp import PnpConfig, project_points, solve_pose

K = CameraIntrinsics(640, 480, 577.0, 577.0, 319.5, 239.5)
CAMERA = np.array([K.fx, K.fy, K.cx, K.cy])
MODEL = load_object("powerdrill")


def _detection(T: np.ndarray, noise: np.ndarray | float = 0.0, name: str = "powerdrill") -> Detection:
    pixels = project_points(T, load_object(name).keypoints, K) + noise
    box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    return Detection(name, pixels, np.ones(9), box, 0.9)


unit = st.floats(-1.0, 1.0)


@settings(max_examples=40)
@given(st.tuples(unit, unit, unit), st.tuples(unit, unit, st.floats(0.6, 3.0)))
def test_exact_keypoints_give_the_exact_pose(phi: tuple, position: tuple) -> None:
    x, y, z = position
    T = transform(exp_so3(3.0 * np.array(phi)), (0.4 * x * z, 0.3 * y * z, z))
    best = solve_pose(_detection(T), MODEL, K, stamp=7)[0]
    assert best.stamp == 7
    assert np.linalg.norm(best.T_camera_object[:3, 3] - T[:3, 3]) < 1e-4
    assert angle_between(best.T_camera_object[:3, :3], T[:3, :3]) < 1e-3
    assert best.reprojection_error < 1e-2


def _reprojection(T: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    return (project_points(T, MODEL.keypoints, K) - pixels).ravel()


def test_the_information_is_that_of_finite_differences() -> None:
    rng = np.random.default_rng(1)
    T = transform(exp_so3(np.array([1.0, -0.3, 0.4])), (0.1, -0.05, 1.1))
    pixels = project_points(T, MODEL.keypoints, K) + rng.standard_normal((9, 2))
    H, g = np.empty((6, 6)), np.empty(6)
    kernels.normal_equations(T, MODEL.keypoints, pixels, np.ones(9), CAMERA, H, g)
    step = 1e-6
    columns = [_reprojection(perturb(T, step * xi), pixels) - _reprojection(T, pixels) for xi in np.eye(6)]
    J = np.stack(columns, axis=1) / step
    np.testing.assert_allclose(H, J.T @ J, rtol=1e-3, atol=1e-2 * np.abs(H).max() / 100)
    np.testing.assert_allclose(g, J.T @ _reprojection(T, pixels), rtol=1e-3, atol=1e-4 * np.abs(g).max())


@settings(max_examples=30)
@given(st.integers(0, 1000))
def test_refinement_ends_where_nothing_near_is_better(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = transform(exp_so3(rng.uniform(-2.0, 2.0, 3)), (*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.6, 2.0)))
    pixels = project_points(T, MODEL.keypoints, K) + 3.0 * rng.standard_normal((9, 2))
    start = perturb(T, np.concatenate([rng.uniform(-0.05, 0.05, 3), rng.uniform(-0.3, 0.3, 3)]))
    found, error = kernels.refine(start, MODEL.keypoints, pixels, CAMERA)
    assert error <= kernels.squared_error(start, MODEL.keypoints, pixels, CAMERA)
    assert error == pytest.approx(float(_reprojection(found, pixels) @ _reprojection(found, pixels)), rel=1e-6)
    around = [perturb(found, s * 1e-4 * xi) for xi in np.eye(6) for s in (1.0, -1.0)]
    assert all(kernels.squared_error(near, MODEL.keypoints, pixels, CAMERA) >= error * (1.0 - 1e-6) for near in around)


def test_a_pose_behind_the_camera_is_given_back() -> None:
    behind = transform(translation=(0.0, 0.0, -1.0))
    found, error = kernels.refine(behind, MODEL.keypoints, np.zeros((9, 2)), CAMERA)
    assert error == np.inf and np.array_equal(found, behind)


def test_covariance_is_that_of_the_noise() -> None:
    rng = np.random.default_rng(0)
    T = transform(exp_so3(np.array([2.0, 0.3, -0.4])), (0.1, 0.0, 1.2))
    config = PnpConfig(error_correlation=1.0)
    found = [solve_pose(_detection(T, rng.standard_normal((9, 2))), MODEL, K, 0, config)[0] for _ in range(80)]
    errors = np.array([h.T_camera_object[:3, 3] - T[:3, 3] for h in found])
    expected = np.mean([h.covariance[:3, :3] for h in found], axis=0)
    ratio = np.sqrt(np.diag(errors.T @ errors / len(errors)) / np.diag(expected))
    assert np.all((ratio > 0.6) & (ratio < 1.6))


def test_corners_that_a_detector_confuses_between_symmetric_poses_are_sorted_out() -> None:
    model = load_object("klt3147")
    T = transform(exp_so3(np.array([2.1, 0.2, 0.3])), (0.0, 0.05, 1.3))
    pixels = project_points(T, model.keypoints, K)
    mirrored = project_points(T @ model.symmetries.discrete[1], model.keypoints, K)
    pixels[[0, 3]] = mirrored[[0, 3]]
    detection = Detection("klt3147", pixels, np.ones(9), np.zeros(4), 0.9)
    turns = T[:3, :3] @ model.symmetries.discrete[:, :3, :3]
    hypotheses = solve_pose(detection, model, K, 0, PnpConfig(max_error=1.0))
    assert min(angle_between(h.T_camera_object[:3, :3], R) for h in hypotheses for R in turns) < np.deg2rad(8)


def test_unusable_keypoints_give_no_hypothesis() -> None:
    T = transform(exp_so3(np.array([2.0, 0.3, -0.4])), (0.1, 0.0, 1.2))
    good = _detection(T)
    for pixels in (np.full((9, 2), np.nan), np.full((9, 2), 100.0), np.linspace(0, 300, 18).reshape(9, 2)):
        broken = Detection(good.class_name, pixels, good.keypoint_sigma, good.box, good.score)
        assert all(np.isfinite(h.T_camera_object).all() for h in solve_pose(broken, MODEL, K, 0))
    assert solve_pose(Detection("powerdrill", np.full((9, 2), np.nan), np.ones(9), np.zeros(4), 1.0), MODEL, K, 0) == []
    partly = good.keypoints.copy()
    partly[[0, 5]] = np.nan
    best = solve_pose(Detection("powerdrill", partly, np.ones(9), good.box, 0.9), MODEL, K, 0)[0]
    assert np.linalg.norm(best.T_camera_object[:3, 3] - T[:3, 3]) < 1e-3
    with pytest.raises(InvalidValueError, match="ambiguity_ratio"):
        PnpConfig(ambiguity_ratio=0.5)
