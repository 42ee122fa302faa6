import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import Room
from simtrack.geometry.meshes import area, concatenate, face_normals, is_closed, transformed
from simtrack.simulation.building.parts import polygon_area
from simtrack.simulation.building.shell import GLASS, Opening, room_shell

L_SHAPE = np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 3.0], [4.0, 3.0], [4.0, 7.0], [0.0, 7.0]])
COLORS = ((200, 200, 200), (90, 90, 90))


@settings(max_examples=20)
@given(edge=st.floats(0.2, 3.0))
def test_a_room_has_its_area_at_any_resolution_and_counts_are_exact(edge: float) -> None:
    room = Room("r", L_SHAPE, 0.0, 2.5)
    openings = {0: [Opening(1.0, 2.0, 0.0, 2.0, 0.06, None)], 4: [Opening(1.0, 2.5, 0.9, 2.2, 0.2, GLASS)]}
    pieces = room_shell(room, openings, COLORS)
    parts = [piece.part(edge) for piece in pieces]
    assert [piece.count(edge) for piece in pieces] == [len(part.mesh.faces) for part in parts]
    floors = sum(area(part.mesh) for part in parts if part.semantic_class == "floor")
    assert floors == pytest.approx(polygon_area(L_SHAPE))
    walls = sum(area(part.mesh) for part in parts if part.semantic_class == "wall")
    reveals = 0.06 * (2 * 2.0 + 2 * 1.0) + 0.2 * (2 * 1.3 + 2 * 1.5)
    assert walls == pytest.approx(2.5 * 32.0 - 1.0 * 2.0 + reveals)


def test_all_faces_look_into_the_room() -> None:
    room = Room("r", L_SHAPE, 0.0, 2.5)
    parts = [piece.part(0.7) for piece in room_shell(room, {4: [Opening(1.0, 2.5, 0.9, 2.2, 0.2, GLASS)]}, COLORS)]
    for part in parts:
        mesh = transformed(part.mesh, part.T_map_part)
        normals, middle = face_normals(mesh), mesh.triangles.mean(axis=1)
        if part.semantic_class == "floor":
            np.testing.assert_allclose(normals[:, 2], 1.0)
            np.testing.assert_allclose(middle[:, 2], 0.0, atol=1e-12)
        elif part.semantic_class == "ceiling":
            np.testing.assert_allclose(normals[:, 2], -1.0)
            np.testing.assert_allclose(middle[:, 2], 2.5)
        else:
            # x of the part frame points into the room; only reveals look sideways
            assert ((normals @ part.T_map_part[:3, 0] > 0.99) | (np.abs(normals @ part.T_map_part[:3, 0]) < 1e-9)).all()


def test_solids_leave_doors_open() -> None:
    room = Room("r", L_SHAPE, 0.0, 2.5)
    part = next(
        p.part(1.0)
        for p in room_shell(room, {0: [Opening(1.0, 2.0, 0.0, 2.0, 0.06, None)]}, COLORS)
        if "wall0" in p.name
    )
    passage = np.array([1.5, -0.03, 1.0])
    for T_part_box, size in part.collision:
        local = np.linalg.inv(part.T_map_part @ T_part_box) @ np.append(passage, 1.0)
        assert not (np.abs(local[:3]) < size / 2).all()


def test_sheets_of_a_wall_join_without_gaps_between_cells() -> None:
    room = Room("r", L_SHAPE, 0.0, 2.5)
    sheet = room_shell(room, {}, COLORS)[-1].sheets[0]
    coarse, fine = sheet.mesh(1.0), sheet.mesh(0.3)
    assert area(coarse) == pytest.approx(area(fine))
    # a flat sheet and its mirror image close up
    assert not is_closed(fine)
    back = type(fine)(fine.vertices, fine.faces[:, ::-1])
    assert is_closed(type(fine)(fine.vertices, np.concatenate([fine.faces, back.faces])))
    assert len(concatenate([coarse, fine]).faces) == len(coarse.faces) + len(fine.faces)
