"""Folders of RGB-D images and of scans: what was written comes back, whatever the format."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simtrack.contracts import Float64, LidarScan, RgbdFrame
from simtrack.geometry.meshes import Mesh, box_mesh
from simtrack.geometry.transforms import exp_so3, interpolate, inverse, transform
from simtrack.objects.export import write_ply
from simtrack.recordings import CameraOptions, PosedFrame, RecordingWarning, open_log
from tests.recordings import samples
from tests.recordings.samples import CAMERA, World, camera_path, lidar_path

Writer = Callable[[Path, Sequence[np.ndarray], Sequence[Float64]], Path]
RGBD: list[tuple[Writer, str, float]] = [
    (samples.write_tum, "TUM RGB-D folder", 1 / 5000),
    (samples.write_seven_scenes, "7-Scenes sequence", 0.001),
    (samples.write_open3d, "Open3D RGB-D folder", 0.001),
]


@pytest.fixture(scope="module")
def depths() -> list[np.ndarray]:
    world = World()
    images = [world.depth(T) for T in camera_path(3)]
    images[1][:10, :20] = 0.0
    return images


def rgbd(entry: PosedFrame) -> RgbdFrame:
    assert isinstance(entry.frame, RgbdFrame)
    return entry.frame


def scan(entry: PosedFrame) -> LidarScan:
    assert isinstance(entry.frame, LidarScan)
    return entry.frame


def pose(entry: PosedFrame) -> Float64:
    assert entry.T_map_sensor is not None
    return entry.T_map_sensor


@pytest.mark.parametrize(("write", "name", "unit"), RGBD, ids=[name for _, name, _ in RGBD])
def test_images_and_poses_come_back(
    write: Writer, name: str, unit: float, depths: list[np.ndarray], tmp_path: Path
) -> None:
    log = open_log(write(tmp_path / "a", depths, camera_path(3)))
    assert (log.format, log.sensor, log.count) == (name, "camera", 3)
    entries = list(log.read())
    for k, (entry, depth, T) in enumerate(zip(entries, depths, camera_path(3), strict=True)):
        frame = rgbd(entry)
        np.testing.assert_allclose(frame.depth, depth, atol=0.51 * unit)
        assert frame.depth.dtype == np.float32 and ((frame.depth == 0.0) == (depth == 0.0)).all()
        np.testing.assert_array_equal(frame.rgb, samples.colour(k, depth.shape))
        assert frame.intrinsics == CAMERA and frame.sequence == k
        np.testing.assert_array_equal(frame.T_base_camera, np.eye(4))
        np.testing.assert_allclose(pose(entry), T, atol=1e-6)
    stamps = [entry.frame.stamp for entry in entries]
    assert stamps == sorted(set(stamps))
    assert [frame.stamp for frame in log.sensor_frames()] == stamps, "a log can be read again"


def test_tum_stamps_are_exact_and_poses_interpolated(depths: list[np.ndarray], tmp_path: Path) -> None:
    path = samples.write_tum(tmp_path / "a", depths, camera_path(3))
    truth = (path / "groundtruth.txt").read_text().splitlines()
    (path / "groundtruth.txt").write_text("\n".join([truth[0], truth[1], truth[3]]))
    (path / "rgb.txt").write_text("1305031102.504000 rgb/0.png\n1305031102.680000 rgb/2.png\n")
    entries = list(open_log(path).read())
    assert [entry.frame.stamp for entry in entries] == [1305031102_500000000 + k * 100_000_000 for k in range(3)]
    first, last = camera_path(3)[0], camera_path(3)[2]
    np.testing.assert_allclose(pose(entries[1]), interpolate(first, last, 0.5), atol=1e-6)
    assert [rgbd(entry).rgb is None for entry in entries] == [False, True, False], (
        "no colour within 20 ms of the second"
    )


def test_frames_beyond_the_trajectory_have_no_pose(depths: list[np.ndarray], tmp_path: Path) -> None:
    path = samples.write_tum(tmp_path / "a", depths, camera_path(3))
    rows = (path / "groundtruth.txt").read_text().splitlines()
    (path / "groundtruth.txt").write_text("\n".join(rows[:2]))
    assert [entry.T_map_sensor is None for entry in open_log(path).read()] == [False, True, True]
    (path / "groundtruth.txt").unlink()
    assert all(entry.T_map_sensor is None for entry in open_log(path).read())


def test_intrinsics_are_the_folders_the_formats_or_the_callers(depths: list[np.ndarray], tmp_path: Path) -> None:
    def first(path: Path, options: CameraOptions | None = None) -> tuple[float, ...]:
        k = rgbd(next(open_log(path, options).read())).intrinsics
        return k.fx, k.fy, k.cx, k.cy

    path = samples.write_tum(tmp_path / "rgbd_dataset_freiburg2_desk", depths, camera_path(3))
    assert first(path, CameraOptions((1.0, 2.0, 3.0, 4.0))) == (1.0, 2.0, 3.0, 4.0)
    (path / "camera.json").unlink()
    assert first(path) == (520.9, 521.0, 325.1, 249.7)
    seven = samples.write_seven_scenes(tmp_path / "seq-01", depths, camera_path(3))
    (seven / "camera.json").unlink()
    assert first(seven) == (585.0, 585.0, 320.0, 240.0)
    unknown = samples.write_open3d(tmp_path / "b", depths, camera_path(3))
    (unknown / "camera_intrinsic.json").unlink()
    with pytest.warns(RecordingWarning, match="--intrinsics"):
        assert first(unknown) == (525.0, 525.0, 319.5, 239.5)
    half = rgbd(next(open_log(path, CameraOptions(depth_unit=0.0001)).read()))
    np.testing.assert_allclose(half.depth, 0.5 * depths[0], atol=2e-4)


# ----------------------------------------------------------------------------------------------------------------- BOP


def write_bop(folder: Path, depths: Sequence[np.ndarray], poses: Sequence[Float64], labels: bool = True) -> Path:
    """A scene below a data set with one model, a brick whose file has its origin beside the box's centre."""
    scene = folder / "test" / "000003"
    cameras, truth, infos = {}, {}, {}
    for k, (depth, T) in enumerate(zip(depths, poses, strict=True)):
        image = 7 * k + 2
        samples.write_png(scene / "depth" / f"{image:06d}.png", samples.units(depth, 0.0001))
        samples.write_png(scene / "rgb" / f"{image:06d}.png", samples.colour(k, depth.shape)[:, :, ::-1])
        T_camera_map = inverse(T)
        cameras[str(image)] = {
            "cam_K": CAMERA.matrix.ravel().tolist(),
            "depth_scale": 0.1,
            "cam_R_w2c": T_camera_map[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000.0 * T_camera_map[:3, 3]).tolist(),
        }
        T = T_camera_map @ brick_pose() @ transform(None, -BRICK_CENTRE)
        entry = {"cam_R_m2c": T[:3, :3].ravel().tolist(), "cam_t_m2c": (1000.0 * T[:3, 3]).tolist(), "obj_id": 4}
        truth[str(image)], infos[str(image)] = [entry], [{"visib_fract": 0.75}]
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    if labels:
        (scene / "scene_gt.json").write_text(json.dumps(truth))
        (scene / "scene_gt_info.json").write_text(json.dumps(infos))
        (folder / "models").mkdir()
        mesh = box_mesh(BRICK)
        write_ply(folder / "models" / "obj_000004.ply", Mesh(mesh.vertices + BRICK_CENTRE, mesh.faces), scale=1000.0)
        half_turn = transform(exp_so3(np.array([0.0, 0.0, np.pi])))
        half_turn[:3, 3] = 1000.0 * (BRICK_CENTRE - half_turn[:3, :3] @ BRICK_CENTRE)
        info = {"4": {"diameter": 350.0, "symmetries_discrete": [half_turn.ravel().tolist()]}}
        (folder / "models" / "models_info.json").write_text(json.dumps(info))
    return scene


