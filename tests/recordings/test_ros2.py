"""The logs as others see them: read with mcap's own reader and decoder, against the definitions of ROS 2."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from simtrack.contracts import LidarScan, Odometry, RgbdFrame
from simtrack.geometry.transforms import rotation_from_quaternion
from simtrack.recordings import McapWriter, layout, ros2
from tests.recordings.feeds import feed


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Any]]:
    entries = feed(np.random.default_rng(0), 4)
    path = tmp_path_factory.mktemp("ros2") / "log.mcap"
    with McapWriter(path) as writer:
        for entry in entries:
            writer.write(entry)
        writer.write_labels(entries[-1].stamp, {"base": np.eye(4)})
    return path, entries


@pytest.fixture(scope="module")
def decoded(log: tuple[Path, list[Any]]) -> dict[str, list[Any]]:
    out: dict[str, list[Any]] = defaultdict(list)
    with log[0].open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for item in reader.iter_decoded_messages():
            out[item.channel.topic].append((item.message.log_time, item.decoded_message))
    return out


def of(entries: list[Any], kind: type) -> list[Any]:
    return [entry for entry in entries if isinstance(entry, kind)]


def stamp(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def pose(transform: Any) -> np.ndarray:
    q, t = transform.rotation, transform.translation
    out = np.eye(4)
    out[:3, :3] = rotation_from_quaternion(np.array([q.w, q.x, q.y, q.z]))
    out[:3, 3] = t.x, t.y, t.z
    return out


def test_profile_schemas_and_quality_of_service(log: tuple[Path, list[Any]]) -> None:
    with log[0].open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.chunk_count >= 1
    assert {c.topic for c in summary.channels.values()} == set(layout.MESSAGES)
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg")
        assert schema.name.count("/msg/") == 1
        parts = schema.data.decode().split("=" * 80 + "\n")
        assert all(part.startswith("MSG: ") for part in parts[1:])
        assert ("offered_qos_profiles" in channel.metadata) == (channel.topic == "/tf_static")
        if channel.topic == "/tf_static":
            assert "durability: 1" in channel.metadata["offered_qos_profiles"]
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}


def test_log_time_increases_strictly_over_the_whole_file(decoded: dict[str, list[Any]]) -> None:
    times = sorted(time for messages in decoded.values() for time, _ in messages)
    assert len(set(times)) == len(times)


def test_images_and_camera_info(log: tuple[Path, list[Any]], decoded: dict[str, list[Any]]) -> None:
    frames = of(log[1], RgbdFrame)
    colored = [frame for frame in frames if frame.rgb is not None]
    assert 0 < len(colored) < len(frames)
    for frame, (_, image), (_, info) in zip(frames, decoded[layout.DEPTH], decoded[layout.DEPTH_INFO], strict=True):
        assert (image.encoding, image.is_bigendian, image.step) == ("32FC1", 0, image.width * 4)
        assert stamp(image) == stamp(info) == frame.stamp
        assert image.header.frame_id == info.header.frame_id == "camera_optical_frame"
        np.testing.assert_array_equal(np.frombuffer(image.data, "<f4").reshape(frame.depth.shape), frame.depth)
        k = frame.intrinsics.matrix
        assert (info.width, info.height, info.distortion_model) == (image.width, image.height, "plumb_bob")
        assert info.d == [0.0] * 5 and info.k == k.ravel().tolist() and info.r == np.eye(3).ravel().tolist()
        assert info.p == np.column_stack([k, np.zeros(3)]).ravel().tolist()
        assert (info.binning_x, info.roi.width, info.roi.do_rectify) == (0, 0, False)
    for frame, (_, image) in zip(colored, decoded[layout.COLOR], strict=True):
        assert (image.encoding, image.step) == ("rgb8", image.width * 3)
        np.testing.assert_array_equal(np.frombuffer(image.data, np.uint8).reshape(frame.rgb.shape), frame.rgb)


def test_point_clouds_are_those_of_the_velodyne_driver(
    log: tuple[Path, list[Any]], decoded: dict[str, list[Any]]
) -> None:
    assert ros2.VELODYNE_POINT.itemsize == 38
    for scan, (_, cloud) in zip(of(log[1], LidarScan), decoded[layout.POINTS], strict=True):
        fields = [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields[:6]]
        assert fields == [
            *(("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("intensity", 12, 7, 1)),
            *(("ring", 16, 4, 1), ("time", 18, 7, 1)),
        ]
        assert (cloud.height, cloud.width, cloud.point_step) == (1, len(scan.ranges), 38)
        assert cloud.row_step == len(cloud.data) and not cloud.is_bigendian
        xyzirt = np.dtype(
            {
                "names": ["xyz", "ring", "time"],
                "formats": ["(3,)<f4", "<u2", "<f4"],
                "offsets": [0, 16, 18],
                "itemsize": 38,
            }
        )
        points = np.frombuffer(cloud.data, xyzirt)
        hit = np.isfinite(scan.ranges)
        assert cloud.is_dense == hit.all()
        assert np.isnan(points["xyz"][~hit]).all()
        np.testing.assert_allclose(points["xyz"][hit], scan.directions[hit] * scan.ranges[hit, None], rtol=1e-6)
        np.testing.assert_array_equal(points["ring"], scan.rings)
        np.testing.assert_array_equal(points["time"], scan.times)


def test_transforms_and_odometry(log: tuple[Path, list[Any]], decoded: dict[str, list[Any]]) -> None:
    frames, readings = of(log[1], RgbdFrame), of(log[1], Odometry)
    moving = [entry for _, message in decoded[layout.TF] for entry in message.transforms]
    camera = [entry for entry in moving if entry.child_frame_id == "camera_optical_frame"]
    base = [entry for entry in moving if entry.child_frame_id == "base_link"]
    for frame, entry in zip(frames, camera, strict=True):
        assert (entry.header.frame_id, stamp(entry)) == ("base_link", frame.stamp)
        np.testing.assert_allclose(pose(entry.transform), frame.T_base_camera, atol=1e-14)
    for reading, entry, (_, message) in zip(readings, base, decoded[layout.ODOMETRY], strict=True):
        assert (entry.header.frame_id, message.header.frame_id, message.child_frame_id) == ("odom", "odom", "base_link")
        np.testing.assert_allclose(pose(entry.transform), reading.T_odom_base, atol=1e-14)
        position = message.pose.pose.position
        np.testing.assert_array_equal([position.x, position.y, position.z], reading.T_odom_base[:3, 3])
        assert (message.twist.twist.linear.x, message.twist.twist.angular.z) == (reading.linear, reading.angular)
        assert len(message.pose.covariance) == len(message.twist.covariance) == 36
    static = [entry for _, message in decoded[layout.TF_STATIC] for entry in message.transforms]
    np.testing.assert_allclose(pose(static[0].transform), of(log[1], LidarScan)[0].T_base_lidar, atol=1e-14)
    assert (static[0].header.frame_id, static[0].child_frame_id) == ("base_link", "lidar")


def test_joint_states_and_detections(log: tuple[Path, list[Any]], decoded: dict[str, list[Any]]) -> None:
    _, joints = decoded[layout.JOINTS][0]
    assert joints.name == list(log[1][0].names) and joints.position == log[1][0].positions.tolist()
    assert joints.velocity == joints.effort == []
    _, answer = decoded[layout.DETECTIONS][1]
    assert [len(d.keypoints) for d in answer.detections] == [18, 18]
    assert answer.available == stamp(answer) + 150_000_001
    assert answer.next_image == stamp(answer) + 200_000_000
