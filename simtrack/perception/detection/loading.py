"""simtrack's own image detectors by name: networks that come along, a folder of trained ones, a YOLOv8-pose file."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from simtrack.errors import FileFormatError
from simtrack.objects import ObjectModel

if TYPE_CHECKING:
    from simtrack.perception.detection.keypoint_detector import KeypointDetector
    from simtrack.perception.detection.yolo_pose import YoloPoseDetector

KEYPOINTS = "keypoints"
"""The networks that come along."""
ALLOWED = (KEYPOINTS, "folder of boxes.onnx and keypoints.onnx", "YOLOv8-pose .onnx file")


def is_image_detector(given: str) -> bool:
    """Whether a name stands for one of simtrack's own detectors that look at images."""
    return given == KEYPOINTS or given.endswith(".onnx") or Path(given).is_dir()


def check_image_detector(given: str) -> None:
    """Whether a detector's files are there, before anything is built; raises FileFormatError."""
    from simtrack.perception.detection import keypoint_detector as own

    folder = own.SHIPPED if given == KEYPOINTS else Path(given)
    wanted = [folder] if given.endswith(".onnx") else [folder / own.BOXES, folder / own.KEYPOINTS]
    for path in wanted:
        if not path.is_file():
            made = "with --arch yolov8-pose makes one" if path == Path(given) else "makes boxes.onnx and keypoints.onnx"
            raise FileFormatError(path, "", f"no such file; `simtrack train detector` {made}")


def known_classes(given: str) -> tuple[str, ...]:
    """Names of the objects that the networks of a folder, or those that come along, can find.

    Raises:
        FileFormatError: a file is missing or is not what it should be.
    """
    from simtrack.perception.detection import keypoint_detector as own

    return own.known_classes(own.SHIPPED if given == KEYPOINTS else Path(given))


def make_image_detector(given: str, models: Mapping[str, ObjectModel]) -> "KeypointDetector | YoloPoseDetector":
    """Open a detector.

    Args:
        given: ``keypoints``, a folder that `simtrack train` wrote, or a YOLOv8-pose network of the user's.
        models: class name -> model of the objects to be found.

    Raises:
        FileFormatError: a file is missing or is not what it should be.
    """
    if given.endswith(".onnx"):
        from simtrack.perception.detection.yolo_pose import YoloPoseDetector

        return YoloPoseDetector(Path(given), models)
    from simtrack.perception.detection.keypoint_detector import KeypointDetector

    return KeypointDetector(models, None if given == KEYPOINTS else Path(given))