BRICK = (0.3, 0.15, 0.1)
BRICK_CENTRE = np.array([0.02, -0.01, 0.05])


def brick_pose() -> Float64:
    """T_map_object, about the centre of the box: on the floor in view of `camera_path`."""
    return transform(exp_so3(np.array([0.0, 0.0, 0.7])), (0.2, 0.6, 0.05))


def test_a_bop_scene_comes_back(depths: list[np.ndarray], tmp_path: Path) -> None:
    log = open_log(write_bop(tmp_path, depths, camera_path(3)))
    assert (log.format, log.count) == ("BOP scene", 3)
    model = log.models["obj_000004"]
    np.testing.assert_allclose(model.extents, BRICK, atol=1e-6)
    np.testing.assert_allclose(model.mesh.bounds.mean(axis=0), 0.0, atol=1e-9)
    assert len(model.symmetries.discrete) == 2
    np.testing.assert_allclose(model.symmetries.discrete[1], np.diag([-1.0, -1.0, 1.0, 1.0]), atol=1e-6)
    for k, (entry, depth, T) in enumerate(zip(log.read(), depths, camera_path(3), strict=True)):
        frame = rgbd(entry)
        np.testing.assert_allclose(frame.depth, depth, atol=6e-5)
        np.testing.assert_array_equal(frame.rgb, samples.colour(k, depth.shape))
        assert frame.intrinsics == CAMERA and frame.sequence == 7 * k + 2
        np.testing.assert_allclose(pose(entry), T, atol=1e-9)
        (label,) = entry.labels
        np.testing.assert_allclose(pose(entry) @ label.T_camera_object, brick_pose(), atol=1e-9)
        assert (label.class_name, label.visible_fraction) == ("obj_000004", 0.75)


