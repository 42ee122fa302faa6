"""A keypoint detector that answers from ground truth with the errors of a trained network."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    CameraIntrinsics,
    Detection,
    DetectionResult,
    Float64,
    RegionOfInterest,
    RgbdFrame,
)
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import exp_so3, inverse, transform
from simtrack.objects import ObjectModel


@dataclass(frozen=True, slots=True)
class OracleDetectorConfig:
    """Errors of the detector.

    The defaults are fitted to those of the networks that come along, on 650 images of two renderers that they were not
    trained on (`reports/detector_errors.json`): 4049 objects, at least 45 pixels large. The latency is a choice.
    """

    keypoint_error: float = 0.024
    """Median distance of a keypoint of a clear object from the truth, as a share of its image size (diameter)."""
    spread: float = 0.5
    """Of the errors' scale from one detection to another: standard deviation of its logarithm. A detection tells its
    own scale, as a network does."""
    correlation: float = 0.17
    """Share of the keypoints' error variance that is common to one detection (shift, scale, turn)."""
    miss_rate: float = 0.003
    """Share of large, wholly visible objects that are not found in an image."""
    hard_misses: float = 0.9
    """Times (1 - visible)^2, and times (min_size / size)^2: shares that are missed for being hidden and small."""
    false_positive_rate: float = 0.027
    """Detections of nothing per true detection."""
    wrong_class_rate: float = 0.003
    """Share of detections with the class of another object."""
    latency: float = 0.15
    """Seconds from the image's stamp to the answer."""
    min_visible: float = 0.1
    """Objects of which less is visible are never found."""
    min_size: float = 8.0
    """Objects smaller than this in the image are never found, pixels."""
    occlusion_growth: float = 2.5
    """Errors grow with exp(occlusion_growth (1 - visible))."""
    bias: float = 0.0
    """All keypoints lie too far to the image's right by this share of the object's image size: a planted fault."""

    def __post_init__(self) -> None:
        shares = "correlation", "miss_rate", "hard_misses", "false_positive_rate", "wrong_class_rate", "min_visible"
        for name in shares:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidValueError(f"OracleDetectorConfig.{name}", getattr(self, name), "0 to 1")
        for field in fields(self):
            if not getattr(self, field.name) >= 0.0:
                raise InvalidValueError(f"OracleDetectorConfig.{field.name}", getattr(self, field.name), ">= 0")


class ObjectTruth(Protocol):
    """What the detector reads of one true object."""

    @property
    def class_name(self) -> str:
        """Name of its model."""
        ...

    @property
    def T_map_object(self) -> Float64:
        """(4, 4)."""
        ...


class ObjectVisibility(Protocol):
    """How much of one object is seen."""

    @property
    def fraction(self) -> float:
        """0 to 1."""
        ...


class SceneTruth(Protocol):
    """What the detector reads of the world at one stamp."""

    @property
    def T_map_camera(self) -> Float64:
        """(4, 4), true."""
        ...

    @property
    def objects(self) -> Mapping[str, ObjectTruth]:
        """All objects by name."""
        ...


class TruthSource(Protocol):
    """The part of `simtrack.simulation.ground_truth.GroundTruth` that the detector needs."""

    def at(self, stamp: int) -> SceneTruth:
        """True state at a stamp."""
        ...

    def visibility(self, stamp: int, names: Collection[str]) -> Mapping[str, ObjectVisibility]:
        """Visible share of the named objects in the camera at a stamp; what is no object is missing."""
        ...


