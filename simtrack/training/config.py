"""What a training is told, and the classes that its folder belongs to."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from simtrack.errors import DatasetError, InvalidValueError

CLASSES = "classes.json"


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """What a training is to do."""

    data: Path
    """A data set that `simtrack generate` made."""
    out: Path
    """Checkpoints, logs and networks."""
    minutes: float | None = None
    """Of computing time for each network, over all calls; None: until the default number of samples."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InvalidValueError("seed", self.seed, "0 or more")
        if self.minutes is not None and not self.minutes > 0.0:
            raise InvalidValueError("minutes", self.minutes, "> 0")


def keep_classes(config: TrainingConfig, names: Sequence[str]) -> None:
    """Write the classes' names into the folder of results; raises DatasetError if it is another training's."""
    config.out.mkdir(parents=True, exist_ok=True)
    path, given = config.out / CLASSES, list(names)
    if path.is_file() and (before := json.loads(path.read_text(encoding="utf-8"))) != given:
        raise DatasetError(config.data, f"its classes are {given}, but {path} says {before}; choose another --out")
    path.write_text(json.dumps(given) + "\n", encoding="utf-8")
