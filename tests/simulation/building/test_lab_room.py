import numpy as np
import pytest

from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.meshes import face_areas
from simtrack.simulation.building.lab_room import LabRoomConfig, lab_room
from simtrack.simulation.building.parts import room_at


def test_the_room_is_furnished_light_and_deterministic() -> None:
    world, again = (lab_room(np.random.default_rng(3)) for _ in range(2))
    assert world.triangles < 30_000
    names = [part.name for part in world.parts]
    assert {"workbench", "shelf", "bin1", "bin2", "bin3", "cupboard", "desk", "chair1", "door"} <= set(names)
    for a, b in zip(world.parts, again.parts, strict=True):
        assert a.name == b.name
        np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)
        np.testing.assert_array_equal(a.T_map_part, b.T_map_part)


def test_another_seed_moves_furniture_but_never_bench_and_shelf() -> None:
    first, second = lab_room(np.random.default_rng(0)), lab_room(np.random.default_rng(1))
    for name in ("workbench", "shelf"):
        np.testing.assert_array_equal(first.part(name).T_map_part, second.part(name).T_map_part)
        assert first.part(name).survey == "as-is"
    assert np.abs(first.part("desk").T_map_part - second.part("desk").T_map_part).max() > 1e-3


def test_no_face_is_degenerate_and_everything_stands_in_its_room() -> None:
    world = lab_room(np.random.default_rng(0))
    assert face_areas(world.mesh()).min() > 1e-9
    for part in world.parts:
        if part.group == "furniture" and part.name != "door_frame_outside":
            inwards = part.T_map_part[:2, 3] + 0.03 * part.T_map_part[:2, 0]
            room = room_at(world.rooms, *inwards)
            assert room is not None
            assert room.name == part.room


def test_rays_from_inside_cannot_leave_the_room() -> None:
    from simtrack.raycast import RayScene, TriangleMesh

    mesh = lab_room(np.random.default_rng(0)).mesh()
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    with RayScene() as scene:
        scene.add(TriangleMesh(mesh.vertices, mesh.faces))
        hits = scene.cast_rays(np.tile([3.0, 2.5, 1.2], (len(directions), 1)), directions)
    assert np.isfinite(hits.distances).mean() > 0.9999
    assert hits.distances[np.isfinite(hits.distances)].max() < 8.0


def test_unknown_parts_and_values_are_named() -> None:
    with pytest.raises(UnknownNameError, match="workbench"):
        lab_room(np.random.default_rng(0)).part("sink")
    with pytest.raises(InvalidValueError, match="scatter"):
        LabRoomConfig(scatter=2.0)