class OracleDetector:
    """Detects objects by looking them up; implements `simtrack.contracts.Detector`.

    Every image's randomness derives from the seed and its stamp alone, so that an answer does not depend on which other
    images were asked about.
    """

    def __init__(
        self,
        truth: TruthSource,
        models: Mapping[str, ObjectModel],
        seed: int,
        config: OracleDetectorConfig | None = None,
        clock_offset: float = 0.0,
    ) -> None:
        """`clock_offset`: seconds by which images are stamped late; what is in them is what was there before."""
        self._truth, self._models, self._seed = truth, dict(models), seed
        self.config = config or OracleDetectorConfig()
        self._clock_offset = round(clock_offset * NANOSECONDS)

    def detect(self, frame: RgbdFrame, regions: Sequence[RegionOfInterest] = ()) -> DetectionResult:
        """Detect the objects in the image of a frame; neither its pixels nor the regions are looked at."""
        rng = np.random.default_rng([self._seed, frame.stamp % (1 << 62)])
        taken = frame.stamp - self._clock_offset
        scene = self._truth.at(taken)
        known = {name for name, thing in scene.objects.items() if thing.class_name in self._models}
        visibility = self._truth.visibility(taken, known)
        T_camera_map = inverse(scene.T_map_camera)
        found: list[Detection] = []
        for name in sorted(known & visibility.keys()):
            model, seen = self._models[scene.objects[name].class_name], visibility[name]
            T_camera_object = T_camera_map @ scene.objects[name].T_map_object
            detection = self._observe(model, T_camera_object, seen.fraction, frame.intrinsics, rng)
            if detection is not None:
                found.append(detection)
            if rng.random() < self.config.false_positive_rate:
                found.append(self._imagine(frame.intrinsics, rng))
        available = frame.stamp + int(self.config.latency * NANOSECONDS)
        return DetectionResult(frame.stamp, available, tuple(found))

    def _observe(
        self,
        model: ObjectModel,
        T_camera_object: Float64,
        visible: float,
        K: CameraIntrinsics,
        rng: np.random.Generator,
    ) -> Detection | None:
        config = self.config
        z = float(T_camera_object[2, 3])
        lucky, relabel = rng.random(), rng.random()
        if z < 0.1 or visible < config.min_visible:
            return None
        size = K.fx * model.diameter / z
        if size < config.min_size:
            return None
        hidden, small = (1.0 - visible) ** 2, (config.min_size / size) ** 2
        found = (1.0 - config.hard_misses * hidden) * (1.0 - config.hard_misses * small)
        if lucky > (1.0 - config.miss_rate) * found:
            return None
        T = canonical_view(T_camera_object, model)
        pixels = _project(model.keypoints, T, K)
        growth = np.exp(config.occlusion_growth * (1.0 - visible) + config.spread * rng.standard_normal())
        median = config.keypoint_error * size * growth
        sigma = median / np.sqrt(2.0 * np.log(2.0))  # the median of a 2D normal's norm is sigma sqrt(2 ln 2)
        pixels = pixels + _keypoint_errors(pixels, sigma, config.correlation, rng) + (config.bias * size, 0.0)
        name = model.name
        if relabel < config.wrong_class_rate and len(self._models) > 1:
            name = str(rng.choice(sorted(set(self._models) - {name})))
        score = float(np.clip(0.8 + 0.11 * visible + 0.06 * rng.standard_normal(), 0.05, 0.99))
        return _detection(name, pixels, sigma, score)

    def _imagine(self, K: CameraIntrinsics, rng: np.random.Generator) -> Detection:
        """A detection of nothing: some model at a random pose in view."""
        model = self._models[str(rng.choice(sorted(self._models)))]
        z = rng.uniform(0.7, 2.5)
        x = z * (rng.uniform(0.1, 0.9) * K.width - K.cx) / K.fx
        y = z * (rng.uniform(0.1, 0.9) * K.height - K.cy) / K.fy
        T = transform(exp_so3(rng.uniform(-np.pi, np.pi, 3)), (x, y, z))
        sigma = self.config.keypoint_error * K.fx * model.diameter / z + 0.3
        pixels = _project(model.keypoints, T, K)
        pixels = pixels + _keypoint_errors(pixels, sigma, self.config.correlation, rng)
        return _detection(model.name, pixels, sigma, float(rng.uniform(0.3, 0.8)))


def canonical_view(T_camera_object: Float64, model: ObjectModel) -> Float64:
    """(4, 4) of the poses that look alike the one whose x axis points most to the image's right, then up.

    A network cannot tell symmetric poses apart; it learns one of them per view.
    """
    poses = T_camera_object @ model.symmetries.poses(np.deg2rad(10.0))
    return poses[int(np.argmax(poses[:, 0, 0] - 1e-3 * poses[:, 1, 0]))]


def _keypoint_errors(pixels: Float64, sigma: float, correlation: float, rng: np.random.Generator) -> Float64:
    """(9, 2) errors in pixels with variance sigma^2 on average over the keypoints, partly common to all of them."""
    own = rng.standard_normal(pixels.shape)
    arms = pixels - pixels.mean(axis=0)
    spread = max(float(np.sqrt(np.mean(arms**2))), 1e-6)
    shift, scale, turn = rng.standard_normal(2), rng.standard_normal(), rng.standard_normal()
    perpendicular = np.stack([-arms[:, 1], arms[:, 0]], axis=1)
    common = np.sqrt(0.5) * shift + 0.5 * (scale * arms + turn * perpendicular) / spread
    return sigma * (np.sqrt(correlation) * common + np.sqrt(1.0 - correlation) * own)


def _project(points: Float64, T: Float64, K: CameraIntrinsics) -> Float64:
    p = points @ T[:3, :3].T + T[:3, 3]
    z = np.maximum(p[:, 2], 0.02)
    return np.stack([K.fx * p[:, 0] / z + K.cx, K.fy * p[:, 1] / z + K.cy], axis=1)


def _detection(name: str, pixels: Float64, sigma: float, score: float) -> Detection:
    box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    return Detection(name, pixels, np.full(len(pixels), max(sigma, 0.3)), box, score)
