"""How well a detector does on images with labels: boxes, keypoints, and poses after each step that follows."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from typing import Protocol

import numpy as np

from simtrack.contracts import CameraIntrinsics, Detection, DetectionResult, Float32, Float64, RgbdFrame, Uint8
from simtrack.evaluation.bop_recall import BopRecall
from simtrack.evaluation.metrics import Metric, Metrics, measured, quantile, ratio
from simtrack.evaluation.pose_errors import PoseScorer
from simtrack.objects import ObjectModel
from simtrack.perception.detection.boxes import Box, overlap
from simtrack.perception.detection.pnp import project_points, solve_pose
from simtrack.perception.detection.pose_search import PoseSearch
from simtrack.perception.tracking.birth import FitConfig, Prober
from simtrack.perception.tracking.registration import RegistrationConfig
from simtrack.perception.tracking.target import tracked_model
from simtrack.training.scores import average_precision
from simtrack.training.source import Label, LabelledImage, Source, images

VISIBLE = 0.5
"""Objects of which less is seen are not counted."""
SAME = 0.5
"""Overlap of boxes from which a detection is that of an object."""
LEAST_SCORE = 0.05
"""Boxes count from here on for average precision, which looks at all scores; keypoints as the detector is set."""
STEPS = {"pnp": (0.02, 15.0), "depth": (0.02, 15.0), "registered": (0.005, 3.0)}
"""Poses after PnP, after the search with depth, after registration: metres and degrees within which one is good."""
OUTCOMES = ("undetected", "no_pose", "misplaced", "misturned", "not_believed", "wrong", "good")
"""What becomes of an object: no box of it; no pose agrees with it; the search's best one is not good, in position or,
being good, in orientation, and none is believed; a good one is not believed; a believed one is not good; one is."""


class BoxDetector(Protocol):
    """A detector that also tells its boxes with low scores; simtrack's own image detectors do."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """That it knows, in the order of their indices."""
        ...

    def boxes(self, rgb: Uint8, depth: Float32, least_score: float) -> list[Box]:
        """In the image's pixels."""
        ...

    def detect(self, frame: RgbdFrame) -> DetectionResult:
        """As `simtrack.contracts.Detector`."""
        ...


@dataclass(slots=True)
class DetectorScores:
    """What was measured, image by image."""

    models: tuple[ObjectModel, ...]
    found: list[list[Box]] = field(default_factory=list)
    there: list[tuple[Float64, np.ndarray, np.ndarray]] = field(default_factory=list)
    keypoint_errors: list[float] = field(default_factory=list)
    """Medians of detections' nine keypoints, in shares of the object's projected diameter."""
    normalised: list[float] = field(default_factory=list)
    """Keypoint errors over their stated standard deviations, both coordinates."""
    poses: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: {step: [] for step in STEPS})
    """Step -> metres and degrees for each object, detected or not; infinite where there is no pose."""
    outcomes: dict[str, list[str]] = field(default_factory=dict)
    """Class -> one of `OUTCOMES` for each object."""
    bop: Metrics = field(default_factory=dict)
    """Average recalls of the BOP challenge after each step."""
    detections: int = 0
    false: int = 0
    seconds: list[float] = field(default_factory=list)
    """Of computing time, of the detector, for each image."""

    def metrics(self) -> Metrics:
        """Everything as named figures."""
        precision = average_precision(self.found, self.there, len(self.models), SAME, VISIBLE)
        out: Metrics = {"boxes.ap50": measured(float(np.nanmean(precision)), "1")}
        for model, value in zip(self.models, precision, strict=True):
            if np.isfinite(value):
                out[f"boxes.ap50.{model.name}"] = measured(float(value), "1")
        out["boxes.false_share"] = ratio(self.false, self.detections, "nothing was detected")
        errors = np.array(self.keypoint_errors)
        out["keypoints.error.median"] = quantile(errors, 0.5, "1", "no object was detected")
        out["keypoints.error.p90"] = quantile(errors, 0.9, "1", "no object was detected")
        squares = np.array(self.normalised) ** 2
        out["keypoints.nees"] = (
            measured(float(np.median(squares) / 0.4549), "1")
            if len(squares)
            else Metric(None, "1", "no object was detected")
        )
        for step, (metres, degrees) in STEPS.items():
            values = np.array(self.poses[step]).reshape(-1, 2)
            known = values[np.isfinite(values).all(axis=1)]
            out[f"poses.{step}.share"] = ratio(len(known), len(values), "no object was to be found")
            out[f"poses.{step}.translation.median"] = quantile(known[:, 0], 0.5, "m", "no pose")
            out[f"poses.{step}.rotation.median"] = quantile(known[:, 1], 0.5, "deg", "no pose")
            good = int(np.count_nonzero((known[:, 0] <= metres) & (known[:, 1] <= degrees)))
            # Of what was detected, as a tracker's births are tried from detections alone.
            out[f"poses.{step}.good"] = ratio(good, len(known), "no pose")
            out[f"poses.{step}.recall"] = ratio(good, len(values), "no object was to be found")
        out |= self.bop
        for name in sorted(self.outcomes):
            for outcome in OUTCOMES:
                count = self.outcomes[name].count(outcome)
                out[f"outcome.{name}.{outcome}"] = ratio(count, len(self.outcomes[name]), "no object was to be found")
        out["speed.detector"] = quantile(np.array(self.seconds[1:]), 0.5, "s", "no image")
        return out


