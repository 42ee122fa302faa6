from dataclasses import dataclass

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

    def visibility(self, stamp: int) -> dict[str, Seen]:
        return {"relay1": Seen(self.visible), "mug": Seen(1.0)}


def _frames(count: int) -> list[RgbdFrame]:
    return [RgbdFrame(k * 33_333_333, np.zeros((1, 1), np.float32), None, K, np.eye(4)) for k in range(count)]


def _true_detections(detector: OracleDetector, count: int):
    return [[d for d in detector.detect(f).detections if d.class_name == "relay"] for f in _frames(count)]


def test_errors_are_as_large_and_as_frequent_as_configured() -> None:
    config = OracleDetectorConfig(false_positive_rate=0.0, wrong_class_rate=0.0)
    answers = _true_detections(OracleDetector(World(), MODELS, 3, config), 600)
    found = [d[0] for d in answers if d]
    assert abs(len(found) / 600 - 0.9) < 0.04
    truth = project_points(T, MODELS["relay"].keypoints, K)
    size = K.fx * MODELS["relay"].diameter / T[2, 3]
    errors = np.stack([d.keypoints - truth for d in found])
    share = np.median(np.linalg.norm(errors, axis=2)) / size
    assert abs(share - 0.04) < 0.006
    within = np.var(errors - errors.mean(axis=1, keepdims=True))
    assert within < 0.95 * np.var(errors)  # part of the error is common to a detection


def test_occlusion_hides_and_blurs() -> None:
    config = OracleDetectorConfig(false_positive_rate=0.0, wrong_class_rate=0.0)
    clear, half, hidden = (_true_detections(OracleDetector(World(v), MODELS, 3, config), 300) for v in (1.0, 0.3, 0.1))
    counts = [sum(len(d) for d in answers) for answers in (clear, half, hidden)]
    assert counts[0] > counts[1] > counts[2] == 0
    assert half[next(i for i, d in enumerate(half) if d)][0].keypoint_sigma[0] > clear[0][0].keypoint_sigma[0]


def test_false_positives_and_wrong_classes() -> None:
    config = OracleDetectorConfig(miss_rate=0.0, false_positive_rate=0.2, wrong_class_rate=0.3)
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
