"""The tracking paper's detector, YOLOv8 with a pose head, trained by ultralytics where the user has installed it.

Nothing of ultralytics is part of simtrack or among its dependencies: it is licensed under AGPL-3.0 and installs
opencv-python, which replaces parts of opencv-python-headless. It is told to stay offline, and to write into the
training's folder alone.
"""

import importlib
import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from simtrack.errors import FileFormatError, InvalidValueError, StageError
from simtrack.perception.detection.yolo_pose import YoloPoseDetector
from simtrack.training.config import TrainingConfig, keep_classes
from simtrack.training.yolo_data import YoloData, prepare_yolo

YoloArch: TypeAlias = Literal["yolov8n-pose", "yolov8s-pose"]
LICENCE = (
    "trained by ultralytics, which is licensed under AGPL-3.0; its makers claim that licence for the weights it "
    "trains, too: whoever gives such weights on, or offers a service with them, has to meet it or buy another"
)
INSTALL = (
    "install it yourself if you accept its licence (AGPL-3.0), in an environment of its own, since it brings "
    "opencv-python, which replaces parts of opencv-python-headless: pip install 'simtrack[train]' ultralytics"
)
EPOCHS = 100
"""Without a limit in minutes."""
STRIDE = 32
"""The image size is a multiple of this."""
WARM_IMAGES = 16_000
"""In which the learning rate rises, at most; ultralytics' own limit is three epochs."""
PLAIN = 10
"""One in so many epochs, the last ones, shows images as they are, not four in one: ultralytics' own share."""
KEPT, PROGRESS = "kept", "progress.json"
UPLOADS = ("sync", "hub", "clearml", "comet", "dvc", "mlflow", "neptune", "raytune", "tensorboard", "wandb")
"""Settings of ultralytics that report to others or load their packages."""


@dataclass(frozen=True, slots=True)
class YoloProgress:
    """How far a training has come, as of its last checkpoint."""

    epochs: int = 0
    """That are complete, or were ended by the clock."""
    seconds: float = 0.0
    """Of the wall clock, over all calls."""


def planned_epochs(progress: YoloProgress, minutes: float | None) -> int:
    """How many epochs a training is to have in all, by the time that those so far have taken."""
    if minutes is None:
        return EPOCHS
    if progress.epochs == 0:
        return EPOCHS if progress.seconds < 60.0 * minutes else 0
    remaining = max(60.0 * minutes - progress.seconds, 0.0)
    return progress.epochs + round(remaining * progress.epochs / max(progress.seconds, 1e-3))


def train_yolo(arch: YoloArch, config: TrainingConfig, image_size: int = 640) -> Path:
    """Train YOLOv8-pose, or carry on from the last epoch's checkpoint, and write it as ONNX.

    The schedule is ultralytics' own for `EPOCHS` epochs or, with a limit in minutes (of the wall clock, since the
    network may learn on a GPU), for as many as fit into it. Images are not mirrored: a mirrored object is another one.

    Args:
        arch: which size.
        config: what is to be done.
        image_size: pixels of the longer side of what the network sees, a multiple of 32.

    Raises:
        StageError: ultralytics is not installed, or cannot be loaded.
        DatasetError, FileFormatError: the data set cannot be learned from (see `prepare_yolo`), `out` is another
            detector's, or what was exported cannot be used.
        InvalidValueError: the image size is none.
    """
    if image_size < STRIDE or image_size % STRIDE:
        raise InvalidValueError("image_size", image_size, f"a multiple of {STRIDE}")
    folder = (config.out / arch).resolve()
    ultralytics = _ultralytics(arch, folder / "settings")
    data = prepare_yolo(config.data, folder / "data")
    keep_classes(config, data.classes)
    progress = _read(folder / KEPT)
    if progress.epochs < planned_epochs(progress, config.minutes):
        _learn(ultralytics, arch, config, image_size, data, folder, progress)
    best = ultralytics.YOLO(str(folder / KEPT / "best.pt"))
    logging.getLogger("ultralytics").setLevel(logging.WARNING)  # it would name a file that is moved
    exported = Path(best.export(format="onnx", imgsz=image_size, simplify=False, device="cpu"))
    path = config.out / f"{arch}.onnx"
    exported.replace(path)
    YoloPoseDetector(path, {})  # refuses what `simtrack run` would refuse
    return path


