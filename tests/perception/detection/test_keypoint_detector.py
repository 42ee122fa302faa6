"""The detector around its networks: what it asks them, what it makes of their answers, which files it refuses."""

import json
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simtrack.contracts import NANOSECONDS, CameraIntrinsics, Detector, RegionOfInterest, RgbdFrame, Status
from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.geometry.meshes import box_mesh
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.objects import ObjectModel
from simtrack.objects.model import build_model, half_turns
from simtrack.perception.detection import keypoint_detector
from simtrack.perception.detection.bins import BEFORE, BINS, position_of
from simtrack.perception.detection.boxes import STRIDE
from simtrack.perception.detection.keypoint_detector import KeypointDetector, KeypointDetectorConfig
from simtrack.perception.detection.loading import check_image_detector, is_image_detector, make_image_detector
from simtrack.perception.detection.onnx_network import OnnxNetwork, open_network
from simtrack.perception.detection.pnp import project_points, solve_pose
from simtrack.perception.detection.views import WINDOW, window_about

CAMERA = CameraIntrinsics(640, 480, 577.0, 577.0, 319.5, 239.5)
SMALL = (320, 240)


def brick(name: str = "brick", size: tuple[float, float, float] = (0.2, 0.12, 0.08)) -> ObjectModel:
    mesh = box_mesh(size, (200, 80, 40))
    return build_model(
        name=name, semantic_class="component", mesh=mesh, visual=mesh, collision=[mesh], mass=1.0, friction=0.5,
        symmetries=half_turns(), trackable=True,
    )  # fmt: skip


ABOUT: dict[str, dict[str, Any]] = {
    "boxes.onnx": {"kind": "boxes", "stride": STRIDE, "width": SMALL[0], "height": SMALL[1]},
    "keypoints.onnx": {"kind": "keypoints", "size": 64, "window": WINDOW, "bins": BINS, "before": BEFORE},
}
CLASSES = {"classes": ["brick", "tile"], "extents": [[0.2, 0.12, 0.08], [0.1, 0.1, 0.02]]}


