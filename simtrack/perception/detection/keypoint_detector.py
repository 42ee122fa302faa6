"""The keypoint detector: boxes in an image, then keypoints in a window about each box.

Colour decides what a thing is; depth, where there is any, is shown to the networks beside it. Without depth they answer
from colour alone, less exactly.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Detection,
    DetectionResult,
    Float32,
    Float64,
    RegionOfInterest,
    RgbdFrame,
    Status,
    Uint8,
)
from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.objects import ObjectModel
from simtrack.perception.detection.bins import BEFORE, BINS, LEAST_SIGMA, decoded
from simtrack.perception.detection.boxes import STRIDE, Box, boxes_of_regions, decoded_boxes
from simtrack.perception.detection.onnx_network import OnnxNetwork, Runtime, open_network
from simtrack.perception.detection.views import (
    WINDOW,
    Pyramid,
    Window,
    conditions,
    reduced,
    shown_image,
    shown_window,
    warped,
    window_about,
)

SHIPPED = Path(__file__).resolve().parent / "weights"
"""Folder of the networks that come along."""
BOXES, KEYPOINTS = "boxes.onnx", "keypoints.onnx"
EXTENT_TOLERANCE = 0.15
"""An object's box may differ from that of the training by this share: a tracker's models are imperfect."""


@dataclass(frozen=True, slots=True)
class KeypointDetectorConfig:
    """Settings of `KeypointDetector`."""

    rate: float = 5.0
    """Images that are taken a second of simulated or recorded time, at most."""
    latency: float = 0.1
    """Seconds of that time from the image's stamp to the answer. No image is taken before."""
    box_score: float = 0.4
    """Boxes with a lower score are not looked at."""
    present: float = 0.98
    """Windows in which the object is with less probability than this are dropped."""
    hint: float = 0.2
    """Boxes with at least this score are looked at, too, ..."""
    region_hint: float = 0.05
    """... and regions that nothing explains with such a centre ..."""
    hints: int = 12
    """... at most so many, those with the highest scores, which are dropped ..."""
    hint_present: float = 0.9999
    """... if the object is in them with less probability than this."""
    same: float = 0.15
    """Detections of a class whose keypoints' centres are nearer to each other than this are of one object, in shares of
    a box's side."""
    max_sigma: float = 0.3
    """Keypoints that are less certain than this, in shares of the window's side, are left out (NaN)."""
    runtime: Runtime = "onnxruntime"
    """onnxruntime answers with the same bits everywhere; OpenVINO may be faster."""

    def __post_init__(self) -> None:
        if not self.rate > 0.0:
            raise InvalidValueError("KeypointDetectorConfig.rate", self.rate, "> 0 Hz")
        for field in fields(self):
            if field.name != "runtime" and not getattr(self, field.name) >= 0.0:
                raise InvalidValueError(f"KeypointDetectorConfig.{field.name}", getattr(self, field.name), ">= 0")


