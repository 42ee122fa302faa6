"""The folder of a run: every file is on disk line by line, so that what a crash leaves is good.

``config.yaml`` resolved configuration and versions; ``trajectory.csv`` true and believed poses of base and camera;
``poses.csv`` one line an object-frame; ``<method>_<scene>-test.csv`` results in the format of the BOP challenge;
``graph.json`` the scene graph; ``metrics.json``; ``report.html``.
"""

import csv
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError, OutputExistsError
from simtrack.evaluation.metrics import Metric, write_atomically, write_metrics
from simtrack.evaluation.tracking import ObjectFrame
from simtrack.geometry.transforms import quaternion_from_rotation

OWN_FILES = ("config.yaml", "trajectory.csv", "poses.csv", "graph.json", "metrics.json", "report.html")
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
TRAJECTORY = ("stamp_ns", "status", *(f"{who}_{c}" for who in ("true", "estimated") for c in _POSE))
POSES = (
    "stamp_ns", "object", "class", "visible_fraction", "moving", "track", "status",
    *(f"true_{c}" for c in _POSE), *(f"estimated_{c}" for c in _POSE),
    "translation_error", "rotation_error", "add", "map_translation_error", "map_rotation_error",
)  # fmt: skip
BOP = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")


class RunFolder:
    """Writes one run; a context manager."""

    def __init__(self, path: Path, scene: str, overwrite: bool = False) -> None:
        """Raises `OutputExistsError` if the folder exists; with `overwrite`, the files of an older run are removed."""
        self.path = Path(path)
        self._bop_name = f"simtrack_{scene.replace('_', '')}-test.csv"
        if self.path.exists() and not self.path.is_dir():
            raise InvalidValueError("out", str(path), "a folder, but this is a file")
        if self.path.exists() and not overwrite:
            raise OutputExistsError(self.path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            for old in [*map(self.path.joinpath, OWN_FILES), *self.path.glob("simtrack_*-test.csv")]:
                old.unlink(missing_ok=True)
            self._trajectory = _Table(self.path / "trajectory.csv", TRAJECTORY)
            self._poses = _Table(self.path / "poses.csv", POSES)
            self._bop = _Table(self.path / self._bop_name, BOP)
        except OSError as error:
            raise InvalidValueError("out", str(path), f"a folder that can be written ({error.strerror})") from error

    def write_config(self, config: Mapping[str, object]) -> None:
        """Write the resolved configuration as YAML."""
        import yaml

        write_atomically(self.path / "config.yaml", yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))

    def add_pose(self, stamp: int, status: str, true: Float64, estimated: Float64) -> None:
        """Append one true and one believed T_map_base."""
        self._trajectory.write([(stamp, status, *_pose(true), *_pose(estimated))])

    def add_objects(self, frames: Sequence[ObjectFrame]) -> None:
        """Append the object-frames of one stamp; poses are T_camera_object, lengths metres, angles radians."""
        self._poses.write(_object_row(frame) for frame in frames)

    def add_bop(self, image: int, frames: Sequence[ObjectFrame], object_ids: Mapping[str, int]) -> None:
        """Append the tracked objects of one image as BOP results: millimetres, matrices row-major.

        The time is -1, which BOP reads as not measured: wall time would make files of equal runs differ.
        """
        self._bop.write(
            (1, image, object_ids[frame.class_name], f"{frame.track.score:.6f}",
             " ".join(f"{v:.8f}" for v in frame.track.T_camera_object[:3, :3].ravel()),
             " ".join(f"{1000 * v:.6f}" for v in frame.track.T_camera_object[:3, 3]), -1)
            for frame in frames
            if frame.track is not None
        )  # fmt: skip

    def write_metrics(self, metrics: Mapping[str, Metric]) -> None:
        """Replace ``metrics.json``."""
        write_metrics(self.path / "metrics.json", metrics)

    def write_graph(self, text: str) -> None:
        """Replace ``graph.json``."""
        write_atomically(self.path / "graph.json", text)

    def close(self) -> None:
        """Close the tables."""
        for table in (self._trajectory, self._poses, self._bop):
            table.close()

    def __enter__(self) -> "RunFolder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _Table:
    """A CSV file that is flushed after each block of rows."""

    def __init__(self, path: Path, header: Sequence[str]) -> None:
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self.write([header])

    def write(self, rows: Iterable[Sequence[object]]) -> None:
        self._writer.writerows(rows)
        self._file.flush()

    def close(self) -> None:
        if not self._file.closed:
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()


def _pose(T: Float64) -> list[str]:
    return [f"{v:.6f}" for v in T[:3, 3]] + [f"{v:.7f}" for v in quaternion_from_rotation(T[:3, :3])]


def _object_row(frame: ObjectFrame) -> tuple[object, ...]:
    head = (frame.stamp, frame.name, frame.class_name, f"{frame.visible_fraction:.3f}", int(frame.moving))
    if frame.track is None:
        return (*head, "", "untracked", *_pose(frame.T_camera_object), *[""] * (len(_POSE) + 5))
    errors = (
        frame.translation_error, frame.rotation_error, frame.add, frame.map_translation_error, frame.map_rotation_error
    )  # fmt: skip
    return (
        *head, frame.track.id, frame.track.status.value, *_pose(frame.T_camera_object),
        *_pose(frame.track.T_camera_object), *(f"{e:.6f}" for e in errors),
    )  # fmt: skip
