"""Training YOLOv8: what ultralytics is told, by a stand-in for it, and the real one where it is installed."""

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simtrack.errors import DatasetError, FileFormatError, InvalidValueError, StageError
from simtrack.training import yolo
from simtrack.training.config import TrainingConfig
from simtrack.training.yolo import EPOCHS, YoloProgress, planned_epochs, train_yolo
from tests.training.yolo_data import contents, write_yolo_dataset

ROOT = Path(__file__).parents[2]
PYTHON = os.environ.get("SIMTRACK_ULTRALYTICS_PYTHON", sys.executable)
"""An interpreter that has ultralytics, which wants an environment of its own."""
WATCH = """
import os, socket

def told(name):
    def asked(*arguments, **others):
        with open(os.environ["ASKED"], "a") as stream:
            stream.write(f"{name} {arguments}\\n")
        raise OSError("there is no network")
    return asked

socket.getaddrinfo = told("getaddrinfo")
socket.socket.connect = told("connect")
"""
"""Writes down who asks for the network, and refuses."""
BATCHES, SECONDS = 4, 1.0
"""Of an epoch of the stand-in, and a batch."""


class StandIn(ModuleType):
    """Trains nothing, but keeps to ultralytics' order of events and ways of writing."""

    def __init__(self) -> None:
        super().__init__("ultralytics")
        self.settings = {"sync": True, "wandb": True, "runs_dir": "somewhere"}
        self.now = 0.0
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.rates: list[list[float]] = []
        """Learning rate of each epoch by its linear schedule, one list a call."""
        self.mosaics: list[bool] = []
        """Whether an epoch showed four images in one."""
        self.epochs_ever = 0
        self.interrupted_at: tuple[int, int] | None = None
        """Epoch and batch."""

    def YOLO(self, name: str) -> "Network":
        return Network(self, name)


class Network:
    def __init__(self, package: StandIn, name: str) -> None:
        self.package, self.name = package, name
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.content = Path(name).read_text() if name.endswith(".pt") else ""

    def add_callback(self, event: str, callback: Callable[[Any], None]) -> None:
        self.callbacks[event] = callback

    def train(self, **arguments: Any) -> None:
        package = self.package
        package.calls.append((self.name, arguments))
        package.rates.append([])
        first = json.loads(self.content)["epoch"] + 1 if arguments.get("resume") else 0
        weights = Path(arguments["save_dir"]) / "weights"
        weights.mkdir(exist_ok=True)
        trainer = SimpleNamespace(
            args=SimpleNamespace(epochs=arguments.get("epochs", 1), close_mosaic=10),
            epochs=arguments.get("epochs", 1), stop=False, best_fitness=None, fitness=None,
            best=weights / "best.pt", last=weights / "last.pt",
        )  # fmt: skip
        self._tell("on_pretrain_routine_start", trainer)
        assert first < trainer.epochs == trainer.args.epochs, "nothing to resume"
        for epoch in range(first, 10_000):
            trainer.epoch = epoch
            package.rates[-1].append(1 - epoch / trainer.epochs)
            package.mosaics.append(epoch < trainer.epochs - trainer.args.close_mosaic)
            for batch in range(BATCHES):
                if package.interrupted_at == (epoch, batch):
                    trainer.last.write_text("cut sh")
                    raise KeyboardInterrupt
                package.now += SECONDS
                self._tell("on_train_batch_end", trainer)
                if trainer.stop:
                    break
            self._tell("on_train_epoch_end", trainer)
            trainer.fitness = 0.5 if epoch else 0.9  # the first is the best
            trainer.best_fitness = 0.9
            content = json.dumps({"epoch": epoch})
            trainer.last.write_text(content)
            if trainer.fitness == trainer.best_fitness:
                trainer.best.write_text(content)
            self._tell("on_model_save", trainer)
            package.epochs_ever += 1
            if trainer.stop or epoch + 1 >= trainer.epochs:
                break
        for path in (trainer.last, trainer.best):
            path.write_text("stripped")

    def export(self, **arguments: Any) -> str:
        assert arguments["format"] == "onnx" and not arguments["simplify"]
        path = Path(self.name).with_suffix(".onnx")
        path.write_text(self.content)
        return str(path)

    def _tell(self, event: str, trainer: Any) -> None:
        self.callbacks[event](trainer)


