"""Recordings without a robot: they make a map, later frames are found in it, and what is new stands out."""

import csv
import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

from simtrack.contracts import Float64
from simtrack.errors import FileFormatError, OutputExistsError
from simtrack.evaluation.metrics import Metrics, read_metrics
from simtrack.evaluation.sensor_replay import SensorReplay
from simtrack.geometry.meshes import box_mesh, transformed
from simtrack.geometry.transforms import perturb, transform
from simtrack.recordings import RecordingWarning, open_log
from tests.recordings import samples
from tests.recordings.samples import World, camera_path, furnished_room, lidar_path
from tests.recordings.test_folders import BRICK, brick_pose, write_bop


def replayed(source: Path, out: Path) -> tuple[Metrics, list[dict[str, str]]]:
    """Metrics and the rows of ``frames.csv``."""
    metrics, stopped = SensorReplay(open_log(source), out).run()
    assert not stopped
    written = read_metrics(out / "metrics.json")
    assert {name: m.value for name, m in metrics.items()} == {name: m.value for name, m in written.items()}
    return metrics, rows_of(out)


def rows_of(out: Path) -> list[dict[str, str]]:
    with (out / "frames.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def value(metrics: Metrics, name: str) -> float:
    number = metrics[name].value
    assert number is not None, f"{name}: {metrics[name].reason}"
    return float(number)


def noisy(depth: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.where(depth > 0.0, depth + 0.0008 * depth**2 * rng.normal(size=depth.shape), 0.0).astype(np.float32)


def write_sequence(folder: Path, poses: list[Float64], world: World | None = None) -> Path:
    world = world or World()
    return samples.write_tum(folder, [noisy(world.depth(T), k) for k, T in enumerate(poses)], poses)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("sequence") / "tum", camera_path(6))


def test_a_camera_is_localized_in_its_first_image(sequence: Path, tmp_path: Path) -> None:
    metrics, rows = replayed(sequence, tmp_path / "out")
    assert [row["status"] for row in rows] == ["map"] + ["ok"] * 5
    assert value(metrics, "localization.located") == 1.0
    assert value(metrics, "localization.translation_error.p95") < 0.01
    assert value(metrics, "localization.rotation_error.p95") < np.deg2rad(0.4)
    assert value(metrics, "map.residual.median") < 0.01 and value(metrics, "map.explained") > 0.9
    assert value(metrics, "depth.difference.median") < 0.02
    assert value(metrics, "presegmentation.unknown") < 0.05
    assert value(metrics, "run.frames") == 6 and metrics["run.partial"].value is False
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())
    estimates = (tmp_path / "out" / "estimates.csv").read_text().splitlines()
    assert len(estimates) == 7 and estimates[0].startswith("stamp_ns,status,x,y,z,qw")
    position = np.array([float(v) for v in estimates[-1].split(",")[2:5]])
    np.testing.assert_allclose(position, camera_path(6)[-1][:3, 3], atol=0.01)
    assert (tmp_path / "out" / "map.ply").read_bytes().startswith(b"ply")


def test_without_poses_it_is_localized_all_the_same(sequence: Path, tmp_path: Path) -> None:
    shutil.copytree(sequence, tmp_path / "tum")
    (tmp_path / "tum" / "groundtruth.txt").unlink()
    metrics, rows = replayed(tmp_path / "tum", tmp_path / "out")
    assert [row["status"] for row in rows[1:]] == ["ok"] * 5
    assert metrics["localization.translation_error.median"].value is None
    assert value(metrics, "localization.residual.median") < 0.01
    last = (tmp_path / "out" / "estimates.csv").read_text().splitlines()[-1].split(",")
    relative = np.linalg.inv(camera_path(6)[0]) @ camera_path(6)[-1]
    np.testing.assert_allclose([float(v) for v in last[2:5]], relative[:3, 3], atol=0.01)


