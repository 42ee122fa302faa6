"""Reads results of others: poses of objects in BOP's format, trajectories in TUM's. Rows that are none are told."""

import csv
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64
from simtrack.errors import FileFormatError
from simtrack.evaluation.run_folder import BOP as BOP_HEADER
from simtrack.geometry.transforms import orthonormal, rotation_from_quaternion, transform

MAX_BYTES = 2_000_000_000
LAST_STAMP = 1e20
"""Seconds; nanoseconds since 1970 that are taken for seconds are below."""
ORTHONORMAL = 1e-3
"""Largest deviation from an orthonormal matrix that is taken for rounding."""

__all__ = ["BOP_HEADER", "LeftOut", "PoseRow", "StampedPose", "read_bop", "read_tum"]


class LeftOut:
    """Rows that cannot be used: the numbers of their lines, by what is wrong with them."""

    def __init__(self) -> None:
        self.lines: defaultdict[str, list[int]] = defaultdict(list)

    def add(self, reason: str, line: int) -> None:
        """Leave a row out; `reason` in words that other rows share."""
        self.lines[reason].append(line)

    @property
    def count(self) -> int:
        """How many rows were left out."""
        return sum(map(len, self.lines.values()))

    def findings(self, name: str = "row") -> list[str]:
        """A sentence for each reason, with the numbers of the first lines."""
        return [
            f"{len(lines)} {name}{'' if len(lines) == 1 else 's'} left out: {reason} (line {_few(lines)})"
            for reason, lines in sorted(self.lines.items())
        ]


@dataclass(frozen=True, slots=True)
class PoseRow:
    """A row of BOP's results."""

    line: int
    """Where it stands in the file, from 1."""
    scene: int
    image: int
    object_id: int
    score: float
    T_camera_object: Float64
    """(4, 4), translation in the file's unit."""


@dataclass(frozen=True, slots=True)
class StampedPose:
    """A row of a TUM trajectory."""

    line: int
    """Where it stands in the file, from 1."""
    stamp: int
    """Nanoseconds."""
    T_map_base: Float64
    """(4, 4), translation in the file's unit."""
    quaternion: Float64
    """(4,), as it stands in the file."""


def read_bop(path: Path) -> tuple[list[PoseRow], LeftOut]:
    """Rows of ``scene_id,im_id,obj_id,score,R,t,time``, and those that cannot be read.

    Raises:
        FileFormatError: no such table.
    """
    _bounded(path)
    rows, bad = [], LeftOut()
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            missing = [name for name in BOP_HEADER[:6] if name not in (reader.fieldnames or ())]
            if missing:
                raise FileFormatError(
                    path, "line 1", f"no column {', '.join(missing)}; expected {','.join(BOP_HEADER)}"
                )
            for row in reader:
                try:
                    rows.append(_pose_row(row, reader.line_num))
                except _BadRowError as error:
                    bad.add(str(error), reader.line_num)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(path, "", f"cannot be read: {error}") from error
    return rows, bad


def read_tum(path: Path) -> tuple[list[StampedPose], LeftOut]:
    """Rows of ``stamp tx ty tz qx qy qz qw`` (seconds, metres; ``#`` begins a comment), and those that cannot be read.

    Raises:
        FileFormatError: the file cannot be read.
    """
    _bounded(path)
    rows, bad = [], LeftOut()
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, start=1):
                text = line.partition("#")[0].split()
                if not text:
                    continue
                try:
                    rows.append(_stamped_pose(text, number))
                except _BadRowError as error:
                    bad.add(str(error), number)
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(path, "", f"cannot be read: {error}") from error
    return rows, bad


class _BadRowError(ValueError):
    """A row that cannot be used; says why in words that other rows share."""


def _pose_row(row: Mapping[str, str | None], line: int) -> PoseRow:
    try:
        scene, image, number = (int(row[name] or "") for name in BOP_HEADER[:3])
    except ValueError as error:
        raise _BadRowError("scene_id, im_id or obj_id is no integer") from error
    score = _numbers("score", (row["score"] or "").split(), 1)[0]
    R = _numbers("R", (row["R"] or "").split(), 9).reshape(3, 3)
    t = _numbers("t", (row["t"] or "").split(), 3)
    if np.abs(R @ R.T - np.eye(3)).max() > ORTHONORMAL or np.linalg.det(R) < 0.0:
        raise _BadRowError("R is no rotation")
    return PoseRow(line, scene, image, number, float(score), transform(orthonormal(R), t))


def _stamped_pose(text: Sequence[str], line: int) -> StampedPose:
    values = _numbers("the line", text, 8)
    norm = float(np.linalg.norm(values[4:]))
    if abs(norm - 1.0) > 0.01:
        raise _BadRowError("the quaternion is not of length 1")
    xyzw = values[4:] / norm
    if abs(values[0]) > LAST_STAMP:
        raise _BadRowError("the stamp is no time")
    # As a float, seconds since 1970 are good to a quarter of a microsecond.
    stamp = round(values[0] * NANOSECONDS)
    return StampedPose(line, stamp, transform(rotation_from_quaternion(xyzw[[3, 0, 1, 2]]), values[1:4]), xyzw)


def _numbers(name: str, text: Sequence[str], count: int) -> Float64:
    try:
        values = np.array([float(word) for word in text])
    except ValueError as error:
        raise _BadRowError(f"{name} holds something else than numbers") from error
    if len(values) != count:
        raise _BadRowError(f"{name} does not have {count} numbers")
    if not np.isfinite(values).all():
        raise _BadRowError(f"{name} is not finite")
    return values


def _bounded(path: Path) -> None:
    if path.is_file() and path.stat().st_size > MAX_BYTES:
        raise FileFormatError(path, "", f"is larger than {MAX_BYTES} bytes")


def _few(numbers: Sequence[int]) -> str:
    """The first few of some numbers."""
    return ", ".join(map(str, numbers[:5])) + (", ..." if len(numbers) > 5 else "")