def evaluate_detector(
    source: Source,
    detector: BoxDetector,
    count: int | None = None,
    told: Callable[[int, int], None] | None = None,
) -> DetectorScores:
    """Measure a detector on a data set that it was not trained on.

    Args:
        source: images with labels.
        detector: what is measured.
        count: images at most; all if None.
        told: called with how many of how many images are done.
    """
    scores = DetectorScores(source.models)
    steps = _PoseSteps({model.name: model for model in source.models})
    try:
        for done, of, image in _some(source, count):
            _score(scores, steps, detector, image)
            if told is not None:
                told(done, of)
        scores.bop = steps.bop()
    finally:
        steps.close()
    return scores


def _some(source: Source, count: int | None) -> Iterator[tuple[int, int, LabelledImage]]:
    """Images of all scenes in turn, with how many they are and how many there will be."""
    sizes = [sum(1 for _ in (scene / "depth").glob("*.png")) for scene in source.scenes]
    number, total = 0, min(sum(sizes), count or sum(sizes))
    for scene in source.scenes:
        for image in images(source, scene):
            if number == total:
                return
            number += 1
            yield number, total, image


def _score(scores: DetectorScores, steps: "_PoseSteps", detector: BoxDetector, image: LabelledImage) -> None:
    frame = RgbdFrame(0, image.depth, image.rgb, image.intrinsics, np.eye(4))
    began = process_time()
    detections = detector.detect(frame).detections
    scores.seconds.append(process_time() - began)
    index_of = {model.name: index for index, model in enumerate(scores.models)}
    named = [
        (detector.class_names[box.class_index], box) for box in detector.boxes(image.rgb, image.depth, LEAST_SCORE)
    ]
    scores.found.append([Box(index_of[name], box.corners, box.score) for name, box in named if name in index_of])
    labels = image.labels
    scores.there.append(
        (
            np.array([label.box for label in labels]).reshape(-1, 4),
            np.array([label.class_index for label in labels], int),
            np.array([label.visible for label in labels]),
        )
    )
    scores.detections += len(detections)
    scores.false += sum(all(overlap(d.box, label.box) < SAME for label in labels) for d in detections)
    for label in labels:
        if label.visible <= VISIBLE:
            continue
        model = scores.models[label.class_index]
        detection = _match(label, model.name, detections)
        if detection is not None:
            T_alike = nearest_alike(detection.keypoints, label.T_camera_object, model, image.intrinsics)
            errors = detection.keypoints - project_points(T_alike, model.keypoints, image.intrinsics)
            size = image.intrinsics.fx * model.diameter / label.T_camera_object[2, 3]
            distances = np.linalg.norm(errors, axis=1)
            if np.isfinite(distances).any():
                scores.keypoint_errors.append(float(np.nanmedian(distances)) / size)
            scores.normalised += [
                float(v) for v in (errors / detection.keypoint_sigma[:, None]).ravel() if np.isfinite(v)
            ]
        found = steps.errors(detection, model, frame, label.T_camera_object)
        for step, errors in found.items():
            scores.poses[step].append(errors)
        outcome = _outcome(found) if detection is not None else "undetected"
        scores.outcomes.setdefault(model.name, []).append(outcome)


def _outcome(errors: Mapping[str, tuple[float, float]]) -> str:
    """What became of a detected object, by its errors after each step."""
    if not np.isfinite(errors["depth"][0]):
        return "no_pose"
    if np.isfinite(errors["registered"][0]):
        return "good" if _good("registered", *errors["registered"]) else "wrong"
    if _good("depth", *errors["depth"]):
        return "not_believed"
    return "misturned" if errors["depth"][0] <= STEPS["depth"][0] else "misplaced"


