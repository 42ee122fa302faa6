"""Folders that are damaged or made up: one named error each, before memory is taken, and nothing outside is read."""

import json
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.recordings import CameraOptions, open_log
from simtrack.recordings.files import image_size, read_depth, read_rgb
from tests.recordings import samples
from tests.recordings.samples import camera_path, lidar_path
from tests.recordings.test_folders import write_bop

DEPTH = np.full((12, 16), 1.5, np.float32)


def read_all(path: Path) -> None:
    for _ in open_log(path).read():
        pass


def refused(path: Path, match: str) -> None:
    with pytest.raises(FileFormatError, match=match):
        read_all(path)


@pytest.fixture
def tum(tmp_path: Path) -> Path:
    return samples.write_tum(tmp_path / "tum", [DEPTH] * 3, camera_path(3))


@pytest.fixture
def bop(tmp_path: Path) -> Path:
    return write_bop(tmp_path / "set", [DEPTH] * 3, camera_path(3))


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    return samples.write_kitti(tmp_path / "00", [np.ones((9, 3))] * 3, lidar_path(3))


def test_what_is_nothing_is_refused_with_what_would_be(tmp_path: Path) -> None:
    refused(tmp_path / "missing", "no such file or folder")
    refused(tmp_path, r"no recording that is known\. Valid: .*\.pcap.*TUM RGB-D \(depth\.txt\).*BOP|BOP.*TUM")
    (tmp_path / "a.txt").write_text("hello")
    refused(tmp_path / "a.txt", r"a\.txt: is no recording of one sensor")


def test_several_recordings_are_listed(tum: Path, tmp_path: Path) -> None:
    samples.write_tum(tmp_path / "second", [DEPTH], camera_path(1))
    refused(tmp_path, r"name one of them: .*second, .*tum")


@pytest.mark.parametrize("name", ["../secret.png", "depth/../../secret.png", "{outside}", "depth/link.png", "a\0b"])
def test_listings_lead_nowhere_else(tum: Path, name: str) -> None:
    outside = tum.parent / "secret.png"
    samples.write_png(outside, samples.units(DEPTH, 1 / 5000))
    (tum / "depth" / "link.png").symlink_to(outside)
    (tum / "depth.txt").write_text(f"1.0 {name.format(outside=outside)}\n")
    refused(tum, r"depth\.txt: line 1: .*(leads out of|no file name)")


@pytest.mark.parametrize(
    ("file", "text", "match"),
    [
        ("depth.txt", "1.0 depth/0.png extra\n", "line 1: expected a stamp in seconds and a file name"),
        ("depth.txt", "nan depth/0.png\n", "line 1: expected 1 finite numbers"),
        ("depth.txt", "1e300 depth/0.png\n", "line 1: the stamp"),
        ("depth.txt", "1.0 depth/9.png\n", r"9\.png: no such file"),
        ("depth.txt", "# nothing\n", "no depth images"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 1\n", "line 1: 7 words; expected: stamp tx ty tz qx qy qz qw"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0 0\n", "line 1: .*unit quaternion"),
        ("groundtruth.txt", "1.0 inf 0 0 0 0 0 1\n", "line 1: expected 7 finite numbers"),
        ("camera.json", '{"fx": 0, "fy": 1, "cx": 2, "cy": 3}', "camera.json: expected an object with fx, fy, cx, cy"),
        ("camera.json", "[1, 2]", "camera.json: expected an object"),
        ("camera.json", "{", "camera.json: expected an object"),
    ],
)
def test_tum_files_are_checked_line_by_line(tum: Path, file: str, text: str, match: str) -> None:
    (tum / file).write_text(text)
    refused(tum, match)


def test_binary_tables_are_refused(tum: Path) -> None:
    (tum / "depth.txt").write_bytes(b"\xff\xfe\x00")
    refused(tum, "is not text")


def test_images_of_the_wrong_kind_are_refused(tum: Path) -> None:
    samples.write_png(tum / "depth" / "1.png", np.zeros((12, 16), np.uint8))
    refused(tum, r"1\.png: uint8 image .*16-bit")
    samples.write_png(tum / "depth" / "1.png", np.zeros((12, 16), np.uint16))
    samples.write_png(tum / "rgb" / "1.png", np.zeros((12, 15, 3), np.uint8))
    refused(tum, "differ in size")


@pytest.mark.parametrize("keep", [0, 5, 20, 30, 60])
def test_images_that_were_cut_off_are_refused(tum: Path, keep: int) -> None:
    path = tum / "depth" / "2.png"
    path.write_bytes(path.read_bytes()[:keep])
    refused(tum, r"2\.png")


