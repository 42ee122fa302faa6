"""Lidar scans as KITTI's odometry benchmark has them, with labels as SemanticKITTI's.

One sequence a scene: ``sequences/000012/velodyne/000003.bin`` (x, y, z, reflectance 0..1 of every return, in the lidar
frame at each shot's own time), ``labels/000003.label``, ``times.txt``, ``poses.txt`` and ``calib.txt``. Poses are, as
there, those of the camera with respect to its first one; ``Tr`` takes points from the lidar to the camera and is that
of the first scan, so that ``inv(Tr) @ pose @ Tr`` is the lidar's pose with respect to its first, whatever the camera
does. http://www.semantic-kitti.org/dataset.html
"""

from pathlib import Path
from typing import TextIO

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64
from simtrack.datasets.frame import DatasetInfo, LabelledFrame, LidarLabels, SceneInfo
from simtrack.datasets.writers.streams import scene_name, write_whole
from simtrack.geometry.transforms import inverse
from simtrack.simulation.strict_file import Strict


class KittiOptions(Strict):
    """What a recipe may say of the writer."""


class KittiWriter:
    """Writes scans; see `simtrack.datasets.writer.DatasetWriter`."""

    name = "kitti"

    def __init__(self, options: KittiOptions) -> None:
        self.options = options

    def begin(self, root: Path, info: DatasetInfo) -> None:
        """Write what the labels' numbers mean."""
        import yaml

        names = {0: "unlabeled"} | {c.id: c.model.name for c in info.categories} | {c.id: c.name for c in info.stuff}
        text = "# Lower 16 bits of a label: semantic class. Upper 16 bits: instance, 0 for what has none.\n"
        (root / self.name).mkdir(parents=True, exist_ok=True)
        write_whole(root / self.name / "labels.yaml", text + yaml.safe_dump({"labels": names}, sort_keys=False))

    def open_scene(self, staging: Path, info: DatasetInfo, scene: SceneInfo) -> "KittiSceneWriter":
        """Start a scene."""
        return KittiSceneWriter(staging / self.name, info, scene)

    def finish(self, root: Path, info: DatasetInfo, scenes: int) -> None:
        """Nothing is said for all scenes together."""


class KittiSceneWriter:
    """Writes one scene; frames without a scan leave nothing."""

    def __init__(self, folder: Path, info: DatasetInfo, scene: SceneInfo) -> None:
        self._things = {c.id for c in info.categories} | {c.id for c in info.stuff if c.thing}
        self._folder = folder / "sequences" / scene_name(scene.scene)
        for name in ("velodyne", "labels"):
            (self._folder / name).mkdir(parents=True)
        self._poses, self._times = (self._open(name) for name in ("poses.txt", "times.txt"))
        self._Tr: Float64 | None = None
        self._T_map_first = np.eye(4)
        self._scans = 0

    def write(self, frame: LabelledFrame) -> None:
        """Write a frame's scan; scans are numbered without gaps."""
        if frame.lidar is None:
            return
        T_map_lidar = frame.lidar.T_map_lidar
        if self._Tr is None:
            self._Tr, self._T_map_first = inverse(frame.T_map_camera) @ T_map_lidar, T_map_lidar
            self._write_calibration(frame)
        pose = self._Tr @ inverse(self._T_map_first) @ T_map_lidar @ inverse(self._Tr)
        self._poses.write(_row(pose) + "\n")
        self._times.write(f"{frame.lidar.scan.stamp / NANOSECONDS:.9f}\n")
        points, labels = returns(frame, frame.lidar, self._things)
        (self._folder / "velodyne" / f"{self._scans:06d}.bin").write_bytes(points.tobytes())
        (self._folder / "labels" / f"{self._scans:06d}.label").write_bytes(labels.tobytes())
        self._scans += 1

    def close(self) -> None:
        """Release the files."""
        self._poses.close()
        self._times.close()

    def _open(self, name: str) -> TextIO:
        return (self._folder / name).open("w", encoding="ascii", newline="\n")

    def _write_calibration(self, frame: LabelledFrame) -> None:
        assert self._Tr is not None
        projection = _row(np.column_stack([frame.intrinsics.matrix, np.zeros(3)]))
        lines = [f"P{k}: {projection}" for k in range(4)] + [f"Tr: {_row(self._Tr)}"]
        (self._folder / "calib.txt").write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")


def returns(frame: LabelledFrame, lidar: LidarLabels, things: set[int]) -> tuple[np.ndarray, np.ndarray]:
    """(N, 4) little-endian float32 points with reflectance and (N,) uint32 labels of the shots that returned."""
    scan = lidar.scan
    hit = np.isfinite(scan.ranges)
    points = np.empty((int(hit.sum()), 4), "<f4")
    points[:, :3] = scan.ranges[hit, None] * scan.directions[hit]
    points[:, 3] = np.clip(scan.intensities[hit] / 255.0, 0.0, 1.0)
    # A return may come from what has no id: noise, or nothing that is named.
    semantic = np.append(frame.segment_categories, 0).astype(np.uint32)
    counted = np.array([k + 1 if category in things else 0 for k, category in enumerate(semantic.tolist())])
    instances = lidar.instances[hit]
    return points, (semantic[instances] | counted.astype(np.uint32)[instances] << 16).astype("<u4")


def _row(matrix: Float64) -> str:
    """The first three rows of a matrix."""
    return " ".join(f"{value:.12e}" for value in matrix[:3].ravel().tolist())
