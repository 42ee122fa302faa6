"""Figures of a detector whose errors are known."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simtrack.contracts import Detection, DetectionResult, RgbdFrame
from simtrack.evaluation import detector as evaluation
from simtrack.evaluation.detector import evaluate_detector, nearest_alike, write_scores
from simtrack.objects import load_object
from simtrack.perception.detection.boxes import Box
from simtrack.perception.detection.pnp import project_points
from simtrack.training.source import Label, LabelledImage, Source
from tests.perception.tracking.scenes import INTRINSICS, BenchWorld, in_camera, on_bench

NAMES = ("klt3147", "relay")


class Known:
    """Answers what it is told; knows its classes in another order than the data set."""

    class_names = ("somebody", *reversed(NAMES))

    def __init__(self, boxes: list[Box], detections: list[Detection]) -> None:
        self._boxes, self._detections = boxes, detections

    def boxes(self, rgb: np.ndarray, depth: np.ndarray, least_score: float) -> list[Box]:
        return [Box(self.class_names.index(NAMES[b.class_index]), b.corners, b.score) for b in self._boxes]

    def detect(self, frame: RgbdFrame) -> DetectionResult:
        return DetectionResult(frame.stamp, frame.stamp, tuple(self._detections))


@pytest.fixture(scope="module")
def image() -> LabelledImage:
    world, labels = BenchWorld(), []
    for index, (name, x, yaw) in enumerate(zip(NAMES, (-0.25, 0.2), (0.4, 0.9), strict=True)):
        model = load_object(name)
        T = on_bench(model, x, 0.05, yaw)
        world.add(model, T)
        pixels = project_points(in_camera(T), np.asarray(model.mesh.vertices, float), INTRINSICS)
        box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
        labels.append(Label(index, in_camera(T), box, 1.0, 5000, Path()))
    depth = world.depth()
    return LabelledImage(0, np.zeros((*depth.shape, 3), np.uint8), depth, INTRINSICS, tuple(labels))


def scored(
    image: LabelledImage, monkeypatch: pytest.MonkeyPatch, boxes: list[Box], detections: list[Detection]
) -> dict[str, float]:
    monkeypatch.setattr(evaluation, "_some", lambda source, count: iter([(1, 1, image)]))
    source = Source(Path(), tuple(load_object(name) for name in NAMES), {1: 0, 2: 1}, ())
    known: Any = Known(boxes, detections)
    metrics = evaluate_detector(source, known).metrics()
    return {name: float(metric.value) for name, metric in metrics.items() if metric.value is not None}


def detections(image: LabelledImage, offset: float = 0.0, sigma: float = 2.0) -> list[Detection]:
    """The truth, with every keypoint moved by so many pixels to the right and down."""
    return [
        Detection(
            NAMES[label.class_index],
            project_points(label.T_camera_object, load_object(NAMES[label.class_index]).keypoints, INTRINSICS) + offset,
            np.full(9, sigma), label.box, 0.9,
        )
        for label in image.labels
    ]  # fmt: skip


def test_the_truth_has_no_errors(image: LabelledImage, monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = [Box(label.class_index, label.box, 0.9) for label in image.labels]
    metrics = scored(image, monkeypatch, boxes, detections(image))
    assert metrics["boxes.ap50"] == 1.0
    assert metrics["boxes.false_share"] == 0.0
    assert metrics["keypoints.error.median"] < 1e-9
    for step in ("pnp", "depth", "registered"):
        assert metrics[f"poses.{step}.good"] == 1.0
        assert metrics[f"poses.{step}.share"] == 1.0
        assert metrics[f"poses.{step}.recall"] == 1.0
        assert metrics[f"bop.{step}.ar"] > 0.9
    for name in NAMES:
        assert metrics[f"outcome.{name}.good"] == 1.0
    assert metrics["poses.pnp.translation.median"] < 1e-4


def test_errors_are_told_in_their_units(image: LabelledImage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keypoints all 3 pixels off each way: an error of known size, and stated deviations that are too small."""
    boxes = [Box(image.labels[0].class_index, image.labels[0].box, 0.9), Box(1, np.array([0.0, 0, 9, 9]), 0.95)]
    elsewhere = Detection("relay", detections(image)[1].keypoints, np.ones(9), np.array([0.0, 0, 9, 9]), 0.9)
    metrics = scored(image, monkeypatch, boxes, [detections(image, 3.0, sigma=1.0)[0], elsewhere])
    label, model = image.labels[0], load_object(NAMES[0])
    size = INTRINSICS.fx * model.diameter / label.T_camera_object[2, 3]
    assert np.isclose(metrics["keypoints.error.median"], 3.0 * np.sqrt(2) / size)
    assert np.isclose(metrics["keypoints.nees"], 9.0 / 0.4549, rtol=1e-3)
    assert metrics["boxes.false_share"] == 0.5
    assert metrics["boxes.ap50.relay"] == 0.0
    assert metrics["poses.pnp.share"] == 0.5
    assert metrics["outcome.relay.undetected"] == 1.0
    assert metrics["poses.registered.recall"] <= 0.5
    assert metrics["bop.pnp.ar"] <= 0.5
    assert metrics["poses.depth.translation.median"] < metrics["poses.pnp.translation.median"] + 0.02


def test_the_nearest_of_what_looks_alike_is_taken(image: LabelledImage) -> None:
    klt, label = load_object(NAMES[0]), image.labels[0]
    turned = label.T_camera_object @ klt.symmetries.discrete[1]
    keypoints = project_points(turned, klt.keypoints, INTRINSICS)
    keypoints[3] = np.nan
    assert np.allclose(nearest_alike(keypoints, label.T_camera_object, klt, INTRINSICS), turned)


def test_scores_are_written(image: LabelledImage, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(evaluation, "_some", lambda source, count: iter([(1, 1, image)]))
    source = Source(Path(), tuple(load_object(name) for name in NAMES), {1: 0, 2: 1}, ())
    nothing: Any = Known([], [])
    scores = evaluate_detector(source, nothing)
    assert write_scores(scores.metrics(), 1, "test", tmp_path) == ["detector.json", "detector.txt"]
    document = json.loads((tmp_path / "detector.json").read_text())
    assert document["metrics"]["boxes.ap50"]["value"] == 0.0
    assert document["metrics"]["keypoints.error.median"]["value"] is None
    assert "poses.pnp.share" in (tmp_path / "detector.txt").read_text()


def test_what_became_of_an_object_is_told_by_the_first_step_that_failed() -> None:
    none, near, turned, far = (np.inf, np.inf), (0.001, 1.0), (0.001, 90.0), (0.05, 1.0)
    steps = {
        "no_pose": (none, none), "good": (far, near), "wrong": (near, turned), "not_believed": (near, none),
        "misturned": (turned, none), "misplaced": (far, none),
    }  # fmt: skip
    for outcome, (depth, registered) in steps.items():
        assert evaluation._outcome({"pnp": none, "depth": depth, "registered": registered}) == outcome
    assert {*steps, "undetected"} == set(evaluation.OUTCOMES)
