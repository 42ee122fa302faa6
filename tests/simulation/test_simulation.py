from collections.abc import Callable
from itertools import pairwise
from typing import Any, TypeAlias

import mujoco
import numpy as np
import pytest

from simtrack.contracts import Command, JointState, LidarScan, Odometry, RgbdFrame, SensorFrame
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.transforms import angle_between, apply, inverse, yaw_of
from simtrack.sensors.camera import unproject
from simtrack.simulation.history import KEY_NS, History
from simtrack.simulation.scene_file import SceneFile, load_scene
from simtrack.simulation.simulation import Simulation

MakeScene: TypeAlias = Callable[..., SceneFile]
LOOK = Command(torso=0.3, head_tilt=-0.3)
EXACT: dict[str, Any] = {
    "depth": "ideal",
    "lidar_noise": {
        "sigma": 0.0, "resolution": 0.0, "dropout": 0.0, "grazing_angle": np.pi / 2, "reflectivity_floor": 0.0,
    },
    "odometry": dict.fromkeys(("travel_from_travel", "travel_from_turn", "turn_from_travel", "turn_from_turn"), 0.0),
    "encoders": {"sigma": 0.0, "resolution": 0.0},
}  # fmt: skip


def advance(simulation: Simulation, frames: int, command: Command = LOOK, rgb: bool = False) -> list[SensorFrame]:
    return [frame for _ in range(frames) for frame in simulation.advance(command, rgb)]


def close_eyes(simulation: Simulation, monkeypatch: pytest.MonkeyPatch, *senders: str) -> None:
    """Physics alone: images are black, and what `senders` are called sends nothing."""
    intrinsics = simulation.camera.intrinsics
    black = np.zeros((intrinsics.height, intrinsics.width), np.float32)
    monkeypatch.setattr(
        simulation, "_take_image", lambda stamp, rgb: RgbdFrame(stamp, black, None, intrinsics, np.eye(4))
    )
    monkeypatch.setattr(simulation, "_draw_noise", lambda: None)
    for name in ("_send_scan", *senders):
        monkeypatch.setattr(simulation, name, lambda stamp: None)


def same(a: SensorFrame, b: SensorFrame) -> bool:
    if type(a) is not type(b):
        return False
    names = [name for name in a.__slots__ if name not in ("rgb", "intrinsics")]
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def test_frames_arrive_at_their_rates_and_in_order(resting: Simulation) -> None:
    start = resting.now
    frames = advance(resting, 12)
    arrival = [f.stamp + (resting.lidar.period if isinstance(f, LidarScan) else 0) for f in frames]
    assert arrival == sorted(arrival)
    images = [f for f in frames if isinstance(f, RgbdFrame)]
    assert [f.stamp for f in images] == [start + (k + 1) * 33_333_333 for k in range(12)]
    assert resting.now == images[-1].stamp
    assert [f.sequence for f in images] == list(range(images[0].sequence, images[0].sequence + 12))
    assert sum(isinstance(f, Odometry) for f in frames) == sum(isinstance(f, JointState) for f in frames) == 20
    assert sum(isinstance(f, LidarScan) for f in frames) == 4


def test_a_seed_repeats_and_rgb_changes_nothing_else(small_scene: MakeScene) -> None:
    runs = []
    for rgb in (False, False, True):
        with Simulation(small_scene(), seed=5, renderer="embree") as simulation:
            runs.append(advance(simulation, 5, Command(0.2, 0.3, 0.2, -0.3, 0.3), rgb))
    assert runs[2][-1].rgb is not None  # type: ignore[union-attr]
    for other in runs[1:]:
        assert len(other) == len(runs[0])
        assert all(same(a, b) for a, b in zip(runs[0], other, strict=True))


