"""Training of the keypoint detector: a data set goes in, two ONNX files come out."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from simtrack.errors import DatasetError
from simtrack.training.config import TrainingConfig, keep_classes
from simtrack.training.shards import CROPS, IMAGES, Shards, prepare
from simtrack.training.source import Source, open_source

if TYPE_CHECKING:
    from simtrack.training.box_task import BoxTask
    from simtrack.training.keypoint_task import KeypointTask
    from simtrack.training.loop import Progress

Part: TypeAlias = Literal["keypoints", "boxes"]
PARTS: tuple[Part, ...] = ("keypoints", "boxes")
SAMPLES: dict[Part, int] = {"keypoints": 1_800_000, "boxes": 200_000}
"""Windows and images that the networks see by default."""
SHARDS = "shards"


def prepared(config: TrainingConfig, told: Callable[[int, int], None] | None = None) -> Source:
    """Make the data set ready for both networks.

    Raises:
        DatasetError, FileFormatError: it is none that can be learned from, or `out` is another detector's.
    """
    source = open_source(config.data)
    keep_classes(config, source.class_names)
    prepare(source, config.out / SHARDS, told)
    return source


def train_part(part: Part, config: TrainingConfig, told: "Callable[[Progress], None] | None" = None) -> Path:
    """Train one network on one thread, or carry on, and write it as ONNX; the data set is `prepared` before.

    Raises:
        DatasetError: a class has no sample.
    """
    import torch  # pyright: ignore[reportMissingImports] - extra `train`

    from simtrack.training.export import export_boxes, export_keypoints
    from simtrack.training.keypoint_task import KeypointTask
    from simtrack.training.loop import Budget, train

    torch.set_num_threads(1)
    task = make_task(part, open_source(config.data), config.out / SHARDS)
    network = train(task, config.out / part, Budget(SAMPLES[part], config.minutes, config.seed), told)
    path = config.out / f"{part}.onnx"
    if isinstance(task, KeypointTask):
        export_keypoints(network, task.models, task.sigma_scale(network), path)
    else:
        export_boxes(network, task.models, path)
    return path


def make_task(part: Part, source: Source, shards: Path) -> "BoxTask | KeypointTask":
    """The task of one network."""
    from simtrack.training.box_task import BoxTask
    from simtrack.training.keypoint_task import KeypointTask

    kind, dtype = ("crops", CROPS) if part == "keypoints" else ("images", IMAGES)
    samples, held_out = (Shards(shards, kind, dtype, held_out=share) for share in (False, True))
    task = (KeypointTask if part == "keypoints" else BoxTask)(source.models, samples, held_out)
    if task.missing:
        reason = f"no image shows {', '.join(task.missing)} well enough to be learned; generate more, or leave them out"
        raise DatasetError(source.root, reason)
    return task