def test_an_image_that_claims_gigapixels_takes_no_memory(tmp_path: Path) -> None:
    def part(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 30_000, 30_000, 16, 0, 0, 0, 0)
    bomb = (
        b"\x89PNG\r\n\x1a\n" + part(b"IHDR", header) + part(b"IDAT", zlib.compress(bytes(10_000))) + part(b"IEND", b"")
    )
    path = tmp_path / "bomb.png"
    path.write_bytes(bomb)
    tracemalloc.start()
    with pytest.raises(FileFormatError, match="claims 30000 x 30000 pixels"):
        read_depth(path, 0.001)
    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()


def test_sizes_are_read_from_headers(tmp_path: Path) -> None:
    import cv2

    image = np.zeros((31, 47, 3), np.uint8)
    for suffix in (".png", ".jpg"):
        assert cv2.imwrite(str(tmp_path / f"a{suffix}"), image)
        assert image_size((tmp_path / f"a{suffix}").read_bytes()) == (47, 31)
        assert read_rgb(tmp_path / f"a{suffix}").shape == image.shape
    assert image_size(b"GIF89a" + bytes(50)) is None


@settings(max_examples=200)
@given(data=st.binary(max_size=60), start=st.sampled_from([b"\xff\xd8\xff", b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b""]))
def test_no_header_breaks_the_reader_of_headers(data: bytes, start: bytes) -> None:
    size = image_size(start + data)
    assert size is None or len(size) == 2


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("frame-000001.pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n", "expected 16 finite numbers"),
        ("frame-000001.pose.txt", " ".join(["2"] * 16), "not a rigid transform"),
        ("frame-000001.pose.txt", " ".join(["nan"] * 16), "expected 16 finite numbers"),
    ],
)
def test_seven_scenes_poses_are_checked(tmp_path: Path, name: str, text: str, match: str) -> None:
    path = samples.write_seven_scenes(tmp_path / "a", [DEPTH] * 2, camera_path(2))
    (path / name).write_text(text)
    refused(path, match)


def test_open3d_trajectories_are_checked(tmp_path: Path) -> None:
    path = samples.write_open3d(tmp_path / "a", [DEPTH] * 2, camera_path(2))
    rows = (path / "trajectory.log").read_text().splitlines()
    (path / "trajectory.log").write_text("\n".join(rows[:-1]))
    refused(path, r"trajectory\.log: 9 lines; five a pose")
    (path / "trajectory.log").write_text("\n".join([*rows[:6], "0 0 0 0", *rows[7:]]))
    refused(path, r"trajectory\.log: line 6: not a rigid transform")


# ----------------------------------------------------------------------------------------------------------------- BOP


def _set(document: dict, image: str, field: str, value: object) -> dict:
    document[image][field] = value
    return document


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda d: _set(d, "9", "cam_K", [1.0] * 8), r"scene_camera\.json: 9\.cam_K: expected 9 finite numbers"),
        (lambda d: _set(d, "9", "cam_K", "K"), r"9\.cam_K: expected a list of 9 numbers"),
        (lambda d: _set(d, "9", "cam_K", [-1.0] * 9), r"9\.cam_K: focal lengths"),
        (lambda d: _set(d, "9", "depth_scale", 0), r"9\.depth_scale: expected millimetres"),
        (lambda d: _set(d, "9", "depth_scale", True), r"9\.depth_scale: expected millimetres"),
        (lambda d: _set(d, "9", "cam_R_w2c", [0.0] * 9), r"9\.cam_R_w2c: not a rigid transform"),
        (lambda d: d | {"../x": {}}, r"\.\./x: expected the number of an image"),
        (lambda d: d | {"77": []}, "77: expected the number of an image and an object"),
        (lambda d: [d], "expected an object with an entry an image"),
        (lambda d: {}, "names no image"),
    ],
)
def test_bop_cameras_are_checked(bop: Path, change: Callable[[dict], object], match: str) -> None:
    path = bop / "scene_camera.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    refused(bop, match)


@pytest.mark.parametrize(
    ("entry", "match"),
    [
        ({"obj_id": "4"}, "obj_id: expected the number of a model"),
        ({"obj_id": 4}, r"2\.cam_R_m2c: expected a list of 9 numbers"),
        ([], "obj_id: expected the number of a model"),
    ],
)
def test_bop_labels_are_checked(bop: Path, entry: object, match: str) -> None:
    (bop / "scene_gt.json").write_text(json.dumps({"2": [entry]}))
    refused(bop, match)


