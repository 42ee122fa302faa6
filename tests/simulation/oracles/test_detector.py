from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, Float64, RgbdFrame
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.objects import load_object
from simtrack.perception.detection.pnp import project_points
from simtrack.simulation.oracles import OracleDetector, OracleDetectorConfig
from simtrack.simulation.oracles.detector import canonical_view

K = CameraIntrinsics(640, 480, 577.0, 577.0, 319.5, 239.5)
MODELS = {name: load_object(name) for name in ("relay", "powerdrill")}
T = transform(exp_so3(np.array([2.0, 0.3, -0.4])), (0.05, 0.0, 1.2))


@dataclass
class Thing:
    class_name: str
    T_map_object: Float64


@dataclass
class Seen:
    fraction: float


@dataclass
class Scene:
    T_map_camera: Float64
    objects: dict[str, Thing]


@dataclass
class World:
    visible: float = 1.0

    def at(self, stamp: int) -> Scene:
        return Scene(np.eye(4), {"relay1": Thing("relay", T), "mug": Thing("mug", T)})

    def visibility(self, stamp: int, names: Collection[str]) -> dict[str, Seen]:
        assert set(names) == {"relay1"}  # a mug is not looked for
        return {"relay1": Seen(self.visible)}


def _frames(count: int) -> list[RgbdFrame]:
    return [RgbdFrame(k * 33_333_333, np.zeros((1, 1), np.float32), None, K, np.eye(4)) for k in range(count)]


def _true_detections(detector: OracleDetector, count: int):
    return [[d for d in detector.detect(f).detections if d.class_name == "relay"] for f in _frames(count)]


SIZE = K.fx * MODELS["relay"].diameter / T[2, 3]
"""Pixels, of the relay in the image."""


def test_errors_are_as_large_and_as_frequent_as_configured() -> None:
    config = OracleDetectorConfig(miss_rate=0.1, correlation=0.5, false_positive_rate=0.0, wrong_class_rate=0.0)
    answers = _true_detections(OracleDetector(World(), MODELS, 3, config), 600)
    found = [d[0] for d in answers if d]
    assert abs(len(found) / 600 - 0.9 * (1.0 - (config.min_size / SIZE) ** 2)) < 0.04
    truth = project_points(T, MODELS["relay"].keypoints, K)
    errors = np.stack([d.keypoints - truth for d in found])
    share = np.median(np.linalg.norm(errors, axis=2)) / SIZE
    assert abs(share - config.keypoint_error) < 0.15 * config.keypoint_error
    within = np.var(errors - errors.mean(axis=1, keepdims=True))
    assert within < 0.95 * np.var(errors)  # part of the error is common to a detection
    told = np.stack([d.keypoint_sigma for d in found])
    assert abs(np.std(np.log(told[:, 0])) - config.spread) < 0.08
    assert abs(np.mean((errors / told[:, :, None]) ** 2) - 1.0) < 0.1  # each detection tells its own


def test_misses_and_errors_grow_with_occlusion_as_those_of_the_networks() -> None:
    """Measured on 4049 objects: visible share, share that the networks missed, error in shares of the size."""
    measured = ((0.85, 0.025, 0.0354), (0.65, 0.087, 0.0561), (0.45, 0.274, 0.0949), (0.25, 0.557, 0.1623))
    truth = project_points(T, MODELS["relay"].keypoints, K)
    for visible, missed, error in measured:
        config = OracleDetectorConfig(false_positive_rate=0.0, wrong_class_rate=0.0, min_size=1.0)
        answers = _true_detections(OracleDetector(World(visible), MODELS, 3, config), 500)
        found = [d[0].keypoints for d in answers if d]
        assert abs(1.0 - len(found) / 500 - missed) < 0.07
        distances = np.linalg.norm(np.stack(found) - truth, axis=2) / SIZE
        assert 0.75 < np.median(distances) / error < 1.33


def test_what_is_hidden_or_far_away_is_not_found() -> None:
    config = OracleDetectorConfig(false_positive_rate=0.0, wrong_class_rate=0.0)
    for world, settings in ((World(0.05), config), (World(), replace(config, min_size=1.01 * SIZE))):
        assert not any(_true_detections(OracleDetector(world, MODELS, 3, settings), 100))


def test_a_detector_without_misses_finds_what_it_may() -> None:
    config = OracleDetectorConfig(miss_rate=0.0, hard_misses=0.0, false_positive_rate=0.0, wrong_class_rate=0.0)
    assert all(_true_detections(OracleDetector(World(0.2), MODELS, 3, config), 100))


def test_false_positives_and_wrong_classes() -> None:
    config = OracleDetectorConfig(miss_rate=0.0, hard_misses=0.0, false_positive_rate=0.2, wrong_class_rate=0.3)
    detector = OracleDetector(World(), MODELS, 3, config)
    answers = [detector.detect(f).detections for f in _frames(400)]
    assert abs(np.mean([len(a) for a in answers]) - 1.2) < 0.07
    firsts = [a[0].class_name for a in answers]
    assert abs(firsts.count("powerdrill") / 400 - 0.3) < 0.08


def test_an_answer_depends_on_seed_and_stamp_alone() -> None:
    frames = _frames(20)
    forwards = OracleDetector(World(), MODELS, 3)
    backwards = OracleDetector(World(), MODELS, 3)
    ours = {f.stamp: forwards.detect(f) for f in frames}
    theirs = {f.stamp: backwards.detect(f) for f in reversed(frames)}
    for stamp, answer in ours.items():
        assert answer.available == stamp + 150_000_000
        assert [d.class_name for d in answer.detections] == [d.class_name for d in theirs[stamp].detections]
        for a, b in zip(answer.detections, theirs[stamp].detections, strict=True):
            np.testing.assert_array_equal(a.keypoints, b.keypoints)


def test_symmetric_poses_look_the_same() -> None:
    klt = load_object("klt3147")
    a = canonical_view(T, klt)
    b = canonical_view(T @ klt.symmetries.discrete[1], klt)
    np.testing.assert_allclose(a, b, atol=1e-12)


def test_settings_are_checked() -> None:
    with pytest.raises(InvalidValueError, match="miss_rate"):
        OracleDetectorConfig(miss_rate=1.5)
    with pytest.raises(InvalidValueError, match="latency"):
        OracleDetectorConfig(latency=-1.0)
