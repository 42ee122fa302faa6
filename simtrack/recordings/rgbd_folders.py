"""Folders of RGB-D images with their trajectory: TUM, 7-Scenes, and Open3D's.

All state poses T_map_camera of the depth image's (registered) optical frame in a fixed frame of their own.
"""

import json
import re
import warnings
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from simtrack.contracts import NANOSECONDS, CameraIntrinsics, Float64, RgbdFrame
from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.geometry.transforms import interpolate, rotation_from_quaternion, transform
from simtrack.recordings.files import inside, numbers, read_bytes, read_depth, read_lines, read_rgb, rigid
from simtrack.recordings.log import PosedFrame, RecordingWarning, SensorLog

_T = TypeVar("_T")

PERIOD = NANOSECONDS // 30
"""Nanoseconds between images that carry no stamps."""
MATCH = 20_000_000
"""Nanoseconds within which a colour image belongs to a depth image (as TUM's associate.py has it)."""
GAP = 250_000_000
"""Nanoseconds between two poses of a trajectory beyond which nothing is interpolated."""
_TUM_CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""fx, fy, cx, cy of the benchmark's three cameras, as its authors publish them."""
_PRIMESENSE = (525.0, 525.0, 319.5, 239.5)
_SEVEN_SCENES = (585.0, 585.0, 320.0, 240.0)


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """What a folder may leave open about its camera."""

    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy in pixels; None takes the folder's own, or those known of its format."""
    depth_unit: float | None = None
    """Metres that 1 stands for in depth images; None takes the format's."""

    def __post_init__(self) -> None:
        given = self.intrinsics
        if given is not None and not (np.isfinite(given).all() and given[0] > 0.0 and given[1] > 0.0):
            raise InvalidValueError("intrinsics", given, "fx, fy, cx, cy in pixels, fx and fy > 0")
        if self.depth_unit is not None and not 0.0 < self.depth_unit <= 1.0:
            raise InvalidValueError("depth_unit", self.depth_unit, "metres that 1 stands for, above 0 and at most 1")


@dataclass(frozen=True, slots=True)
class _Image:
    """One frame's files."""

    stamp: int
    depth: Path
    rgb: Path | None
    T_map_camera: Float64 | None


@dataclass(frozen=True, slots=True)
class _Camera:
    fx_fy_cx_cy: tuple[float, float, float, float]
    unit: float
    missing: int | None = None


def _log(folder: Path, kind: str, images: Sequence[_Image], camera: _Camera) -> SensorLog:
    if not images:
        raise FileFormatError(folder, "", f"holds no depth images of a {kind}")
    posed = any(image.T_map_camera is not None for image in images)
    return SensorLog(folder, kind, "camera", len(images), lambda: _frames(images, camera), posed=posed)


def _frames(images: Sequence[_Image], camera: _Camera) -> Iterator[PosedFrame]:
    for number, image in enumerate(images):
        depth = read_depth(image.depth, camera.unit, camera.missing)
        height, width = depth.shape
        rgb = None if image.rgb is None else read_rgb(image.rgb)
        if rgb is not None and rgb.shape[:2] != depth.shape:
            raise FileFormatError(image.rgb or "", "", f"colour {rgb.shape[:2]} and depth {depth.shape} differ in size")
        intrinsics = CameraIntrinsics(width, height, *camera.fx_fy_cx_cy)
        frame = RgbdFrame(image.stamp, depth, rgb, intrinsics, np.eye(4), number)
        yield PosedFrame(frame, image.T_map_camera)


# ------------------------------------------------------------------------------------------------------------------ TUM


