from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest

from simtrack.errors import FileFormatError
from simtrack.simulation.placement import Outline, is_free, outline, separation
from simtrack.simulation.scene_file import SceneFile, load_scene
from simtrack.simulation.simulation import Simulation
from simtrack.simulation.world import body_pose, build_world

MakeScene: TypeAlias = Callable[..., SceneFile]


def test_separation_of_rectangles() -> None:
    a = Outline(0.0, 0.0, 0.0, (0.1, 0.05), 0.0, 0.1)
    assert separation(a, Outline(0.3, 0.0, 0.0, (0.1, 0.05), 0.0, 0.1)) == pytest.approx(0.1)
    assert separation(a, Outline(0.0, 0.3, np.pi / 2, (0.1, 0.05), 0.0, 0.1)) == pytest.approx(0.15)
    assert separation(a, Outline(0.1, 0.0, 0.5, (0.1, 0.05), 0.0, 0.1)) < 0
    assert separation(a, Outline(0.1, 0.0, 0.5, (0.1, 0.05), 0.2, 0.3)) == np.inf


def test_what_is_far_is_free_as_the_separation_says() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        x, y, yaw, length, width = rng.uniform([-0.5, -0.5, -3.0, 0.01, 0.01], [0.5, 0.5, 3.0, 0.2, 0.2], (2, 5)).T
        a, b = (Outline(x[k], y[k], yaw[k], (length[k], width[k]), 0.0, 0.1) for k in range(2))
        gap = rng.uniform(0.0, 0.3)
        assert is_free(a, [b], gap) == (separation(a, b) >= gap)


@pytest.mark.parametrize("seed", [0, 7])
def test_workbench_settles_without_overlap_and_varies_with_the_seed(seed: int) -> None:
    world = build_world(load_scene("workbench"), seed)
    boxes = {
        name: outline(model.extents, body_pose(world.data, world.bodies[name])) for name, model in world.objects.items()
    }
    names = sorted(boxes)
    gaps = [separation(boxes[a], boxes[b]) for a in names for b in names if a < b]
    assert min(gaps) > 0.025
    assert all(body_pose(world.data, world.bodies[name])[2, 2] > 0.98 for name in names)
    assert np.abs(world.data.qvel).max() < 1e-6
    other = build_world(load_scene("workbench"), seed + 1)
    moved = [np.linalg.norm(world.data.xpos[world.bodies[n]] - other.data.xpos[other.bodies[n]]) for n in names]
    assert np.median(moved) > 0.05


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"objects": [{"model": "materialbix", "place": {"on": "workbench"}}]}, r"objects\.0\.model.*materialbox"),
        ({"objects": [{"model": "thermos", "place": {"on": "workbench"}}]}, r"objects\.0\.model.*'thermos' is clutter"),
        ({"objects": [{"model": "relay", "place": {"on": "throne"}}]}, r"objects\.0\.place.*throne.*workbench"),
        ({"objects": [{"model": "relay", "place": {"on": "workbench", "face": 9}}]}, r"face = 9"),
        (
            {"objects": [{"model": "klt3147", "place": {"on": "workbench", "x": [0, 0.01], "y": [0.88, 0.89]}}]},
            r"objects\.0 \(klt3147\): found no free place",
        ),
        (
            {"objects": [{"model": "relay", "place": {"pose": {"xyz": [2.6, 4.3, 2.5]}}}]},
            r"objects\.0\.place.*moved by 1\.\d+ m",
        ),
        ({"robot": {"start": {"x": 2.6, "y": 4.6}}}, r"robot\.start: the robot would stand in 'workbench'"),
        ({"robot": {"start": {"room": "cellar"}}}, r"robot\.start\.room.*cellar.*lab"),
        ({"static": {"builder": "lab_room", "config": {"edges": 1}}}, r"static\.config\.edges: unknown field.*edge"),
        ({"static": {"builder": "lab_room", "config": {"edge": -1}}}, r"static\.config.*0\.05 to 10"),
    ],
)
def test_impossible_scenes_are_told(small_scene: MakeScene, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        build_world(small_scene(**changes), 0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensors": {"depth": "kinnect"}}, r"sensors\.depth: unknown preset; allowed: .*xtion"),
        ({"sensors": {"feed": {"sonar": {"drop": 1.0}}}}, r"sensors\.feed.*camera"),
        ({"sensors": {"feed": {"camera": {"drop": 2.0}}}}, r"sensors\.feed\.camera.*0\.\.1"),
        ({"sensors": {"odometry": {"slip": 1.0}}}, r"sensors\.odometry\.slip: unknown field; allowed: .*slip_rate"),
    ],
)
def test_impossible_sensors_are_told(small_scene: MakeScene, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        Simulation(small_scene(**changes), 0, renderer="embree")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco><worldbody>", r"mine\.xml: line 1: not valid XML"),
        ("<mujoco><worldbody><geom type='blob'/></worldbody></mujoco>", r"mine\.xml: MuJoCo cannot use it.*blob"),
        ("<mujoco><include file='../../x.xml'/></mujoco>", r"include\.file.*leads out of the scene's folder"),
        (
            "<mujoco><compiler meshdir='/'/><asset><mesh file='etc/passwd.stl'/></asset></mujoco>",
            r"leads out of the scene's folder",
        ),
    ],
)
def test_broken_mjcf_is_told(small_scene: MakeScene, tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "mine.xml").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        build_world(small_scene(tmp_path, mjcf="mine.xml"), 0)


def test_users_mjcf_becomes_part_of_the_world(small_scene: MakeScene, tmp_path: Path) -> None:
    (tmp_path / "mine.xml").write_text(
        "<mujoco><worldbody><body name='gong' pos='2.6 4.45 1.6'><joint type='hinge' axis='1 0 0' pos='0 0 .2'/>"
        "<geom type='cylinder' size='.1 .01' mass='1'/></body></worldbody></mujoco>",
    )
    world = build_world(small_scene(tmp_path, mjcf="mine.xml"), 0)
    assert "mjcf/gong" in world.names
    assert world.model.nq > build_world(small_scene(), 0).model.nq
