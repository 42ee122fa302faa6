"""Depth noise: marginal laws, correlation, shadows, losses, and a real PrimeSense camera."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.sensors.camera import XTION, pixel_rays
from simtrack.sensors.depth_noise import (
    PRESETS,
    SIMKINECT_BIAS,
    DepthNoiseConfig,
    apply_depth_noise,
    axial_sigma,
    draw_depth_noise,
    preset,
)

CAMERA = XTION.intrinsics


def only_axial(**changes: Any) -> DepthNoiseConfig:
    """The default preset with nothing but axial noise and rounding, and then the given changes."""
    off = {"lateral": "none", "shadow_baseline": 0.0, "grazing_dropout": np.pi / 2, "dropout": 0.0, "albedo_floor": 0.0}
    return DepthNoiseConfig(**(off | changes))


def plane(normal: tuple[float, float, float], z: float, camera: CameraIntrinsics = CAMERA) -> np.ndarray:
    """Depth image of a plane through (0, 0, z)."""
    n = np.array(normal) / np.linalg.norm(normal)
    return (n[2] * z / (pixel_rays(camera) @ n)).astype(np.float32)


def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.mark.parametrize("z", [0.6, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("step", [0.0, 0.125])
def test_marginal_sigma_is_the_models_with_and_without_rounding(z: float, step: float) -> None:
    config = only_axial(disparity_step=step)
    errors = apply_depth_noise(plane((0, 0, 1), z), None, CAMERA, config, rng()) - z
    assert errors.std() == pytest.approx(float(axial_sigma(z)), rel=0.06 if step else 0.03)
    assert abs(errors.mean()) < 0.1 * float(axial_sigma(z))


def test_sigma_grows_with_incidence_as_nguyen_says() -> None:
    tilt = np.deg2rad(72.0)
    depth = plane((np.sin(tilt), 0, -np.cos(tilt)), 1.5)
    middle = (slice(200, 280), slice(315, 325))
    camera = CAMERA
    errors = apply_depth_noise(depth, None, camera, only_axial(disparity_step=0.0), rng()) - depth
    expected = float(axial_sigma(1.5, tilt))
    assert expected > 1.3 * float(axial_sigma(1.5))
    assert errors[middle].std() == pytest.approx(expected, rel=0.15)
    assert float(axial_sigma(1.5, np.deg2rad(85))) == float(axial_sigma(1.5, np.deg2rad(80)))  # clamped
    np.testing.assert_allclose(axial_sigma(np.array([0.4, 1.4])), [0.0012, 0.0031])


def test_incidence_from_differences_equals_incidence_from_normals() -> None:
    from simtrack.sensors.depth_kernels import cosines_from_depth, cosines_from_normals, inverse_depth

    normal = np.array([0.5, -0.3, -1.0]) / np.linalg.norm([0.5, -0.3, -1.0])
    depth = plane((0.5, -0.3, -1.0), 1.5)
    depth[100:200, 100:300] = plane((0, 0, 1), 0.8)[100:200, 100:300]
    normals = np.tile(normal.astype(np.float32), (480, 640, 1))
    normals[100:200, 100:300] = (0, 0, -1)
    camera = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
    given, own = cosines_from_normals(normals, *camera), cosines_from_depth(inverse_depth(depth), *camera)
    np.testing.assert_allclose(own, given, atol=0.02)  # edges included: differences do not reach over them


def test_correlation_is_as_stated() -> None:
    config = only_axial(disparity_step=0.0, correlated_share=0.4, correlation_window=9)
    errors = apply_depth_noise(plane((0, 0, 1), 2.0), None, CAMERA, config, rng()) - 2.0
    errors /= errors.std()

    def correlation(lag: int) -> float:
        return float((errors[:, lag:] * errors[:, : errors.shape[1] - lag]).mean())

    assert 0.3 < correlation(1) < 0.4  # 0.4 times that of the binomial window at lag 1
    assert correlation(1) > correlation(3) > correlation(5) > -0.02
    assert abs(correlation(9)) < 0.02  # the window's width ends it
    white = only_axial(disparity_step=0.0, correlated_share=0.0)
    errors = apply_depth_noise(plane((0, 0, 1), 2.0), None, CAMERA, white, rng()) - 2.0
    assert abs(correlation(1)) < 0.02


def test_readings_are_multiples_of_an_eighth_of_a_pixel_of_disparity() -> None:
    depth = plane((0.3, 0.2, -1), 2.0)
    readings = apply_depth_noise(depth, None, CAMERA, PRESETS["xtion"], rng())
    levels = 577.0 * 0.075 / readings[readings > 0].astype(np.float64) / 0.125
    np.testing.assert_allclose(levels, np.round(levels), atol=2e-4)


def step_scene(front: float, back: float) -> np.ndarray:
    depth = np.full((480, 640), back, np.float32)
    depth[150:350, 300:420] = front
    return depth


def test_the_projectors_shadow_is_as_wide_as_geometry_says() -> None:
    config = only_axial(shadow_baseline=0.075, axial_offset=0.0, axial_quadratic=0.0)
    readings = apply_depth_noise(step_scene(1.0, 3.0), None, CAMERA, config, rng())
    row = readings[250] == 0
    width = 577.0 * 0.075 * (1 - 1 / 3)
    assert np.flatnonzero(row).max() == 299  # the projector stands at +x, so the shadow falls on the left
    assert row.sum() == pytest.approx(width, abs=1.5)
    assert not (readings[100] == 0).any()
    other = only_axial(shadow_baseline=-0.075, axial_offset=0.0, axial_quadratic=0.0)
    mirrored = apply_depth_noise(step_scene(1.0, 3.0), None, CAMERA, other, rng())[250] == 0
    assert np.flatnonzero(mirrored).min() == 420 and mirrored.sum() == row.sum()
    thin = np.full((480, 640), 3.0, np.float32)
    thin[:, 400:406] = 1.0
    row = apply_depth_noise(thin, None, CAMERA, config, rng())[250] == 0
    assert row.sum() == pytest.approx(6, abs=1.5)  # the projector sees the wall between a pole and its shadow
    assert np.flatnonzero(row).mean() == pytest.approx(402.5 - width, abs=2)
    slanted = plane((np.sin(1.3), 0, -np.cos(1.3)), 2.0)
    slanted[(slanted <= 0) | (slanted > 7.0)] = 0
    assert (apply_depth_noise(slanted, None, CAMERA, config, rng()) == 0).sum() == (slanted < 0.4).sum()


def test_lateral_jitter_stays_at_depth_edges() -> None:
    config = only_axial(lateral="edges", axial_offset=0, axial_quadratic=0, disparity_step=0)
    depth = step_scene(1.0, 1.2)
    changed = apply_depth_noise(depth, None, CAMERA, config, rng()) != depth
    rows, columns = np.nonzero(changed)
    assert changed.sum() > 100
    distance = np.minimum(np.abs(columns - 299.5), np.abs(columns - 419.5))
    distance = np.minimum(distance, np.minimum(np.abs(rows - 149.5), np.abs(rows - 349.5)))
    assert distance.max() <= 5
    left_edge = changed[200:300, 290:310].mean(0)
    assert 0.2 < left_edge[9:11].mean() < 0.6  # sigma 0.8 px moves this share of the nearest pixels over the edge


def test_losses_grow_with_incidence_and_darkness() -> None:
    lost = []
    for degrees in (0, 78, 82, 86):
        tilt = np.deg2rad(degrees)
        normals = np.tile(np.array([np.sin(tilt), 0, -np.cos(tilt)], np.float32), (480, 640, 1))
        readings = apply_depth_noise(plane((0, 0, 1), 1.0), normals, CAMERA, PRESETS["xtion"], rng())
        lost.append((readings[:, 315:325] == 0).mean())
    assert lost[0] < 0.01 and lost[0] < lost[1] < lost[2] < lost[3]
    assert lost[2] == pytest.approx(0.5, abs=0.1)
    albedo = np.full((480, 640), 0.5, np.float32)
    albedo[:240] = 0.02
    readings = apply_depth_noise(plane((0, 0, 1), 6.0), None, CAMERA, PRESETS["xtion"], rng(), albedo)
    assert (readings[:230] == 0).mean() > 0.3 > 0.05 > (readings[250:] == 0).mean()


def test_simkinect_is_biased_as_stated() -> None:
    for z in (1.0, 2.0, 3.0):
        # Averaged over a centimetre of depths: the preset rounds to centimetres on the way.
        depths = np.linspace(z - 0.05, z + 0.05, 640, dtype=np.float32) * np.ones((480, 1), np.float32)
        errors = apply_depth_noise(depths, None, CAMERA, PRESETS["simkinect"], rng()) - depths
        assert errors.mean() == pytest.approx(SIMKINECT_BIAS * z**2, rel=0.25)


def test_time_of_flight_mixes_depths_at_edges() -> None:
    readings = apply_depth_noise(step_scene(1.0, 3.0), None, CAMERA, PRESETS["kinect_v2"], rng())
    flying = (readings > 1.1) & (readings < 2.9)
    rows, columns = np.nonzero(flying)
    assert 100 < flying.sum() < 2000
    assert (np.abs(columns - 359.5) < 62).all() and (np.abs(rows - 249.5) < 102).all()


@pytest.mark.parametrize("name", PRESETS)
def test_bad_pixels_stay_without_reading_and_nothing_is_nan(name: str) -> None:
    depth = plane((0.2, 0.1, -1), 2.0)
    bad = np.zeros((480, 640), bool)
    bad[::7, ::3] = True
    depth[bad] = np.tile([0.0, np.nan, np.inf, -1.0, -np.inf], bad.sum() // 5 + 1)[: bad.sum()]
    normals = np.full((480, 640, 3), np.nan, np.float32)
    for n in (None, normals):
        readings = apply_depth_noise(depth, n, CAMERA, PRESETS[name], rng())
        assert np.isfinite(readings).all() and (readings >= 0).all()
        assert not readings[bad].any()
        assert readings.dtype == np.float32
    for nothing in (np.zeros((480, 640), np.float32), np.full((480, 640), np.nan, np.float32)):
        assert not apply_depth_noise(nothing, None, CAMERA, PRESETS[name], rng()).any()


def test_ideal_is_ideal_and_one_seed_repeats() -> None:
    depth = plane((0.2, 0.1, -1), 2.0)
    np.testing.assert_allclose(apply_depth_noise(depth, None, CAMERA, PRESETS["ideal"], rng()), depth, rtol=3e-7)
    a, b = (apply_depth_noise(depth, None, CAMERA, PRESETS["xtion"], rng()) for _ in range(2))
    assert a.tobytes() == b.tobytes()


def test_one_frame_takes_the_same_numbers_whatever_it_shows() -> None:
    states = []
    for depth in (plane((0, 0, 1), 1.0), np.zeros((480, 640), np.float32)):
        generator = rng()
        apply_depth_noise(depth, None, CAMERA, PRESETS["xtion"], generator)
        states.append(generator.bit_generator.state["state"])
    assert states[0] == states[1]


def test_randomness_may_be_drawn_ahead_of_the_image() -> None:
    depth = step_scene(1.0, 2.0)
    now = apply_depth_noise(depth, None, CAMERA, PRESETS["xtion"], rng())
    draws = draw_depth_noise(CAMERA, PRESETS["xtion"], rng())
    np.testing.assert_array_equal(apply_depth_noise(depth, None, CAMERA, PRESETS["xtion"], rng(), draws=draws), now)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"axial_offset": -1.0}, InvalidValueError),
        ({"correlated_share": 1.5}, InvalidValueError),
        ({"correlation_window": 4}, InvalidValueError),
        ({"max_incidence": 2.0}, InvalidValueError),
        ({"min_range": 9.0}, InvalidValueError),
        ({"dropout": float("nan")}, InvalidValueError),
        ({"lateral": "sideways"}, UnknownNameError),
    ],
)
def test_impossible_noise_is_refused(change: dict, error: type[Exception]) -> None:
    with pytest.raises(error):
        DepthNoiseConfig(**change)
    with pytest.raises(UnknownNameError, match="xtion"):
        preset("kinect_v9")
    with pytest.raises(InvalidValueError, match="depth_true"):
        apply_depth_noise(np.zeros((2, 2), np.float32), None, CAMERA, PRESETS["ideal"], rng())


def plane_residuals(depth: np.ndarray, camera: CameraIntrinsics, size: int = 41) -> np.ndarray:
    """(K, 3): depth in metres, RMS residual in metres and correlation at 3 px of patches that are nearly planar.

    A plane and a faint curvature are fitted to inverse depth: lens and calibration errors are not noise.
    """
    v, u = np.mgrid[:size, :size].astype(float) / size
    basis = np.linalg.qr(np.stack([np.ones_like(u), u, v, u * u, v * v, u * v], -1).reshape(-1, 6))[0]
    rows = []
    for top in range(0, camera.height - size, 20):
        for left in range(0, camera.width - size, 20):
            patch = depth[top : top + size, left : left + size].astype(float)
            if (patch <= 0).any():
                continue
            inverse = 1.0 / patch.ravel()
            residual = ((inverse - basis @ (basis.T @ inverse)) * patch.ravel() ** 2).reshape(size, size)
            sigma = residual.std()
            rows.append((patch.mean(), sigma, (residual[:, 3:] * residual[:, :-3]).mean() / sigma**2))
    return np.array(rows)


def test_a_real_primesense_camera_is_as_noisy(real_data: Path) -> None:
    """Walls at 1.7 to 2.7 m in five frames; the flattest patches, since furniture is no noise."""
    import cv2

    files = sorted((real_data / "open3d_rgbd" / "depth").glob("*.png"))
    if not files:
        pytest.skip(f"no depth images in {real_data / 'open3d_rgbd'}")
    camera = CameraIntrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
    images = [np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)) / 1000.0 for file in files]
    real = np.concatenate([plane_residuals(image, camera) for image in images])
    checked = 0
    for near, far in ((1.7, 2.0), (2.0, 2.3), (2.3, 2.7)):
        patches = real[(real[:, 0] >= near) & (real[:, 0] < far)]
        flat = patches[patches[:, 1] < np.quantile(patches[:, 1], 0.25)]
        z = float(np.median(flat[:, 0]))
        simulated = plane_residuals(
            apply_depth_noise(plane((0, 0, 1), z), None, camera, PRESETS["xtion"], rng()), camera
        )
        ratio = np.median(simulated[:, 1]) / np.median(flat[:, 1])
        assert 0.5 < ratio < 2.0, f"at {z:.2f} m the model's noise is {ratio:.2f} times the real one"
        assert abs(np.median(simulated[:, 2]) - np.median(flat[:, 2])) < 0.25
        checked += len(flat)
    assert checked > 100
