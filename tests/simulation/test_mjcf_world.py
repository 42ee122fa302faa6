"""An MJCF file as a world: its fixed bodies are the building, what trackers know is tracked, the robot joins in."""

from pathlib import Path

import numpy as np
import pytest

from simtrack.errors import FileFormatError
from simtrack.simulation.building.parts import room_at
from simtrack.simulation.mjcf_world import mjcf_building
from simtrack.simulation.scene_file import StartPose, load_scene
from simtrack.simulation.world import body_pose, build_world

FLOOR = '<geom type="plane" size="3 2.5 .1" pos="0 0 0.2"/>'
DESK = '<body name="desk" pos="1 0 .9"><geom type="box" size=".4 .6 .02"/></body>'
CRATE = '<body name="crate" pos="1 -.3 1.02"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>'
RELAY = '<body name="relay-7" pos="1 .3 .96"><freejoint/><geom type="box" size=".02 .02 .02" mass=".1"/></body>'
CLASSES = '<custom><text name="class:desk" data="desk"/><text name="class:relay-7" data="relay"/></custom>'


def written(folder: Path, *bodies: str) -> Path:
    path = folder / "scene.xml"
    path.write_text(f"<mujoco><worldbody>{''.join(bodies)}</worldbody>{CLASSES}</mujoco>")
    return path


def test_a_file_becomes_a_world_on_the_level_of_its_floor(tmp_path: Path) -> None:
    world = build_world(load_scene(written(tmp_path, FLOOR, DESK, CRATE, RELAY)), 0)
    assert {part.name: part.semantic_class for part in world.static.parts} == {"world": "floor", "desk": "desk"}
    desk = world.static.part("desk")
    assert desk.T_map_part[2, 3] == pytest.approx(0.7)
    ((T_part_face, size),) = desk.supports
    assert (desk.T_map_part @ T_part_face)[:3, 3] == pytest.approx([1.0, 0.0, 0.72], abs=1e-3)
    assert sorted(size) == pytest.approx([0.8, 1.2], abs=1e-3)
    assert set(world.names) == {"world", "desk", "crate", "relay-7", "robot"}
    assert world.objects["relay-7"].name == "relay"
    relay = body_pose(world.data, world.bodies["relay-7"])
    assert relay[:2, 3] == pytest.approx([1.0, 0.3], abs=0.01)
    assert relay[2, 3] == pytest.approx(0.72 + world.objects["relay-7"].extents[2] / 2, abs=0.002)
    crate = world.model.body("mjcf/crate").id
    assert world.data.xpos[crate] == pytest.approx([1.0, -0.3, 0.82], abs=0.002)


def test_the_robot_starts_on_free_floor_and_looks_at_what_is_tracked(tmp_path: Path) -> None:
    scene = load_scene(written(tmp_path, FLOOR, DESK, RELAY))
    start, building = scene.robot.start, mjcf_building(scene)
    assert isinstance(start, StartPose)
    assert room_at(building.rooms, start.x, start.y) is not None
    off = np.array([1.0 - start.x, 0.3 - start.y])
    assert np.arctan2(off[1], off[0]) == pytest.approx(start.yaw)
    assert np.linalg.norm(off) == pytest.approx(1.3, abs=0.1)


@pytest.mark.parametrize(
    ("bodies", "message"),
    [
        ((DESK, CRATE), r"scene\.xml: worldbody: there is no floor.*1 square metre"),
        ((FLOOR, '<body pos="0 0 .5"><geom type="box" size="2.8 2.3 .2"/></body>'), r"no free place on the floor"),
        (('<geom type="blob"/>',), r"MuJoCo cannot use it.*blob"),
    ],
)
def test_what_is_no_world_is_told(tmp_path: Path, bodies: tuple[str, ...], message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        load_scene(written(tmp_path, *bodies))
