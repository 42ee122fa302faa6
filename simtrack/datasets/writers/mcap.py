"""ROS 2 logs, one a scene: what the robot's sensors saw, as `simtrack.recordings` logs it, with the true poses beside.

A camera without a robot is its own base, fixed to the map where each image was taken. A log can be replayed if the
scene has a map and a robot.
"""

from pathlib import Path

import numpy as np

from simtrack.contracts import JointState, LidarScan, RgbdFrame, SensorFrame
from simtrack.datasets.frame import DatasetInfo, LabelledFrame, SceneInfo
from simtrack.datasets.writers.streams import scene_name
from simtrack.geometry.transforms import inverse
from simtrack.recordings import McapWriter
from simtrack.recordings.layout import BASE_FRAME, CAMERA_OPTICAL_FRAME
from simtrack.simulation.strict_file import Strict


class McapOptions(Strict):
    """What a recipe may say of the writer."""

    labels: bool = True
    """Whether true poses are logged too, on a topic of their own."""


class McapDatasetWriter:
    """Writes logs; see `simtrack.datasets.writer.DatasetWriter`."""

    name = "mcap"

    def __init__(self, options: McapOptions) -> None:
        self.options = options

    def begin(self, root: Path, info: DatasetInfo) -> None:
        """Nothing is said for all scenes together."""

    def open_scene(self, staging: Path, info: DatasetInfo, scene: SceneInfo) -> "McapSceneWriter":
        """Start a scene."""
        return McapSceneWriter(staging / self.name, self.options, info, scene)

    def finish(self, root: Path, info: DatasetInfo, scenes: int) -> None:
        """Nothing is said for all scenes together."""


class McapSceneWriter:
    """Writes one scene."""

    def __init__(self, folder: Path, options: McapOptions, info: DatasetInfo, scene: SceneInfo) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path, self._options, self._info, self._scene = folder, options, info, scene
        self._log: McapWriter | None = None

    def write(self, frame: LabelledFrame) -> None:
        """Write a frame."""
        log = self._log or self._start(frame)
        for arrival, entry in sorted(sensor_frames(frame), key=lambda pair: pair[0]):
            log.write(entry, max(arrival, 0))
        if self._options.labels:
            poses = {label.name: label.T_map_object for label in frame.labels}
            base = frame.T_map_camera if frame.T_map_base is None else frame.T_map_base
            log.write_labels(frame.stamp, {BASE_FRAME: base, CAMERA_OPTICAL_FRAME: frame.T_map_camera} | poses)

    def close(self) -> None:
        """Complete the log."""
        if self._log is not None:
            self._log.close()

    def _start(self, frame: LabelledFrame) -> McapWriter:
        info, scene = self._info, self._scene
        base = frame.T_map_camera if frame.T_map_base is None else frame.T_map_base
        self._log = McapWriter(
            self._path / f"{scene_name(scene.scene)}.mcap",
            static_map=scene.static_map,
            models={category.model.name: category.model for category in info.categories},
            robot=scene.robot,
            metadata={"dataset": info.name, "seed": info.seed, "scene": scene.scene, "T_map_base": base.tolist()},
        )
        return self._log


def sensor_frames(frame: LabelledFrame) -> list[tuple[int, SensorFrame]]:
    """(arrival in nanoseconds, reading) of all that was sensed for a frame; a scan arrives with its last shot."""
    out: list[tuple[int, SensorFrame]] = []
    if frame.joints:
        names = tuple(frame.joints)
        out.append((frame.stamp, JointState(frame.stamp, names, np.array([frame.joints[name] for name in names]))))
    if frame.odometry is not None:
        out.append((frame.odometry.stamp, frame.odometry))
    if frame.lidar is not None:
        out.append((_last_shot(frame.lidar.scan), frame.lidar.scan))
    T_base_camera = np.eye(4) if frame.T_map_base is None else inverse(frame.T_map_base) @ frame.T_map_camera
    image = RgbdFrame(frame.stamp, frame.depth, frame.rgb, frame.intrinsics, T_base_camera, frame.index)
    return [*out, (frame.stamp, image)]


def _last_shot(scan: LidarScan) -> int:
    return scan.stamp + round(float(scan.times.max(initial=0.0)) * 1e9)
