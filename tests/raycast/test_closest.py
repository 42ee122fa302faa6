"""Closest points against an exhaustive search and closed forms."""

import numpy as np
import pytest
import trimesh

from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.raycast import RayScene, TriangleMesh

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
BOX = trimesh.creation.box((0.6, 0.4, 0.8))


@pytest.mark.parametrize("scale", [(1, 1, 1), (2, 2, 2), (1, -1, 1), (0.3, -1.7, 1.1)])
@pytest.mark.parametrize("limit", [np.inf, 0.3])
def test_posed_instances_equal_an_exhaustive_search(scale: tuple[float, ...], limit: float) -> None:
    T = transform(exp_so3(np.array([0.3, 0.2, -0.9])) @ np.diag(scale), (0.7, 0.2, 0.1))
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (700, 3))
    results = []
    for use_fallback in (False, True):
        with RayScene(use_fallback=use_fallback) as scene:
            scene.add(TriangleMesh(BALL.vertices, BALL.faces), transform(translation=(-0.4, 0, 0)))
            scene.add(TriangleMesh(BOX.vertices, BOX.faces), T, instance=3)
            results.append(scene.closest_points(points, limit))
    fast, oracle = results
    np.testing.assert_array_equal(np.isinf(fast.distances), np.isinf(oracle.distances))
    found = fast.instances >= 0
    assert found.any()
    np.testing.assert_allclose(fast.distances[found], oracle.distances[found], atol=1e-6)
    assert (fast.instances == oracle.instances).mean() > 0.995
    away = np.linalg.norm(fast.points[found] - points[found], axis=1)
    np.testing.assert_allclose(away, fast.distances[found], atol=2e-6)


def test_a_box_in_closed_form() -> None:
    half = np.array([0.3, 0.2, 0.4])
    points = np.random.default_rng(1).uniform(-2, 2, (500, 3))
    points = points[(np.abs(points) > half).any(axis=1)]
    with RayScene() as scene:
        scene.add(TriangleMesh(BOX.vertices, BOX.faces))
        found = scene.closest_points(points)
    np.testing.assert_allclose(found.points, np.clip(points, -half, half), atol=1e-6)


def test_hidden_instances_bad_points_and_misuse() -> None:
    with RayScene() as scene:
        scene.add(TriangleMesh(BOX.vertices, BOX.faces))
        scene.add(TriangleMesh(BALL.vertices, BALL.faces), transform(translation=(2, 0, 0)))
        scene.set_enabled(0, False)
        found = scene.closest_points([[0.5, 0, 0], [np.nan, 0, 0]])
        assert found.instances.tolist() == [1, -1]
        assert found.distances[0] == pytest.approx(1.0, abs=1e-3)
        with pytest.raises(InvalidValueError, match="points"):
            scene.closest_points(np.zeros(3))
        with pytest.raises(InvalidValueError, match="max_distance"):
            scene.closest_points(np.zeros((1, 3)), -1.0)
