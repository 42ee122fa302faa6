"""``simtrack train``: let the networks of detector and segmenter learn from a generated data set."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from simtrack.training.detector import Part, TrainingConfig
    from simtrack.training.loop import Progress


def train(
    what: Annotated[Literal["detector", "segmenter"], tyro.conf.Positional],
    data: Path,
    out: Path,
    minutes: float | None = None,
    seed: int = 0,
    part: Literal["both", "boxes", "keypoints"] = "both",
) -> int:
    """Let networks learn from a generated data set. The same command carries on where it was stopped.

    The detector's are boxes.onnx and keypoints.onnx, which `simtrack run --detector DIR` takes; the segmenter's is
    segments.onnx, which `simtrack map --segmenter DIR` takes. Needs the extra train.

    Args:
        what: What learns.
        data: Folder of a data set that `simtrack generate` made: of a recipe with the format bop among its writers for
            the detector, rooms_panoptic for the segmenter.
        out: Folder for checkpoints, logs and networks.
        minutes: Of computing time for each network, over all calls; until it has learned if not given.
        seed: Of everything random.
        part: Of the detector: both networks at once, a process each, or one of them.
    """
    import importlib.util

    from simtrack.cli import console
    from simtrack.errors import StageError
    from simtrack.training.detector import PARTS, TrainingConfig, prepared

    missing = [name for name in ("torch", "onnx") if importlib.util.find_spec(name) is None]
    if missing:
        raise StageError(what, str(data), f"{', '.join(missing)} not installed; pip install 'simtrack[train]'")
    if what == "segmenter":
        return _segmenter(data, out, minutes, seed)
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


def _segmenter(data: Path, out: Path, minutes: float | None, seed: int) -> int:
    from simtrack.cli import console
    from simtrack.training.segmenter import SegmenterTraining, train_segmenter

    try:
        path = train_segmenter(SegmenterTraining(data, out, minutes, seed), _shown("segments"))
    except KeyboardInterrupt:
        console.show_error("stopped: the same command carries on from the last checkpoint")
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