class Answers:
    """Networks that know the answer for one object of the first class."""

    def __init__(self, T_camera_object: np.ndarray, present: float = 10.0) -> None:
        self.keypoints = project_points(T_camera_object, brick().keypoints, CAMERA)
        self.box = np.concatenate([self.keypoints.min(axis=0), self.keypoints.max(axis=0)])
        self.present = present
        self.centre = 4.0

    def boxes(self, inputs: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        assert inputs["image"].shape == (1, 5, SMALL[1], SMALL[0])
        h, w = SMALL[1] // STRIDE, SMALL[0] // STRIDE
        u0, v0, u1, v1 = ((self.box + 0.5) / 2 - 0.5 + 0.5) / STRIDE - 0.5  # half the size, then cells
        u, v = round((u0 + u1) / 2), round((v0 + v1) / 2)
        heat, sides = np.full((1, 2, h, w), -9.0, np.float32), np.zeros((1, 4, h, w), np.float32)
        heat[0, 0, v, u] = self.centre
        sides[0, :, v, u] = np.log([u - u0, v - v0, u1 - u, v1 - v])
        return [heat, sides]

    def windows(self, inputs: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        count = len(inputs["window"])
        assert inputs["window"].shape == (count, 5, 64, 64)
        assert inputs["told"].shape == (count, 4)
        window = window_about(self.box)
        places = (self.keypoints - [window.u, window.v]) / window.side + 0.5
        position = position_of(places)
        logits = -0.5 * ((np.arange(BINS) - position[..., None]) / 1.3) ** 2
        return [np.tile(logits.astype(np.float32), (count, 1, 1, 1)), np.full(count, self.present, np.float32)]


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> dict[str, dict[str, Any]]:
    """Metadata of the networks' files, to be spoiled, behind which `Answers` stand."""
    about = {name: values | CLASSES for name, values in ABOUT.items()}
    answers = Answers(pose())
    about["answers"] = {"instance": answers}

    def open_network(path: Path, runtime: str) -> OnnxNetwork:
        boxes = path.name == "boxes.onnx"
        inputs = {"image": (1, 5, *SMALL[::-1])} if boxes else {"window": ("n", 5, 64, 64), "told": ("n", 4)}
        outputs = ("heat", "sides") if boxes else ("coordinates", "present")
        run = answers.boxes if boxes else answers.windows
        return OnnxNetwork(path, inputs, outputs, {"simtrack": json.dumps(about[path.name])}, run, runtime)

    monkeypatch.setattr(keypoint_detector, "open_network", open_network)
    return about


def pose() -> np.ndarray:
    return transform(exp_so3(np.array([0.5, -0.7, 0.3])), (0.1, -0.05, 1.1))


def models() -> dict[str, ObjectModel]:
    return {"brick": brick(), "tile": brick("tile", (0.1, 0.1, 0.02))}


def frame(rgb: np.ndarray | None) -> RgbdFrame:
    return RgbdFrame(7 * NANOSECONDS, np.ones((480, 640), np.float32), rgb, CAMERA, np.eye(4))


def test_right_answers_become_the_right_pose(opened: dict[str, Any]) -> None:
    detector = KeypointDetector(models(), Path("somewhere"), KeypointDetectorConfig(rate=2.0, latency=0.3))
    assert isinstance(detector, Detector)
    result = detector.detect(frame(np.zeros((480, 640, 3), np.uint8)))
    assert (result.stamp, result.available, result.next_image) == (7 * NANOSECONDS, 7_300_000_000, 7_500_000_000)
    (detection,) = result.detections
    assert detection.class_name == "brick"
    answers = opened["answers"]["instance"]
    assert np.allclose(detection.box, answers.box, atol=1e-3)
    assert np.abs(detection.keypoints - answers.keypoints).max() < 0.3  # pixels
    (best, *_) = solve_pose(detection, models()["brick"], CAMERA, 0)
    assert np.linalg.norm(best.T_camera_object[:3, 3] - pose()[:3, 3]) < 0.005


def test_boxes_in_which_nothing_is_are_dropped(opened: dict[str, Any]) -> None:
    opened["answers"]["instance"].present = -3.0
    assert KeypointDetector(models(), Path("x")).detect(frame(np.zeros((480, 640, 3), np.uint8))).detections == ()


def region(box: np.ndarray, sensor: str = "camera") -> RegionOfInterest:
    return RegionOfInterest(7 * NANOSECONDS, box + 0.5, np.zeros(3), np.zeros(3), 900, sensor)


def test_weak_centres_want_surer_windows(opened: dict[str, Any]) -> None:
    answers, image = opened["answers"]["instance"], frame(np.zeros((480, 640, 3), np.uint8))
    for centre, present, count in (
        (4.0, 4.5, 1),  # scores of 0.98 and 0.989
        (-1.2, 8.0, 0),  # 0.23 and 0.9997
        (-1.2, 10.0, 1),  # 0.99995
        (-2.0, 10.0, 0),  # 0.12
    ):
        answers.centre, answers.present = centre, present
        assert len(KeypointDetector(models(), Path("x")).detect(image).detections) == count


def test_regions_that_nothing_explains_have_windows_of_their_own(opened: dict[str, Any]) -> None:
    answers, image = opened["answers"]["instance"], frame(np.zeros((480, 640, 3), np.uint8))
    box, detector = answers.box, KeypointDetector(models(), Path("x"))
    beside = box + 0.4 * (box[2] - box[0]) * np.array([1.0, 0.0, 1.0, 0.0])
    # What has box and region is one object, and so are regions that are nearly the same.
    for regions, found in (([region(box)], [box]), ([region(beside), region(beside + 1.0)], [box, beside])):
        detections = detector.detect(image, regions).detections
        assert len(detections) == len(found)
        assert all(np.abs(d.box - b).max() < 1.1 for d, b in zip(detections, found, strict=True))
    assert len(detector.detect(image, [region(beside, "lidar")]).detections) == 1
    none = KeypointDetector(models(), Path("x"), KeypointDetectorConfig(hints=0))
    assert len(none.detect(image, [region(beside)]).detections) == 1
    answers.present = 4.5
    assert len(detector.detect(image, [region(beside)]).detections) == 1


def test_objects_that_nobody_asked_for_are_let_be(opened: dict[str, Any]) -> None:
    detector, box = KeypointDetector({"tile": models()["tile"]}, Path("x")), opened["answers"]["instance"].box
    assert detector.detect(frame(np.zeros((480, 640, 3), np.uint8)), [region(box)]).detections == ()


def test_without_colour_there_is_no_data(opened: dict[str, Any]) -> None:
    assert KeypointDetector(models(), Path("x")).detect(frame(None)).status is Status.NO_DATA


@pytest.mark.parametrize(
    ("file", "field", "value", "told"),
    [
        ("boxes.onnx", "kind", "keypoints", "expected 'boxes'"),
        ("boxes.onnx", "width", 0, "16 to 4096"),
        ("keypoints.onnx", "bins", 10, "expected 96"),
        ("keypoints.onnx", "classes", ["tile", "brick"], "keypoints would differ"),
        ("keypoints.onnx", "extents", [[0.2, 0.12, 0.16], [0.1, 0.1, 0.02]], "'brick' was trained with a box of"),
        ("boxes.onnx", "classes", ["brick", "plate"], "knows nothing of tile; it was trained to find brick, plate"),
        ("keypoints.onnx", "classes", [], "expected names"),
    ],
)
def test_other_networks_are_refused(opened: dict[str, Any], file: str, field: str, value: object, told: str) -> None:
    opened[file][field] = value
    with pytest.raises(FileFormatError, match=told) as caught:
        KeypointDetector(models(), Path("x"))
    assert caught.value.path.name == file


def test_files_that_are_no_networks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"boxes\.onnx: no such file"):
        make_image_detector(str(tmp_path), models())
    with pytest.raises(FileFormatError, match="simtrack train detector"):
        check_image_detector(str(tmp_path))
    (tmp_path / "boxes.onnx").write_bytes(b"not a network")
    with pytest.raises(FileFormatError, match="no ONNX network"):
        open_network(tmp_path / "boxes.onnx")
    with pytest.raises(InvalidValueError, match="auto, onnxruntime, openvino"):
        open_network(tmp_path / "boxes.onnx", "tensorrt")  # type: ignore[arg-type]
    assert [is_image_detector(name) for name in ("keypoints", "a.onnx", str(tmp_path), "oracle", "m:C")] == [
        True, True, True, False, False,
    ]  # fmt: skip


def test_settings_are_checked() -> None:
    with pytest.raises(InvalidValueError, match="latency"):
        KeypointDetectorConfig(latency=-1.0)
    with pytest.raises(InvalidValueError, match="rate"):
        KeypointDetectorConfig(rate=0.0)


def test_the_networks_that_come_along_know_the_workbench() -> None:
    from simtrack.objects import load_object

    names = ("klt3147", "materialbox", "multimeter", "powerdrill", "relay", "screwdriver")
    detector = KeypointDetector({name: load_object(name) for name in names})
    assert detector.class_names == names
    blank = np.full((480, 640, 3), 90, np.uint8)
    once, again = (detector.detect(frame(blank)) for _ in range(2))
    assert once.detections == again.detections == ()
    assert sum(path.stat().st_size for path in keypoint_detector.SHIPPED.glob("*.onnx")) < 12_000_000
    check_image_detector("keypoints")


@pytest.mark.skipif(find_spec("openvino") is None, reason="OpenVINO is not installed (extra openvino)")
@pytest.mark.parametrize("file", [keypoint_detector.BOXES, keypoint_detector.KEYPOINTS])
def test_openvino_answers_as_onnxruntime_does(file: str) -> None:
    """As near as 16-bit arithmetic allows, which OpenVINO takes where the processor has it."""
    rng = np.random.default_rng(0)
    ours, theirs = (open_network(keypoint_detector.SHIPPED / file, name) for name in ("onnxruntime", "openvino"))
    assert (ours.runtime, theirs.runtime) == ("onnxruntime", "openvino")
    assert (ours.inputs, ours.outputs, ours.metadata) == (theirs.inputs, theirs.outputs, theirs.metadata)
    free = 2  # of sizes that are not fixed
    given = {
        name: rng.standard_normal([n if isinstance(n, int) else free for n in shape]).astype(np.float32)
        for name, shape in ours.inputs.items()
    }
    for a, b in zip(ours.run(given), theirs.run(given), strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        assert np.abs(a - b).max() < 0.1 * a.std()