def _good(step: str, metres: float, degrees: float) -> bool:
    return metres <= STEPS[step][0] and degrees <= STEPS[step][1]


def nearest_alike(
    keypoints: Float64, T_camera_object: Float64, model: ObjectModel, camera: CameraIntrinsics
) -> Float64:
    """(4, 4): of the poses that look alike, the one whose keypoints are nearest to detected ones (9, 2)."""
    alike = T_camera_object @ model.symmetries.poses(np.deg2rad(5.0))
    known = np.isfinite(keypoints).all(axis=1)
    if not known.any():
        return T_camera_object
    distances = [
        np.mean(np.sum((project_points(T, model.keypoints[known], camera) - keypoints[known]) ** 2, axis=1))
        for T in alike
    ]
    return alike[int(np.nanargmin(distances))]


def _match(label: Label, name: str, detections: tuple[Detection, ...]) -> Detection | None:
    shared = [(overlap(d.box, label.box), d) for d in detections if d.class_name == name]
    best = max(shared, key=lambda pair: pair[0], default=None)
    return best[1] if best is not None and best[0] >= SAME else None


class _PoseSteps:
    """Takes a detection to a registered pose, and compares with the truth after each step."""

    def __init__(self, models: Mapping[str, ObjectModel]) -> None:
        self._tracked = {name: tracked_model(model) for name, model in models.items()}
        self._scorers = {
            name: PoseScorer(np.asarray(model.mesh.vertices, float), model.symmetries, model.diameter)
            for name, model in models.items()
        }
        self._search = PoseSearch(models)
        self._prober = Prober(RegistrationConfig(), FitConfig())
        self._bop = {step: BopRecall(models, self._scorers) for step in STEPS}

    def close(self) -> None:
        """Release the scenes of rays."""
        self._search.close()
        self._prober.close()
        for recall in self._bop.values():
            recall.close()

    def errors(
        self, detection: Detection | None, model: ObjectModel, frame: RgbdFrame, T_true: Float64
    ) -> dict[str, tuple[float, float]]:
        """Metres and degrees after each step; infinite where there is no pose."""
        out = {}
        for step, T in self._poses(detection, model, frame).items():
            self._bop[step].take(frame, model.name, T, T_true)
            out[step] = (np.inf, np.inf) if T is None else self._compared(model.name, T, T_true)
        return out

    def bop(self) -> Metrics:
        """Average recalls of all objects so far, after each step."""
        return {k: v for step, recall in self._bop.items() for k, v in recall.metrics(f"bop.{step}").items()}

    def _poses(self, detection: Detection | None, model: ObjectModel, frame: RgbdFrame) -> dict[str, Float64 | None]:
        """T_camera_object after each step."""
        out: dict[str, Float64 | None] = dict.fromkeys(STEPS)
        if detection is None:
            return out
        hypotheses = solve_pose(detection, model, frame.intrinsics, frame.stamp)
        if hypotheses:
            out["pnp"] = hypotheses[0].T_camera_object
        hypotheses = self._search.search(detection, frame.depth, frame.intrinsics, frame.stamp, hypotheses) or []
        if not hypotheses:
            return out
        out["depth"] = hypotheses[0].T_camera_object
        found = self._prober.best(hypotheses, self._tracked[model.name], frame.depth, frame.intrinsics, {})
        out["registered"] = found.T_camera_object if found is not None else None
        return out

    def _compared(self, name: str, T: Float64, T_true: Float64) -> tuple[float, float]:
        metres, radians = self._scorers[name].errors(T, T_true)
        return metres, float(np.rad2deg(radians))


def write_scores(metrics: Metrics, images: int, data: str, out: Path) -> list[str]:
    """Write ``detector.json`` and ``detector.txt`` into a folder; returns their names.

    Args:
        metrics: as `DetectorScores.metrics` gives them.
        images: number of them.
        data: name of the data set.
        out: made if missing.
    """
    import json

    out.mkdir(parents=True, exist_ok=True)
    values = {name: {"value": metric.value, "unit": metric.unit} for name, metric in metrics.items()}
    document = {"data": data, "images": images, "visible": VISIBLE, "metrics": values}
    (out / "detector.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    lines = [f"{name:42} {'-' if m.value is None else f'{m.value:.4g}':>10} {m.unit}" for name, m in metrics.items()]
    head = f"{images} images of {data}, objects seen by more than {VISIBLE:.0%}\n\n"
    (out / "detector.txt").write_text(head + "\n".join(lines) + "\n", encoding="utf-8")
    return ["detector.json", "detector.txt"]
