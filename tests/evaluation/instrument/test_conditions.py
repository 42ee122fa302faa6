"""Conditions change what they say and nothing else, and keep to what the configurations allow."""

import numpy as np
import pytest

from simtrack.contracts import LidarScan
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.evaluation.instrument.conditions import AXES, Conditions, changed, parse_conditions
from simtrack.objects import TrackerModelConfig, load_object, tracker_model
from simtrack.sensors.depth_noise import PRESETS, DepthNoiseConfig
from simtrack.sensors.faults import CalibrationFaults
from simtrack.sensors.lidar import VLP16, LidarNoiseConfig
from simtrack.simulation.oracles import OracleDetectorConfig
from simtrack.simulation.scene_file import Carry, Push, load_scene
from simtrack.simulation.world import configured


@pytest.fixture(scope="module")
def scene():
    return load_scene("workbench")


def depth_noise(scene) -> DepthNoiseConfig:
    return configured(DepthNoiseConfig, scene.sensors.depth_noise, scene, "", PRESETS[scene.sensors.depth])


def test_the_defaults_change_nothing(scene) -> None:
    assert Conditions().scene(scene) == scene
    assert Conditions().detector(OracleDetectorConfig()) == OracleDetectorConfig()
    assert Conditions().changed() == {}


def test_noise_scales_amounts_and_zero_switches_all_of_it_off(scene) -> None:
    standard, doubled = PRESETS["xtion"], depth_noise(Conditions(noise=2.0).scene(scene))
    assert doubled.axial_quadratic == 2 * standard.axial_quadratic and doubled.dropout == 2 * standard.dropout
    assert doubled.max_range == standard.max_range and doubled.shadow_baseline == standard.shadow_baseline
    exact = depth_noise(Conditions(noise=0.0).scene(scene))
    assert exact.sigma([0.5, 4.0], [0.0, 1.2]) == pytest.approx(0.0)
    assert exact.disparity_step == exact.shadow_baseline == exact.dropout == 0.0 and exact.lateral == "none"
    sensors = Conditions(noise=0.0).scene(scene).sensors
    lidar = configured(LidarNoiseConfig, sensors.lidar_noise, scene, "")
    assert lidar.sigma == lidar.dropout == lidar.reflectivity_floor == 0.0
    assert Conditions(noise=3.0).scene(scene).sensors.odometry["turn_from_turn"] == pytest.approx(9 * 2e-5)


def test_the_believed_camera_is_turned_by_so_many_degrees(scene) -> None:
    given = Conditions(extrinsics=2.0, time_offset=0.05).scene(scene).sensors.calibration
    faults = configured(CalibrationFaults, given, scene, "")
    T = faults.believed_camera(np.eye(4))
    assert np.degrees(np.arccos(0.5 * (np.trace(T[:3, :3]) - 1.0))) == pytest.approx(2.0)
    assert faults.camera_time_offset == 0.05


def test_lasers_are_taken_for_each_other_and_shapes_for_symmetric_ones(scene) -> None:
    changed_scene = Conditions(lidar_mirrored=1, false_symmetry=1).scene(scene)
    faults = configured(CalibrationFaults, changed_scene.sensors.calibration, scene, "")
    shots = VLP16.shots()
    ranges = np.ones(len(shots), np.float32)
    scan = LidarScan(0, shots.directions, ranges, shots.times, shots.rings, ranges, np.eye(4))
    told = faults.apply(scan)
    assert isinstance(told, LidarScan)
    assert told.directions[:, 2] == pytest.approx(-scan.directions[:, 2]) and told.rings.dtype == np.uint8
    assert (told.rings + scan.rings == 15).all()
    config = configured(TrackerModelConfig, changed_scene.tracker_models, scene, "")
    drill = load_object("powerdrill")
    told_model = tracker_model(drill, config, np.random.default_rng(0))
    assert len(told_model.symmetries.discrete) == 2 * len(drill.symmetries.discrete)


def test_things_in_the_way_stand_among_the_objects(scene) -> None:
    added = Conditions(occlusion=3).scene(scene).clutter[len(scene.clutter) :]
    assert [thing.id for thing in added] == ["occluder-1", "occluder-2", "occluder-3"]
    assert {thing.place.on for thing in added} == {"workbench"}


def test_the_hand_is_faster_within_what_it_can(scene) -> None:
    hand = Conditions(speed=2.0).scene(scene).hand
    assert hand is not None
    for old, new in zip(scene.hand.script, hand.script, strict=True):
        if isinstance(old, Carry | Push):
            assert isinstance(new, Carry | Push)
            most = 0.5 if isinstance(old, Push) else 1.0
            assert new.speed == pytest.approx(min(2.0 * old.speed, most))


def test_a_perfect_detector_is_still_late() -> None:
    perfect = Conditions(detection=0.0).detector(OracleDetectorConfig())
    assert perfect.keypoint_error == perfect.miss_rate == perfect.hard_misses == perfect.false_positive_rate == 0.0
    assert perfect.latency == OracleDetectorConfig().latency
    assert Conditions(latency=0.0).detector(OracleDetectorConfig()).latency == 0.0


def test_a_text_is_read_and_nonsense_named() -> None:
    assert parse_conditions("noise=2, occlusion=3") == Conditions(noise=2.0, occlusion=3)
    assert parse_conditions("") == Conditions()
    with pytest.raises(UnknownNameError, match="latency"):
        parse_conditions("luck=1")
    for text in ("noise", "noise=1,noise=2", "noise=much", "noise=-1", "occlusion=1.5", "latency=nan"):
        with pytest.raises(InvalidValueError):
            parse_conditions(text)
    with pytest.raises(InvalidValueError, match="whole"):
        changed(Conditions(), "occlusion", 0.5)
    assert set(AXES) == {*Conditions.__dataclass_fields__}
