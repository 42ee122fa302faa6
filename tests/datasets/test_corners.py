import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.datasets.corners import corners_of
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh, box_mesh, cylinder_mesh, face_normals
from tests.datasets.tabletop import BRACKET


def no_uv(mesh: Mesh) -> np.ndarray:
    return np.zeros((len(mesh.faces), 3, 2), np.float32)


@pytest.mark.parametrize("mesh", [box_mesh((1.0, 2.0, 3.0)), cylinder_mesh(0.5, 1.0, 24), BRACKET])
def test_corners_draw_the_same_mesh(mesh: Mesh) -> None:
    uv = np.random.default_rng(0).random((len(mesh.faces), 3, 2)).astype(np.float32)
    positions, normals, coordinates, faces = corners_of(mesh, uv)
    assert np.allclose(positions[faces], mesh.vertices[mesh.faces])
    assert np.array_equal(coordinates[faces], uv)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    # No corner's normal leaves the crease of its own face.
    assert np.einsum("fij,fj->fi", normals[faces], face_normals(mesh)).min() > np.cos(np.deg2rad(36.0))


def test_a_box_has_three_corners_a_vertex_and_a_round_thing_one_normal_a_vertex_of_its_wall() -> None:
    box = box_mesh((1.0, 1.0, 1.0))
    positions, normals, _, _ = corners_of(box, no_uv(box))
    assert len(positions) == 24 and np.allclose(np.abs(normals).max(axis=1), 1.0)
    can = cylinder_mesh(0.5, 1.0, 24)
    positions, normals, _, _ = corners_of(can, no_uv(can))
    assert len(positions) == 4 * 24 + 2  # two rings for the wall and two for the caps, and the caps' middles
    wall = np.abs(normals[:, 2]) < 0.5
    radial = positions[wall] * [1.0, 1.0, 0.0] / 0.5
    assert np.einsum("ij,ij->i", normals[wall], radial).min() > 0.99


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 3.0))
def test_any_triangles_can_be_drawn(seed: int, crease: float) -> None:
    rng = np.random.default_rng(seed)
    mesh = Mesh(rng.integers(-2, 3, (8, 3)).astype(float), rng.integers(0, 8, (20, 3)).astype(np.int32))
    positions, normals, _, faces = corners_of(mesh, no_uv(mesh), crease)
    assert np.array_equal(positions[faces], mesh.vertices[mesh.faces])
    assert np.isfinite(normals).all() and np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)


def test_coordinates_of_another_mesh_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="uv"):
        corners_of(BRACKET, np.zeros((3, 3, 2), np.float32))
