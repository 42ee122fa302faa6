"""Distance and collision of meshes against closed forms, exhaustive search and laws."""

import itertools

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.raycast import RayScene, TriangleMesh
from simtrack.raycast.distance import MeshDistance, instance_distance, mesh_distance, meshes_collide
from simtrack.raycast.triangles import between_triangles

SEEDS = st.integers(0, 2**32 - 1)
BOX = TriangleMesh(*(lambda mesh: (mesh.vertices, mesh.faces))(trimesh.creation.box((1.0, 1.0, 1.0))))


def shape(mesh: trimesh.Trimesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces)


def ball(radius: float, subdivisions: int = 3) -> TriangleMesh:
    return shape(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius))


def random_pose(rng: np.random.Generator, spread: float = 1.0) -> np.ndarray:
    return transform(exp_so3(rng.normal(size=3)), spread * rng.normal(size=3))


def posed(mesh: TriangleMesh, T: np.ndarray) -> np.ndarray:
    """(F, 3, 3) triangles in the map frame."""
    return (mesh.vertices.astype(float) @ T[:3, :3].T + T[:3, 3])[mesh.faces]


def exhaustive(first: np.ndarray, second: np.ndarray) -> float:
    """Least distance of two sets of triangles: of all pairs."""
    pairs = itertools.product([tuple(map(tuple, t)) for t in first], [tuple(map(tuple, t)) for t in second])
    return float(np.sqrt(min(between_triangles(a, b)[0] for a, b in pairs)))