def test_wrong_poses_show(sequence: Path, tmp_path: Path) -> None:
    """Residuals at the stated poses are no self-fulfilling ones."""
    shutil.copytree(sequence, tmp_path / "tum")
    poses = [camera_path(6)[0], *(perturb(T, np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0])) for T in camera_path(6)[1:])]
    shifted = samples.write_tum(tmp_path / "shifted", [np.ones((2, 2), np.float32)] * 6, poses)
    shutil.copy(shifted / "groundtruth.txt", tmp_path / "tum" / "groundtruth.txt")
    metrics, _ = replayed(tmp_path / "tum", tmp_path / "out")
    assert value(metrics, "localization.translation_error.median") == pytest.approx(0.1, abs=0.01)
    assert value(metrics, "localization.residual.median") < 0.01 < 0.03 < value(metrics, "map.residual.median")


def test_what_was_brought_in_is_unknown(tmp_path: Path) -> None:
    poses = camera_path(4)
    brought = transformed(box_mesh((0.3, 0.3, 0.5)), transform(None, (0.2, 0.3, 0.25)))
    before, after = World(), World(furnished_room(), brought)
    depths = [noisy((before if k < 2 else after).depth(T), k) for k, T in enumerate(poses)]
    shown = [np.mean(np.abs(after.depth(T) - before.depth(T)) > 0.05) for T in poses]
    _, rows = replayed(samples.write_tum(tmp_path / "tum", depths, poses), tmp_path / "out")
    unknown = [float(row["unknown"]) for row in rows[1:]]
    assert unknown[0] < 0.02
    for k in (2, 3):
        assert unknown[k - 1] == pytest.approx(shown[k], abs=0.02) and shown[k] > 0.03
        assert int(rows[k]["regions"]) >= 1


def test_the_map_grows_where_the_camera_looks_past_it(tmp_path: Path) -> None:
    poses = [perturb(camera_path(1)[0], np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.09 * k])) for k in range(8)]
    metrics, rows = replayed(write_sequence(tmp_path / "tum", poses), tmp_path / "out")
    faces = [int(row["map_faces"]) for row in rows]
    assert faces == sorted(faces) and faces[-1] > 1.3 * faces[0]
    assert 1 < value(metrics, "map.frames") < 8
    assert [row["status"] for row in rows[1:]] == ["ok"] * 7
    assert value(metrics, "localization.translation_error.p95") < 0.02