@pytest.fixture
def ultralytics(monkeypatch: pytest.MonkeyPatch) -> StandIn:
    package = StandIn()
    monkeypatch.setitem(sys.modules, "ultralytics", package)
    for name in ("YOLO_OFFLINE", "YOLO_AUTOINSTALL", "YOLO_CONFIG_DIR"):
        monkeypatch.setenv(name, "")
    monkeypatch.setenv("ULTRALYTICS_API_KEY", "mine")
    monkeypatch.setattr(yolo, "time", SimpleNamespace(monotonic=lambda: package.now))
    monkeypatch.setattr(yolo, "YoloPoseDetector", lambda path, models: None)
    return package


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_yolo_dataset(tmp_path_factory.mktemp("yolo"), name="relay")


def test_it_is_told_to_stay_offline_and_not_to_mirror(tmp_path: Path, data: Path, ultralytics: StandIn) -> None:
    before = contents(data)
    path = train_yolo("yolov8n-pose", TrainingConfig(data, tmp_path / "out", minutes=1.0, seed=7), 96)
    ((name, told),) = ultralytics.calls
    assert name == "yolov8n-pose.yaml"
    assert (told["imgsz"], told["seed"], told["epochs"]) == (96, 7, EPOCHS)
    assert [told[key] for key in ("amp", "plots", "pretrained", "fliplr", "flipud")] == [False, False, False, 0, 0]
    assert Path(told["data"]).is_relative_to(tmp_path / "out") and Path(told["save_dir"]).parent == tmp_path / "out"
    assert os.environ["YOLO_OFFLINE"] == "1" and os.environ["YOLO_AUTOINSTALL"] == "0"
    assert Path(os.environ["YOLO_CONFIG_DIR"]).is_relative_to(tmp_path / "out")
    assert "ULTRALYTICS_API_KEY" not in os.environ
    assert ultralytics.settings == {"sync": False, "wandb": False, "runs_dir": "somewhere"}
    assert path == tmp_path / "out" / "yolov8n-pose.onnx"
    assert json.loads(path.read_text()) == {"epoch": 0}  # the best, not the last
    assert contents(data) == before


def test_it_ends_by_the_clock_with_a_falling_rate(tmp_path: Path, data: Path, ultralytics: StandIn) -> None:
    train_yolo("yolov8s-pose", TrainingConfig(data, tmp_path, minutes=1.0))
    assert 60.0 - 0.5 * BATCHES * SECONDS <= ultralytics.now <= 60.0 + SECONDS
    (rates,) = ultralytics.rates
    assert rates == sorted(rates, reverse=True) and rates[-1] == pytest.approx(1 / len(rates))
    assert ultralytics.mosaics == [True] * (len(rates) - 1) + [False]


def test_less_time_than_an_epoch_needs_is_kept_to(tmp_path: Path, data: Path, ultralytics: StandIn) -> None:
    config = TrainingConfig(data, tmp_path, minutes=1.5 * SECONDS / 60.0)
    train_yolo("yolov8s-pose", config)
    assert ultralytics.now == 2 * SECONDS and ultralytics.epochs_ever == 1
    train_yolo("yolov8s-pose", config)
    assert ultralytics.now == 2 * SECONDS


@pytest.mark.parametrize("at", [(0, 2), (1, 0), (3, 1), (14, 3)])
def test_it_carries_on_from_the_last_whole_checkpoint(
    tmp_path: Path, data: Path, ultralytics: StandIn, at: tuple[int, int]
) -> None:
    config = TrainingConfig(data, tmp_path, minutes=1.0)
    ultralytics.interrupted_at = at
    with pytest.raises(KeyboardInterrupt):
        train_yolo("yolov8s-pose", config)
    assert not (tmp_path / "yolov8s-pose.onnx").is_file()
    ultralytics.interrupted_at = None
    train_yolo("yolov8s-pose", config)
    (_, begun), (name, told) = ultralytics.calls
    assert told["data"] == begun["data"] and told["save_dir"] == begun["save_dir"]
    if at[0]:
        assert told["resume"] is True and name == str(tmp_path / "yolov8s-pose" / "weights" / "last.pt")
    else:
        assert "resume" not in told and name == "yolov8s-pose.yaml"
    lost = at[1] * SECONDS
    assert 60.0 - 0.5 * BATCHES * SECONDS <= ultralytics.now - lost <= 60.0 + SECONDS
    assert ultralytics.epochs_ever == 15
    rates = ultralytics.rates[0][: at[0]] + ultralytics.rates[1]
    assert rates == sorted(rates, reverse=True) and rates[-1] == pytest.approx(1 / 15)
    assert json.loads((tmp_path / "yolov8s-pose.onnx").read_text()) == {"epoch": 0}


