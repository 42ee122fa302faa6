"""Lidar scans that were stored as point clouds in the sensor's frame: KITTI velodyne folders, folders of PLY scans."""

import io
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from simtrack.contracts import NANOSECONDS, Float64, LidarScan
from simtrack.errors import FileFormatError
from simtrack.geometry.transforms import inverse
from simtrack.recordings.files import numbers, read_bytes, read_lines, rigid
from simtrack.recordings.log import PosedFrame, SensorLog

MAX_POINTS = 4_000_000
"""Largest scan."""
MAX_RANGE = 1000.0
"""Metres: points farther away are no returns of a lidar, and count as none."""
NOISE = 0.02
"""Metres, standard deviation of a range where the sensor is not known."""
PERIOD = NANOSECONDS // 10
"""Nanoseconds between scans that carry no stamps: lidars turn ten times a second."""

_Reader = Callable[[Path], tuple[Float64, npt.NDArray[np.float32]]]


def open_kitti(folder: Path) -> SensorLog:
    """A KITTI velodyne folder: scans ``NAME.bin`` in it, in ``velodyne/`` or in ``velodyne_points/data/``.

    Beside the scans' folder may stand ``times.txt`` (seconds, one a line) or KITTI raw's ``timestamps.txt``, and
    ``poses.txt`` (12 numbers a line, T_world_camera of the left camera, with ``calib.txt`` naming ``Tr``; or, without
    ``calib.txt``, those of the lidar itself). Poses of the odometry benchmark are found in its ``poses/00.txt``, too.
    The format has no times of single shots: a scan is taken as if all of it were measured at its stamp.
    """
    scans = folder
    for name in ("velodyne", "velodyne_points/data", "data"):
        if not any(scans.glob("*.bin")) and (folder / name).is_dir():
            scans = folder / name
    files = _files(scans, ".bin")
    around = [folder, scans.parent, scans.parent.parent]
    stamps, poses = _kitti_stamps(around, len(files)), _kitti_poses(folder, len(files))
    return _log(folder, "KITTI velodyne folder", _read_kitti, files, stamps, poses)


def open_ply_scans(folder: Path) -> SensorLog:
    """A folder of scans in PLY files, each in its sensor's frame; the first by name comes first.

    A file ``T_A_B.txt`` (16 numbers) states the pose of scan B.ply in the frame of scan A.ply: A is then the first,
    and the fixed frame is its.
    """
    files = _files(folder, ".ply")
    by_name = {file.stem: file for file in files}
    poses: list[Float64 | None] = [None] * len(files)
    for stated in sorted(folder.glob("T_*_*.txt")):
        match = re.fullmatch(r"T_(\w+)_(\w+)", stated.stem)
        if match is None or not {match[1], match[2]} <= set(by_name):
            continue
        words = [word for _, line in read_lines(stated) for word in line]
        first = by_name[match[1]]
        files = [first, *(file for file in files if file != first)]
        poses = [np.eye(4)] + [None] * (len(files) - 1)
        poses[files.index(by_name[match[2]])] = rigid(numbers(words, 16, stated, "transform"), stated, "transform")
        break
    stamps = [k * PERIOD for k in range(len(files))]
    return _log(folder, "folder of PLY scans", _read_ply, files, stamps, poses)


def scan_of_points(
    points: Float64, intensities: npt.NDArray[np.float32], stamp: int = 0, sequence: int = 0
) -> LidarScan:
    """A scan of (N, 3) points in the sensor's frame, all at one time; points without a range are no returns.

    What a cloud does not tell is told as far as it can be: rings number the points by half degrees of elevation.
    """
    points = np.where(np.isfinite(points).all(axis=1, keepdims=True), points, 0.0)
    ranges: Float64 = np.linalg.norm(points, axis=1)
    returned = np.asarray((ranges > 0.0) & (ranges <= MAX_RANGE))
    directions = np.zeros_like(points)
    directions[:, 0] = 1.0
    directions[returned] = points[returned] / ranges[returned][:, None]
    elevation = np.rad2deg(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))
    return LidarScan(
        stamp=stamp,
        directions=directions.astype(np.float32),
        ranges=np.where(returned, ranges, np.inf).astype(np.float32),
        times=np.zeros(len(points), np.float32),
        rings=np.clip(2.0 * (elevation + 60.0), 0.0, 255.0).astype(np.uint8),
        intensities=np.nan_to_num(intensities).astype(np.float32),
        T_base_lidar=np.eye(4),
        sequence=sequence,
    )