def test_views_far_apart_are_compared_but_not_followed(tmp_path: Path) -> None:
    poses = camera_path(4)
    poses[2] = perturb(poses[2], np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    metrics, rows = replayed(write_sequence(tmp_path / "tum", poses), tmp_path / "out")
    assert [row["status"] for row in rows] == ["map", "ok", "jump", "jump"]
    assert value(metrics, "localization.located") == 1.0
    assert float(rows[3]["residual_median"] or "nan") != 0.0 and float(rows[3]["explained"]) > 0.9


def test_a_bop_scene_feeds_the_tracker(tmp_path: Path) -> None:
    brick = transformed(box_mesh(BRICK), brick_pose())
    world, poses = World(furnished_room(), brick), camera_path(12)
    scene = write_bop(tmp_path / "set", [noisy(world.depth(T), k) for k, T in enumerate(poses)], poses)
    metrics, _ = replayed(scene, tmp_path / "out")
    assert value(metrics, "objects.depth_difference.median") < 0.01
    assert value(metrics, "tracking.recall") >= 0.5, "believed after some confirmations"
    assert value(metrics, "tracking.translation_error.median") < 0.008, "better than the hypotheses, 17 mm off"
    assert value(metrics, "localization.translation_error.median") < 0.01


def test_a_lidar_is_localized_in_its_first_turn(tmp_path: Path) -> None:
    world, poses, rng = World(), lidar_path(4), np.random.default_rng(0)
    clouds = [world.points(T, columns=1808) for T in poses]
    clouds = [points + 0.004 * rng.normal(size=points.shape) for points in clouds]
    metrics, rows = replayed(samples.write_kitti(tmp_path / "00", clouds, poses), tmp_path / "out")
    assert [row["status"] for row in rows] == ["map"] + ["ok"] * 3
    assert value(metrics, "localization.translation_error.p95") < 0.01
    assert value(metrics, "localization.rotation_error.p95") < np.deg2rad(0.3)
    assert value(metrics, "localization.residual.median") < 0.01
    assert "depth.difference.median" not in metrics


# ----------------------------------------------------------------------------------------------------------- real data


def test_the_real_vlp16_capture(real_data: Path, tmp_path: Path) -> None:
    file = real_data / "mrpt_vlp16.pcap"
    if not file.is_file():
        pytest.skip(f"no {file}")
    metrics, rows = replayed(file, tmp_path / "out")
    assert [row["status"] for row in rows] == ["map", "ok", "ok", "ok"]
    assert value(metrics, "localization.residual.median") < 0.01
    assert value(metrics, "localization.residual.p95") < 0.03
    assert value(metrics, "map.explained") > 0.8
    estimates = (tmp_path / "out" / "estimates.csv").read_text().splitlines()[1:]
    positions = np.array([[float(v) for v in row.split(",")[2:5]] for row in estimates])
    assert np.linalg.norm(positions, axis=1).max() < 0.01, "the sensor stood still"


def test_the_real_pair_of_scans(real_data: Path, tmp_path: Path) -> None:
    folder = real_data / "small_gicp"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    metrics, _ = replayed(folder, tmp_path / "out")
    assert value(metrics, "localization.translation_error.median") < 0.04, "of half a metre"
    assert value(metrics, "localization.rotation_error.median") < np.deg2rad(0.5)
    assert value(metrics, "localization.residual.median") < 0.03


def test_the_real_rgbd_frames(real_data: Path, tmp_path: Path) -> None:
    folder = real_data / "open3d_rgbd"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    with pytest.warns(RecordingWarning, match="intrinsics"):
        metrics, rows = replayed(folder, tmp_path / "out")
    assert [row["status"] for row in rows] == ["map", "ok", "ok", "ok", "ok"]
    assert value(metrics, "map.residual.median") < 0.01 and value(metrics, "map.residual.p95") < 0.03
    assert value(metrics, "depth.difference.median") < 0.02
    assert value(metrics, "localization.translation_error.p95") < 0.01
    assert value(metrics, "localization.rotation_error.p95") < np.deg2rad(0.3)
    assert value(metrics, "presegmentation.unknown") < 0.05


# ----------------------------------------------------------------------------------------------------------------- harm


def test_a_damaged_frame_leaves_what_came_before(sequence: Path, tmp_path: Path) -> None:
    shutil.copytree(sequence, tmp_path / "tum")
    (tmp_path / "tum" / "depth" / "3.png").write_bytes(b"\x89PNG")
    with pytest.raises(FileFormatError, match=r"3\.png"):
        SensorReplay(open_log(tmp_path / "tum"), tmp_path / "out").run()
    metrics = read_metrics(tmp_path / "out" / "metrics.json")
    assert metrics["run.partial"].value is True and metrics["run.frames"].value == 3
    assert len(rows_of(tmp_path / "out")) == 3


def test_an_interrupted_replay_keeps_what_it_has(sequence: Path, tmp_path: Path) -> None:
    def interrupt(progress: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    metrics, stopped = SensorReplay(open_log(sequence), tmp_path / "out", on_progress=interrupt).run()
    assert stopped and metrics["run.partial"].value is True
    assert len(rows_of(tmp_path / "out")) == metrics["run.frames"].value == 2


def test_what_sees_nothing_leaves_nothing_behind(tmp_path: Path) -> None:
    blank = samples.write_tum(tmp_path / "tum", [np.zeros((12, 16), np.float32)] * 3, camera_path(3))
    with pytest.raises(FileFormatError, match=r"no frame of this TUM RGB-D folder sees a surface"):
        SensorReplay(open_log(blank), tmp_path / "out").run()
    assert not (tmp_path / "out").exists()


def test_blank_frames_are_passed_over(tmp_path: Path) -> None:
    poses = camera_path(5)
    depths = [noisy(World().depth(T), k) for k, T in enumerate(poses)]
    depths[0][:] = depths[3][:] = 0.0
    _, rows = replayed(samples.write_tum(tmp_path / "tum", depths, poses), tmp_path / "out")
    assert [row["status"] for row in rows] == ["map", "ok", "no-data", "ok"]


def test_older_results_are_kept_unless_told_otherwise(sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(OutputExistsError):
        SensorReplay(open_log(sequence), tmp_path).run()
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    SensorReplay(open_log(sequence), tmp_path, overwrite=True).run()
    assert (tmp_path / "mine.txt").read_text() == "keep" and (tmp_path / "frames.csv").is_file()
