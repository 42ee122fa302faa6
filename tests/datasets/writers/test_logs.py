"""Formats of sensor logs: MCAP, KITTI, TUM; and DOPE's files and the plain labels."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from simtrack.contracts import JointState, LidarScan, Odometry, RgbdFrame
from simtrack.datasets.frame import LabelledFrame
from simtrack.datasets.writers import make_writer
from simtrack.geometry.transforms import inverse, rotation_from_quaternion, transform
from simtrack.objects.model import BOX_CORNERS
from simtrack.recordings import open_log, open_recording
from tests.datasets.writers.labelled import CAMERA, FRAMES, INFO, MAP, Small, made, without_robot
from tests.recordings.feeds import same

NAMES = ("kitti", "tum", "dope", "mcap", "labels")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("logs"), [make_writer(name) for name in NAMES])


@pytest.fixture(scope="module")
def frames() -> list[LabelledFrame]:
    """Of scene 1."""
    return list(Small().scene(1))


# ------------------------------------------------------------------------------------------------------------- MCAP


def test_a_log_comes_back_as_the_sensors_saw_it(root: Path, frames: list[LabelledFrame]) -> None:
    recording = open_recording(root / "mcap" / "000001.mcap")
    assert recording.complete and recording.static_map is not None and recording.robot is not None
    assert same(recording.static_map, MAP) and set(recording.models) == {c.model.name for c in INFO.categories}
    feed = list(recording.sensor_frames())
    kinds = {kind: [entry for entry in feed if isinstance(entry, kind)] for kind in (RgbdFrame, LidarScan, Odometry)}
    assert all(len(entries) == FRAMES for entries in kinds.values())
    assert sum(isinstance(entry, JointState) for entry in feed) == FRAMES
    for frame, image, scan, odometry in zip(frames, *kinds.values(), strict=True):
        assert isinstance(image, RgbdFrame) and image.rgb is not None
        assert image.stamp == frame.stamp and (image.rgb == frame.rgb).all() and (image.depth == frame.depth).all()
        assert frame.T_map_base is not None and frame.lidar is not None
        np.testing.assert_allclose(frame.T_map_base @ image.T_base_camera, frame.T_map_camera, atol=1e-12)
        assert same(scan, frame.lidar.scan) and same(odometry, frame.odometry)
    for (stamp, poses), frame in zip(recording.labels(), frames, strict=True):
        assert stamp == frame.stamp
        for label in frame.labels:
            np.testing.assert_allclose(poses[label.name], label.T_map_object, atol=1e-9)


def test_ros_tools_read_the_log(root: Path, frames: list[LabelledFrame]) -> None:
    found: dict[str, list[Any]] = {}
    with (root / "mcap" / "000001.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        times = []
        for schema, _, message, decoded in reader.iter_decoded_messages():
            assert schema is not None
            times.append(message.log_time)
            found.setdefault(schema.name, []).append(decoded)
    assert times == sorted(times)
    assert len(found["sensor_msgs/msg/Image"]) == 2 * FRAMES == len(found["sensor_msgs/msg/CameraInfo"])
    info = found["sensor_msgs/msg/CameraInfo"][0]
    assert list(info.k) == [CAMERA.fx, 0, CAMERA.cx, 0, CAMERA.fy, CAMERA.cy, 0, 0, 1]
    clouds = found["sensor_msgs/msg/PointCloud2"]
    assert [cloud.width for cloud in clouds] == [len(f.lidar.scan.ranges) for f in frames if f.lidar is not None]
    assert len(found["nav_msgs/msg/Odometry"]) == FRAMES
    assert {t.child_frame_id for tf in found["tf2_msgs/msg/TFMessage"] for t in tf.transforms} >= {
        "camera_optical_frame", "lidar", "base_link", "bars-1"
    }  # fmt: skip


def test_rosbags_reads_the_log(root: Path, frames: list[LabelledFrame]) -> None:
    highlevel = pytest.importorskip("rosbags.highlevel")
    with highlevel.AnyReader([root / "mcap" / "000001.mcap"]) as reader:
        images = [
            reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages()
            if connection.topic == "/camera/color/image_rect"
        ]
        assert "/tf_static" in reader.topics and "/lidar/points" in reader.topics
    for frame, image in zip(frames, images, strict=True):
        assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == frame.stamp
        np.testing.assert_array_equal(image.data.reshape(frame.rgb.shape), frame.rgb)


def test_a_camera_without_a_robot_is_its_own_base(tmp_path: Path, frames: list[LabelledFrame]) -> None:
    writer = make_writer("mcap").open_scene(tmp_path, INFO, replace(Small().scene_info(1), robot=None, static_map=None))
    for frame in frames:
        writer.write(without_robot(frame))
    writer.close()
    recording = open_recording(tmp_path / "mcap" / "000001.mcap")
    feed = list(recording.sensor_frames())
    assert len(feed) == FRAMES and recording.static_map is None
    for frame, image, (_, poses) in zip(frames, feed, recording.labels(), strict=True):
        assert isinstance(image, RgbdFrame)
        np.testing.assert_array_equal(image.T_base_camera, np.eye(4))
        np.testing.assert_allclose(poses["base_link"], frame.T_map_camera, atol=1e-9)


# ------------------------------------------------------------------------------------------------------------ KITTI


def test_scans_have_the_returns_and_their_instances(root: Path, frames: list[LabelledFrame]) -> None:
    folder = root / "kitti" / "sequences" / "000001"
    names = yaml.safe_load((root / "kitti" / "labels.yaml").read_text())["labels"]
    calibration = dict(line.split(": ") for line in (folder / "calib.txt").read_text().splitlines())
    Tr = np.vstack([np.array(calibration["Tr"].split(), float).reshape(3, 4), [0, 0, 0, 1]])
    poses, times = np.loadtxt(folder / "poses.txt"), np.loadtxt(folder / "times.txt")
    first = frames[0].lidar
    assert first is not None
    labelled = 0
    for frame in frames:
        lidar = frame.lidar
        assert lidar is not None
        points = np.fromfile(folder / "velodyne" / f"{frame.index:06d}.bin", "<f4").reshape(-1, 4)
        labels = np.fromfile(folder / "labels" / f"{frame.index:06d}.label", "<u4")
        hit = np.isfinite(lidar.scan.ranges)
        assert len(points) == len(labels) == hit.sum() < len(hit)
        np.testing.assert_allclose(np.linalg.norm(points[:, :3], axis=1), lidar.scan.ranges[hit], rtol=1e-5)
        assert points[:, 3].min() >= 0.0 and points[:, 3].max() <= 1.0
        for semantic, instance, truth in zip(labels & 0xFFFF, labels >> 16, lidar.instances[hit], strict=True):
            assert semantic == frame.segment_categories[truth]
            assert instance == (0 if names[semantic] == "floor" else truth + 1)
            labelled += instance > 0
        pose = np.vstack([poses[frame.index].reshape(3, 4), [0, 0, 0, 1]])
        np.testing.assert_allclose(
            inverse(Tr) @ pose @ Tr, inverse(first.T_map_lidar) @ lidar.T_map_lidar, atol=1e-9
        )  # as readers of the benchmark do
        assert times[frame.index] == pytest.approx(lidar.scan.stamp * 1e-9, abs=1e-9)
    assert labelled
    np.testing.assert_allclose(frames[0].T_map_camera @ Tr, first.T_map_lidar, atol=1e-9)


def test_frames_without_a_scan_leave_none(tmp_path: Path) -> None:
    folder = made(tmp_path, [make_writer("kitti")], Small(lidar=False), 1) / "kitti" / "sequences" / "000000"
    assert not list(folder.rglob("*.bin")) and (folder / "poses.txt").read_text() == ""


# -------------------------------------------------------------------------------------------------------------- TUM


def test_a_sequence_is_read_back_with_its_trajectory(root: Path, frames: list[LabelledFrame]) -> None:
    folder = root / "tum" / "000001"
    assert len((folder / "associations.txt").read_text().splitlines()) == FRAMES + 1
    for line, frame in zip((folder / "associations.txt").read_text().splitlines()[1:], frames, strict=True):
        time, colour, other, depth = line.split()
        assert time == other and round(float(time) * 1e9) == pytest.approx(frame.stamp, abs=200)
        rgb, steps = (cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED) for name in (colour, depth))
        assert rgb is not None and steps is not None and steps.dtype == np.uint16
        np.testing.assert_array_equal(rgb[..., ::-1], frame.rgb)
        np.testing.assert_allclose(steps / 5000.0, frame.depth, atol=1.01e-4)
    for row, frame in zip(np.loadtxt(folder / "groundtruth.txt"), frames, strict=True):
        x, y, z, qx, qy, qz, qw = row[1:]
        T = transform(rotation_from_quaternion(np.array([qw, qx, qy, qz])), (x, y, z))
        np.testing.assert_allclose(T, frame.T_map_camera, atol=1e-7)
    log = list(open_log(folder).read())
    for entry, frame in zip(log, frames, strict=True):
        image = entry.frame
        assert isinstance(image, RgbdFrame) and image.stamp == frame.stamp and image.intrinsics == frame.intrinsics
        assert entry.T_map_sensor is not None
        np.testing.assert_allclose(entry.T_map_sensor, frame.T_map_camera, atol=1e-6)


# ------------------------------------------------------------------------------------------------------------- DOPE


def test_dope_cuboids_are_drawn_in_its_order(root: Path, frames: list[LabelledFrame]) -> None:
    conventions = json.loads((root / "dope" / "conventions.json").read_text())
    corners = np.array(conventions["cuboid_corners"])
    # Readme of Deep_Object_Pose: seen from the rear (x forward, y left, z up), 4 5 6 7 go around the rear face from the
    # lower left corner over the lower right one, 0 1 2 3 around the front face likewise.
    assert (corners[4:, 0] == -1).all() and (corners[:4, 0] == 1).all()
    for face in (corners[:4], corners[4:]):
        np.testing.assert_array_equal(face[:, 1:], [[1, -1], [-1, -1], [-1, 1], [1, 1]])
    for frame in frames:
        data = json.loads((root / "dope" / "000001" / f"{frame.index:06d}.json").read_text())
        assert (root / "dope" / "000001" / f"{frame.index:06d}.jpg").is_file()
        view = np.array(data["camera_data"]["camera_view_matrix"])
        k = data["camera_data"]["intrinsics"]
        seen = [label for label in frame.targets() if label.pixels_visible]
        for entry, label in zip(data["objects"], seen, strict=True):
            x, y, z, w = entry["quaternion_xyzw"]
            T = transform(rotation_from_quaternion(np.array([w, x, y, z])), tuple(entry["location"]))
            np.testing.assert_allclose(T, view @ np.array(entry["local_to_world_matrix"]), atol=1e-9)
            box = 0.5 * corners * conventions["dimensions"][entry["class"]]
            points = np.vstack([box, np.zeros(3)]) @ T[:3, :3].T + T[:3, 3]
            u, v = (k["fx"] * points[:, 0] / points[:, 2] + k["cx"], k["fy"] * points[:, 1] / points[:, 2] + k["cy"])
            np.testing.assert_allclose(entry["projected_cuboid"], np.stack([u, v], axis=1), atol=1e-6)
            assert entry["visibility"] == label.visible_fraction and entry["name"] == label.name
    assert sorted(map(tuple, corners)) == sorted(map(tuple, BOX_CORNERS.astype(int)))


# ----------------------------------------------------------------------------------------------------------- labels


def test_plain_labels_hold_everything(root: Path, frames: list[LabelledFrame]) -> None:
    folder = root / "labels" / "000001"
    lines = (folder / "trajectory.csv").read_text().splitlines()
    assert len(lines) == 1 + FRAMES and all(line.count(",") == lines[0].count(",") for line in lines)
    for line, frame in zip(lines[1:], frames, strict=True):
        numbers = [float(word) for word in line.split(",")]
        assert numbers[0] == frame.stamp
        np.testing.assert_allclose(numbers[1:4], frame.T_map_camera[:3, 3], atol=1e-9)
        np.testing.assert_allclose(
            rotation_from_quaternion(np.array(numbers[4:8])), frame.T_map_camera[:3, :3], atol=1e-7
        )
        about = json.loads((folder / f"{frame.index:06d}.json").read_text())
        assert about["support"] == [{"carried": a, "carrier": b} for a, b in frame.support]
        assert about["relations"] == [[r.subject, r.name, r.reference] for r in frame.relations]
        assert [entry["name"] for entry in about["objects"]] == [label.name for label in frame.labels]
        assert about["objects"][0]["keypoint_visibility"] == frame.labels[0].keypoint_visibility.tolist()
        assert frame.lidar is not None
        with np.load(folder / f"{frame.index:06d}.npz") as arrays:
            np.testing.assert_array_equal(arrays["ids"], frame.ids)
            np.testing.assert_array_equal(arrays["clean_depth"], frame.clean_depth)
            np.testing.assert_allclose(arrays["normals"] / 127.0, frame.normals, atol=0.5 / 127 + 1e-6)
            np.testing.assert_array_equal(arrays["lidar_instance"], frame.lidar.instances)
            hit = np.isfinite(frame.lidar.scan.ranges)
            np.testing.assert_array_equal(np.isfinite(arrays["lidar_points"]).all(axis=1), hit)