def test_sensors_see_the_truth_when_nothing_disturbs_them(small_scene: MakeScene) -> None:
    with Simulation(small_scene(sensors=EXACT), seed=2, renderer="embree") as simulation:
        frames = advance(simulation, 16, Command(0.4, 0.6, 0.5, -0.5, 0.2))
        image = next(f for f in reversed(frames) if isinstance(f, RgbdFrame))
        truth = simulation.truth.at(image.stamp)
        believed = truth.T_map_base @ image.T_base_camera
        assert np.abs(believed - truth.T_map_camera).max() < 1e-9

        # Depth lies on the surfaces of the world at the stamp of the image.
        ids = simulation.truth.ids(image.stamp)
        floor = ids == simulation.truth.names.index("lab/floor0")
        points = apply(truth.T_map_camera, unproject(image.depth, image.intrinsics)[floor & (image.depth > 0)])
        assert len(points) > 500
        assert np.abs(points[:, 2]).max() < 1e-5

        # Each shot ends on a surface when it starts from the pose at its own time, and beside it from the first pose.
        scan = next(f for f in reversed(frames) if isinstance(f, LidarScan))
        robot = simulation.truth.names.index("robot")
        shots = np.flatnonzero((simulation.truth.lidar_ids(scan.stamp) != robot) & np.isfinite(scan.ranges))[::211]
        own, first = np.zeros((2, len(shots), 3))
        T_start = simulation.truth.at(scan.stamp).T_map_lidar
        for row, k in enumerate(shots):
            T_own = simulation.truth.at(scan.stamp + round(1e9 * float(scan.times[k]))).T_map_lidar
            own[row] = apply(T_own, scan.ranges[k] * scan.directions[k][None])[0]
            first[row] = apply(T_start, scan.ranges[k] * scan.directions[k][None])[0]
        scene = simulation._rays.scene
        assert len(shots) > 80
        assert np.quantile(scene.closest_points(own, 1.0).distances, 0.98) < 1e-4
        assert np.quantile(scene.closest_points(first, 1.0).distances, 0.9) > 5e-3

        # Odometry without noise is the motion itself.
        readings = [f for f in frames if isinstance(f, Odometry)]
        moved = (
            inverse(simulation.truth.at(readings[0].stamp).T_map_base)
            @ simulation.truth.at(readings[-1].stamp).T_map_base
        )
        read = inverse(readings[0].T_odom_base) @ readings[-1].T_odom_base
        assert np.abs(moved - read).max() < 1e-3


