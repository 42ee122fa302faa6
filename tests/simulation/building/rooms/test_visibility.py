"""What of a surface can be seen at all: outsides, not undersides on the ground, insides and glued faces."""

from collections.abc import Sequence

import numpy as np
import pytest

from simtrack.contracts import Bool
from simtrack.errors import MeshError
from simtrack.geometry.meshes import Mesh, box_mesh, concatenate, face_normals, subdivide_to, transformed
from simtrack.geometry.transforms import transform
from simtrack.simulation.building.rooms.visibility import visible_faces


def board(size: Sequence[float], centre: Sequence[float]) -> Mesh:
    return subdivide_to(transformed(box_mesh(size), transform(translation=np.array(centre))), 60)


def cupboard(*, front: bool) -> tuple[Mesh, Bool]:
    """Six boards around 0.5 x 0.5 x 0.5 m, or five, and which of the faces look into it."""
    sides = [([0.54, 0.02, 0.54], [0.0, 0.26, 0.27]), ([0.54, 0.02, 0.54], [0.0, -0.26, 0.27])]
    sides += [([0.02, 0.5, 0.54], [x, 0.0, 0.27]) for x in (-0.26, 0.26)]
    sides += [([0.5, 0.5, 0.02], [0.0, 0.0, z]) for z in (0.01, 0.53)]
    mesh = concatenate([board(*side) for side in (sides if front else [sides[0], *sides[2:]])])
    offset = mesh.triangles.mean(axis=1) + 1e-4 * face_normals(mesh) - [0.0, 0.0, 0.27]
    return mesh, (np.abs(offset) < 0.25).all(axis=1)


def test_of_a_box_on_the_ground_everything_is_seen_but_its_underside() -> None:
    mesh = board([0.3, 0.5, 0.2], [3.0, -2.0, 0.9])
    assert np.array_equal(visible_faces(mesh), face_normals(mesh)[:, 2] > -0.5)


def test_a_table_is_seen_from_below() -> None:
    legs = [board([0.04, 0.04, 0.7], [x, y, 0.35]) for x in (-0.45, 0.45) for y in (-0.45, 0.45)]
    mesh = concatenate([board([1.0, 1.0, 0.03], [0.0, 0.0, 0.7151]), *legs])
    assert visible_faces(mesh)[:60][face_normals(mesh)[:60, 2] < -0.5].mean() > 0.8


def test_the_inside_of_a_cupboard_is_seen_if_it_is_open() -> None:
    closed, inside = cupboard(front=True)
    assert inside.sum() > 20
    assert not visible_faces(closed)[inside].any()
    opened, inside = cupboard(front=False)
    assert visible_faces(opened)[inside].all()


def test_faces_between_two_boards_are_hidden() -> None:
    lower, upper = board([0.4, 0.4, 0.05], [0.0, 0.0, 0.025]), board([0.4, 0.4, 0.05], [0.0, 0.0, 0.075])
    mesh = concatenate([lower, upper])
    between = np.isclose(mesh.triangles[:, :, 2], 0.05).all(axis=1)
    assert between.sum() > 10
    assert not visible_faces(mesh)[between].any()
    assert visible_faces(mesh)[~between & (face_normals(mesh)[:, 2] > -0.5)].all()


def test_a_mesh_without_faces_is_refused() -> None:
    with pytest.raises(MeshError, match="no faces"):
        visible_faces(Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32)))
