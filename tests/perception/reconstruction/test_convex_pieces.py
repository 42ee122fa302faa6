"""Boards and blocks of furniture are their hulls, also when noisy and without undersides; what is hollow is not."""

import numpy as np
import pytest

from simtrack.geometry.meshes import (
    Mesh,
    area,
    box_mesh,
    concatenate,
    convex_hull,
    face_normals,
    subdivide_to,
    transformed,
    volume,
)
from simtrack.geometry.planes import detect_planes
from simtrack.geometry.transforms import transform
from simtrack.perception.reconstruction.convex_pieces import (
    THICKNESS,
    connected_pieces,
    convex_pieces,
    hull_of_piece,
    levelled,
)


def at(mesh: Mesh, x: float, y: float, z: float) -> Mesh:
    return transformed(mesh, transform(None, (x, y, z)))


def without(mesh: Mesh, axis: int, sign: float) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[sign * face_normals(mesh)[:, axis] < 0.7])


def wavy(mesh: Mesh, faces: int, size: float) -> Mesh:
    """A finer mesh with smooth waves of `size` metres."""
    fine = subdivide_to(mesh, faces)
    return Mesh(fine.vertices + size * np.sin(fine.vertices[:, [1, 2, 0]] / 0.25), fine.faces)


def _joined(mesh: Mesh) -> Mesh:
    """The mesh with one vertex at each place."""
    places, index = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
    return Mesh(places, index.reshape(-1)[mesh.faces].astype(np.int32))


BOARD, LEG = box_mesh((1.2, 0.6, 0.04)), box_mesh((0.06, 0.06, 0.7))
TABLE = concatenate([at(BOARD, 0, 0, 0.72), *(at(LEG, x, y, 0.35) for x in (-0.5, 0.5) for y in (-0.2, 0.2))])


def test_a_table_is_a_board_and_four_legs() -> None:
    hulls, rest = convex_pieces(TABLE)
    assert rest is None
    assert sorted(volume(hull) for hull in hulls) == pytest.approx(sorted([1.2 * 0.6 * 0.04, *[0.7 * 0.06**2] * 4]))


def test_noise_and_missing_undersides_change_nothing_of_that() -> None:
    seen = concatenate([wavy(without(piece, 2, -1.0), 60, 0.004) for piece in (at(BOARD, 0, 0, 0.72), LEG)])
    hulls, rest = convex_pieces(seen)
    assert rest is None
    assert [volume(hull) for hull in hulls] == pytest.approx([1.2 * 0.6 * 0.04, 0.7 * 0.06**2], rel=0.4)


def test_a_solid_that_is_concave_is_left() -> None:
    elbow = _joined(concatenate([box_mesh((0.4, 0.1, 0.1)), at(box_mesh((0.1, 0.4, 0.1)), 0.15, 0.25, 0)]))
    hulls, rest = convex_pieces(concatenate([elbow, at(BOARD, 2, 0, 0)]))
    assert len(hulls) == 1
    assert rest is not None
    assert len(rest.faces) == len(elbow.faces)


def test_a_tub_is_plates_behind_its_faces_and_stays_hollow() -> None:
    tub = without(box_mesh((0.4, 0.3, 0.2)), 2, 1.0)
    hulls, rest = convex_pieces(tub)
    assert rest is None
    assert sum(volume(hull) for hull in hulls) == pytest.approx(THICKNESS * area(tub), rel=0.01)
    inside = np.array([[0.0, 0.0, 0.08], [0.19, 0.14, 0.09], [-0.19, 0.0, -0.09]])
    for hull in hulls:
        normals = face_normals(hull)
        outside = (inside @ normals.T - np.einsum("fd,fd->f", normals, hull.triangles[:, 0])).max(axis=1)
        assert (outside > 0.0).all()


def test_boards_that_share_corners_are_told_apart_by_their_vertices() -> None:
    side, shelf = box_mesh((0.02, 0.4, 1.0)), box_mesh((0.8, 0.4, 0.02))
    unit = concatenate([at(side, -0.41, 0, 0.5), at(side, 0.41, 0, 0.5), at(shelf, 0, 0, 0.99)])
    assert len(connected_pieces(unit)) == 1
    hulls, rest = convex_pieces(unit)
    assert rest is None
    assert len(hulls) == 3


def test_a_sheet_is_made_thick_behind_the_side_that_it_shows() -> None:
    sheet = Mesh(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    hull = hull_of_piece(sheet)
    assert hull is not None
    assert hull.bounds[:, 2] == pytest.approx([-THICKNESS, 0.0])
    line = Mesh(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]), np.array([[0, 1, 2]], np.int32))
    assert hull_of_piece(line) is None


def test_level_faces_become_level_where_they_were() -> None:
    seen = wavy(BOARD, 400, 0.004)
    T_map_mesh = transform(None, (3.0, -2.0, 0.7))
    planes = tuple(plane.moved(T_map_mesh) for plane in detect_planes(seen, np.random.default_rng(0)))
    flat = levelled(seen, planes, transform(None, (-3.0, 2.0, -0.7)))
    top = max((p for p in planes if p.normal[2] > 0.9), key=lambda plane: plane.area)
    heights = flat.vertices[np.unique(flat.faces[top.faces]), 2]
    assert np.ptp(heights) < 1e-12
    assert heights[0] == pytest.approx(0.02, abs=0.004)
    np.testing.assert_array_equal(flat.vertices[:, :2], seen.vertices[:, :2])
    assert convex_hull(flat.vertices).extents[2] < convex_hull(seen.vertices).extents[2]