class KeypointDetector:
    """Detects known objects in images; implements `simtrack.contracts.Detector`."""

    def __init__(
        self,
        models: Mapping[str, ObjectModel],
        folder: Path | None = None,
        config: KeypointDetectorConfig | None = None,
    ) -> None:
        """Open the networks.

        Args:
            models: class name -> model of the objects to be found; classes that a network knows beyond them are let be.
            folder: holds ``boxes.onnx`` and ``keypoints.onnx``; those that come along if None.
            config: settings.

        Raises:
            FileFormatError: one of the networks is missing, is another kind of network, or was trained with other
                objects or another order of keypoints.

        """
        self.config = config or KeypointDetectorConfig()
        folder = SHIPPED if folder is None else folder
        self._boxes = open_network(folder / BOXES, self.config.runtime)
        self._keypoints = open_network(folder / KEYPOINTS, self.config.runtime)
        self._boxes.expect(["image"], ["heat", "sides"])
        self._keypoints.expect(["window", "told"], ["coordinates", "present"])
        about = _told(self._boxes, "boxes", stride=STRIDE)
        self._size = _count(self._boxes, about, "width"), _count(self._boxes, about, "height")
        windows = _told(self._keypoints, "keypoints", window=WINDOW, bins=BINS, before=BEFORE)
        self._window = _count(self._keypoints, windows, "size")
        self._sigma_scale = float(windows.get("sigma_scale", 1.0))
        self._names = _classes(self._keypoints, windows, models)
        if _classes(self._boxes, about, models) != self._names:
            raise FileFormatError(self._boxes.path, "classes", f"differ from those of {self._keypoints.path}")
        self._diameters = [models[name].diameter if name in models else 0.0 for name in self._names]

    @property
    def class_names(self) -> tuple[str, ...]:
        """That the networks know, in the order of their answers."""
        return self._names

    def detect(self, frame: RgbdFrame, regions: Sequence[RegionOfInterest] = ()) -> DetectionResult:
        """Detect the objects in the image of a frame.

        Regions that nothing explains have windows of their own beside those of the boxes that the first network tells:
        where objects overlap, that takes them for one.
        """
        available = frame.stamp + int(self.config.latency * NANOSECONDS)
        next_image = max(frame.stamp + int(NANOSECONDS / self.config.rate), available)
        if frame.rgb is None:
            return DetectionResult(frame.stamp, available, (), Status.NO_DATA)
        config = self.config
        heat, sides, scale = self._look(frame.rgb, frame.depth)
        boxes = self._decoded(heat, sides, scale, min(config.hint, config.box_score))
        clear = [(box, config.present) for box in boxes if box.score > config.box_score]
        unexplained = [region.box for region in regions if region.sensor == "camera"]
        hints = boxes[len(clear) :] + [
            box
            for box in boxes_of_regions(heat, unexplained, scale, config.region_hint)
            if self._diameters[box.class_index]
        ]
        hints = sorted(hints, key=lambda hint: -hint.score)[: config.hints]
        looked = clear + [(box, config.hint_present) for box in hints]
        answers = self._closer([box for box, _ in looked], frame.rgb, frame.depth, frame.intrinsics.fx)
        found = [
            (k >= len(clear), answer)
            for k, ((answer, there), (_, least)) in enumerate(zip(answers, looked, strict=True))
            if there >= least
        ]
        found.sort(key=lambda pair: (pair[0], -pair[1].score))
        detections = tuple(self._unlike([detection for _, detection in found]))
        return DetectionResult(frame.stamp, available, detections, next_image=next_image)

    def _unlike(self, found: Sequence[Detection]) -> list[Detection]:
        """Those of detections that are not of the same object as an earlier one."""
        kept: list[Detection] = []
        for detection in found:
            reach = self.config.same * float(np.max(detection.box[2:] - detection.box[:2]))
            if all(d.class_name != detection.class_name or _apart(d, detection) > reach for d in kept):
                kept.append(detection)
        return kept

    def boxes(self, rgb: Uint8, depth: Float32, least_score: float | None = None) -> list[Box]:
        """Boxes of the wanted objects in an image, in its own pixels, best first; from the configured score on if None.

        Args:
            rgb: (H, W, 3).
            depth: (H, W), metres, 0 = no reading.
            least_score: 0 to 1.
        """
        return self._decoded(*self._look(rgb, depth), self.config.box_score if least_score is None else least_score)

    def _look(self, rgb: Uint8, depth: Float32) -> tuple[np.ndarray, np.ndarray, Float64]:
        """Centres (classes, h, w) and sides (4, h, w) as the first network tells them; its pixels in the image's."""
        small = shown_image(*reduced(rgb, depth, *self._size))
        heat, sides = self._boxes.run({"image": small[None]})
        return heat[0], sides[0], np.array(depth.shape[::-1]) / np.array(self._size)

    def _decoded(self, heat: np.ndarray, sides: np.ndarray, scale: Float64, least_score: float) -> list[Box]:
        scale = np.tile(scale, 2)
        wanted = (box for box in decoded_boxes(heat, sides, least_score) if self._diameters[box.class_index])
        return [Box(box.class_index, (box.corners + 0.5) * scale - 0.5, box.score) for box in wanted]

    def keypoints(self, boxes: Sequence[Box], rgb: Uint8, depth: Float32, focal: float) -> tuple[Detection, ...]:
        """Look closer at boxes.

        Args:
            boxes: in the image's pixels.
            rgb: (H, W, 3).
            depth: (H, W), metres, 0 = no reading.
            focal: length in pixels.
        """
        answers = self._closer(boxes, rgb, depth, focal)
        return tuple(detection for detection, there in answers if there >= self.config.present)

    def _closer(self, boxes: Sequence[Box], rgb: Uint8, depth: Float32, focal: float) -> list[tuple[Detection, float]]:
        """What is in boxes, and the probability that it is there."""
        if not boxes:
            return []
        pyramid, size = Pyramid(rgb), self._window
        windows = [window_about(box.corners) for box in boxes]
        shown, told = [], []
        for box, window in zip(boxes, windows, strict=True):
            pixels = window.pixels_of(size)
            view, width = shown_window(
                pyramid.cut(pixels, size), warped(depth, pixels, size, smooth=False), window.side / focal
            )
            shown.append(view)
            told.append(conditions(box.class_index, len(self._names), width, self._diameters[box.class_index]))
        coordinates, present = self._keypoints.run({"window": np.stack(shown), "told": np.stack(told)})
        places, spreads = decoded(coordinates)
        there = 1.0 / (1.0 + np.exp(-present.astype(float)))
        answers = zip(boxes, windows, places, spreads, there.tolist(), strict=True)
        return [(self._detection(*answer), answer[4]) for answer in answers]

    def _detection(self, box: Box, window: Window, places: Float64, spreads: Float64, there: float) -> Detection:
        first = np.array([window.u, window.v]) - 0.5 * window.side
        pixels = first + places * window.side
        # Both coordinates' spreads, as the standard deviation of either of them.
        spread = np.sqrt(np.mean(spreads**2, axis=1))
        pixels[spread > self.config.max_sigma] = np.nan
        sigma = np.maximum(spread, LEAST_SIGMA) * (self._sigma_scale * window.side)
        return Detection(self._names[box.class_index], pixels, sigma, box.corners, float(np.sqrt(box.score * there)))