def open_tum(folder: Path, options: CameraOptions) -> SensorLog:
    """A folder of the TUM RGB-D benchmark: ``depth.txt``, and if there are any ``rgb.txt`` and ``groundtruth.txt``.

    Poses are interpolated to the depth images' stamps. Depth has 5000 units a metre. Format:
    https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
    """
    depth = _tum_listing(folder, "depth.txt")
    colors = _tum_listing(folder, "rgb.txt") if (folder / "rgb.txt").is_file() else []
    poses = _tum_poses(folder / "groundtruth.txt") if (folder / "groundtruth.txt").is_file() else []
    images = []
    for stamp, file in depth:
        color = _nearest(colors, stamp)
        images.append(_Image(stamp, file, color, _pose_at(poses, stamp)))
    known = next((value for name, value in _TUM_CAMERAS.items() if name in folder.resolve().name), None)
    camera = _Camera(_intrinsics(folder, options, known), options.depth_unit or 1 / 5000)
    return _log(folder, "TUM RGB-D folder", images, camera)


def _tum_listing(folder: Path, name: str) -> list[tuple[int, Path]]:
    path, rows = folder / name, []
    for number, words in read_lines(path):
        where = f"line {number}"
        if len(words) != 2:
            raise FileFormatError(path, where, "expected a stamp in seconds and a file name")
        rows.append((_nanoseconds(words[0], path, where), inside(folder, words[1], path, where)))
    return sorted(rows, key=lambda row: row[0])


def _nanoseconds(word: str, path: Path, where: str) -> int:
    """Seconds as written, to the nanosecond: a float has no more than a tenth of a microsecond left of 1e9 s."""
    if re.fullmatch(r"\d{1,12}(\.\d*)?", word):
        whole, _, fraction = word.partition(".")
        return int(whole) * NANOSECONDS + int(f"{fraction[:9]:0<9}")
    seconds = numbers([word], 1, path, where)[0]
    if abs(seconds) > 1e9:
        raise FileFormatError(path, where, f"the stamp {word[:40]} is no number of seconds")
    return round(seconds * NANOSECONDS)


def _tum_poses(path: Path) -> list[tuple[int, Float64]]:
    rows = []
    for number, words in read_lines(path):
        where = f"line {number}"
        if len(words) != 8:
            raise FileFormatError(path, where, f"{len(words)} words; expected: stamp tx ty tz qx qy qz qw")
        x, y, z, qx, qy, qz, qw = numbers(words[1:], 7, path, where)
        quaternion = np.array([qw, qx, qy, qz])
        if not 0.9 < np.linalg.norm(quaternion) < 1.1:
            raise FileFormatError(path, where, "qx qy qz qw is not a unit quaternion")
        T = transform(rotation_from_quaternion(quaternion), (x, y, z))
        rows.append((_nanoseconds(words[0], path, where), T))
    return sorted(rows, key=lambda row: row[0])


def _nearest(rows: Sequence[tuple[int, _T]], stamp: int) -> _T | None:
    """Of the row whose stamp is nearest, if it is within `MATCH`."""
    k = bisect_left(rows, stamp, key=lambda row: row[0])
    found = min(rows[max(k - 1, 0) : k + 1], key=lambda row: abs(row[0] - stamp), default=None)
    return found[1] if found is not None and abs(found[0] - stamp) <= MATCH else None


def _pose_at(rows: Sequence[tuple[int, Float64]], stamp: int) -> Float64 | None:
    k = bisect_left(rows, stamp, key=lambda row: row[0])
    if 0 < k < len(rows) and rows[k][0] - rows[k - 1][0] <= GAP:
        (a, T_a), (b, T_b) = rows[k - 1], rows[k]
        return interpolate(T_a, T_b, (stamp - a) / (b - a))
    return _nearest(rows, stamp)


# ------------------------------------------------------------------------------------------------------------- 7-Scenes


def open_seven_scenes(folder: Path, options: CameraOptions) -> SensorLog:
    """A sequence of Microsoft's 7-Scenes: ``frame-000000.depth.png``, ``.color.png`` and ``.pose.txt``.

    Depth is in millimetres, 65535 = no reading; the published colour images are not registered to it.
    """
    images = []
    for number, depth in enumerate(sorted(folder.glob("frame-*.depth.png"))):
        stem = depth.name.removesuffix(".depth.png")
        color, pose = folder / f"{stem}.color.png", folder / f"{stem}.pose.txt"
        T = _matrix_file(pose) if pose.is_file() else None
        images.append(_Image(number * PERIOD, depth, color if color.is_file() else None, T))
    camera = _Camera(_intrinsics(folder, options, _SEVEN_SCENES), options.depth_unit or 0.001, 65535)
    return _log(folder, "7-Scenes sequence", images, camera)