def _log(
    folder: Path,
    kind: str,
    reader: _Reader,
    files: Sequence[Path],
    stamps: Sequence[int],
    poses: Sequence[Float64 | None],
) -> SensorLog:
    posed = any(pose is not None for pose in poses)
    return SensorLog(
        folder, kind, "lidar", len(files), lambda: _scans(reader, files, stamps, poses), posed=posed, noise=NOISE
    )


def _files(folder: Path, suffix: str) -> list[Path]:
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() == suffix)
    if not files:
        raise FileFormatError(folder, "", f"holds no *{suffix} scans")
    return files


def _scans(
    reader: _Reader, files: Sequence[Path], stamps: Sequence[int], poses: Sequence[Float64 | None]
) -> Iterator[PosedFrame]:
    for number, (file, stamp, pose) in enumerate(zip(files, stamps, poses, strict=True)):
        points, intensities = reader(file)
        yield PosedFrame(scan_of_points(points, intensities, stamp, number), pose)


# ---------------------------------------------------------------------------------------------------------------- KITTI


def _read_kitti(path: Path) -> tuple[Float64, npt.NDArray[np.float32]]:
    """Points and intensities 0 to 255 of little-endian float32 x, y, z, reflectance 0 to 1."""
    data = read_bytes(path, 16 * MAX_POINTS)
    if not data or len(data) % 16:
        raise FileFormatError(path, "", f"{len(data)} bytes; a scan is one or more points of four float32, 16 bytes")
    values = np.frombuffer(data, "<f4").reshape(-1, 4)
    return values[:, :3].astype(np.float64), np.float32(255.0) * values[:, 3].astype(np.float32)


def _kitti_stamps(folders: Sequence[Path], count: int) -> list[int]:
    for folder in folders:
        if (folder / "times.txt").is_file():
            path = folder / "times.txt"
            rows = [numbers(words, 1, path, f"line {number}")[0] for number, words in read_lines(path)]
            return _as_many([round(row * NANOSECONDS) for row in rows], count, path)
        if (folder / "timestamps.txt").is_file():
            path = folder / "timestamps.txt"
            return _as_many([_wall_clock(words, path, number) for number, words in read_lines(path)], count, path)
    return [k * PERIOD for k in range(count)]


def _wall_clock(words: list[str], path: Path, number: int) -> int:
    """Nanoseconds since 1970 of KITTI raw's ``2011-09-26 13:02:25.951199337``."""
    from datetime import UTC, datetime

    try:
        second, _, fraction = " ".join(words).partition(".")
        whole = int(datetime.strptime(second, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC).timestamp())
        return whole * NANOSECONDS + int(f"{fraction:0<9.9}" if fraction else "0")
    except ValueError as error:
        raise FileFormatError(path, f"line {number}", "expected a stamp like 2011-09-26 13:02:25.951199337") from error


def _kitti_poses(folder: Path, count: int) -> list[Float64 | None]:
    named = (folder / "poses.txt", folder.resolve().parent.parent / "poses" / f"{folder.resolve().name}.txt")
    path = next((file for file in named if file.is_file()), None)
    if path is None:
        return [None] * count
    poses = [
        rigid(numbers(words, 12, path, f"line {number}"), path, f"line {number}") for number, words in read_lines(path)
    ]
    calibration = folder / "calib.txt"
    if calibration.is_file():
        T_camera_lidar = _kitti_calibration(calibration)
        poses = [T @ T_camera_lidar for T in poses]
        T_first = inverse(T_camera_lidar)  # the world is the first lidar's frame rather than the first camera's
        poses = [T_first @ T for T in poses]
    return list(_as_many(poses, count, path))


