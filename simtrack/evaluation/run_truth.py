"""The truth that the folder of a run holds: ``trajectory.csv``, ``poses.csv`` and the classes in ``config.yaml``."""

import csv
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import FileFormatError
from simtrack.geometry.transforms import rotation_from_quaternion, transform

MAX_ROWS = 20_000_000


@dataclass(frozen=True, slots=True)
class TrueObject:
    """A catalogue object at one camera stamp."""

    name: str
    class_name: str
    visible_fraction: float
    moving: bool
    T_camera_object: Float64
    """(4, 4)."""


@dataclass(frozen=True, slots=True)
class RunTruth:
    """What was true at each camera stamp of a run."""

    stamps: Sequence[int]
    """Nanoseconds; their places in the list number the images."""
    T_map_base: Sequence[Float64]
    """(4, 4), by image."""
    objects: Mapping[int, Sequence[TrueObject]]
    """Stamp -> catalogue objects."""
    object_ids: Mapping[str, int]
    """Class name -> BOP's object id."""

    @property
    def scored_classes(self) -> set[str]:
        """Classes of the catalogue objects."""
        return {thing.class_name for things in self.objects.values() for thing in things}


def read_truth(run: Path) -> RunTruth:
    """Read a run's folder.

    Raises:
        FileFormatError: a file is missing, broken, or not what `simtrack run` writes.
    """
    stamps, poses = [], []
    for line, row in _rows(run / "trajectory.csv"):
        try:
            stamps.append(int(row["stamp_ns"]))
            poses.append(_true_pose(row))
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(run / "trajectory.csv", f"line {line}", f"is no line of a run: {error}") from error
    if not stamps:
        raise FileFormatError(run / "trajectory.csv", "", "holds no image")
    objects: defaultdict[int, list[TrueObject]] = defaultdict(list)
    for line, row in _rows(run / "poses.csv"):
        try:
            thing = TrueObject(
                row["object"], row["class"], float(row["visible_fraction"]), bool(int(row["moving"])), _true_pose(row)
            )
            objects[int(row["stamp_ns"])].append(thing)
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(run / "poses.csv", f"line {line}", f"is no line of a run: {error}") from error
    return RunTruth(stamps, poses, {stamp: objects[stamp] for stamp in stamps}, _object_ids(run / "config.yaml"))


def object_ids(classes: Iterable[str]) -> dict[str, int]:
    """Class name -> BOP's object id: alphabetical order, from 1."""
    return {name: number for number, name in enumerate(sorted(set(classes)), start=1)}


def _object_ids(path: Path) -> dict[str, int]:
    import yaml

    try:
        config = yaml.safe_load(path.read_text(encoding="utf-8"))
        return object_ids([str(thing["model"]) for thing in config["scene_file"]["objects"]])
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError) as error:
        raise FileFormatError(path, "scene_file.objects", f"is no configuration of a run: {error}") from error


def _rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for line, row in enumerate(csv.DictReader(file), start=2):
                if line > MAX_ROWS:
                    raise FileFormatError(path, "", f"holds more than {MAX_ROWS} lines")
                yield line, row
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(path, "", f"no table of a run of `simtrack run`: {error}") from error


def _true_pose(row: Mapping[str, str]) -> Float64:
    values = np.array([float(row[f"true_{name}"]) for name in ("x", "y", "z", "qw", "qx", "qy", "qz")])
    if not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1.0) > 1e-3:
        raise ValueError("the true pose is none")
    return transform(rotation_from_quaternion(values[3:]), values[:3])
