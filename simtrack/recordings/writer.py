"""Writes a sensor feed as ROS 2 messages into an MCAP file, as it arrives."""

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from simtrack.contracts import (
    DetectionResult,
    Float64,
    JointState,
    LidarScan,
    Odometry,
    RgbdFrame,
    SensorFrame,
    StaticMap,
)
from simtrack.errors import InvalidValueError, OutputExistsError
from simtrack.geometry.kinematics import KinematicTree
from simtrack.objects import ObjectModel
from simtrack.recordings import archive, layout, ros2

CHUNK_BYTES = 1 << 20
"""Uncompressed size at which a chunk is closed: about one camera frame, which is all that a kill can lose."""


def create_file(path: str | Path, overwrite: bool) -> BinaryIO:
    """Open a new file for writing; raises `OutputExistsError` if there is one and it may not be overwritten."""
    try:
        return Path(path).open("wb" if overwrite else "xb")
    except FileExistsError as error:
        raise OutputExistsError(path) from error


class McapWriter:
    """Log of everything that a perception stack is fed with; a context manager.

    Memory does not grow with the log but for its index, and the file is readable up to the last whole chunk whenever
    the process dies. `simtrack.recordings.layout` tells of the topics, `open_recording` is the way back.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        static_map: StaticMap | None = None,
        models: Mapping[str, ObjectModel] | None = None,
        robot: KinematicTree | None = None,
        metadata: Mapping[str, Any] | None = None,
        overwrite: bool = False,
    ) -> None:
        """Open `path` and store what a stack needs beside the feed; `metadata` is JSON: scene, configuration, versions.

        Keys named ``ground_truth`` at the top of `metadata` are labels and go with them. Raises `OutputExistsError`
        unless `overwrite`.
        """
        self.path = Path(path)
        resources = ((layout.STATIC_MAP, static_map), (layout.MODELS, models), (layout.ROBOT, robot))
        attachments = {layout.METADATA: json.dumps(dict(metadata or {})).encode()}
        attachments |= {name: archive.encode(value) for name, value in resources if value is not None}
        self._stream = create_file(path, overwrite)
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile=Profile.ROS2, library="simtrack")
        self._clock = -1
        self._T_base_lidar = np.zeros((4, 4))  # of no sensor: the first scan tells
        for name, data in attachments.items():
            self._writer.add_attachment(0, 0, name, layout.MEDIA_TYPES[Path(name).suffix], data)
        self._channels = self._register()

    def _register(self) -> dict[str, int]:
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic, message in layout.MESSAGES.items():
            if message not in schemas:
                schemas[message] = self._writer.register_schema(
                    ros2.schema_name(message), SchemaEncoding.ROS2, ros2.schema_text(message)
                )
            qos = {"offered_qos_profiles": layout.TRANSIENT_LOCAL} if topic == layout.TF_STATIC else {}
            channels[topic] = self._writer.register_channel(topic, MessageEncoding.CDR, schemas[message], qos)
        return channels

    def write(self, entry: SensorFrame | DetectionResult, arrival: int | None = None) -> None:
        """Append one frame or detector's answer.

        `arrival` is when it arrived, nanoseconds; by default its stamp, or the moment after the entry before it.
        """
        messages = _messages(entry)
        if isinstance(entry, LidarScan) and not np.array_equal(entry.T_base_lidar, self._T_base_lidar):
            self._T_base_lidar = entry.T_base_lidar.copy()
            mount = {layout.LIDAR_SENSOR_FRAME: entry.T_base_lidar}
            messages.insert(0, (layout.TF_STATIC, ros2.transforms(entry.stamp, layout.BASE_FRAME, mount)))
        self._append(messages, entry.stamp, arrival, getattr(entry, "sequence", 0))

    def write_labels(self, stamp: int, poses: Mapping[str, Float64], arrival: int | None = None) -> None:
        """Append true poses: name -> (4, 4) T_map_name. No estimator reads them, `strip_labels` removes them."""
        self._append([(layout.LABELS, ros2.transforms(stamp, layout.MAP_FRAME, poses))], stamp, arrival, 0)

    def _append(self, messages: list[tuple[str, bytes]], stamp: int, arrival: int | None, sequence: int) -> None:
        publish_time = max(stamp, 0)
        for topic, data in messages:
            self._clock = max(self._clock + 1, stamp if arrival is None else arrival)
            self._writer.add_message(
                channel_id=self._channels[topic],
                log_time=self._clock,
                data=data,
                publish_time=publish_time,
                sequence=sequence & 0xFFFFFFFF,
            )
        self._stream.flush()  # whole chunks reach the file even if the process is killed next

    def close(self) -> None:
        """Write the last chunk and the index. Idempotent."""
        if not self._stream.closed:
            self._writer.finish()
            self._stream.close()

    def __enter__(self) -> "McapWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def _messages(entry: SensorFrame | DetectionResult) -> list[tuple[str, bytes]]:
    match entry:
        case RgbdFrame():
            return _rgbd_messages(entry)
        case LidarScan():
            frame = ros2.frame_record(entry.stamp, entry.sequence, entry.T_base_lidar, layout.LIDAR_SENSOR_FRAME)
            return [(layout.POINTS, ros2.point_cloud(entry, layout.LIDAR_SENSOR_FRAME)), (layout.LIDAR_FRAME, frame)]
        case Odometry():
            base = {layout.BASE_FRAME: entry.T_odom_base}
            return [
                (layout.TF, ros2.transforms(entry.stamp, layout.ODOM_FRAME, base)),
                (layout.ODOMETRY, ros2.odometry(entry, layout.ODOM_FRAME, layout.BASE_FRAME)),
                (layout.ODOMETRY_FRAME, ros2.frame_record(entry.stamp, 0, entry.T_odom_base, layout.ODOM_FRAME)),
            ]
        case JointState():
            return [(layout.JOINTS, ros2.joint_state(entry))]
        case DetectionResult():
            return [(layout.DETECTIONS, ros2.detections(entry, layout.CAMERA_OPTICAL_FRAME))]
    raise InvalidValueError("entry", type(entry).__name__, "a SensorFrame or a DetectionResult")


def _rgbd_messages(frame: RgbdFrame) -> list[tuple[str, bytes]]:
    optical = layout.CAMERA_OPTICAL_FRAME
    info = ros2.camera_info(frame, optical)
    messages = [
        (layout.TF, ros2.transforms(frame.stamp, layout.BASE_FRAME, {optical: frame.T_base_camera})),
        (layout.DEPTH_INFO, info),
        (layout.DEPTH, ros2.depth_image(frame, optical)),
    ]
    if frame.rgb is not None:
        messages += [(layout.COLOR_INFO, info), (layout.COLOR, ros2.color_image(frame, optical))]
    messages.append((layout.CAMERA_FRAME, ros2.frame_record(frame.stamp, frame.sequence, frame.T_base_camera, optical)))
    return messages
