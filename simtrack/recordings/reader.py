"""Reads recordings back into the frames that a perception stack is fed with, bit by bit as they were written."""

import json
import struct
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.decoder import DecoderFactory as AnyDecoderFactory
from mcap.exceptions import McapError
from mcap.well_known import Profile
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory

from simtrack.contracts import (
    NANOSECONDS,
    CameraIntrinsics,
    Detection,
    DetectionResult,
    Float64,
    JointState,
    LidarScan,
    Odometry,
    RegionOfInterest,
    RgbdFrame,
    SensorFrame,
    StaticMap,
    Status,
)
from simtrack.errors import FileFormatError, SimtrackError
from simtrack.geometry.kinematics import KinematicTree
from simtrack.geometry.transforms import rotation_from_quaternion, transform
from simtrack.objects import ObjectModel
from simtrack.recordings import archive, layout, ros2
from simtrack.recordings.container import Container, LogMessage
from simtrack.recordings.log import RecordingWarning
from simtrack.recordings.writer import CHUNK_BYTES, create_file


@dataclass(frozen=True, slots=True)
class Recording:
    """A sensor feed and what a perception stack needs beside it. Frames are read when asked for, one at a time."""

    path: Path
    static_map: StaticMap | None
    """None if none was recorded."""
    models: Mapping[str, ObjectModel]
    """The estimator's object models by name."""
    robot: KinematicTree | None
    """The robot's body, None if none was recorded."""
    metadata: Mapping[str, Any]
    """As the writer got it: scene, configuration, versions."""
    complete: bool
    """False if the file was cut off, as by a kill of its writer: everything before the cut is there."""
    _container: Container

    def frames(self) -> Iterator[SensorFrame | DetectionResult]:
        """Everything that was fed to the stack, in the order in which it arrived. Raises `FileFormatError`."""
        topics = [topic for topic in layout.MESSAGES if topic not in (layout.LABELS, layout.TF, layout.TF_STATIC)]
        assembler = _Assembler()
        for topic, message in _decoded(self._container, topics):
            try:
                entry = assembler.take(topic, message)
            except (AttributeError, KeyError, ValueError, TypeError) as error:
                raise FileFormatError(self.path, topic, f"message cannot be used: {error}") from error
            if entry is not None:
                yield entry

    def sensor_frames(self) -> Iterator[SensorFrame]:
        """`frames` without the detector's answers, which `RecordedDetector` gives when asked."""
        for frame in self.frames():
            if not isinstance(frame, DetectionResult):
                yield frame

    def detections(self) -> Iterator[DetectionResult]:
        """The detector's answers alone, in order; skips the parts of the file that hold none."""
        for topic, message in _decoded(self._container, [layout.DETECTIONS]):
            try:
                yield _detections(message)
            except (AttributeError, ValueError, TypeError) as error:
                raise FileFormatError(self.path, topic, f"message cannot be used: {error}") from error

    def labels(self) -> Iterator[tuple[int, dict[str, Float64]]]:
        """True poses, if recorded and not stripped: (stamp, name -> (4, 4) T_map_name). Not for estimators."""
        for topic, message in _decoded(self._container, [layout.LABELS]):
            try:
                stamps = {_stamp(entry.header) for entry in message.transforms}
                for stamp in sorted(stamps):
                    entries = [entry for entry in message.transforms if _stamp(entry.header) == stamp]
                    yield stamp, {entry.child_frame_id: _pose(entry.transform) for entry in entries}
            except (AttributeError, ValueError, TypeError) as error:
                raise FileFormatError(self.path, topic, f"message cannot be used: {error}") from error


class RecordedDetector:
    """The detector of a recording: answers by the image's stamp what the recorded one answered.

    Where one image was asked about several times, the answers come in their order. Where none was recorded the status
    is NO_DATA.
    """

    def __init__(self, recording: Recording) -> None:
        self._answers: dict[int, list[DetectionResult]] = {}
        for result in recording.detections():
            self._answers.setdefault(result.stamp, []).append(result)

    def detect(self, frame: RgbdFrame, regions: Sequence[RegionOfInterest] = ()) -> DetectionResult:
        """The recorded answer; `regions` change nothing."""
        answers = self._answers.get(frame.stamp)
        if not answers:
            return DetectionResult(frame.stamp, frame.stamp, (), Status.NO_DATA)
        return answers.pop(0) if len(answers) > 1 else answers[0]