def _apart(a: Detection, b: Detection) -> float:
    """Pixels between the centres of two detections, as their keypoints tell them; else those of the boxes."""
    centres = [d.keypoints[-1] if np.isfinite(d.keypoints[-1]).all() else 0.5 * (d.box[:2] + d.box[2:]) for d in (a, b)]
    return float(np.linalg.norm(centres[0] - centres[1]))


def known_classes(folder: Path) -> tuple[str, ...]:
    """Names of the objects that the networks of a folder can find; raises FileFormatError."""
    network = open_network(folder / BOXES, "onnxruntime")
    return _classes(network, _told(network, "boxes"), {})


def _told(network: OnnxNetwork, kind: str, **fixed: float) -> dict[str, Any]:
    """The metadata of a network of a kind; values that this code relies on must be as it has them."""
    about = network.about()
    for name, expected in {"kind": kind, **fixed}.items():
        if about.get(name) != expected:
            raise FileFormatError(network.path, f"metadata.{name}", f"is {about.get(name)!r}; expected {expected!r}")
    return about


def _count(network: OnnxNetwork, about: Mapping[str, Any], name: str) -> int:
    value = about.get(name)
    if not isinstance(value, int) or not 16 <= value <= 4096:
        raise FileFormatError(network.path, f"metadata.{name}", f"is {value!r}; expected pixels, 16 to 4096")
    return value


def _classes(network: OnnxNetwork, about: Mapping[str, Any], models: Mapping[str, ObjectModel]) -> tuple[str, ...]:
    names, extents = about.get("classes"), about.get("extents")
    if not isinstance(names, list) or not isinstance(extents, list) or len(names) != len(extents) or not names:
        raise FileFormatError(network.path, "metadata.classes, extents", "expected names, and as many boxes' sizes")
    missing = sorted(set(models) - set(names))
    if missing:
        reason = f"knows nothing of {', '.join(missing)}; it was trained to find {', '.join(names)}"
        raise FileFormatError(network.path, "metadata.classes", reason)
    for name, size in zip(names, extents, strict=True):
        if name in models and not np.allclose(size, models[name].extents, rtol=EXTENT_TOLERANCE):
            ours = ", ".join(f"{e:.3f}" for e in models[name].extents)
            reason = f"'{name}' was trained with a box of {size} m, but its model's is {ours} m: keypoints would differ"
            raise FileFormatError(network.path, "metadata.extents", reason)
    return tuple(str(name) for name in names)
