"""The folder of a run: every file is on disk line by line, so that what a crash leaves is good.

``config.yaml`` resolved configuration and versions; ``estimates.csv`` and ``tracks.csv`` what the stack believed of the
robot and of every object; ``trajectory.csv`` true and believed pose of the base; ``poses.csv`` one line an
object-frame; ``simtrack_<scene>-test.csv`` results in the format of the BOP challenge; ``graph.json`` the scene
graph; ``map.npz`` the surveyed map, as the stack has it; ``moments/`` the worst frames, for `simtrack debug`;
``metrics.json``; ``report.html``. Of a scene in which something happens unseen: ``changes.csv``, what could be noticed
of it, and when it was. Of a run with stages that are not simtrack's: ``faults.csv``, the frames that they
missed. Of a recording without a robot: ``frames.csv`` how its frames compare with ``map.ply``, the map that they make.
"""

import csv
import os
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from simtrack.contracts import Belief, Float64, StaticMap
from simtrack.errors import InvalidValueError, OutputExistsError
from simtrack.evaluation.changes import ObjectChange
from simtrack.evaluation.metrics import Metric, write_atomically, write_metrics
from simtrack.evaluation.run_truth import object_ids
from simtrack.evaluation.tracking import ObjectFrame
from simtrack.geometry.transforms import quaternion_from_rotation

OWN_FILES = (
    "config.yaml", "estimates.csv", "tracks.csv", "trajectory.csv", "poses.csv", "graph.json", "metrics.json",
    "report.html", "frames.csv", "map.ply", "map.npz", "faults.csv", "changes.csv",
)  # fmt: skip
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
TRAJECTORY = ("stamp_ns", "status", *(f"{who}_{c}" for who in ("true", "estimated") for c in _POSE))
POSES = (
    "stamp_ns", "object", "class", "visible_fraction", "moving", "track", "status",
    *(f"true_{c}" for c in _POSE), *(f"estimated_{c}" for c in _POSE),
    "translation_error", "rotation_error", "add", "map_translation_error", "map_rotation_error",
)  # fmt: skip
ESTIMATES = ("stamp_ns", "status", *_POSE)
TRACKS = ("stamp_ns", "track", "class", "status", *_POSE, "visible_fraction", "moving", "score")
FRAMES = (
    "stamp_ns", "status", "readings", "covered", "explained", "residual_median", "residual_p95", "difference_median",
    "unknown", "regions", "translation_error", "rotation_error", "map_faces",
)  # fmt: skip
CHANGES = (
    "class", "kind", *(f"{when}_{c}" for when in ("before", "after") for c in "xyz"), "noticeable_ns", "noticed_ns",
)  # fmt: skip
BOP = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
SCENE_ID = 1
"""BOP's number of the one scene of a run."""


