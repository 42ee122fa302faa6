"""``simtrack train``: let networks of detector and segmenter learn from a data set, or an agent from what it does."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from simtrack.training.config import TrainingConfig
    from simtrack.training.detector import Part
    from simtrack.training.loop import Progress
    from simtrack.training.yolo import YoloArch


def train(
    what: Annotated[Literal["detector", "segmenter", "agent"], tyro.conf.Positional],
    out: Path,
    data: Path | None = None,
    minutes: float | None = None,
    seed: int = 0,
    part: Literal["both", "boxes", "keypoints"] = "both",
    arch: Literal["two-stage", "yolov8-pose", "yolov8n-pose", "yolov8s-pose"] = "two-stage",
    image_size: int | None = None,
) -> int:
    """Let networks or an agent learn. The same command carries on where it was stopped.

    The detector's networks learn from a generated data set: boxes.onnx and keypoints.onnx, which `simtrack run
    --detector DIR` takes (extra train). `--arch yolov8-pose` has ultralytics train the tracking paper's YOLOv8s, where
    you have installed it: it is licensed under AGPL-3.0, which its makers claim for the weights it trains, too. The
    segmenter's is segments.onnx, which `simtrack map --segmenter DIR` takes (extra train). An agent learns by PPO
    where to look in ActivePerception, from what is believed: `simtrack env ActivePerception --policy DIR` lets it play
    (extra rl).

    Args:
        what: What learns: detector, segmenter or agent.
        out: Folder for checkpoints, logs and networks.
        data: For networks: folder of a data set that `simtrack generate` made, of a recipe with the format bop among
            its writers for the detector (yolo for YOLOv8), rooms_panoptic for the segmenter.
        minutes: Of computing time for each network (of the wall clock for YOLOv8), over all calls; if not given, until
            it has learned (a network) or 30 (an agent).
        seed: Of everything random.
        part: Of the two-stage detector: both networks at once, a process each, or one of them.
        arch: Of the detector: two-stage is simtrack's own, boxes and keypoints in windows about them; yolov8n-pose and
            yolov8s-pose (yolov8-pose for short) are ultralytics', one network, written to OUT/ARCH.onnx.
        image_size: Pixels of the longer side of what YOLOv8 sees, a multiple of 32; if not given, 640.
    """
    import importlib.util

    from simtrack.cli import console
    from simtrack.errors import InvalidValueError, MissingValueError, StageError

    if arch != "two-stage" and what != "detector":
        raise InvalidValueError("--arch", arch, "two-stage: others are detectors")
    if arch != "two-stage" and part != "both":
        raise InvalidValueError("--part", part, f"both: {arch} is one network")
    if arch == "two-stage" and image_size is not None:
        raise InvalidValueError("--image-size", image_size, "none: it is for --arch yolov8-pose alone")
    if what == "agent":
        return _train_agent(out, 30.0 if minutes is None else minutes, seed)
    if data is None:
        raise MissingValueError("--data", "the folder of a data set, which `simtrack generate` makes")
    from simtrack.training.config import TrainingConfig
    from simtrack.training.detector import PARTS, prepared

    missing = [name for name in ("torch", "onnx") if importlib.util.find_spec(name) is None]
    if missing:
        raise StageError(what, str(data), f"{', '.join(missing)} not installed; pip install 'simtrack[train]'")
    if what == "segmenter":
        return _segmenter(data, out, minutes, seed)
    if arch != "two-stage":
        return _yolo("yolov8n-pose" if arch == "yolov8n-pose" else "yolov8s-pose", data, out, minutes, seed, image_size)
    config = TrainingConfig(data, out, minutes, seed)
    with console.ProgressLine(f"train {what}", "reading the data set") as line:
        prepared(config, lambda done, of: line.show(f"{done}/{of} scenes made ready", done / of))
    parts = PARTS if part == "both" else (part,)
    try:
        if len(parts) == 1:
            _train(parts[0], config)
        else:
            _together(parts, config)
    except KeyboardInterrupt:
        console.show_error("stopped: the same command carries on from the last checkpoint")
        return 130
    console.show_written(out, [f"{name}.onnx" for name in parts])
    return 0


def _train_agent(out: Path, minutes: float, seed: int) -> int:
    """Show each episode, and draw the curve of what was learned."""
    from simtrack.cli import console
    from simtrack.envs.learning import GazeTraining, LearnedEpisode
    from simtrack.errors import InvalidValueError
    from simtrack.report.learning import draw_learning

    if not minutes > 0.0:
        raise InvalidValueError("minutes", minutes, "a time above 0")
    training = GazeTraining(out, seed)

    def show(episode: LearnedEpisode) -> None:
        print(
            f"{episode.minutes:5.1f} min  {episode.steps} steps  episode {len(training.episodes)}: "
            f"return {episode.total:.2f}, known {episode.known_share:.3f}",
            flush=True,
        )

    try:
        training.run(minutes, show)
    except KeyboardInterrupt:
        console.show_error("stopped: the same command carries on from the last checkpoint")
        return 130
    draw_learning([(e.minutes, e.total, e.known_share) for e in training.episodes], out / "learning.png")
    console.show_written(out, ["gaze.npz", "learning.png"])
    return 0


def _segmenter(data: Path, out: Path, minutes: float | None, seed: int) -> int:
    from simtrack.cli import console
    from simtrack.training.config import TrainingConfig
    from simtrack.training.segmenter import train_segmenter

    try:
        path = train_segmenter(TrainingConfig(data, out, minutes, seed), _shown("segments"))
    except KeyboardInterrupt:
        console.show_error("stopped: the same command carries on from the last checkpoint")
        return 130
    console.show_written(out, [path.name])
    return 0


def _yolo(arch: "YoloArch", data: Path, out: Path, minutes: float | None, seed: int, image_size: int | None) -> int:
    """Tell of the licence, and let ultralytics show its own progress."""
    from simtrack.cli import console
    from simtrack.training.config import TrainingConfig
    from simtrack.training.yolo import LICENCE, train_yolo

    console.show_choice("network", arch, LICENCE)
    try:
        path = train_yolo(arch, TrainingConfig(data, out, minutes, seed), 640 if image_size is None else image_size)
    except KeyboardInterrupt:
        console.show_error("stopped: the same command carries on from the last epoch")
        return 130
    console.show_written(out, [path.name])
    return 0


def _together(parts: "tuple[Part, ...]", config: "TrainingConfig") -> None:
    """A process each; raises what one of them raised."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    with ProcessPoolExecutor(len(parts), multiprocessing.get_context("spawn")) as pool:
        for future in [pool.submit(_train, part, config) for part in parts]:
            future.result()


def _train(part: "Part", config: "TrainingConfig") -> None:
    from simtrack.training.detector import train_part

    train_part(part, config, _shown(part))


def _shown(part: str) -> "Callable[[Progress], None]":
    """Prints how a training fares, now and then and when it was measured."""
    last: dict[str, float] = {}

    def show(progress: "Progress") -> None:
        if progress.figures != last or progress.step % 500 == 0:
            figures = ", ".join(f"{name} {value:.3g}" for name, value in progress.figures.items())
            text = f"{part}: {100 * progress.spent:5.1f} %  {progress.samples} samples  loss {progress.loss:.3f}"
            print(f"{text}  held out: {figures or 'not measured yet'}", flush=True)
            last.clear()
            last.update(progress.figures)

    return show
