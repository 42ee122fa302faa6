"""Closest points against an exhaustive search and closed forms."""

import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

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


def soup(mesh: trimesh.Trimesh) -> TriangleMesh:
    """Every face with vertices of its own, as an STL file has them."""
    return TriangleMesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))


def notched() -> trimesh.Trimesh:
    """An L, whose reentrant edge and corners are where signs by face normals go wrong."""
    outline = [(0.0, 0.0), (1.0, 0.0), (1.0, 0.4), (0.4, 0.4), (0.4, 1.0), (0.0, 1.0)]
    return trimesh.creation.extrude_polygon(shapely.Polygon(outline), 0.5)


SHEARED = np.array([[0.9, 0.4, 0.0, 0.1], [0.0, 1.3, -0.2, 0.2], [0.3, 0.0, 0.6, -0.3], [0.0, 0.0, 0.0, 1.0]])
MIRRORED = SHEARED @ np.diag([1.0, -1.0, 1.0, 1.0])


@pytest.mark.parametrize("T", [np.eye(4), SHEARED, MIRRORED], ids=["identity", "sheared", "mirrored"])
@pytest.mark.parametrize(
    "mesh",
    [notched(), trimesh.creation.annulus(0.2, 0.5, 0.6, sections=12), trimesh.creation.cone(0.5, 1.0, sections=5)],
    ids=["notched", "annulus", "cone"],
)
def test_signs_are_negative_inside_closed_meshes(mesh: trimesh.Trimesh, T: np.ndarray) -> None:
    low, high = mesh.bounds
    points = np.random.default_rng(2).uniform(low - 0.5, high + 0.5, (2000, 3))
    inside = mesh.contains(points)
    points = points @ T[:3, :3].T + T[:3, 3]
    assert 0.02 < inside.mean() < 0.9
    for use_fallback in (False, True):
        for shape in (TriangleMesh(mesh.vertices, mesh.faces), soup(mesh)):
            assert shape.topology.closed
            with RayScene(use_fallback) as scene:
                scene.add(shape, T)
                unsigned, found = scene.closest_points(points), scene.closest_points(points, signed=True)
            np.testing.assert_array_equal(np.abs(found.distances), unsigned.distances)
            np.testing.assert_array_equal(found.distances < 0.0, inside)


def test_open_meshes_have_no_inside_and_every_instance_its_own() -> None:
    half = BOX.copy()
    half.update_faces(np.arange(len(half.faces)) > 1)
    shape = TriangleMesh(half.vertices, half.faces)
    assert not shape.topology.closed
    twice = TriangleMesh(np.concatenate([BOX.vertices] * 2), np.concatenate([BOX.faces, BOX.faces + 8]))
    assert not twice.topology.closed  # edges with two faces on either side
    points = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [9.0, 0.0, 0.0]]
    with RayScene() as scene:
        scene.add(shape)
        scene.add(TriangleMesh(BOX.vertices, BOX.faces), transform(translation=(2, 0, 0)))
        found = scene.closest_points(points, 3.0, signed=True)
    assert found.distances.tolist() == pytest.approx([0.2, -0.2, np.inf])
    assert found.instances.tolist() == [0, 1, -1]


@given(st.integers(0, 2**31), st.floats(0.05, 2.0))
@settings(max_examples=25)
def test_signed_distance_of_a_ball_is_that_of_its_radius(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    T = transform(exp_so3(rng.normal(size=3)) * scale, rng.normal(size=3))
    points = T[:3, 3] + rng.normal(size=(50, 3)) * scale
    with RayScene() as scene:
        scene.add(TriangleMesh(BALL.vertices, BALL.faces), T)
        found = scene.closest_points(points, signed=True)
    exact = np.linalg.norm(points - T[:3, 3], axis=1) - 0.5 * scale
    np.testing.assert_allclose(found.distances, exact, atol=0.02 * scale)  # of the facets
