"""YOLOv8-pose networks: their answers in our terms, and which files are refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, RgbdFrame, Status
from simtrack.errors import FileFormatError
from simtrack.perception.detection import yolo_pose
from simtrack.perception.detection.onnx_network import OnnxNetwork
from simtrack.perception.detection.yolo_pose import YoloPoseConfig, YoloPoseDetector, letterboxed
from tests.perception.detection.test_keypoint_detector import models

SIZE = 320
CAMERA = CameraIntrinsics(640, 480, 577.0, 577.0, 319.5, 239.5)
GOOD: dict[str, Any] = {
    "inputs": {"images": (1, 3, SIZE, SIZE)},
    "outputs": ("output0",),
    "metadata": {"names": "{0: 'brick', 1: 'tile'}", "kpt_shape": "[9, 3]"},
}


def rows() -> np.ndarray:
    """(1, 33, 4): one tile seen twice, one brick, one that is too uncertain."""
    answer = np.zeros((1, 4 + 2 + 27, 4), np.float32)
    for k, (u, v, brick, tile) in enumerate(
        [(100, 100, 0.1, 0.9), (102, 100, 0, 0.8), (200, 150, 0.7, 0), (50, 200, 0.2, 0)]
    ):
        answer[0, :6, k] = u, v, 40, 20, brick, tile
        answer[0, 6:, k] = np.stack([u + np.arange(9), v + np.arange(9), np.full(9, 0.9)], axis=1).ravel()
        answer[0, 8, k] = 0.1  # the visibility of the first keypoint
    return answer


def detector(
    monkeypatch: pytest.MonkeyPatch,
    answer: np.ndarray | None = None,
    config: YoloPoseConfig | None = None,
    **spoiled: Any,
) -> YoloPoseDetector:
    parts = GOOD | spoiled

    def run(inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        assert inputs["images"].shape == (1, 3, SIZE, SIZE)
        return [rows() if answer is None else answer]

    network = OnnxNetwork(Path("net.onnx"), parts["inputs"], parts["outputs"], parts["metadata"], run, "onnxruntime")  # type: ignore[arg-type]
    monkeypatch.setattr(yolo_pose, "open_network", lambda path, runtime: network)
    return YoloPoseDetector(Path("net.onnx"), models(), config)


def test_its_answers_in_our_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    made = detector(monkeypatch, config=YoloPoseConfig(visibility=0.5))
    frame = RgbdFrame(5, np.zeros((480, 640), np.float32), np.zeros((480, 640, 3), np.uint8), CAMERA, np.eye(4))
    tile, brick = made.detect(frame).detections
    assert (tile.class_name, brick.class_name) == ("tile", "brick")
    assert np.isclose(tile.score, 0.9)
    # 640x480 fits 320x320 at half the size, 40 rows of grey above; its coordinates begin half a pixel earlier.
    assert np.allclose(tile.box, [2 * 80 - 0.5, 2 * 50 - 0.5, 2 * 120 - 0.5, 2 * 70 - 0.5])
    assert np.isnan(tile.keypoints[0]).all()
    assert np.allclose(tile.keypoints[1:], np.stack([2 * (100 + np.arange(1, 9)), 2 * (60 + np.arange(1, 9))], 1) - 0.5)
    assert made.detect(RgbdFrame(5, frame.depth, None, CAMERA, np.eye(4))).status is Status.NO_DATA


def test_its_boxes_down_to_any_score(monkeypatch: pytest.MonkeyPatch) -> None:
    made = detector(monkeypatch)
    rgb, depth = np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.float32)
    boxes = made.boxes(rgb, depth, 0.1)
    assert [(made.class_names[box.class_index], round(box.score, 3)) for box in boxes] == [
        ("tile", 0.9),
        ("brick", 0.7),
        ("brick", 0.2),
    ]
    found = made.detect(RgbdFrame(5, depth, rgb, CAMERA, np.eye(4))).detections
    assert [box.corners.tolist() for box in made.boxes(rgb, depth)] == [d.box.tolist() for d in found]


def test_an_image_is_fitted_as_it_was_trained() -> None:
    rgb = np.full((480, 640, 3), 255, np.uint8)
    image, scale, shift = letterboxed(rgb, SIZE, SIZE)
    assert (scale, shift.tolist()) == (0.5, [0.0, 40.0])
    assert np.allclose(image[0, :, 40:280], 1.0)
    assert np.allclose(image[0, :, :40], 114 / 255)


@pytest.mark.parametrize(
    ("spoiled", "told"),
    [
        ({"outputs": ("a", "b", "c")}, "1 inputs and 3 outputs; expected one of each"),
        ({"inputs": {"x": (1, 4, SIZE, SIZE)}}, r"expected \(1, 3, height, width\)"),
        ({"inputs": {"x": (1, 3, "h", "w")}}, "fixed size"),
        ({"metadata": {}}, "metadata of a pose network"),
        ({"metadata": {"names": "{0: 'brick', 1: 'tile'}", "kpt_shape": "[17, 3]"}}, r"expected \[9, 3\]"),
        (
            {"metadata": {"names": "{0: 'brick', 1: 'cat'}", "kpt_shape": "[9, 3]"}},
            "nothing of tile; only of brick, cat",
        ),
        ({"metadata": {"names": "__import__('os')", "kpt_shape": "[9, 3]"}}, "metadata of a pose network"),
    ],
)
def test_other_networks_are_refused(monkeypatch: pytest.MonkeyPatch, spoiled: dict[str, Any], told: str) -> None:
    with pytest.raises(FileFormatError, match=told):
        detector(monkeypatch, **spoiled)


def test_an_answer_of_another_shape_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    made = detector(monkeypatch, answer=np.zeros((1, 56, 100), np.float32))
    frame = RgbdFrame(5, np.zeros((480, 640), np.float32), np.zeros((480, 640, 3), np.uint8), CAMERA, np.eye(4))
    with pytest.raises(FileFormatError, match=r"expected \(1, 33, boxes\)"):
        made.detect(frame)