def _matrix_file(path: Path) -> Float64:
    words = [word for _, line in read_lines(path) for word in line]
    return rigid(numbers(words, 16, path, "pose"), path, "pose")


# --------------------------------------------------------------------------------------------------------------- Open3D


def open_open3d(folder: Path, options: CameraOptions) -> SensorLog:
    """A folder as Open3D's examples have it: ``depth/``, ``color/`` (or ``rgb/``, ``image/``), ``trajectory.log``.

    Depth is in millimetres. Of a trajectory, ``trajectory.log`` is read, or else ``odometry.log``.
    """
    depth = sorted((folder / "depth").glob("*.png"))
    beside = next((folder / name for name in ("color", "rgb", "image") if (folder / name).is_dir()), None)
    colors = {} if beside is None else {f.stem: f for f in beside.iterdir() if f.suffix.lower() in (".png", ".jpg")}
    logs = [folder / name for name in ("trajectory.log", "odometry.log") if (folder / name).is_file()]
    poses = _trajectory_log(logs[0]) if logs else {}
    images = [_Image(k * PERIOD, file, colors.get(file.stem), poses.get(k)) for k, file in enumerate(depth)]
    camera = _Camera(_intrinsics(folder, options, None), options.depth_unit or 0.001)
    return _log(folder, "Open3D RGB-D folder", images, camera)


def _trajectory_log(path: Path) -> dict[int, Float64]:
    """T_map_camera by image of Open3D's .log: five lines a pose, the first of which names the image."""
    rows = list(read_lines(path))
    if len(rows) % 5:
        raise FileFormatError(path, "", f"{len(rows)} lines; five a pose are expected: three numbers, then 4 x 4")
    poses = {}
    for k in range(0, len(rows), 5):
        line, words = rows[k]
        image = numbers(words[:1], 1, path, f"line {line}")[0]
        matrix = [word for _, row in rows[k + 1 : k + 5] for word in row]
        poses[int(image)] = rigid(numbers(matrix, 16, path, f"lines {line + 1} to {line + 4}"), path, f"line {line}")
    return poses


# ----------------------------------------------------------------------------------------------------------- intrinsics


def _intrinsics(
    folder: Path, options: CameraOptions, known: tuple[float, float, float, float] | None
) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy: as given, as a file beside the images says, as known of the format, or a PrimeSense camera's."""
    if options.intrinsics is not None:
        return options.intrinsics
    for file in [folder / "camera.json", *sorted(folder.glob("*intrinsic*.json"))]:
        if file.is_file():
            return _intrinsics_file(file)
    if known is None:
        warnings.warn(
            f"{folder} does not say the camera's intrinsics; those of a PrimeSense camera are taken "
            f"(--intrinsics {' '.join(map(str, _PRIMESENSE))})",
            RecordingWarning,
            stacklevel=2,
        )
    return known or _PRIMESENSE


def _intrinsics_file(path: Path) -> tuple[float, float, float, float]:
    """``{"fx": .., "fy": .., "cx": .., "cy": ..}`` or Open3D's ``{"intrinsic_matrix": [9, column by column]}``."""
    reason = "expected an object with fx, fy, cx, cy, or with intrinsic_matrix (9 numbers, column by column)"
    try:
        content = json.loads(read_bytes(path, 100_000))
        if "intrinsic_matrix" in content:
            fx, _, _, _, fy, _, cx, cy, _ = map(float, content["intrinsic_matrix"])
        else:
            fx, fy, cx, cy = (float(content[name]) for name in ("fx", "fy", "cx", "cy"))
        CameraOptions((fx, fy, cx, cy))
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise FileFormatError(path, "", reason) from error
    return fx, fy, cx, cy
