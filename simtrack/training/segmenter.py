"""Training of the panoptic segmenter: filmed rooms go in, one ONNX file comes out."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from simtrack.errors import DatasetError, InvalidValueError
from simtrack.perception.segmentation.learned import FILE

if TYPE_CHECKING:
    from simtrack.training.loop import Progress

SAMPLES = 150_000
"""Images that the network sees by default."""
CLASSES, CHECKPOINTS = "classes.json", "segments"


@dataclass(frozen=True, slots=True)
class SegmenterTraining:
    """What `train_segmenter` is to do."""

    data: Path
    """A folder that `simtrack generate rooms_panoptic` made."""
    out: Path
    """Checkpoints, log and network."""
    minutes: float | None = None
    """Of computing time over all calls; None: until the default number of samples."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InvalidValueError("seed", self.seed, "0 or more")
        if self.minutes is not None and not self.minutes > 0.0:
            raise InvalidValueError("minutes", self.minutes, "> 0")


def train_segmenter(config: SegmenterTraining, told: "Callable[[Progress], None] | None" = None) -> Path:
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
    config.out.mkdir(parents=True, exist_ok=True)
    path, names = config.out / CLASSES, list(task.classes)
    if path.is_file() and (before := json.loads(path.read_text(encoding="utf-8"))) != names:
        raise DatasetError(config.data, f"its classes are {names}, but {path} says {before}; choose another --out")
    path.write_text(json.dumps(names) + "\n", encoding="utf-8")
    budget = Budget(SAMPLES, config.minutes, config.seed)
    network = train(task, config.out / CHECKPOINTS, budget, told, validated_every=500)
    export_segments(network, task.classes, config.out / FILE)
    return config.out / FILE
