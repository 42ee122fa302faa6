"""What a path holds, found out by itself."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from simtrack.errors import FileFormatError
from simtrack.recordings import bop, clouds, pcap, rgbd_folders, velodyne
from simtrack.recordings.log import SensorLog
from simtrack.recordings.rgbd_folders import CameraOptions

MAX_DEPTH, MAX_LISTED = 4, 3
"""How far below a folder recordings are looked for, and how many are named."""
_MCAP = b"\x89MCAP0\r\n"


@dataclass(frozen=True, slots=True)
class Format:
    """One kind of folder."""

    name: str
    marks: str
    """What tells it, for people."""
    fits: Callable[[Path], bool]
    open: Callable[[Path, CameraOptions], SensorLog]


FOLDERS = (
    Format("BOP scene", "scene_camera.json", lambda f: (f / "scene_camera.json").is_file(), bop.open_bop),
    Format("TUM RGB-D", "depth.txt", lambda f: (f / "depth.txt").is_file(), rgbd_folders.open_tum),
    Format("7-Scenes", "frame-*.depth.png", lambda f: _any(f, "frame-*.depth.png"), rgbd_folders.open_seven_scenes),
    Format("Open3D RGB-D", "depth/*.png", lambda f: _any(f / "depth", "*.png"), rgbd_folders.open_open3d),
    Format(
        "KITTI velodyne",
        "*.bin, velodyne/*.bin or velodyne_points/data/*.bin",
        lambda f: any(_any(f / name, "*.bin") for name in ("", "velodyne", "velodyne_points/data", "data")),
        lambda f, _: clouds.open_kitti(f),
    ),
    Format(
        "PLY scans",
        "*.ply",
        lambda f: _any(f, "*.ply") and not (f / "models_info.json").exists(),  # those are a BOP data set's meshes
        lambda f, _: clouds.open_ply_scans(f),
    ),
)
"""Kinds of folders, the first that fits is taken."""


def find_source(path: Path) -> Path:
    """The one recording that a path is, or that lies below a folder which is none itself.

    Raises:
        FileFormatError: there is none, with what would have been one; or there are several, with their names.
    """
    if not path.exists():
        raise FileFormatError(path, "", "no such file or folder")
    try:
        if path.is_file() or _kind(path) is not None:
            return path
        found = list(islice(_below(path, MAX_DEPTH), MAX_LISTED + 1))
    except OSError as error:
        raise FileFormatError(error.filename or path, "", f"cannot be read: {error.strerror or error}") from error
    if not found:
        raise FileFormatError(path, "", f"holds no recording that is known. Valid: {KNOWN}")
    if len(found) > 1:
        more = " ..." if len(found) > MAX_LISTED else ""
        some = ", ".join(str(part) for part in found[:MAX_LISTED])
        raise FileFormatError(path, "", f"holds several recordings; name one of them: {some}{more}")
    return found[0]


def is_mcap(path: Path) -> bool:
    """Whether a path is to be read as MCAP: it is such a file, or by its name should be one."""
    return path.suffix.lower() == ".mcap" or _head(path).startswith(_MCAP)


def open_log(path: str | Path, options: CameraOptions | None = None) -> SensorLog:
    """Open a recording of one sensor, of whatever format it is; MCAP, which has all of them, has `open_recording`.

    Raises:
        FileFormatError: nothing that is known, with what would have been, or a damaged one.
    """
    path = find_source(Path(path))
    if is_mcap(path):
        raise FileFormatError(
            path, "", "is an MCAP file, of a whole robot: simtrack.recordings.open_recording reads it"
        )
    kind = _kind(path) if path.is_dir() else None
    if kind is not None:
        return kind.open(path, options or CameraOptions())
    if pcap.is_capture(_head(path)):
        return velodyne.open_vlp16(path)
    raise FileFormatError(path, "", f"is no recording of one sensor that is known. Valid: {_SINGLE}")


def _kind(folder: Path) -> Format | None:
    return next((kind for kind in FOLDERS if kind.fits(folder)), None)


def _below(folder: Path, depth: int) -> Iterator[Path]:
    """Recordings in a folder, by name; folders that are one are not looked into, nor are links."""
    for entry in sorted(folder.iterdir()):
        if entry.is_symlink() or entry.name.startswith("."):
            continue
        if entry.is_file():
            if entry.suffix.lower() in (".mcap", ".pcap"):
                yield entry
        elif _kind(entry) is not None:
            yield entry
        elif depth > 1:
            yield from _below(entry, depth - 1)


_SINGLE = "a VLP-16 capture (.pcap), or a folder: " + "; ".join(f"{k.name} ({k.marks})" for k in FOLDERS)
KNOWN = f"an MCAP file, {_SINGLE}"
"""All formats, for people."""


def _any(folder: Path, pattern: str) -> bool:
    return folder.is_dir() and next(folder.glob(pattern), None) is not None


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(8)
    except OSError:
        return b""
