"""What a path holds, found out by itself."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from simtrack.errors import FileFormatError
from simtrack.recordings import clouds, pcap, rgbd_folders, velodyne
from simtrack.recordings.log import SensorLog
from simtrack.recordings.rgbd_folders import CameraOptions

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
    Format("TUM RGB-D", "depth.txt", lambda f: (f / "depth.txt").is_file(), rgbd_folders.open_tum),
    Format("7-Scenes", "frame-*.depth.png", lambda f: _any(f, "frame-*.depth.png"), rgbd_folders.open_seven_scenes),
    Format("Open3D RGB-D", "depth/*.png", lambda f: _any(f / "depth", "*.png"), rgbd_folders.open_open3d),
    Format(
        "KITTI velodyne",
        "*.bin, velodyne/*.bin or velodyne_points/data/*.bin",
        lambda f: any(_any(f / name, "*.bin") for name in ("", "velodyne", "velodyne_points/data", "data")),
        lambda f, _: clouds.open_kitti(f),
    ),
    Format("PLY scans", "*.ply", lambda f: _any(f, "*.ply"), lambda f, _: clouds.open_ply_scans(f)),
)
"""Kinds of folders, the first that fits is taken."""


def is_mcap(path: Path) -> bool:
    """Whether a path is to be read as MCAP: it is such a file, or by its name should be one."""
    return path.suffix.lower() == ".mcap" or _head(path).startswith(_MCAP)


def open_log(path: Path, options: CameraOptions | None = None) -> SensorLog:
    """Open a recording of one sensor, of whatever format it is; MCAP has `open_recording`.

    Raises:
        FileFormatError: nothing that is known, with what would have been, or a damaged one.
    """
    options = options or CameraOptions()
    if path.is_file():
        if pcap.is_capture(_head(path)):
            return velodyne.open_vlp16(path)
        raise FileFormatError(path, "", f"is no recording that is known. Valid: {KNOWN}")
    if not path.is_dir():
        raise FileFormatError(path, "", "no such file or folder")
    for kind in FOLDERS:
        if kind.fits(path):
            return kind.open(path, options)
    parts = [found for found in sorted(path.iterdir()) if found.is_dir() and any(k.fits(found) for k in FOLDERS)]
    if len(parts) == 1:
        return open_log(parts[0], options)
    if parts:
        some = ", ".join(str(part) for part in parts[:3]) + (" ..." if len(parts) > 3 else "")
        raise FileFormatError(path, "", f"holds {len(parts)} recordings; name one of them: {some}")
    raise FileFormatError(path, "", f"is no recording that is known. Valid: {KNOWN}")


KNOWN = "an MCAP file, a VLP-16 capture (.pcap), or a folder: " + "; ".join(f"{k.name} ({k.marks})" for k in FOLDERS)
"""All formats, for people."""


def _any(folder: Path, pattern: str) -> bool:
    return folder.is_dir() and next(folder.glob(pattern), None) is not None


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(8)
    except OSError:
        return b""