class RunFolder:
    """The folder of one run or replay, and the files in it that are written as a whole."""

    def __init__(self, path: Path, overwrite: bool = False) -> None:
        """Make the folder; with `overwrite`, the files of an older run in it are removed, and nothing else.

        Raises:
            OutputExistsError: the folder exists and may not be overwritten.
            InvalidValueError: it cannot be written.
        """
        self.path = Path(path)
        if self.path.exists() and not self.path.is_dir():
            raise InvalidValueError("out", str(path), "a folder, but this is a file")
        if self.path.exists() and not overwrite:
            raise OutputExistsError(self.path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            for old in [*map(self.path.joinpath, OWN_FILES), *self.path.glob("simtrack_*-test.csv")]:
                old.unlink(missing_ok=True)
            (self.path / OWN_FILES[0]).touch()
        except OSError as error:
            raise InvalidValueError("out", str(path), f"a folder that can be written ({error.strerror})") from error

    def write_config(self, config: Mapping[str, object]) -> None:
        """Write the resolved configuration as YAML."""
        import yaml

        write_atomically(self.path / "config.yaml", yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))

    def write_metrics(self, metrics: Mapping[str, Metric]) -> None:
        """Replace ``metrics.json``."""
        write_metrics(self.path / "metrics.json", metrics)

    def write_graph(self, text: str) -> None:
        """Replace ``graph.json``."""
        write_atomically(self.path / "graph.json", text)

    def write_changes(self, noticed: Mapping[ObjectChange, tuple[int, int | None]]) -> None:
        """Write ``changes.csv``; ``noticed_ns`` is empty where the belief has not followed in the end."""
        nowhere = ("", "", "")
        rows = [CHANGES] + [
            (
                change.class_name,
                change.kind,
                *(change.before or nowhere),
                *(change.after or nowhere),
                since,
                "" if when is None else when,
            )
            for change, (since, when) in sorted(noticed.items(), key=lambda item: item[1][0])
        ]
        text = StringIO(newline="")
        csv.writer(text, lineterminator="\n").writerows(rows)
        write_atomically(self.path / "changes.csv", text.getvalue())

    def write_map(self, static_map: StaticMap) -> None:
        """Write ``map.npz``: the mesh of the surveyed map and which of its entities each face belongs to."""
        from simtrack.perception.mapping.static_entities import face_owners

        names = np.array([entity.name for entity in static_map.entities], dtype=np.str_)
        arrays = {"vertices": static_map.vertices, "faces": static_map.faces, "owners": face_owners(static_map)}
        temporary = self.path / ".map.npz.part"
        with temporary.open("wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, names=names, **arrays)
        temporary.replace(self.path / "map.npz")


class _Tables:
    """Tables that are closed together; a context manager."""

    def __init__(self) -> None:
        self._open: list[_Table] = []

    def _table(self, path: Path, header: Sequence[str]) -> "_Table":
        self._open.append(_Table(path, header))
        return self._open[-1]

    def close(self) -> None:
        """Close the tables."""
        for table in self._open:
            table.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class EstimateTables(_Tables):
    """What the stack believed; the same for a run and for a replay of its log."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._estimates = self._table(folder / "estimates.csv", ESTIMATES)
        self._tracks = self._table(folder / "tracks.csv", TRACKS)

    def add(self, belief: Belief) -> None:
        """Append T_map_base and every track's T_map_object, as believed at one stamp."""
        localization = belief.localization
        self._estimates.write([(belief.stamp, localization.status.value, *_pose(localization.T_map_base))])
        self._tracks.write(
            (belief.stamp, track.id, track.class_name, track.status.value, *_pose(track.T_map_object),
             f"{track.visible_fraction:.3f}", int(track.moving), f"{track.score:.3f}")
            for track in belief.tracks
        )  # fmt: skip


class TruthTables(_Tables):
    """What was believed next to what was true."""

    def __init__(self, folder: Path, scene: str, classes: Iterable[str]) -> None:
        """`classes`: names of the catalogue objects; BOP's object ids number them in alphabetical order from 1."""
        super().__init__()
        self._object_ids = object_ids(classes)
        self._trajectory = self._table(folder / "trajectory.csv", TRAJECTORY)
        self._poses = self._table(folder / "poses.csv", POSES)
        # An underscore would end the data set's name for BOP's tools.
        self._bop = self._table(folder / f"simtrack_{scene.replace('_', '')}-test.csv", BOP)

    def add(self, image: int, belief: Belief, T_map_base: Float64, objects: Sequence[ObjectFrame]) -> None:
        """Append one camera stamp: `image` is its number in ``trajectory.csv`` from 0, `T_map_base` (4, 4) true."""
        localization = belief.localization
        poses = *_pose(T_map_base), *_pose(localization.T_map_base)
        self._trajectory.write([(belief.stamp, localization.status.value, *poses)])
        self._poses.write(_object_row(frame) for frame in objects)
        self._bop.write(self._bop_row(image, frame) for frame in objects if frame.track is not None)

    def _bop_row(self, image: int, frame: ObjectFrame) -> tuple[object, ...]:
        """A result: millimetres, matrices row-major; no time (-1): wall time would make files of equal runs differ."""
        assert frame.track is not None
        T, score = frame.track.T_camera_object, f"{frame.track.score:.6f}"
        R, t = (" ".join(f"{v:.8f}" for v in values) for values in (T[:3, :3].ravel(), 1000 * T[:3, 3]))
        return SCENE_ID, image, self._object_ids[frame.class_name], score, R, t, -1


class SensorTables(_Tables):
    """Poses of a sensor that is its own base, and how its frames compare with the map."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._estimates = self._table(folder / "estimates.csv", ESTIMATES)
        self._frames = self._table(folder / "frames.csv", FRAMES)

    def add(self, stamp: int, status: str, T_map_sensor: Float64, values: Mapping[str, float]) -> None:
        """Append one frame; `values` by the names of `FRAMES`, those that are missing stay empty."""
        self._estimates.write([(stamp, status, *_pose(T_map_sensor))])
        row = [f"{values[name]:.6g}" if name in values else "" for name in FRAMES[2:]]
        self._frames.write([(stamp, status, *row)])


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
