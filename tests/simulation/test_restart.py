"""Simulations that begin anew, sensors that are off, things that sleep, pasts that are forgotten."""

from collections.abc import Callable

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, Command, JointState, LidarScan, Odometry, RgbdFrame, SensorFrame
from simtrack.errors import InvalidValueError, RenderingError, UnknownNameError
from simtrack.sensors.camera import CameraModel
from simtrack.sensors.lidar import LidarModel
from simtrack.simulation.scene_file import SceneFile
from simtrack.simulation.simulation import Simulation

SMALL_CAMERA = CameraIntrinsics(32, 24, 29.0, 29.0, 15.5, 11.5)
LIDAR = LidarModel(firing_period=1.6e-3)
COMMAND = Command(linear=0.2, angular=0.3, head_tilt=-0.3, torso=0.3)


def seen(simulation: Simulation, steps: int = 3) -> list[tuple[type, int, bytes]]:
    """What the sensors send, as bytes."""

    def content(frame: SensorFrame) -> bytes:
        match frame:
            case RgbdFrame():
                return frame.depth.tobytes()
            case LidarScan():
                return frame.ranges.tobytes()
            case Odometry():
                return frame.T_odom_base.tobytes()
            case JointState():
                return frame.positions.tobytes()

    return [(type(f), f.stamp, content(f)) for _ in range(steps) for f in simulation.advance(COMMAND)]


@pytest.fixture
def open_small(small_scene: Callable[..., SceneFile]) -> Callable[..., Simulation]:
    def make(**arguments) -> Simulation:
        camera = CameraModel(SMALL_CAMERA, 10.0)
        return Simulation(small_scene(), 3, "embree", camera, LIDAR, **arguments)

    return make


def test_a_restart_repeats_itself_whatever_was_simulated_before(open_small: Callable[..., Simulation]) -> None:
    with open_small() as one, open_small() as other:
        one.restart(5)
        first = seen(one)
        other.restart(6)
        assert seen(other) != first
        other.restart(5)
        assert seen(other) == first
        assert other.seed == 5 and other.truth.at(other.now).stamp == other.now
        with pytest.raises(InvalidValueError, match="simulated so far"):
            other.truth.at(other.now + 1_000_000_000)
    with pytest.raises(RenderingError, match="closed"):
        one.restart(5)


def test_sensors_that_are_off_send_nothing_and_change_nothing_for_the_others(
    open_small: Callable[..., Simulation],
) -> None:
    with open_small() as all_on:
        whole = seen(all_on)
    with open_small(sensors=("proprioception",)) as alone:
        part = seen(alone)
    assert part == [entry for entry in whole if entry[0] in (Odometry, JointState)]
    with pytest.raises(UnknownNameError, match="lidar"):
        open_small(sensors=("sonar",))


def test_the_camera_may_look_ten_times_a_second(open_small: Callable[..., Simulation]) -> None:
    with open_small() as simulation:
        stamps = [stamp for kind, stamp, _ in seen(simulation) if kind is RgbdFrame]
    assert stamps == [100_000_000, 200_000_000, 300_000_000]


def test_things_that_sleep_stand_where_they_stood_and_on_what_they_stood(
    open_small: Callable[..., Simulation],
) -> None:
    truths = []
    for sleep in (False, True):
        with open_small(sleep=sleep, sensors=()) as simulation:
            for _ in range(5):
                simulation.advance(Command(head_tilt=-0.3, torso=0.3))
            assert bool((simulation.world.data.tree_asleep >= 0).any()) is sleep
            truths.append(simulation.truth.at(simulation.now))
    awake, asleep = truths
    assert asleep.contacts == awake.contacts and len(awake.contacts) == 3
    for name, thing in awake.objects.items():
        np.testing.assert_allclose(asleep.objects[name].T_map_object, thing.T_map_object, atol=1e-4)


def test_what_sleeps_wakes_when_it_is_pulled(open_small: Callable[..., Simulation]) -> None:
    with open_small(sleep=True, sensors=()) as simulation:
        simulation.advance(Command(head_tilt=-0.3, torso=0.3))
        body = simulation.world.bodies["relay"]
        data, before = simulation.world.data, simulation.truth.at(simulation.now).objects["relay"].T_map_object
        data.xfrc_applied[body, 2] = 20.0
        simulation.advance(Command(head_tilt=-0.3, torso=0.3))
        data.xfrc_applied[body] = 0.0
        assert simulation.truth.at(simulation.now).objects["relay"].T_map_object[2, 3] > before[2, 3] + 0.01


def test_the_past_is_forgotten_but_for_what_is_to_be_remembered(open_small: Callable[..., Simulation]) -> None:
    memory = 300_000_000
    with open_small(memory=memory, sensors=("proprioception",)) as bounded, open_small(sensors=()) as whole:
        for _ in range(25):
            bounded.advance(COMMAND)
            whole.advance(COMMAND)
        for ago in (0, 1, memory - 1, memory):
            stamp = bounded.now - ago
            np.testing.assert_array_equal(bounded.truth.at(stamp).T_map_base, whole.truth.at(stamp).T_map_base)
        with pytest.raises(InvalidValueError, match="simulated so far"):
            bounded.truth.at(0)
