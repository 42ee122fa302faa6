"""ROS 2 logs in MCAP, read by the format's own library: records, stamps, and messages that describe each other."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.datasets.validation.findings import Report

BYTES = {"rgb8": 3, "bgr8": 3, "mono8": 1, "16UC1": 2, "32FC1": 4, "mono16": 2}
SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 8: 8}
"""PointField datatype -> bytes."""


def validate_mcap(report: Report, root: Path) -> int:
    """Check all logs of a folder; returns their number."""
    files = sorted(root.rglob("*.mcap"))
    for path in files:
        report.read(path, lambda file: _check(report, file))
    return len(files)


def _check(report: Report, path: Path) -> None:
    from mcap.exceptions import McapError

    try:
        sizes: dict[str, tuple[int, int]] = {}
        last: dict[str, int] = {}
        for topic, log_time, message in _messages(path):
            kind = message.__class__.__name__
            place = f"{topic} at {log_time} ns"
            before = last.get(topic, 0)
            report.holds(log_time >= before, path, place, f"a message logged after one of {before} ns", "rising times")
            last[topic] = log_time
            if kind == "Image":
                _check_image(report, path, place, message)
                sizes[topic.rsplit("/", 1)[0]] = (message.width, message.height)
            elif kind == "CameraInfo":
                _check_camera(report, path, place, message, sizes.get(topic.rsplit("/", 1)[0]))
            elif kind == "PointCloud2":
                _check_cloud(report, path, place, message)
            elif kind == "TFMessage":
                for transform in message.transforms:
                    q = transform.transform.rotation
                    name = f"{place}, {transform.header.frame_id} to {transform.child_frame_id}"
                    report.near(path, name, float(np.linalg.norm([q.x, q.y, q.z, q.w])), 1.0, 1e-3)
        report.holds(bool(last), path, "", "no messages", "messages")
    except McapError as error:
        raise ValueError(str(error) or type(error).__name__) from error


def _messages(path: Path) -> Iterator[tuple[str, int, Any]]:
    from mcap.reader import SeekingReader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            if schema is not None and schema.encoding == "ros2msg":
                yield channel.topic, message.log_time, decoded


def _check_image(report: Report, path: Path, place: str, message: Any) -> None:
    width = BYTES.get(message.encoding)
    if report.holds(width is not None, path, f"{place}, encoding", message.encoding, sorted(BYTES)):
        assert width is not None
        report.holds(message.step >= message.width * width, path, f"{place}, step", message.step, "a row's bytes")
        report.equal(path, f"{place}, data", len(message.data), message.step * message.height)
    _check_header(report, path, place, message.header)


def _check_camera(report: Report, path: Path, place: str, message: Any, size: tuple[int, int] | None) -> None:
    if size is not None:
        report.equal(path, f"{place}, width, height", (message.width, message.height), size)
    k, p = np.reshape(message.k, (3, 3)), np.reshape(message.p, (3, 4))
    report.holds(bool(k[0, 0] > 0 and k[1, 1] > 0 and k[2, 2] == 1), path, f"{place}, k", k.tolist(), "a camera matrix")
    report.holds(np.array_equal(p[:, :3], k), path, f"{place}, p", p.tolist(), "k and a column")
    _check_header(report, path, place, message.header)


def _check_cloud(report: Report, path: Path, place: str, message: Any) -> None:
    for field in message.fields:
        end = field.offset + SIZES.get(field.datatype, 1) * field.count
        good = field.datatype in SIZES and end <= message.point_step
        report.holds(good, path, f"{place}, field {field.name}", f"bytes up to {end}", f"up to {message.point_step}")
    names = {field.name for field in message.fields}
    report.holds({"x", "y", "z"} <= names, path, f"{place}, fields", sorted(names), "x, y, z among them")
    report.equal(path, f"{place}, row_step", message.row_step, message.point_step * message.width)
    report.equal(path, f"{place}, data", len(message.data), message.row_step * message.height)
    _check_header(report, path, place, message.header)


def _check_header(report: Report, path: Path, place: str, header: Any) -> None:
    good = bool(header.frame_id) and not header.frame_id.startswith("/") and 0 <= header.stamp.nanosec < 10**9
    report.holds(good, path, f"{place}, header", f"{header.frame_id} {header.stamp}", "a frame without '/', a time")
