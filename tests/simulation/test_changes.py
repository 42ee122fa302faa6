"""Changes of a scene that happen while the robot looks elsewhere."""

import numpy as np
import pytest

from simtrack.contracts import Command
from simtrack.errors import FileFormatError
from simtrack.simulation.scene_file import parse_scene
from simtrack.simulation.simulation import Simulation

CHANGES = [
    {"at": [0.1, 0.2], "object": "relay", "to": {"away": True}},
    {"at": [0.1, 0.2], "object": "materialbox", "to": {"on": "workbench", "x": [-0.1, 0.1], "y": [0.5, 0.7]}},
    {"at": [0.1, 0.2], "object": "mug", "to": {"on": "workbench", "x": [0.1, 0.25], "y": [-0.3, 0.0]}},
]


@pytest.fixture
def scene(document, tmp_path):
    """The small scene with things to happen; the mug is away at first."""

    def make(**changes):
        document["clutter"][0]["place"] = {"away": True}
        return parse_scene(document | {"changes": CHANGES} | changes, tmp_path / "scene.yaml")

    return make


@pytest.mark.parametrize("sleep", [False, True])
def test_changes_happen_once_nobody_looks_and_then_all_is_at_rest(scene, sleep) -> None:
    with Simulation(scene(), seed=3, renderer="embree", sensors=(), sleep=sleep) as simulation:
        facing, away = Command(torso=0.3, head_tilt=-0.3), Command(angular=1.5, torso=0.3, head_tilt=-0.3)
        assert set(simulation.truth.at(0).objects) == {"materialbox", "relay"}
        for _ in range(15):
            simulation.advance(facing)
        assert (len(simulation.changes), simulation.pending_changes) == (0, 3)
        before = simulation.truth.at(simulation.now)
        for k in range(120):
            simulation.advance(away if k < 70 else facing)
            for name, seen in simulation.truth.visibility(simulation.now).items():
                if any(
                    change.name == name and change.stamp > simulation.now - 40_000_000 for change in simulation.changes
                ):
                    assert seen.pixels == 0
        after = simulation.truth.at(simulation.now)
        assert simulation.pending_changes == 0
        assert set(after.objects) == {"materialbox", "mug"}
        done = {change.name: change for change in simulation.changes}
        assert done["relay"].T_after is None
        assert done["mug"].T_before is None
        for name in ("materialbox", "mug"):
            target, thing = done[name].T_after, after.objects[name]
            assert target is not None
            assert np.linalg.norm(thing.T_map_object[:3, 3] - target[:3, 3]) < 0.02
            assert np.abs(thing.velocity).max() < 0.01
            assert (name, "workbench") in after.contacts
        T_before = done["materialbox"].T_before
        assert T_before is not None
        assert np.allclose(T_before, before.objects["materialbox"].T_map_object, atol=1e-3)


def test_a_restart_repeats_the_changes(scene) -> None:
    turning = Command(angular=1.5, torso=0.3, head_tilt=-0.3)
    with Simulation(scene(), seed=3, renderer="embree", sensors=()) as simulation:
        courses = []
        for _ in range(2):
            for _ in range(60):
                simulation.advance(turning)
            courses.append(
                [(c.stamp, c.name, None if c.T_after is None else c.T_after.tolist()) for c in simulation.changes]
            )
            simulation.restart(3)
            assert set(simulation.truth.at(0).objects) == {"materialbox", "relay"}
    assert len(courses[0]) == 3
    assert courses[0] == courses[1]


def test_broken_changes_are_refused_with_their_field(scene) -> None:
    with pytest.raises(FileFormatError, match=r"changes.*names the object 'lamp'.*relay"):
        scene(changes=[{"at": [0, 1], "object": "lamp", "to": {"away": True}}])
    with pytest.raises(FileFormatError, match=r"changes\.0\.to.*exactly one of"):
        scene(changes=[{"at": [0, 1], "object": "relay", "to": {"away": True, "on": "workbench"}}])
    broken = scene(changes=[{"at": [0, 1], "object": "relay", "to": {"on": "piano"}}])
    with pytest.raises(FileFormatError, match=r"changes\.0\.to.*piano.*workbench"):
        Simulation(broken, seed=0, renderer="embree", sensors=())