def _ultralytics(arch: str, settings: Path) -> Any:
    """The package, offline and with settings of its own. It reads these variables when it is first imported."""
    os.environ.update(YOLO_OFFLINE="1", YOLO_AUTOINSTALL="0", YOLO_CONFIG_DIR=str(settings))
    os.environ.pop("ULTRALYTICS_API_KEY", None)
    try:
        package = importlib.import_module("ultralytics")
        package.YOLO  # noqa: B018 - is loaded at its first mention
    except ModuleNotFoundError as error:
        if error.name != "ultralytics":
            raise StageError("arch", arch, f"ultralytics lacks {error.name}; {INSTALL}") from error
        raise StageError("arch", arch, f"ultralytics is not installed; {INSTALL}") from error
    except Exception as error:  # of whatever it loads: torch and torchvision that do not fit, OpenCV without a display
        raise StageError("arch", arch, f"ultralytics cannot be loaded: {error}; {INSTALL}") from error
    _give_fonts(settings / "Ultralytics")
    package.settings.update({name: False for name in UPLOADS if name in package.settings})
    return package


def _give_fonts(folder: Path) -> None:
    """It would fetch fonts for pictures that it does not draw."""
    import matplotlib

    folder.mkdir(parents=True, exist_ok=True)
    font = Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")
    for name in ("Arial.ttf", "Arial.Unicode.ttf"):
        if not (folder / name).is_file():
            shutil.copyfile(font, folder / name)


def _learn(
    ultralytics: Any, arch: YoloArch, config: TrainingConfig, image_size: int, data: YoloData, folder: Path,
    progress: YoloProgress,
) -> None:  # fmt: skip
    kept, weights = folder / KEPT, folder / "weights"
    common = {"data": str(data.path), "imgsz": image_size, "patience": 0, "plots": False, "save_dir": str(folder)}
    if progress.epochs:
        for name in ("best.pt", "last.pt"):  # those of ultralytics may be cut short, or stripped of what is needed
            _copy(kept / name, weights / name)
        network, arguments = ultralytics.YOLO(str(weights / "last.pt")), {"resume": True}
    else:
        network, arguments = ultralytics.YOLO(f"{arch}.yaml"), _arguments(config.seed, data.images["train"])
    for event, callback in _Schedule(kept, progress, config.minutes).callbacks().items():
        network.add_callback(event, callback)
    network.train(**common, **arguments)


def _arguments(seed: int, images: int) -> dict[str, Any]:
    """Of a new training."""
    return {
        "epochs": EPOCHS, "warmup_epochs": min(3.0, WARM_IMAGES / images), "seed": seed, "exist_ok": True,
        "pretrained": False, "amp": False, "fliplr": 0.0, "flipud": 0.0, "degrees": 0.0,
    }  # fmt: skip


class _Schedule:
    """Plans the epochs, ends a training by the clock, and keeps checkpoints that are whole."""

    def __init__(self, kept: Path, before: YoloProgress, minutes: float | None) -> None:
        self._kept, self._before, self._minutes = kept, before, minutes
        self._began = time.monotonic()

    def callbacks(self) -> Mapping[str, Callable[[Any], None]]:
        """By ultralytics' names of events."""
        return {
            "on_pretrain_routine_start": self._plan,
            "on_train_batch_end": self._watch,
            "on_train_epoch_end": self._plan,
            "on_model_save": self._keep,
        }

    def _seconds(self) -> float:
        return self._before.seconds + time.monotonic() - self._began

    def _plan(self, trainer: Any) -> None:
        """The learning rate falls linearly over `trainer.epochs`, which ultralytics reads anew each epoch."""
        epoch = getattr(trainer, "epoch", None)
        now = self._before if epoch is None else YoloProgress(epoch + 1, self._seconds())
        trainer.epochs = trainer.args.epochs = max(planned_epochs(now, self._minutes), now.epochs)
        trainer.args.close_mosaic = max(1, trainer.epochs // PLAIN)

    def _watch(self, trainer: Any) -> None:
        if self._minutes is not None and self._seconds() > 60.0 * self._minutes:
            trainer.stop = True

    def _keep(self, trainer: Any) -> None:
        """Copy checkpoints: ultralytics writes them in place, and strips them when it has ended."""
        if trainer.fitness == trainer.best_fitness:
            _copy(Path(trainer.best), self._kept / "best.pt")
        # Not after last.pt: of a training that has ended there would be nothing to resume, though it seemed so.
        self._kept.mkdir(exist_ok=True)
        part = self._kept / f"{PROGRESS}.part"
        part.write_text(json.dumps(asdict(YoloProgress(trainer.epoch + 1, self._seconds()))) + "\n", encoding="utf-8")
        part.replace(self._kept / PROGRESS)
        _copy(Path(trainer.last), self._kept / "last.pt")


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.part")
    shutil.copyfile(source, part)
    part.replace(target)


def _read(kept: Path) -> YoloProgress:
    """Of the checkpoint that is kept, if there is one."""
    path = kept / PROGRESS
    if not (kept / "last.pt").is_file():
        return YoloProgress()
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return YoloProgress(int(content["epochs"]), float(content["seconds"]))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(path, "epochs, seconds", f"cannot be read: {error}; choose another --out") from error
