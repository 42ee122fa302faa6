from collections.abc import Callable

import numpy as np
import pytest

from simtrack.geometry.meshes import area, face_areas, face_normals, is_closed, validate, volume
from simtrack.geometry.transforms import apply, is_rigid
from simtrack.simulation.building import fixtures, furniture
from simtrack.simulation.building.furniture import Furniture

BUILDERS: dict[str, Callable[[], Furniture]] = {
    "workbench": furniture.workbench,
    "shelf": furniture.shelf,
    "bin": furniture.bin_box,
    "cupboard": furniture.cupboard,
    "desk": furniture.desk,
    "table": furniture.table,
    "round table": furniture.round_table,
    "chair": furniture.chair,
    "office chair": furniture.office_chair,
    "filing cabinet": furniture.filing_cabinet,
    "sofa": furniture.sofa,
    "counter": furniture.counter,
    "door leaf": fixtures.door_leaf,
    "door frame": fixtures.door_frame,
    "whiteboard": fixtures.whiteboard,
    "radiator": fixtures.radiator,
    "column": fixtures.column,
    "round column": fixtures.round_column,
    "cart": fixtures.cart,
    "plant": lambda: fixtures.plant(rng=np.random.default_rng(0)),
    "trash bin": fixtures.trash_bin,
    "stool": fixtures.stool,
    "carton": fixtures.carton,
}


@pytest.mark.parametrize("name", BUILDERS)
def test_pieces_are_closed_coloured_and_centred(name: str) -> None:
    piece = BUILDERS[name]()
    mesh = validate(piece.mesh, name)
    assert is_closed(mesh)
    assert volume(mesh) > 0
    assert face_areas(mesh).min() > 1e-9
    assert mesh.face_colors is not None
    assert len(mesh.faces) < 400
    np.testing.assert_allclose(mesh.bounds, [-piece.extents / 2, piece.extents / 2], atol=1e-12)
    # the builder's frame stands on the floor
    assert piece.centre[2] - piece.extents[2] / 2 >= -1e-9


@pytest.mark.parametrize("name", BUILDERS)
def test_collision_boxes_fill_the_piece_and_no_more(name: str) -> None:
    piece = BUILDERS[name]()
    assert piece.collision
    for T, size in piece.collision:
        assert is_rigid(T)
        assert (size > 0).all()
        corners = apply(T, np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size / 2)
        assert (np.abs(corners) <= piece.extents / 2 + 1e-9).all()


@pytest.mark.parametrize("name", BUILDERS)
def test_supports_lie_on_faces_that_look_up(name: str) -> None:
    piece = BUILDERS[name]()
    upward = piece.mesh.triangles[face_normals(piece.mesh)[:, 2] > 0.99]
    for T_part_face, size in piece.supports:
        np.testing.assert_allclose(T_part_face[:3, :3], np.eye(3))
        assert (size > 0.1).all()
        level = np.abs(upward[:, :, 2] - T_part_face[2, 3]).max(axis=1) < 1e-9
        assert level.any()
        low, high = upward[level].reshape(-1, 3).min(axis=0), upward[level].reshape(-1, 3).max(axis=0)
        assert (T_part_face[:2, 3] - size / 2 >= low[:2] - 1e-9).all()
        assert (T_part_face[:2, 3] + size / 2 <= high[:2] + 1e-9).all()


def test_workbench_has_the_size_asked_for() -> None:
    bench = furniture.workbench(0.7, 2.0, 0.9)
    T_part_face, size = bench.supports[0]
    assert T_part_face[2, 3] + bench.centre[2] == pytest.approx(0.9)
    np.testing.assert_allclose(bench.extents[:2], [0.7, 2.0])
    assert size[1] == pytest.approx(2.0)
    assert area(bench.mesh) > 2.8


def test_a_placed_piece_stands_where_and_as_it_was_told() -> None:
    piece = furniture.cupboard()
    part = piece.placed("c", 2.0, 3.0, np.pi / 2, room="lab", z=0.5)
    np.testing.assert_allclose(part.T_map_part[:2, 3], [2.0, 3.0], atol=0.02)
    assert apply(part.T_map_part, part.mesh.vertices)[:, 2].min() == pytest.approx(0.5)
    np.testing.assert_allclose(part.T_map_part[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.ptp(part.footprint(), axis=0), piece.extents[[1, 0]], atol=1e-9)