@pytest.mark.parametrize("written", range(13))
def test_killed_while_a_checkpoint_is_kept_it_carries_on(
    tmp_path: Path, data: Path, ultralytics: StandIn, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    """After any of the 13 files that six epochs keep: three of the first, which is the best, two of each other."""
    config = TrainingConfig(data, tmp_path, minutes=0.4)
    replace, left = Path.replace, [written]

    def replaced(path: Path, target: Path) -> Path:
        if target.parent.name == "kept":
            if not left[0]:
                raise KeyboardInterrupt
            left[0] -= 1
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", replaced)
    with pytest.raises(KeyboardInterrupt):
        train_yolo("yolov8s-pose", config)
    left[0] = 1000
    train_yolo("yolov8s-pose", config)
    assert json.loads((tmp_path / "yolov8s-pose.onnx").read_text()) == {"epoch": 0}
    assert ultralytics.epochs_ever in (5, 6)


def test_what_has_learned_learns_on_with_more_time_alone(tmp_path: Path, data: Path, ultralytics: StandIn) -> None:
    for minutes, epochs in ((0.4, 6), (0.4, 6), (0.2, 6), (1.0, 15), (None, EPOCHS), (None, EPOCHS)):
        train_yolo("yolov8s-pose", TrainingConfig(data, tmp_path, minutes=minutes))
        assert ultralytics.epochs_ever == epochs
    assert len(ultralytics.calls) == 3
    assert (tmp_path / "yolov8s-pose.onnx").is_file()


@given(done=st.integers(0, 500), each=st.floats(0.1, 1e4), minutes=st.floats(0.01, 1e4), more=st.floats(0.0, 1e3))
def test_plans_follow_from_the_time_that_epochs_take(done: int, each: float, minutes: float, more: float) -> None:
    progress = YoloProgress(done, done * each)
    plan = planned_epochs(progress, minutes)
    assert plan >= done or progress == YoloProgress()
    assert planned_epochs(progress, minutes + more) >= plan
    assert planned_epochs(progress, None) == EPOCHS
    if done:
        assert plan == done if progress.seconds >= 60.0 * minutes else abs(plan - 60.0 * minutes / each) <= 0.5 + 1e-6


def test_sizes_other_folders_and_damaged_progress_are_refused(tmp_path: Path, data: Path, ultralytics: StandIn) -> None:
    for size in (0, 100, -32):
        with pytest.raises(InvalidValueError, match="a multiple of 32"):
            train_yolo("yolov8s-pose", TrainingConfig(data, tmp_path), size)
    (tmp_path / "classes.json").write_text('["mug"]')
    with pytest.raises(DatasetError, match="choose another --out"):
        train_yolo("yolov8s-pose", TrainingConfig(data, tmp_path))
    (tmp_path / "classes.json").unlink()
    kept = tmp_path / "yolov8s-pose" / "kept"
    kept.mkdir()
    (kept / "progress.json").write_text("{}")
    (kept / "last.pt").write_text("")
    with pytest.raises(FileFormatError, match="epochs, seconds: cannot be read"):
        train_yolo("yolov8s-pose", TrainingConfig(data, tmp_path))
    assert not ultralytics.calls


def test_without_ultralytics_it_is_said_how_to_get_it(
    tmp_path: Path, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("YOLO_OFFLINE", "YOLO_AUTOINSTALL", "YOLO_CONFIG_DIR"):
        monkeypatch.setenv(name, "")
    monkeypatch.setitem(sys.modules, "ultralytics", None)
    with pytest.raises(
        StageError, match=r"not installed; .*AGPL-3.0.*environment of its own.*pip install .*ultralytics"
    ):
        train_yolo("yolov8s-pose", TrainingConfig(data, tmp_path))

    class Broken(ModuleType):
        def __getattr__(self, name: str) -> Any:
            raise RuntimeError("operator torchvision::nms does not exist")

    monkeypatch.setitem(sys.modules, "ultralytics", Broken("ultralytics"))
    with pytest.raises(StageError, match="cannot be loaded: operator torchvision::nms does not exist"):
        train_yolo("yolov8s-pose", TrainingConfig(data, tmp_path))


@pytest.mark.slow
def test_the_real_one_trains_and_its_network_finds_what_it_finds(tmp_path: Path, data: Path) -> None:
    ask = "import ultralytics, onnx, onnxruntime; ultralytics.YOLO"
    settings = {"YOLO_CONFIG_DIR": str(tmp_path / "asked"), "YOLO_OFFLINE": "1"}
    environment = {**os.environ, **settings, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    if sys.executable == PYTHON and importlib.util.find_spec("ultralytics") is None:
        pytest.skip("ultralytics is not installed ($SIMTRACK_ULTRALYTICS_PYTHON names an interpreter that has it)")
    if subprocess.run([PYTHON, "-c", ask], capture_output=True, env=environment).returncode != 0:
        pytest.skip(f"{PYTHON} has no ultralytics that can be loaded, with onnx and onnxruntime")
    before, home = contents(data), tmp_path / "home"
    home.mkdir()
    site, asked = tmp_path / "site", tmp_path / "asked.txt"
    site.mkdir()
    (site / "sitecustomize.py").write_text(WATCH)
    environment |= {"HOME": str(home), "PYTHONPATH": f"{site}{os.pathsep}{ROOT}", "ASKED": str(asked)}
    for name in settings:
        environment.pop(name)
    look_up = "import socket; socket.getaddrinfo('localhost', 80)"
    subprocess.run([PYTHON, "-c", look_up], env=environment, capture_output=True)
    assert asked.read_text()  # the watch works
    asked.unlink()

    def train(minutes: float) -> str:
        options = ["--arch", "yolov8n-pose", "--image-size", "64", "--minutes", str(minutes)]
        command = [PYTHON, "-m", "simtrack", "train", "detector", "--data", str(data), "--out", str(tmp_path / "out")]
        run = subprocess.run([*command, *options], capture_output=True, text=True, env=environment, timeout=500)
        assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-2000:]
        return run.stdout

    def progress() -> dict[str, float]:
        return json.loads((tmp_path / "out" / "yolov8n-pose" / "kept" / "progress.json").read_text())

    assert "AGPL-3.0" in train(0.001)
    assert progress()["epochs"] == 1
    assert "Resuming training" in train(progress()["seconds"] / 60.0 * 2.2)
    done = progress()
    assert done["epochs"] >= 2
    assert "Starting training" not in train(0.001)
    assert progress() == done
    code = """
import sys, numpy as np
from pathlib import Path
from simtrack.contracts import RgbdFrame, Status
from simtrack.objects import load_object
from simtrack.perception.detection.yolo_pose import YoloPoseConfig, YoloPoseDetector
from tests.training.yolo_data import CAMERA
path = Path(sys.argv[1])
detector = YoloPoseDetector(path, {"relay": load_object("relay")}, YoloPoseConfig(score=0.0))
rgb = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
frame = RgbdFrame(5, np.zeros(rgb.shape[:2], np.float32), rgb, CAMERA, np.eye(4))
found = detector.detect(frame)
assert found.status is Status.OK and found.detections[0].keypoints.shape == (9, 2)
"""
    path = tmp_path / "out" / "yolov8n-pose.onnx"
    subprocess.run([PYTHON, "-c", code, str(path)], check=True, env=environment, cwd=ROOT)
    assert contents(data) == before
    assert not [path for path in home.rglob("*") if "ltralytics" in path.name]
    assert not asked.exists(), asked.read_text()
