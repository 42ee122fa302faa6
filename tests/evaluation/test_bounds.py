"""The Cramer-Rao bound is what the best estimator reaches, and grows and shrinks as information does."""

import numpy as np
import pytest

from simtrack.contracts import Float64
from simtrack.evaluation.bounds import median_length, shared_pixels, translation_bound
from simtrack.sensors.depth_noise import PRESETS


def box_readings(rng: np.random.Generator, count: int = 300) -> tuple[Float64, Float64, Float64]:
    """Normals, points and rays (z = 1) on three faces of a box at 1 m that is turned to the camera."""
    turn = np.linalg.qr(np.array([[1.0, 0.4, 0.3], [-0.5, 1.0, 0.2], [0.2, -0.6, 1.0]]))[0]
    faces = rng.integers(0, 3, count)
    local = rng.uniform(-0.1, 0.1, (count, 3))
    normals = np.eye(3)[faces]
    local[np.arange(count), faces] = 0.1
    towards = -np.sign(turn[2])  # of the faces that look to the camera
    points = (local * towards) @ turn.T
    origin = np.array([0.05, -0.02, 1.0])
    directions = (points + origin) / (points + origin)[:, 2:]
    return (normals * towards) @ turn.T, points, directions


def test_the_best_linear_estimator_reaches_the_bound() -> None:
    rng = np.random.default_rng(1)
    normals, points, directions = box_readings(rng)
    sigmas = rng.uniform(0.001, 0.004, len(points))
    bound = translation_bound(normals, points, directions, sigmas)
    J = np.hstack([normals, np.cross(points, normals)]) / np.einsum("ij,ij->i", normals, directions)[:, None]
    errors = sigmas[:, None] * rng.standard_normal((len(points), 4000))
    found = np.linalg.lstsq(J / sigmas[:, None], errors / sigmas[:, None], rcond=None)[0][:3]
    assert np.cov(found) == pytest.approx(bound, rel=0.15, abs=1e-2 * np.trace(bound))
    assert np.median(np.linalg.norm(found, axis=0)) == pytest.approx(median_length(bound), rel=0.05)


def test_it_grows_with_the_noise_and_shrinks_with_the_number_of_readings() -> None:
    parts = box_readings(np.random.default_rng(2))
    sigmas = np.full(len(parts[0]), 0.002)
    bound = translation_bound(*parts, sigmas)
    assert translation_bound(*parts, 3 * sigmas) == pytest.approx(9 * bound)
    twice = [np.concatenate([part, part]) for part in (*parts, sigmas)]
    assert translation_bound(*twice) == pytest.approx(0.5 * bound)


def test_a_single_plane_and_nothing_at_all_bound_nothing() -> None:
    normals, points, directions = box_readings(np.random.default_rng(3))
    flat = np.abs(normals @ normals[0]) > 0.99
    assert np.isinf(translation_bound(normals[flat], points[flat], directions[flat], np.ones(flat.sum()))).all()
    assert np.isinf(translation_bound(normals[:0], points[:0], directions[:0], np.ones(0))).all()


def test_shared_noise_counts_as_often_as_averages_of_it_say() -> None:
    from simtrack.sensors.depth_kernels import blend_correlated, window

    noise, rng = PRESETS["xtion"], np.random.default_rng(4)
    averages = []
    for _ in range(60):
        axial = rng.standard_normal((64, 64)).astype(np.float32)
        white = rng.random((64 + noise.correlation_window - 1,) * 2).astype(np.float32)
        blend_correlated(axial, white, window(noise.correlation_window), noise.correlated_share)
        averages.append(
            [axial[:32, :32].mean(), axial[:32, 32:].mean(), axial[32:, :32].mean(), axial[32:, 32:].mean()]
        )
    assert np.var(averages) * 32 * 32 == pytest.approx(shared_pixels(noise), rel=0.3)
    assert shared_pixels(PRESETS["ideal"]) == 1.0
