"""YOLOv8-pose networks that the user trained, as ultralytics exports them to ONNX.

Nothing of ultralytics' code is needed or used here. Its makers claim its licence (AGPL-3.0) for the weights that it
trains, too.
"""

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

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
from simtrack.perception.detection.boxes import Box, overlap
from simtrack.perception.detection.onnx_network import OnnxNetwork, Runtime, open_network

KEYPOINTS, VALUES = 9, 3
"""The corners of the object's box and its centre, each with u, v, visibility."""
GREY = 114
"""What ultralytics fills an image up with."""
MOST = 1000
"""Answers that are looked at, those with the highest scores."""


@dataclass(frozen=True, slots=True)
class YoloPoseConfig:
    """Settings of `YoloPoseDetector`."""

    latency: float = 0.2
    """Seconds of simulated or recorded time from the image's stamp to the answer."""
    score: float = 0.4
    """Boxes with a lower score are left out."""
    same: float = 0.6
    """Boxes of one class that overlap by more than this are one object's."""
    visibility: float = 0.0
    """Keypoints that are visible with less probability than this are left out."""
    keypoint_error: float = 0.06
    """Standard deviation of a keypoint, in shares of the box's longer side: the network does not tell any."""
    runtime: Runtime = "onnxruntime"

    def __post_init__(self) -> None:
        for name in ("latency", "score", "same", "visibility", "keypoint_error"):
            if not getattr(self, name) >= 0.0:
                raise InvalidValueError(f"YoloPoseConfig.{name}", getattr(self, name), ">= 0")


class YoloPoseDetector:
    """Runs a YOLOv8-pose network; implements `simtrack.contracts.Detector`."""

    def __init__(self, path: Path, models: Mapping[str, ObjectModel], config: YoloPoseConfig | None = None) -> None:
        """Open a network.

        Args:
            path: ONNX file with one input (1, 3, H, W) and one output (1, 4 + classes + 27, boxes).
            models: class name -> model of the objects to be found.
            config: settings.

        Raises:
            FileFormatError: it is another kind of network, has other keypoints, or does not know one of the objects.

        """
        self.config = config or YoloPoseConfig()
        self._network = open_network(path, self.config.runtime)
        self._input, self._size = _input(self._network)
        self._names = _names(self._network)
        self._wanted = {index: name for index, name in self._names.items() if name in models}
        missing = sorted(set(models) - set(self._names.values()))
        if missing:
            known = ", ".join(self._names.values())
            raise FileFormatError(path, "metadata.names", f"knows nothing of {', '.join(missing)}; only of {known}")

    def detect(self, frame: RgbdFrame, regions: Sequence[RegionOfInterest] = ()) -> DetectionResult:
        """Detect the objects in the image of a frame; neither depth nor regions are looked at."""
        available = frame.stamp + int(self.config.latency * NANOSECONDS)
        if frame.rgb is None:
            return DetectionResult(frame.stamp, available, (), Status.NO_DATA)
        return DetectionResult(frame.stamp, available, tuple(self._found(frame.rgb, self.config.score)))

    @property
    def class_names(self) -> tuple[str, ...]:
        """That the network knows, in the order of its answers."""
        return tuple(self._names.values())

    def boxes(self, rgb: Uint8, depth: Float32, least_score: float | None = None) -> list[Box]:
        """Boxes of the wanted objects in an image, in its own pixels, best first; from the configured score on if None.

        Args:
            rgb: (H, W, 3).
            depth: not looked at.
            least_score: 0 to 1.
        """
        found = self._found(rgb, self.config.score if least_score is None else least_score)
        return [Box(self.class_names.index(d.class_name), d.box, d.score) for d in found]

    def _found(self, rgb: Uint8, least_score: float) -> list[Detection]:
        """The best of those that overlap, best first."""
        image, scale, shift = letterboxed(rgb, *self._size)
        rows = self._rows(self._network.run({self._input: image})[0], least_score)
        found: list[Detection] = []
        for row in rows:
            index = int(np.argmax(row[4 : 4 + len(self._names)]))
            detection = self._detection(row, index, scale, shift)
            if all(
                o.class_name != detection.class_name or overlap(o.box, detection.box) < self.config.same for o in found
            ):
                found.append(detection)
        return found

    def _rows(self, answer: np.ndarray, least_score: float) -> Float64:
        """(K, 4 + classes + 27) of the wanted objects, best first."""
        columns = 4 + len(self._names) + KEYPOINTS * VALUES
        if answer.ndim != 3 or answer.shape[:2] != (1, columns):
            reason = (
                f"has shape {answer.shape}; expected (1, {columns}, boxes): 4 of the box, {len(self._names)} scores, "
            )
            raise FileFormatError(self._network.path, "output", reason + f"{KEYPOINTS} keypoints x (u, v, visibility)")
        rows = answer[0].T.astype(float)
        scores = rows[:, 4 : 4 + len(self._names)]
        best = scores.max(axis=1)
        kept = (best >= least_score) & np.isin(scores.argmax(axis=1), list(self._wanted))
        order = np.argsort(-best[kept], kind="stable")
        return rows[kept][order][:MOST]

    def _detection(self, row: Float64, index: int, scale: float, shift: Float64) -> Detection:
        centre, size = row[:2], row[2:4]
        # Its pixel coordinates begin at the image's edge, ours in the middle of the first pixel.
        box = (np.concatenate([centre - size / 2, centre + size / 2]) - np.tile(shift, 2)) / scale - 0.5
        points = row[4 + len(self._names) :].reshape(KEYPOINTS, VALUES)
        pixels = (points[:, :2] - shift) / scale - 0.5
        pixels[points[:, 2] < self.config.visibility] = np.nan
        sigma = np.full(KEYPOINTS, max(self.config.keypoint_error * float(np.max(size)) / scale, 0.3))
        return Detection(self._names[index], pixels, sigma, box, float(min(row[4 + index], 1.0)))


