"""Grasping and placing through physics."""

from collections.abc import Iterator

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, Command, Float64
from simtrack.envs.arm import READY, ArmKinematics
from simtrack.envs.goals import Goals, parse_goal
from simtrack.envs.grasps import suction_spot
from simtrack.envs.macros import Manipulator, Outcome
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import transform, yaw_of
from simtrack.objects import load_object
from simtrack.objects.tiago import TORSO, tiago
from simtrack.sensors.camera import CameraModel
from simtrack.simulation.scene_file import load_scene
from simtrack.simulation.simulation import Simulation

STILL = Command(head_tilt=-0.9, torso=0.35)
CAMERA = CameraModel(CameraIntrinsics(16, 12, 14.0, 14.0, 7.5, 5.5), 10.0)


def run(simulation: Simulation, manipulator: Manipulator, limit: int = 600) -> Outcome:
    for _ in range(limit):
        manipulator.step()
        if not manipulator.busy:
            return manipulator.outcome
        simulation.advance(STILL)
    return manipulator.outcome


@pytest.fixture(scope="module")
def simulation() -> Iterator[Simulation]:
    with Simulation(load_scene("tidy"), 0, "embree", CAMERA, sensors=(), sleep=True) as made:
        yield made


@pytest.fixture
def table(simulation: Simulation) -> tuple[Simulation, Manipulator]:
    simulation.restart(1)
    return simulation, Manipulator(simulation)


def pose(simulation: Simulation, name: str) -> Float64:
    return simulation.truth.at(simulation.now).objects[name].T_map_object


def test_what_is_grasped_where_it_stands_is_lifted_and_put_into_the_box(table: tuple[Simulation, Manipulator]) -> None:
    simulation, hand = table
    before = pose(simulation, "relay")
    base = simulation.truth.at(simulation.now).T_map_base
    hand.grasp(before, load_object("relay"), base)
    assert run(simulation, hand) is Outcome.DONE and hand.cup.holding == "relay"
    assert pose(simulation, "relay")[2, 3] > before[2, 3] + 0.03
    box = pose(simulation, "materialbox")
    turn = yaw_of(box) + np.pi / 2 - yaw_of(before)
    hand.place(box[:3, 3] + (0.0, 0.0, 0.012), base, (turn, turn + np.pi), clearance=0.09)
    assert run(simulation, hand) is Outcome.DONE and hand.cup.holding is None
    for _ in range(5):
        simulation.advance(STILL)
    truth = simulation.truth.at(simulation.now)
    (state,) = Goals(simulation.world, [parse_goal("relay in materialbox")]).states(truth)
    assert state.holds, state


def test_a_grasp_where_nothing_is_holds_nothing_and_moves_nothing(table: tuple[Simulation, Manipulator]) -> None:
    simulation, hand = table
    before = pose(simulation, "relay")
    beside = before.copy()
    beside[0, 3] += 0.07
    hand.grasp(beside, load_object("relay"), simulation.truth.at(simulation.now).T_map_base)
    assert run(simulation, hand) is Outcome.MISSED and hand.cup.holding is None
    np.testing.assert_allclose(pose(simulation, "relay"), before, atol=2e-3)


def test_what_cannot_be_done_is_told_and_not_tried(table: tuple[Simulation, Manipulator]) -> None:
    simulation, hand = table
    base = simulation.truth.at(simulation.now).T_map_base
    hand.place(np.zeros(3), base)
    assert run(simulation, hand) is Outcome.EMPTY
    far = pose(simulation, "relay")
    far[:2, 3] = base[:2, 3] + 2.0
    hand.grasp(far, load_object("relay"), base)
    assert run(simulation, hand) is Outcome.OUT_OF_REACH
    assert hand.cup.touching() is None


def test_what_sleeps_follows_the_cup_that_holds_it(
    table: tuple[Simulation, Manipulator], monkeypatch: pytest.MonkeyPatch
) -> None:
    simulation, hand = table
    for _ in range(10):
        simulation.advance(STILL)
    world, before = simulation.world, pose(simulation, "relay")
    assert world.data.tree_asleep[world.model.body_treeid[world.bodies["relay"]]] >= 0
    monkeypatch.setattr(hand.cup, "touching", lambda: "relay")
    assert hand.cup.close() == "relay"
    world.controller.reach({"arm_1_joint": -0.8})
    for _ in range(10):
        simulation.advance(STILL)
    assert np.linalg.norm(pose(simulation, "relay")[:3, 3] - before[:3, 3]) > 0.02
    hand.cup.open()


def test_a_robot_without_a_cup_cannot_grasp() -> None:
    with (
        Simulation(load_scene("workbench"), 0, "embree", CAMERA, sensors=(), sleep=True) as simulation,
        pytest.raises(InvalidValueError, match="suction"),
    ):
        Manipulator(simulation)


@pytest.mark.parametrize("place", [(0.55, 0.15, 0.85), (0.5, -0.2, 0.9), (0.6, 0.0, 0.8)])
@pytest.mark.parametrize("heading", [None, 0.4])
def test_joint_angles_lead_to_where_they_were_asked_for(
    place: tuple[float, float, float], heading: float | None
) -> None:
    arm = ArmKinematics(tiago())
    joints = arm.solve(np.array(place), 0.35, READY, heading)
    assert joints is not None
    T = arm.cup(joints | {TORSO: 0.35})
    np.testing.assert_allclose(T[:3, 3], place, atol=1e-3)
    assert T[2, 0] < -0.999
    if heading is not None:
        assert abs(np.arctan2(T[1, 1], T[0, 1]) - heading) < 0.05
    limits = {joint.name: joint for joint in tiago().joints}
    assert all(limits[name].lower <= value <= limits[name].upper for name, value in joints.items())


def test_out_of_reach_is_none() -> None:
    assert ArmKinematics(tiago()).solve(np.array([2.0, 0.0, 0.9]), 0.35) is None


@pytest.mark.parametrize("name", ["relay", "multimeter", "screwdriver"])
def test_a_suction_spot_lies_on_the_surface_and_turns_with_the_object(name: str) -> None:
    model = load_object(name)
    spot = suction_spot(model, np.eye(4))
    assert spot is not None and np.all(np.abs(spot) <= model.extents / 2 + 1e-6)
    T = transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), (1.0, 2.0, 0.5))
    turned = suction_spot(model, T)
    assert turned is not None
    np.testing.assert_allclose(turned, T[:3, :3] @ spot + T[:3, 3], atol=0.012)
