"""Training of the panoptic segmenter: filmed rooms go in, one ONNX file comes out."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from simtrack.perception.segmentation.learned import FILE
from simtrack.training.config import TrainingConfig, keep_classes

if TYPE_CHECKING:
    from simtrack.training.loop import Progress

SAMPLES = 150_000
"""Images that the network sees by default."""
CHECKPOINTS = "segments"


def train_segmenter(config: TrainingConfig, told: "Callable[[Progress], None] | None" = None) -> Path:
    """Train the network on one thread, or carry on, and write it as ONNX.

    Raises:
        DatasetError: the data set cannot be learned from, or `out` has a network of other classes.
    """
    import torch  # pyright: ignore[reportMissingImports] - extra `train`

    from simtrack.training.export import export_segments
    from simtrack.training.loop import Budget, train
    from simtrack.training.segment_task import SegmentTask

    torch.set_num_threads(1)
    task = SegmentTask(config.data)
    keep_classes(config, task.classes)
    budget = Budget(SAMPLES, config.minutes, config.seed)
    network = train(task, config.out / CHECKPOINTS, budget, told, validated_every=500)
    export_segments(network, task.classes, config.out / FILE)
    return config.out / FILE
