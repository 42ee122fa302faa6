"""``simtrack train``, ``evaluate detector`` and ``run --detector`` as a user gives them."""

import sys
from pathlib import Path

import pytest

from tests.cli.commands import simtrack_command
from tests.training.data import write_dataset


def test_a_detector_is_trained_by_one_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch", reason="training needs the extra train")
    pytest.importorskip("onnx", reason="networks are written with onnx, of the extra train")
    from simtrack.training import box_task, detector

    monkeypatch.setattr(box_task.BoxTask, "batch_size", 2)
    monkeypatch.setattr(detector, "SAMPLES", {"keypoints": 2, "boxes": 2})
    data, out = write_dataset(tmp_path / "data"), tmp_path / "out"
    done = simtrack_command("train", "detector", "--data", data, "--out", out, "--part", "boxes")
    assert done.returncode == 0, done.stderr
    assert "AP50" in done.stdout
    assert (out / "boxes.onnx").is_file()
    again = simtrack_command("train", "detector", "--data", data, "--out", out, "--part", "boxes")
    assert again.returncode == 0
    assert "AP50" not in again.stdout  # it has learned already


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("train", "detector", "--data", "{tmp}", "--out", "{tmp}/out"), "no dataset.json"),
        (
            ("train", "detector", "--data", "{tmp}", "--out", "{tmp}/out", "--minutes", "0"),
            "minutes = 0.0 is not valid",
        ),
        (
            ("train", "detector", "--data", "{tmp}", "--out", "{tmp}/out", "--arch", "yolov8-pose", "--part", "boxes"),
            "--part = 'boxes' is not valid; allowed: both: yolov8-pose is one network",
        ),
        (("train", "segmenter", "--data", "{tmp}", "--out", "{tmp}/out", "--arch", "yolov8n-pose"), "--arch ="),
        (
            ("train", "detector", "--data", "{tmp}", "--out", "{tmp}/out", "--image-size", "320"),
            "--image-size = 320 is not valid; allowed: none: it is for --arch yolov8-pose alone",
        ),
        (("evaluate", "detector"), "--data is required"),
        (("train", "detector", "--out", "{tmp}/out"), "--data is required"),
        (("train", "agent", "--out", "{tmp}/out", "--minutes", "0"), "minutes = 0.0 is not valid"),
        (("evaluate", "detector", "--data", "{tmp}", "--count", "0"), "count = 0 is not valid"),
        (("run", "--detector", "{tmp}"), "boxes.onnx: no such file"),
        (("run", "--detector", "{tmp}/mine.onnx"), "mine.onnx: no such file"),
        (("run", "--detector", "yolo"), "unknown detector 'yolo'"),
    ],
)
def test_what_cannot_be_used_is_told(tmp_path: Path, arguments: tuple[str, ...], told: str) -> None:
    if arguments[0] == "train":
        pytest.importorskip("torch", reason="training needs the extra train")
        pytest.importorskip("onnx", reason="networks are written with onnx, of the extra train")
    done = simtrack_command(*(argument.format(tmp=tmp_path) for argument in arguments))
    assert done.returncode == 2
    assert told in " ".join(done.stderr.split())


def test_the_licence_of_yolo_is_said_where_it_is_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())  # torch and onnx need not be there for it
    monkeypatch.setitem(sys.modules, "ultralytics", None)
    for name in ("YOLO_OFFLINE", "YOLO_AUTOINSTALL", "YOLO_CONFIG_DIR"):
        monkeypatch.setenv(name, "")
    done = simtrack_command("train", "detector", "--arch", "yolov8-pose", "--data", tmp_path, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "yolov8s-pose" in done.stdout and "AGPL-3.0" in done.stdout
    assert "ultralytics is not installed" in done.stderr and "AGPL-3.0" in done.stderr
    assert "AGPL-3.0" in simtrack_command("train", "--help").stdout


def test_without_torch_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    done = simtrack_command("train", "detector", "--data", tmp_path, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "simtrack[train]" in done.stderr