def test_bop_models_are_checked(bop: Path) -> None:
    models = bop.parent.parent / "models"
    ply, info = models / "obj_000004.ply", models / "models_info.json"
    good = ply.read_bytes()
    info.write_text('{"4": {"symmetries_discrete": [[1, 2]]}}')
    refused(bop, r"models_info\.json: 4\.matrix: expected 16 finite numbers")
    info.write_text("{")
    refused(bop, r"models_info\.json: not JSON")
    info.unlink()
    samples_in_metres = good.replace(struct.pack("<f", 170.0), struct.pack("<f", 170_000.0))
    ply.write_bytes(samples_in_metres)
    refused(bop, "BOP models are in millimetres")


def test_deep_json_is_refused(bop: Path) -> None:
    (bop / "scene_camera.json").write_text("[" * 200_000)
    refused(bop, "not JSON")


# -------------------------------------------------------------------------------------------------------------- clouds


@pytest.mark.parametrize(
    ("file", "content", "match"),
    [
        ("velodyne/000001.bin", b"", "0 bytes"),
        ("velodyne/000001.bin", bytes(17), "17 bytes; a scan is one or more points of four float32"),
        ("times.txt", b"0\n1\n", r"times\.txt: 2 lines for 3 scans"),
        ("times.txt", b"0\n1\nx\n", r"times\.txt: line 3: expected 1 numbers"),
        ("poses.txt", b"1 2 3\n", r"poses\.txt: line 1: expected 12 finite numbers"),
        ("calib.txt", b"P0: 1 2\n", r"calib\.txt: Tr: missing"),
        ("calib.txt", b"Tr: 1 2\n", r"calib\.txt: line 1: expected 12 finite numbers"),
    ],
)
def test_kitti_files_are_checked(kitti: Path, file: str, content: bytes, match: str) -> None:
    (kitti / file).write_bytes(content)
    refused(kitti, match)


def test_points_that_are_not_finite_are_no_returns(kitti: Path) -> None:
    values = np.array([[np.nan, 0, 0, 0], [np.inf, 1, 1, np.nan], [1e30, 0, 0, 1], [0, 0, 0, 1], [3, 4, 0, 1]], "<f4")
    (kitti / "velodyne" / "000000.bin").write_bytes(values.tobytes())
    frame = next(open_log(kitti).sensor_frames())
    np.testing.assert_array_equal(frame.ranges, [np.inf] * 4 + [5.0])  # type: ignore[union-attr]
    assert np.isfinite(frame.directions).all() and np.isfinite(frame.intensities).all()  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("header", "match"),
    [
        (b"plx\n", "not a PLY file"),
        (b"ply\nformat ascii 1.0\n", "not a PLY file"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 1\nend_header\n", "element face: stands before"),
        (b"ply\nformat zip 1.0\nend_header\n", "header line 'format zip 1.0'"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "header: expected a format"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n", "header line"),
        (b"ply\nformat ascii 1.0\nelement vertex 999999999999\nend_header\n", "header: expected a format, 1 to"),
    ],
)
def test_ply_headers_are_checked(tmp_path: Path, header: bytes, match: str) -> None:
    (tmp_path / "a.ply").write_bytes(header)
    refused(tmp_path, match)


def test_ply_bodies_must_hold_what_is_claimed(tmp_path: Path) -> None:
    points = np.arange(30.0).reshape(10, 3)
    for order in ("<", ""):
        samples.write_ply_points(tmp_path / "a.ply", points, order)
        data = (tmp_path / "a.ply").read_bytes()
        (tmp_path / "a.ply").write_bytes(data[:-20])
        refused(tmp_path, "element vertex")


@settings(max_examples=80)
@given(at=st.integers(0, 400), flip=st.integers(1, 255))
def test_flipped_bytes_of_a_ply_are_refused_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, at: int, flip: int
) -> None:
    folder = tmp_path_factory.getbasetemp() / "flipped"
    samples.write_ply_points(folder / "a.ply", np.arange(60.0).reshape(20, 3))
    data = bytearray((folder / "a.ply").read_bytes())
    data[at % len(data)] ^= flip
    (folder / "a.ply").write_bytes(bytes(data))
    try:
        for frame in open_log(folder).sensor_frames():
            assert np.isfinite(frame.directions).all()  # type: ignore[union-attr]
    except FileFormatError as error:
        assert "a.ply" in str(error)


def test_options_outside_their_domain_are_named() -> None:
    with pytest.raises(InvalidValueError, match="intrinsics"):
        CameraOptions(intrinsics=(0.0, 1.0, 2.0, 3.0))
    with pytest.raises(InvalidValueError, match="intrinsics"):
        CameraOptions(intrinsics=(float("nan"), 1.0, 2.0, 3.0))
    with pytest.raises(InvalidValueError, match="depth_unit"):
        CameraOptions(depth_unit=0.0)
