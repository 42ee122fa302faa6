from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from simtrack.contracts import (
    CameraIntrinsics,
    DetectionResult,
    Detector,
    JointState,
    LidarScan,
    Odometry,
    RgbdFrame,
    StaticMap,
    Status,
)
from simtrack.errors import InvalidValueError, OutputExistsError
from simtrack.geometry.kinematics import Joint, KinematicTree, Link
from simtrack.objects import load_object
from simtrack.recordings import McapWriter, RecordedDetector, open_recording, strip_labels
from tests.recordings.feeds import detection_result, feed, joint_state, lidar_scan, odometry, rgbd_frame, same

Record = Callable[..., Path]


def test_every_entry_comes_back_to_the_bit_and_in_the_order_of_arrival(record: Record) -> None:
    entries = feed(np.random.default_rng(1), 6)
    read = list(open_recording(record(entries)).frames())
    assert [type(entry) for entry in read] == [type(entry) for entry in entries]
    assert all(same(a, b) for a, b in zip(read, entries, strict=True))


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**32 - 1),
    stamps=st.lists(st.integers(-(10**18), 10**18), min_size=1, max_size=6),
    size=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    shots=st.integers(0, 40),
)
def test_any_stamps_and_sizes_round_trip(
    tmp_path: Path, seed: int, stamps: list[int], size: tuple[int, int], shots: int
) -> None:
    rng = np.random.default_rng(seed)
    entries = []
    for stamp in stamps:
        frame = rgbd_frame(rng, stamp, color=bool(seed & 1), size=size)
        entries += [frame, lidar_scan(rng, stamp, shots), odometry(rng, stamp), joint_state(rng, stamp)]
        entries.append(detection_result(rng, stamp, seed % 3))
    path = tmp_path / "log.mcap"
    with McapWriter(path, overwrite=True) as log:
        for entry in entries:
            log.write(entry)
    assert all(same(a, b) for a, b in zip(open_recording(path).frames(), entries, strict=True))


def test_degenerate_frames_round_trip(record: Record) -> None:
    none = np.zeros(0, dtype=np.float32)
    camera = CameraIntrinsics(0, 0, 1.0, 1.0, 0.0, 0.0)
    nan = np.full((4, 4), np.nan)
    entries = [
        RgbdFrame(0, np.zeros((0, 0), dtype=np.float32), None, camera, np.eye(4)),
        LidarScan(1, none.reshape(0, 3), none, none, none.astype(np.uint8), none, np.eye(4)),
        JointState(2, (), np.zeros(0)),
        Odometry(3, nan, float("nan"), float("inf")),
        DetectionResult(4, 2**62, (), Status.FAILED),
    ]
    assert all(same(a, b) for a, b in zip(open_recording(record(entries)).frames(), entries, strict=True))


def test_an_arrival_time_neither_reorders_nor_changes_stamps(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    entries = [odometry(rng, stamp) for stamp in (5, 3, 3, 9)]
    with McapWriter(tmp_path / "a.mcap") as log:
        for entry, arrival in zip(entries, (100, 100, 90, 101), strict=True):
            log.write(entry, arrival)
    assert all(same(a, b) for a, b in zip(open_recording(log.path).frames(), entries, strict=True))


def test_what_a_stack_needs_comes_back(record: Record, static_map: StaticMap) -> None:
    rng = np.random.default_rng(4)
    axis = Joint("head_1_joint", "revolute", np.array([0.0, 0.0, 1.0]), -1.2, 1.2, 3.0)
    none = (np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.int32))
    base = Link("base", "", None, np.eye(4), *none, 28.0)
    head = Link("head", "base", axis, np.eye(4), *none, 2.5, (0.1, 0.2, 0.3))
    resources = {
        "static_map": static_map,
        "models": {"klt3147": load_object("klt3147")},
        "robot": KinematicTree((base, head)),
        "metadata": {"scene": "workbench", "configuration": {"seed": 0, "gain": 0.1 + 0.2, "none": None}},
    }
    recording = open_recording(record([odometry(rng, 1)], **resources))
    assert recording.complete
    for name, value in resources.items():
        assert same(getattr(recording, name), value), name
    assert recording.models["klt3147"].mesh.vertices.flags.writeable


def test_a_recording_without_resources_is_only_a_feed(record: Record) -> None:
    recording = open_recording(record([]))
    assert (recording.static_map, recording.robot) == (None, None)
    assert (dict(recording.models), dict(recording.metadata), list(recording.frames())) == ({}, {}, [])


def test_stripping_removes_all_labels_and_nothing_else(tmp_path: Path, static_map: StaticMap) -> None:
    rng = np.random.default_rng(5)
    entries = feed(rng, 4)
    pose = rgbd_frame(rng, 0).T_base_camera
    path, stripped_path = tmp_path / "full.mcap", tmp_path / "stripped.mcap"
    with McapWriter(path, static_map=static_map, metadata={"a": 1, "ground_truth": {"relay": [0, 0, 0]}}) as log:
        for entry in entries:
            log.write(entry)
            log.write_labels(entry.stamp, {"base": np.eye(4), "relay-1": pose})
    strip_labels(path, stripped_path)
    full, stripped = open_recording(path), open_recording(stripped_path)
    labels = list(full.labels())
    assert [stamp for stamp, _ in labels] == [entry.stamp for entry in entries]
    assert list(labels[0][1]) == ["base", "relay-1"]
    np.testing.assert_allclose(labels[0][1]["relay-1"], pose, atol=1e-14)
    assert list(stripped.labels()) == []
    assert b"ground_truth" not in stripped_path.read_bytes()
    assert dict(stripped.metadata) == {"a": 1}
    assert same(stripped.static_map, static_map)
    assert all(same(a, b) for a, b in zip(stripped.frames(), entries, strict=True))


def test_the_recorded_detector_answers_by_stamp(record: Record) -> None:
    rng = np.random.default_rng(6)
    frames = [rgbd_frame(rng, stamp) for stamp in (10, 20, 20, 30)]
    answers = [detection_result(rng, frame.stamp) for frame in frames[:3]]
    recording = open_recording(record([entry for pair in zip(frames, answers, strict=False) for entry in pair]))
    detector = RecordedDetector(recording)
    assert isinstance(detector, Detector)
    assert all(same(detector.detect(f), answer) for f, answer in zip(frames[:3], answers, strict=True))
    assert same(detector.detect(frames[2]), answers[2]), "asked more often than recorded: the last answer stands"
    assert detector.detect(frames[3]) == DetectionResult(30, 30, (), Status.NO_DATA)
    assert all(same(a, b) for a, b in zip(recording.sensor_frames(), frames[:3], strict=True))


def test_the_same_feed_makes_the_same_bytes(record: Record, static_map: StaticMap) -> None:
    entries = feed(np.random.default_rng(7), 3)
    first, second = (record(entries, name, static_map=static_map) for name in ("a.mcap", "b.mcap"))
    assert first.read_bytes() == second.read_bytes()


def test_existing_logs_are_kept_unless_told_otherwise(record: Record) -> None:
    path = record([])
    with pytest.raises(OutputExistsError):
        McapWriter(path)
    McapWriter(path, overwrite=True).close()
    with pytest.raises(OutputExistsError):
        strip_labels(path, path)


def test_misuse_is_named(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "a.mcap") as log:
        with pytest.raises(InvalidValueError, match="SensorFrame"):
            log.write("frame")  # type: ignore[arg-type]
        with pytest.raises(InvalidValueError, match="stamp"):
            log.write(JointState(2**63, (), np.zeros(0)))
        log.close()
    assert list(open_recording(log.path).frames()) == []