@given(SEEDS)
@settings(max_examples=60)
def test_triangles_are_as_far_apart_as_no_pair_of_their_points(seed: int) -> None:
    """No point of one is nearer to one of the other, and the points found lie on the triangles."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 3, 3)) + rng.normal(size=(2, 1, 3)) * rng.choice([0.0, 1.0, 3.0])
    square, p, q = between_triangles(tuple(map(tuple, a)), tuple(map(tuple, b)))
    assert np.linalg.norm(np.subtract(p, q)) == pytest.approx(np.sqrt(square), abs=1e-9)
    weights = rng.dirichlet([0.6] * 3, (2, 2000))
    samples = weights[0] @ a, weights[1] @ b
    assert (np.linalg.norm(samples[0] - samples[1], axis=1) >= np.sqrt(square) - 1e-9).all()
    for point, corners in ((p, a), (q, b)):
        coordinates = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), np.append(point, 1.0), rcond=None)[0]
        np.testing.assert_allclose(coordinates @ corners, point, atol=1e-8)
        assert (coordinates > -1e-7).all()
    assert between_triangles(tuple(map(tuple, b)), tuple(map(tuple, a)))[0] == pytest.approx(square, abs=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_the_trees_find_what_an_exhaustive_search_finds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    kinds = [
        trimesh.creation.icosphere(subdivisions=1, radius=0.5),
        trimesh.creation.cone(0.4, 0.9, sections=7),
        trimesh.creation.torus(0.6, 0.2, major_sections=9, minor_sections=5),
    ]
    first, second = (shape(kinds[k]) for k in rng.integers(3, size=2))
    for spread in (0.2, 0.7, 2.0):
        T_a, T_b = random_pose(rng, spread), random_pose(rng, spread)
        T_a[:3, :3] = T_a[:3, :3] @ np.diag(rng.uniform(0.5, 1.5, 3) * rng.choice([-1, 1], 3))
        found = mesh_distance(first, T_a, second, T_b)
        expected = exhaustive(posed(first, T_a), posed(second, T_b))
        assert abs(found.distance) == pytest.approx(expected, abs=1e-9)
        assert np.linalg.norm(found.first - found.second) == pytest.approx(expected, abs=1e-9)
        assert found.crossing == (expected == 0.0)


@given(SEEDS)
@settings(max_examples=40)
def test_balls_in_closed_form(seed: int) -> None:
    rng = np.random.default_rng(seed)
    radii, centres = rng.uniform(0.2, 1.0, 2), rng.normal(size=(2, 3))
    small, big = ball(radii[0]), ball(radii[1])
    T = [transform(exp_so3(rng.normal(size=3)), centre) for centre in centres]
    found, apart = mesh_distance(small, T[0], big, T[1]), float(np.linalg.norm(centres[0] - centres[1]))
    sag = 0.01 * radii.sum()  # of the facets
    if apart > radii.sum() + sag:
        assert found.distance == pytest.approx(apart - radii.sum(), abs=sag)
    elif apart < abs(radii[0] - radii[1]) - sag:
        assert found.distance == pytest.approx(apart - abs(radii[0] - radii[1]), abs=sag)
        assert found.colliding and not found.crossing
    elif abs(radii[0] - radii[1]) + sag < apart < radii.sum() - sag:
        assert found.distance == 0.0 and found.crossing
        deep = mesh_distance(small, T[0], big, T[1], depth=True).distance
        assert deep < 0.0
        if apart > max(radii):  # then the deepest points lie between the centres
            facet = 0.2 * radii.max()
            assert apart - radii.sum() - sag <= deep <= min(0.0, apart - radii.sum() + facet)


def test_boxes_face_edge_and_corner_to_corner() -> None:
    for offset, expected in (((1.25, 0, 0), 0.25), ((1.3, 1.4, 0), 0.5), ((1.1, 1.2, 1.2), 0.3), ((0.5, 0, 0), 0.0)):
        found = mesh_distance(BOX, np.eye(4), BOX, transform(translation=offset))
        assert found.distance == pytest.approx(expected, abs=1e-12)
    touching = mesh_distance(BOX, np.eye(4), BOX, transform(translation=(1.0, 0.0, 0.0)))
    assert touching.crossing and touching.colliding and touching.distance == 0.0
    stacked = mesh_distance(BOX, np.eye(4), BOX, transform(translation=(0.1, 0.2, 1.003)))
    assert stacked.distance == pytest.approx(0.003, abs=1e-9)
    deep = mesh_distance(BOX, np.eye(4), BOX, transform(translation=(0.03, 0.02, 0.9)), depth=True)
    assert deep.distance == pytest.approx(-0.02, abs=1e-6)  # each corner is nearest to a side face of the other


def test_what_is_inside_is_colliding_and_what_is_open_has_no_inside() -> None:
    small, big = ball(0.2), ball(1.0)
    shell = TriangleMesh(big.vertices, big.faces[:-1])
    T = transform(translation=(0.1, 0.0, 0.0))
    inside = mesh_distance(small, T, big, np.eye(4))
    assert inside.distance == pytest.approx(-0.7, abs=0.02) and inside.colliding and not inside.crossing
    assert mesh_distance(big, np.eye(4), small, T).distance == pytest.approx(inside.distance, abs=1e-9)
    for limit in (0.0, 0.1, 2.0):
        assert mesh_distance(small, T, big, np.eye(4), limit).colliding
        assert not mesh_distance(small, T, shell, np.eye(4), limit).colliding
    assert meshes_collide(small, T, big, np.eye(4)) and not meshes_collide(small, T, shell, np.eye(4))
    assert mesh_distance(small, T, shell, np.eye(4)).distance == pytest.approx(0.7, abs=0.02)


@given(SEEDS)
@settings(max_examples=30)
def test_laws(seed: int) -> None:
    """Symmetry, invariance to a common motion and to the limit, and points that lie on the surfaces."""
    rng = np.random.default_rng(seed)
    first, second = ball(0.4, 2), shape(trimesh.creation.cylinder(0.2, 1.0, sections=9))
    T_a, T_b, T = random_pose(rng, 0.8), random_pose(rng, 0.8), random_pose(rng, 3.0)
    found = mesh_distance(first, T_a, second, T_b)

    def same(other: MeshDistance) -> None:
        assert other.distance == pytest.approx(found.distance, abs=1e-9)
        assert other.crossing == found.crossing

    same(mesh_distance(second, T_b, first, T_a))
    same(mesh_distance(first, T @ T_a, second, T @ T_b))
    if found.distance > 0.0:
        same(mesh_distance(first, T_a, second, T_b, found.distance * 1.001))
        nothing = mesh_distance(first, T_a, second, T_b, found.distance * 0.999)
        assert np.isinf(nothing.distance) and np.isnan(nothing.first).all() and not nothing.colliding
    assert meshes_collide(first, T_a, second, T_b) == found.colliding
    with RayScene() as scene:
        scene.add(first, T_a, instance=4)
        scene.add(second, T_b, instance=9)
        same(instance_distance(scene, 4, 9))
        for point, instance in ((found.first, 4), (found.second, 9)):
            scene.set_enabled(13 - instance, False)
            assert scene.closest_points(point[None]).distances[0] < 1e-6
            scene.set_enabled(13 - instance, True)


def test_far_from_the_origin_distances_keep_their_precision() -> None:
    away = np.array([5000.0, -3000.0, 100.0])
    near = mesh_distance(BOX, np.eye(4), BOX, transform(translation=(1.0001, 0.3, 0.2)))
    far = mesh_distance(BOX, transform(translation=away), BOX, transform(translation=away + [1.0001, 0.3, 0.2]))
    assert near.distance == pytest.approx(1e-4, abs=1e-12)
    assert far.distance == pytest.approx(1e-4, abs=1e-9)


def test_misuse_is_told() -> None:
    with pytest.raises(InvalidValueError, match="T_map_second"):
        mesh_distance(BOX, np.eye(4), BOX, np.zeros((4, 4)))
    with pytest.raises(InvalidValueError, match="max_distance"):
        mesh_distance(BOX, np.eye(4), BOX, np.eye(4), -1.0)
    with pytest.raises(InvalidValueError, match="instance = 1"), RayScene() as scene:
        scene.add(BOX)
        instance_distance(scene, 0, 1)