def open_recording(path: str | Path) -> Recording:
    """Open an MCAP file that `McapWriter` wrote.

    Warns with `RecordingWarning` if the file was cut off. Raises `FileFormatError` for anything else that is wrong.
    """
    container = Container(path)
    if not container.complete:
        warnings.warn(
            f"{path} was not finished by its writer; what lies before the cut is used", RecordingWarning, stacklevel=2
        )
    static_map: StaticMap | None = _attached(container, layout.STATIC_MAP, StaticMap)
    if static_map is not None:
        _check_map(static_map, path)
    return Recording(
        path=Path(path),
        static_map=static_map,
        models=_attached(container, layout.MODELS, dict[str, ObjectModel]) or {},
        robot=_attached(container, layout.ROBOT, KinematicTree),
        metadata=_metadata(container),
        complete=container.complete,
        _container=container,
    )


def strip_labels(source: str | Path, target: str | Path, *, overwrite: bool = False) -> None:
    """Copy a recording without its labels: neither true poses nor what its metadata says of the simulated world."""
    container = Container(source)
    with create_file(target, overwrite) as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile=Profile.ROS2, library="simtrack")
        for name in container.attachments:
            data = container.attachment(name) or b""
            if name.startswith(layout.LABEL_KEY):
                continue
            if name == layout.METADATA:
                kept = {key: value for key, value in _metadata(container).items() if key != layout.LABEL_KEY}
                data = json.dumps(kept).encode()
            media_type = layout.MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
            writer.add_attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for entry in container.messages():
            if not entry.channel.topic.startswith(layout.LABEL_TOPICS):
                _copy(entry, writer, schemas, channels)
        writer.finish()


def _copy(entry: LogMessage, writer: Writer, schemas: dict[int, int], channels: dict[int, int]) -> None:
    channel, schema, message = entry.channel, entry.schema, entry.message
    if schema is not None and schema.id not in schemas:
        schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
    if channel.id not in channels:
        schema_id = 0 if schema is None else schemas[schema.id]
        channels[channel.id] = writer.register_channel(
            channel.topic, channel.message_encoding, schema_id, channel.metadata
        )
    writer.add_message(
        channels[channel.id], message.log_time, message.data, message.publish_time, sequence=message.sequence
    )


def _metadata(container: Container) -> dict[str, Any]:
    where = f"attachment {layout.METADATA}"
    data = container.attachment(layout.METADATA)
    if data is None:
        raise FileFormatError(container.path, where, "missing: not a recording of simtrack")
    try:
        metadata = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(container.path, where, f"not JSON: {error}") from error
    if not isinstance(metadata, dict):
        raise FileFormatError(container.path, where, "not a JSON object")
    return metadata


def _attached(container: Container, name: str, kind: Any) -> Any:
    data = container.attachment(name)
    if data is None:
        return None
    try:
        return archive.decode(kind, data)
    except (archive.ArchiveError, SimtrackError) as error:
        raise FileFormatError(container.path, f"attachment {name}", str(error)) from error


def _check_map(static_map: StaticMap, path: str | Path) -> None:
    where = f"attachment {layout.STATIC_MAP}"
    vertices, faces = static_map.vertices, static_map.faces
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise FileFormatError(path, where, f"vertices {vertices.shape}, faces {faces.shape}; expected (V, 3), (F, 3)")
    if not np.isfinite(vertices).all() or (faces.size and not 0 <= faces.min() <= faces.max() < len(vertices)):
        raise FileFormatError(path, where, "vertices that are not finite, or faces that name none of them")