def _kitti_calibration(path: Path) -> Float64:
    for number, words in read_lines(path):
        if words[0] in ("Tr:", "Tr_velo_to_cam:"):
            return rigid(numbers(words[1:], 12, path, f"line {number}"), path, f"line {number}")
    raise FileFormatError(path, "Tr", "missing: the line 'Tr:' with the 12 numbers of T_camera_lidar")


def _as_many(rows: list, count: int, path: Path) -> list:
    if len(rows) != count:
        raise FileFormatError(path, "", f"{len(rows)} lines for {count} scans; one a scan is expected")
    return rows


# ------------------------------------------------------------------------------------------------------------------ PLY

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_INTENSITY = ("intensity", "scalar_intensity", "scalar_Intensity", "reflectance")


def _read_ply(path: Path) -> tuple[Float64, npt.NDArray[np.float32]]:
    """The points of a PLY file (http://paulbourke.net/dataformats/ply), and their intensities if it has them."""
    data = read_bytes(path)
    end = data.find(b"end_header")
    body = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or body == 0:
        raise FileFormatError(path, "", "is not a PLY file, or its header is damaged")
    count, columns, order = _ply_layout(data[:end].decode("ascii", "replace").splitlines(), path)
    if order == "ascii":
        values = _ply_text(data[body:], count, columns, path)
    else:
        point = np.dtype([(name, order + kind) for name, kind in columns])
        if len(data) - body < count * point.itemsize:
            reason = f"{count} points of {point.itemsize} bytes are claimed, {len(data) - body} bytes are there"
            raise FileFormatError(path, "element vertex", reason)
        values = np.frombuffer(data, point, count, body)
    points = np.stack([values[axis].astype(np.float64) for axis in "xyz"], axis=1)
    named = next((name for name in _INTENSITY if name in (values.dtype.names or ())), None)
    return points, np.zeros(count, np.float32) if named is None else values[named].astype(np.float32)


def _ply_layout(lines: list[str], path: Path) -> tuple[int, list[tuple[str, str]], str]:
    """Number of vertices, their (name, type) columns, and ``<``, ``>`` or ``ascii``; vertices must come first."""
    orders = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "ascii"}
    order, count, columns, inside = "", -1, [], ""
    for line in lines:
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = orders[words[1]]
            elif words[:1] == ["element"]:
                if count < 0 and words[1] != "vertex":
                    raise FileFormatError(path, f"element {words[1]}", "stands before the vertices")
                inside = words[1]
                count = int(words[2]) if inside == "vertex" else count
            elif words[:1] == ["property"] and inside == "vertex":
                columns.append((words[2], _PLY_TYPES[words[1]]))
        except (KeyError, IndexError, ValueError) as error:
            raise FileFormatError(path, f"header line {line[:60]!r}", "not valid in a PLY file of points") from error
    names = [name for name, _ in columns]
    if not order or not 0 < count <= MAX_POINTS or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        reason = f"expected a format, 1 to {MAX_POINTS} vertices, and properties x, y, z, each once"
        raise FileFormatError(path, "header", reason)
    return count, columns, order


def _ply_text(body: bytes, count: int, columns: list[tuple[str, str]], path: Path) -> np.ndarray:
    try:
        rows = np.loadtxt(io.BytesIO(body), np.float64, max_rows=count, ndmin=2)
    except ValueError as error:
        raise FileFormatError(path, "element vertex", str(error)) from error
    if rows.shape != (count, len(columns)):
        reason = f"{rows.shape[0]} rows of {rows.shape[1]} numbers, expected {count} of {len(columns)}"
        raise FileFormatError(path, "element vertex", reason)
    return rows.view([(name, "f8") for name, _ in columns])[:, 0]