def test_a_bop_scene_needs_neither_labels_nor_models(depths: list[np.ndarray], tmp_path: Path) -> None:
    log = open_log(write_bop(tmp_path, depths, camera_path(3), labels=False))
    assert log.models == {} and all(entry.labels == () for entry in log.read())


# -------------------------------------------------------------------------------------------------------------- scans


def test_kitti_scans_stamps_and_poses_come_back(tmp_path: Path) -> None:
    world, poses = World(), lidar_path(3)
    clouds = [world.points(T) for T in poses]
    log = open_log(samples.write_kitti(tmp_path / "00", clouds, poses))
    assert (log.format, log.sensor, log.count) == ("KITTI velodyne folder", "lidar", 3)
    for k, (entry, points, T) in enumerate(zip(log.read(), clouds, poses, strict=True)):
        frame = scan(entry)
        np.testing.assert_allclose(frame.directions * frame.ranges[:, None], points, atol=1e-5)
        assert frame.stamp == k * 100_000_000 and frame.sequence == k
        assert (frame.intensities == 127.5).all() and (np.diff(np.unique(frame.rings)) >= 1).all()
        np.testing.assert_allclose(pose(entry), inverse(poses[0]) @ T, atol=1e-9)


def test_kitti_raw_stamps_and_bare_folders_are_read(tmp_path: Path) -> None:
    clouds = [np.full((5, 3), 1.0 + k) for k in range(2)]
    path = samples.write_kitti(tmp_path / "a", clouds, lidar_path(2))
    scans = path / "velodyne"
    assert [entry.T_map_sensor is None for entry in open_log(scans).read()] == [True, True]
    raw = tmp_path / "raw" / "velodyne_points"
    raw.mkdir(parents=True)
    scans.rename(raw / "data")
    (raw / "timestamps.txt").write_text("2011-09-26 13:02:25.951199337\n2011-09-26 13:02:26\n")
    stamps = [entry.frame.stamp for entry in open_log(tmp_path / "raw").read()]
    assert stamps == [1317042145_951199337, 1317042146_000000000]


@pytest.mark.parametrize("order", ["<", ">", ""])
def test_ply_scans_come_back(order: str, tmp_path: Path) -> None:
    clouds = [np.random.default_rng(k).normal(0.0, 3.0, (50, 3)) for k in range(2)]
    clouds[1][3] = 0.0
    for name, points in zip(("target", "source"), clouds, strict=True):
        samples.write_ply_points(tmp_path / f"{name}.ply", points, order)
    T = transform(exp_so3(np.array([0.1, 0.2, 0.3])), (1.0, 2.0, 3.0))
    (tmp_path / "T_target_source.txt").write_text("\n".join(" ".join(f"{v:.9f}" for v in row) for row in T))
    first, second = (replace(entry) for entry in open_log(tmp_path).read())
    np.testing.assert_allclose(scan(first).directions * scan(first).ranges[:, None], clouds[0], atol=1e-5)
    assert (scan(first).intensities == 77.0).all()
    np.testing.assert_array_equal(pose(first), np.eye(4))
    np.testing.assert_allclose(pose(second), T, atol=1e-6)
    assert np.isinf(scan(second).ranges[3]) and np.isfinite(np.delete(scan(second).ranges, 3)).all()


def test_a_folder_that_holds_one_recording_stands_for_it(depths: list[np.ndarray], tmp_path: Path) -> None:
    write_bop(tmp_path / "set", depths, camera_path(3))
    assert open_log(tmp_path / "set").format == "BOP scene"
    assert open_log(tmp_path).count == 3
