"""Which detector a run has where none is named, and where that is told."""

from dataclasses import replace
from pathlib import Path

import pytest

from simtrack.errors import UnknownNameError
from simtrack.evaluation.closed_loop import closed
from simtrack.evaluation.detector_choice import ORACLE, choose_detector
from simtrack.evaluation.run_config import RunConfig
from simtrack.evaluation.targets import targets_of
from simtrack.objects.registry import BUILT_IN
from simtrack.perception.detection.keypoint_detector import KeypointDetector
from simtrack.perception.detection.loading import KEYPOINTS
from simtrack.perception.detection.runner import RunnerConfig
from simtrack.simulation.oracles import OracleDetectorConfig
from simtrack.simulation.scene_file import load_scene, parse_scene


def config(scene: str = "workbench", **changes: object) -> RunConfig:
    return RunConfig(scene=load_scene(scene), out=Path("out"), **changes)  # type: ignore[arg-type]


def test_images_are_looked_at_where_all_objects_are_known() -> None:
    assert choose_detector(BUILT_IN).name == choose_detector(["relay"]).name == KEYPOINTS
    unknown = choose_detector([*BUILT_IN, "teapot", "duck"])
    assert unknown.name == ORACLE
    assert "duck, teapot" in unknown.reason
    assert choose_detector([]).name == ORACLE
    assert choose_detector(BUILT_IN, oracle_errs_otherwise=True).name == ORACLE


@pytest.mark.parametrize(("scene", "name"), [("workbench", KEYPOINTS), ("visits", KEYPOINTS), ("rooms:3", ORACLE)])
def test_a_run_says_what_was_chosen_and_why(scene: str, name: str) -> None:
    resolved = config(scene).resolved()
    assert resolved["detector"] == name
    assert resolved["detector_reason"]


def test_what_was_asked_for_is_taken() -> None:
    for name in (ORACLE, KEYPOINTS):
        assert config(detector=name).detector_choice.name == name
    assert config().foreign == {}
    with pytest.raises(UnknownNameError, match="psychic"):
        config(detector="psychic")


def test_errors_that_are_given_are_the_oracles() -> None:
    choice = config(oracle=OracleDetectorConfig(latency=0.3)).detector_choice
    assert choice.name == ORACLE
    assert "conditions" in choice.reason


def test_objects_that_no_network_knows_need_the_oracle() -> None:
    document = load_scene("workbench").model_dump(mode="json")
    document["objects"].append({"model": "teapot", "place": {"on": "workbench"}})
    scene = parse_scene(document, load_scene("workbench").path)
    choice = RunConfig(scene=scene, out=Path("out")).detector_choice
    assert choice.name == ORACLE
    assert "teapot" in choice.reason


def test_less_is_asked_of_poses_where_images_are_looked_at() -> None:
    oracle, images = (targets_of("workbench", name) for name in (ORACLE, KEYPOINTS))
    differing = {name: (oracle[name].limit, images[name].limit) for name in oracle if oracle[name] != images[name]}
    assert differing == {"tracking.add_s_auc": (0.93, 0.90), "speed.frames_per_second": (8.0, 5.0)}
    assert targets_of("of_mine", KEYPOINTS) == {}


@pytest.mark.slow
def test_a_slow_machine_does_not_change_a_run() -> None:
    """The wall clock ends the patience with detectors of others, which have a guard, but not with simtrack's own."""
    with closed(config(renderer="embree"), "fixed-gaze") as loop:
        runner = loop.stack.detections
        assert isinstance(runner._detector, KeypointDetector)
        assert runner.config.timeout >= 600.0
        assert replace(runner.config, timeout=RunnerConfig().timeout) == RunnerConfig()