def test_the_robot_keeps_to_its_limits_and_does_not_slide(
    small_scene: MakeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = small_scene(robot={"start": {"x": 2.6, "y": 2.0, "yaw": 0.4}}, objects=[], clutter=[])
    with Simulation(scene, seed=0, renderer="embree") as simulation:
        close_eyes(simulation, monkeypatch)
        poses, heads = [], []
        for k in range(90):
            simulation.advance(Command(9.0 if k < 30 else 0.0, -9.0, 1.2, -0.9, 0.35))
            poses.append(simulation.truth.at(simulation.now).T_map_base)
            heads.append(simulation.truth.joint_positions(simulation.now))
    dt = 1 / 30
    steps = [inverse(a) @ b for a, b in pairwise(poses)]
    forward = np.array([T[0, 3] for T in steps]) / dt
    turn = np.array([yaw_of(T) for T in steps]) / dt
    assert forward.max() <= 1.02
    assert turn.min() >= -1.05
    assert turn.min() < -0.9
    # About the middle of each step, a differential drive moves along its heading only.
    sideways = [T[1, 3] - np.tan(yaw_of(T) / 2) * T[0, 3] for T in steps]
    assert np.abs(sideways).max() / dt < 0.02
    assert np.abs(np.diff(forward)).max() / dt < 1.3
    pan = np.array([joints["head_1_joint"] for joints in heads])
    assert pan[-1] == pytest.approx(1.2, abs=0.01)
    assert pan.max() < 1.24
    assert np.abs(np.diff(pan)).max() / dt < 2.1
    assert heads[-1]["head_2_joint"] == pytest.approx(-0.9, abs=0.02)
    assert heads[-1]["torso_lift_joint"] > 0.28


def test_the_robot_stops_at_the_bench(small_scene: MakeScene, monkeypatch: pytest.MonkeyPatch) -> None:
    with Simulation(small_scene(objects=[], clutter=[]), seed=0, renderer="embree") as simulation:
        close_eyes(simulation, monkeypatch)
        advance(simulation, 90, Command(linear=1.0, torso=0.3))
        T = simulation.truth.at(simulation.now).T_map_base
    bench = simulation.world.static.part("workbench")
    assert T[1, 3] < bench.T_map_part[1, 3] - bench.extents[0] / 2 - 0.15


def test_truth_interpolates_and_stays_within_time(resting: Simulation) -> None:
    truth = resting.truth
    assert truth.at(0).stamp == 0
    at = truth.at(resting.now)
    assert at.objects["mug"].kind == "clutter"
    assert at.objects["relay"].kind == "catalogue"
    assert at.objects["relay"].class_name == "relay"
    assert np.abs(at.objects["relay"].velocity).max() < 1e-3
    assert {("relay", "workbench"), ("mug", "workbench")} <= at.contacts
    assert ("relay", "workbench") in at.touching
    with pytest.raises(InvalidValueError, match="simulated so far"):
        truth.at(resting.now + 10 * KEY_NS)
    with pytest.raises(InvalidValueError):
        truth.at(-1)
    with pytest.raises(UnknownNameError):
        truth.lidar_ids(12345)


def test_visibility_agrees_with_the_id_image(resting: Simulation) -> None:
    seen, ids = resting.truth.visibility(resting.now), resting.truth.ids(resting.now)
    for name, visibility in seen.items():
        pixels = np.count_nonzero(ids == resting.truth.names.index(name))
        assert visibility.pixels == pytest.approx(pixels, rel=0.1, abs=60)
        assert 0.0 <= visibility.fraction <= 1.0
    assert seen["relay"].fraction > 0.9


def test_visibility_of_some_objects_is_that_of_all_of_them(resting: Simulation) -> None:
    truth = resting.truth
    everything = truth.visibility(resting.now)
    for names in ({"relay"}, set(), {"relay", "nothing"}, set(everything)):
        truth._seen = None
        some = truth.visibility(resting.now, names)
        assert some == {name: seen for name, seen in everything.items() if name in names}
        assert truth.visibility(resting.now) == everything  # the rest is looked at when it is asked for


def test_a_rendered_image_tells_what_is_visible_as_rays_of_its_own_do(small_scene: MakeScene) -> None:
    """The image of a stamp is looked up instead of being cast again; the two agree up to rays along an edge."""
    with Simulation(small_scene(), seed=3, renderer="embree") as simulation:
        for pan in (0.3, 0.0, -0.5, -1.2):
            for _ in range(6):
                simulation.advance(Command(head_pan=pan, head_tilt=-0.3, torso=0.3))
            truth = simulation.truth
            looked_up = truth.visibility(simulation.now)
            truth._images.clear()
            truth._seen = None
            cast = truth.visibility(simulation.now)
            for name, seen in cast.items():
                assert looked_up[name].fraction == pytest.approx(seen.fraction, abs=0.01)
                assert looked_up[name].pixels == pytest.approx(seen.pixels, rel=0.01, abs=20)
            assert any(seen.fraction > 0.0 for seen in cast.values())


def test_an_object_leaving_the_image_loses_visibility(small_scene: MakeScene, monkeypatch: pytest.MonkeyPatch) -> None:
    with Simulation(small_scene(), seed=3, renderer="embree") as simulation:
        close_eyes(simulation, monkeypatch)
        fractions = []
        for _ in range(30):
            simulation.advance(Command(head_pan=-1.2, head_tilt=-0.3, torso=0.3))
            fractions.append(simulation.truth.visibility(simulation.now)["materialbox"].fraction)
    assert fractions[0] > 0.9
    assert fractions[-1] == 0.0
    assert any(0.1 < fraction < 0.9 for fraction in fractions)


def test_history_interpolates_between_keys_and_through_antipodes() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='a'><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    data, scratch = mujoco.MjData(model), mujoco.MjData(model)
    history = History(model)
    for k, angle in enumerate((0.0, 0.02, 0.04)):
        sign = -1.0 if k == 1 else 1.0
        data.qpos[:] = [k, 0, 0, sign * np.cos(angle / 2), 0, 0, sign * np.sin(angle / 2)]
        history.append(data)
    history.load(1.5 * KEY_NS, scratch)
    assert scratch.xpos[1, 0] == pytest.approx(1.5)
    assert np.arctan2(scratch.xmat[1, 3], scratch.xmat[1, 0]) == pytest.approx(0.03, abs=1e-9)


def test_faults_reach_the_frames(small_scene: MakeScene) -> None:
    faults = EXACT | {
        "feed": {"camera": {"drop": 1.0}},
        "calibration": {"lidar": [0.1, 0, 0, 0, 0, 0], "encoder_bias": {"head_1_joint": 0.05}},
    }
    with Simulation(small_scene(sensors=faults), seed=0, renderer="embree") as simulation:
        frames = advance(simulation, 5)
        assert not any(isinstance(f, RgbdFrame) for f in frames)
        scan = next(f for f in frames if isinstance(f, LidarScan))
        assert scan.T_base_lidar[0, 3] == pytest.approx(-0.13)
        joints = next(f for f in frames if isinstance(f, JointState))
        assert joints.positions[joints.names.index("head_1_joint")] == pytest.approx(0.05, abs=1e-4)


def test_what_a_fast_clock_stamps_arrives_when_its_time_has_come(small_scene: MakeScene) -> None:
    faults = EXACT | {"calibration": {"camera_time_offset": 0.05}}
    with Simulation(small_scene(sensors=faults), seed=0, renderer="embree") as simulation:
        images = []
        for _ in range(6):
            arrived = [f for f in advance(simulation, 1) if isinstance(f, RgbdFrame)]
            assert all(frame.stamp <= simulation.now < frame.stamp + simulation.camera_period for frame in arrived)
            images += arrived
        assert [frame.stamp - 50_000_000 for frame in images] == [k * simulation.camera_period for k in range(1, 5)]


@pytest.mark.parametrize("seed", [1])
def test_the_hand_moves_things_as_asked(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Picks, carries, puts down gently and pushes; never throws."""
    scene = load_scene("workbench")
    with Simulation(scene, seed, renderer="embree") as simulation:
        close_eyes(simulation, monkeypatch, "_send_proprioception")
        start = simulation.truth.at(0).objects
        fastest, spin, tilt = 0.0, 0.0, 0.0
        objects = start
        for _ in range(30 * 11):
            advance(simulation, 2)
            objects = simulation.truth.at(simulation.now).objects
            for name, thing in objects.items():
                if thing.kind == "actor":
                    continue
                fastest = max(fastest, float(np.linalg.norm(thing.velocity[:3])))
                spin = max(spin, float(np.linalg.norm(thing.velocity[3:])))
                tilt = max(tilt, float(np.arccos(np.clip(thing.T_map_object[2, 2], -1, 1))))
                assert thing.T_map_object[2, 3] > 0.3, f"{name} fell off"
        moved = [
            name for name, thing in objects.items()
            if thing.kind == "catalogue"
            and (np.linalg.norm(thing.T_map_object[:3, 3] - start[name].T_map_object[:3, 3]) > 0.04
                 or angle_between(thing.T_map_object[:3, :3], start[name].T_map_object[:3, :3]) > 0.1)
        ]  # fmt: skip
        assert len(moved) >= 3
        assert 0.3 < fastest < 0.6
        assert 1.0 < spin < 3.0
        assert np.radians(5) < tilt < np.radians(40)
        assert "hand" in objects
        assert any(b == "materialbox" for _, b in simulation.truth.at(simulation.now).contacts) or len(moved) >= 4