def letterboxed(rgb: np.ndarray, width: int, height: int) -> tuple[np.ndarray, float, Float64]:
    """(1, 3, height, width) float32, 0 to 1, of an image that is scaled to fit and filled up with grey.

    Also returns the scale, and the shift (2,) in pixels of what was made.
    """
    import cv2

    scale = min(width / rgb.shape[1], height / rgb.shape[0])
    size = round(rgb.shape[1] * scale), round(rgb.shape[0] * scale)
    small = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_LINEAR)) if scale != 1.0 else rgb
    left, top = (width - size[0]) // 2, (height - size[1]) // 2
    image = np.full((height, width, 3), GREY, np.uint8)
    image[top : top + size[1], left : left + size[0]] = small
    return image.transpose(2, 0, 1)[None].astype(np.float32) / 255.0, scale, np.array([left, top], float)


def _input(network: OnnxNetwork) -> tuple[str, tuple[int, int]]:
    """Name of the input, and (width, height)."""
    if len(network.inputs) != 1 or len(network.outputs) != 1:
        given = f"{len(network.inputs)} inputs and {len(network.outputs)} outputs"
        raise FileFormatError(network.path, "", f"has {given}; expected one of each, as YOLOv8-pose has them")
    ((name, shape),) = network.inputs.items()
    match shape:
        case (1 | str() | None, 3, int() as height, int() as width):
            return name, (width, height)
    raise FileFormatError(
        network.path, f"input {name}", f"has shape {shape}; expected (1, 3, height, width) with a fixed size"
    )


def _names(network: OnnxNetwork) -> dict[int, str]:
    """Class index -> name, from the metadata that ultralytics writes."""
    try:
        names = ast.literal_eval(network.metadata["names"])
        shape = ast.literal_eval(network.metadata["kpt_shape"])
    except (KeyError, ValueError, SyntaxError) as error:
        reason = "missing: expected the metadata of a pose network that ultralytics exported"
        raise FileFormatError(network.path, "metadata.names, metadata.kpt_shape", reason) from error
    if list(shape) != [KEYPOINTS, VALUES]:
        reason = (
            f"is {shape}; expected [{KEYPOINTS}, {VALUES}]: eight corners of the box and its centre, with visibility"
        )
        raise FileFormatError(network.path, "metadata.kpt_shape", reason)
    if not isinstance(names, dict) or sorted(names) != list(range(len(names))):
        raise FileFormatError(network.path, "metadata.names", "expected names of classes 0, 1, ...")
    return {index: str(name) for index, name in sorted(names.items())}