def _decoded(container: Container, topics: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """Messages of `topics` in order, as attribute trees."""
    factory: AnyDecoderFactory = DecoderFactory()
    last = -1
    for entry in container.messages(topics):
        topic = entry.channel.topic
        if entry.message.log_time < last:
            raise FileFormatError(container.path, f"{topic}: log_time", "messages are not in the order of arrival")
        last = entry.message.log_time
        expected = ros2.schema_name(layout.MESSAGES[topic])
        if entry.schema is None or entry.schema.name != expected:
            found = "none" if entry.schema is None else entry.schema.name
            raise FileFormatError(container.path, f"{topic}: schema", f"{found}, expected {expected}")
        try:
            decoder = factory.decoder_for(entry.channel.message_encoding, entry.schema)
            if decoder is None:
                raise ValueError(f"encoding {entry.channel.message_encoding!r}, expected 'cdr'")
            message = decoder(entry.message.data)
        except (McapError, struct.error, ValueError, TypeError, KeyError, IndexError, RecursionError) as error:
            raise FileFormatError(container.path, topic, f"cannot be decoded: {error}") from error
        yield topic, message


class _Assembler:
    """Puts the messages of one frame together; the frame's last message closes it."""

    def __init__(self) -> None:
        self._pending: dict[str, Any] = {}

    def take(self, topic: str, message: Any) -> SensorFrame | DetectionResult | None:
        match topic:
            case layout.CAMERA_FRAME:
                parts = self._pending
                self._pending = {key: value for key, value in parts.items() if not key.startswith("/camera/")}
                return _rgbd_frame(parts[layout.DEPTH], parts[layout.DEPTH_INFO], parts.get(layout.COLOR), message)
            case layout.LIDAR_FRAME:
                return _scan(self._pending.pop(layout.POINTS), message)
            case layout.ODOMETRY_FRAME:
                twist = self._pending.pop(layout.ODOMETRY).twist.twist
                return Odometry(_stamp(message.header), _matrix(message.pose), twist.linear.x, twist.angular.z)
            case layout.JOINTS:
                return _joint_state(message)
            case layout.DETECTIONS:
                return _detections(message)
        self._pending[topic] = message
        return None


def _stamp(header: Any) -> int:
    return header.stamp.sec * NANOSECONDS + header.stamp.nanosec


def _matrix(values: Sequence[float]) -> Float64:
    return np.array(values, dtype=np.float64).reshape(4, 4)


def _pose(message: Any) -> Float64:
    t, q = message.translation, message.rotation
    return transform(rotation_from_quaternion(np.array([q.w, q.x, q.y, q.z])), (t.x, t.y, t.z))


def _pixels(image: Any, encoding: str, dtype: str, channels: int) -> np.ndarray:
    """(H, W, channels) of an image message, whose data it must fill exactly."""
    item = np.dtype(dtype)
    if image.encoding != encoding or image.is_bigendian:
        raise ValueError(f"image encoding {image.encoding!r}, expected little-endian {encoding!r}")
    step = image.width * channels * item.itemsize
    if (image.height and image.step != step) or image.height * step != len(image.data):
        raise ValueError(f"{image.height} rows of {image.step} bytes do not make {len(image.data)} bytes of image")
    return np.frombuffer(image.data, dtype=item).reshape(image.height, image.width, channels).copy()


def _rgbd_frame(depth: Any, info: Any, color: Any | None, frame: Any) -> RgbdFrame:
    k = info.k
    return RgbdFrame(
        stamp=_stamp(frame.header),
        depth=_pixels(depth, "32FC1", "<f4", 1)[:, :, 0],
        rgb=None if color is None else _pixels(color, "rgb8", "u1", 3),
        intrinsics=CameraIntrinsics(info.width, info.height, fx=k[0], fy=k[4], cx=k[2], cy=k[5]),
        T_base_camera=_matrix(frame.pose),
        sequence=frame.sequence,
    )


def _scan(cloud: Any, frame: Any) -> LidarScan:
    layout_found = [(field.name, field.offset, field.datatype, field.count) for field in cloud.fields]
    if layout_found != ros2.POINT_FIELDS or cloud.is_bigendian or cloud.point_step != ros2.VELODYNE_POINT.itemsize:
        raise ValueError(f"point layout {layout_found}, expected {ros2.POINT_FIELDS}")
    if cloud.height * cloud.width * cloud.point_step != len(cloud.data):
        raise ValueError(f"{cloud.height} x {cloud.width} points do not make {len(cloud.data)} bytes")
    points = np.frombuffer(cloud.data, dtype=ros2.VELODYNE_POINT)
    return LidarScan(
        stamp=_stamp(frame.header),
        directions=np.stack([points[f"direction_{axis}"] for axis in "xyz"], axis=1),
        ranges=points["range"].copy(),
        times=points["time"].copy(),
        rings=points["ring"].astype(np.uint8),
        intensities=points["intensity"].copy(),
        T_base_lidar=_matrix(frame.pose),
        sequence=frame.sequence,
    )


def _joint_state(message: Any) -> JointState:
    if len(message.name) != len(message.position):
        raise ValueError(f"{len(message.name)} names but {len(message.position)} positions")
    return JointState(_stamp(message.header), tuple(message.name), np.array(message.position, dtype=np.float64))


def _detections(message: Any) -> DetectionResult:
    next_image = getattr(message, "next_image", message.available)  # recordings of before there was one lack it
    return DetectionResult(
        stamp=_stamp(message.header),
        available=message.available,
        detections=tuple(
            Detection(
                class_name=entry.class_name,
                keypoints=np.array(entry.keypoints, dtype=np.float64).reshape(9, 2),
                keypoint_sigma=np.array(entry.keypoint_sigma, dtype=np.float64),
                box=np.array(entry.box, dtype=np.float64),
                score=entry.score,
            )
            for entry in message.detections
        ),
        status=Status(message.status),
        next_image=None if next_image == message.available else next_image,
    )
