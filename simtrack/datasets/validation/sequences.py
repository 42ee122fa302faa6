"""Sequences: lidar scans as KITTI's and SemanticKITTI's, RGB-D as TUM's."""

from pathlib import Path

import numpy as np

from simtrack.contracts import Float64
from simtrack.datasets.validation.findings import Report
from simtrack.recordings.files import image_size, read_bytes, read_depth

ROUNDING = 1e-6


def is_kitti(root: Path) -> bool:
    """Whether a folder looks like KITTI's odometry benchmark."""
    return any((root / "sequences").glob("*/velodyne"))


def validate_kitti(report: Report, root: Path) -> int:
    """Check all sequences; returns the number of scans."""
    names = report.read(root / "labels.yaml", _label_names) if (root / "labels.yaml").exists() else None
    return sum(_kitti_sequence(report, folder, names) for folder in sorted((root / "sequences").iterdir()))


def _label_names(path: Path) -> dict[int, str]:
    import yaml

    return {int(number): str(name) for number, name in yaml.safe_load(path.read_text())["labels"].items()}


def _kitti_sequence(report: Report, folder: Path, names: dict[int, str] | None) -> int:
    scans = sorted((folder / "velodyne").glob("*.bin"))
    report.equal(folder / "velodyne", "", [scan.stem for scan in scans], [f"{k:06d}" for k in range(len(scans))])
    for scan in scans:
        points = report.read(scan, lambda file: _records(file, "<f4", 4))
        if points is None:
            continue
        report.holds(bool(np.isfinite(points).all()), scan, "", "values that are not finite", "x, y, z, reflectance")
        good = len(points) == 0 or (points[:, 3].min() >= 0.0 and points[:, 3].max() <= 1.0)
        report.holds(bool(good), scan, "reflectance", "values beyond", "0 to 1")
        _check_labels(report, folder / "labels" / f"{scan.stem}.label", len(points), names)
    if (folder / "poses.txt").exists():
        for k, T in enumerate(_rows(report, folder / "poses.txt", 12, len(scans))):
            report.rigid(folder / "poses.txt", f"line {k + 1}", np.vstack([T.reshape(3, 4), [0, 0, 0, 1]]))
    if (folder / "times.txt").exists():
        times = _rows(report, folder / "times.txt", 1, len(scans)).ravel()
        report.holds(bool((np.diff(times) > 0).all()), folder / "times.txt", "", "times that go back", "rising ones")
    if (folder / "calib.txt").exists():
        lines = report.read(folder / "calib.txt", lambda file: file.read_text().splitlines()) or []
        entries = {line.partition(":")[0]: line.partition(":")[2].split() for line in lines}
        good = all(len(words) == 12 for words in entries.values()) and {"P0", "Tr"} <= entries.keys()
        if report.holds(good, folder / "calib.txt", "", sorted(entries), "P0 to P3 and Tr, 12 numbers each"):
            Tr = np.vstack([np.array(entries["Tr"], float).reshape(3, 4), [0, 0, 0, 1]])
            report.rigid(folder / "calib.txt", "Tr", Tr)
    return len(scans)


def _records(path: Path, kind: str, columns: int) -> np.ndarray:
    data = read_bytes(path)
    width = np.dtype(kind).itemsize * columns
    if len(data) % width:
        raise ValueError(f"{len(data)} bytes are no multiple of {width}")
    return np.frombuffer(data, kind).reshape(-1, columns)


def _check_labels(report: Report, path: Path, points: int, names: dict[int, str] | None) -> None:
    if not path.parent.is_dir():
        return
    labels = report.read(path, lambda file: _records(file, "<u4", 1))
    if labels is None:
        return
    report.equal(path, "(number)", len(labels), points)
    if names is not None:
        unknown = sorted(set(np.unique(labels & 0xFFFF).tolist()) - names.keys())
        report.holds(not unknown, path, "", f"classes {unknown[:5]}", "those of labels.yaml")


def _rows(report: Report, path: Path, columns: int, rows: int) -> Float64:
    """Numbers of a text file, (rows, columns); none of them if it has another shape."""

    def load(file: Path) -> Float64:
        lines = [line.split() for line in file.read_text().splitlines() if line and not line.startswith("#")]
        values = np.array(lines, float).reshape(len(lines), -1) if lines else np.zeros((0, columns))
        if values.shape != (rows, columns) or not np.isfinite(values).all():
            raise ValueError(f"{values.shape} numbers; expected {rows} lines of {columns} finite ones")
        return values

    values = report.read(path, load)
    return np.zeros((0, columns)) if values is None else values


# ------------------------------------------------------------------------------------------------------------ TUM RGB-D


def tum_folders(root: Path) -> list[Path]:
    """Folders that look like sequences of the TUM benchmark: the given one, or those in it."""
    return [folder for folder in (root, *sorted(p for p in root.iterdir() if p.is_dir()))
            if (folder / "depth.txt").is_file() and (folder / "rgb.txt").is_file()]  # fmt: skip


def validate_tum(report: Report, root: Path) -> int:
    """Check all sequences; returns the number of depth images."""
    return sum(_tum_sequence(report, folder) for folder in tum_folders(root))


def _tum_sequence(report: Report, folder: Path) -> int:
    sizes: set[tuple[int, int]] = set()
    counts: dict[str, int] = {}
    for name in ("rgb.txt", "depth.txt"):
        entries = _listing(report, folder / name)
        counts[name] = len(entries)
        for file in entries:
            if name == "depth.txt":
                depth = report.read(folder / file, lambda path: read_depth(path, 1.0 / 5000.0))
                size = None if depth is None else (depth.shape[1], depth.shape[0])
            else:
                data = report.read(folder / file, read_bytes)
                size = None if data is None else image_size(data)
                report.holds(data is None or size is not None, folder / file, "", "no image", "a JPEG or PNG image")
            sizes |= set() if size is None else {size}
    report.holds(len(sizes) <= 1, folder, "", f"images of the sizes {sorted(sizes)}", "one size")
    if (folder / "groundtruth.txt").exists():
        _check_trajectory(report, folder / "groundtruth.txt")
    return counts["depth.txt"]


def _listing(report: Report, path: Path) -> list[str]:
    """Files of a list of stamps and names."""
    lines = report.read(path, lambda file: file.read_text().splitlines()) or []
    rows = [(k, line.split()) for k, line in enumerate(lines, start=1) if line and not line.startswith("#")]
    files: list[str] = []
    last = -np.inf
    for number, words in rows:
        try:
            stamp, file = float(words[0]), words[1]
        except (ValueError, IndexError):
            report.add(path, f"line {number}", " ".join(words), "a time and a file")
            continue
        report.holds(stamp > last, path, f"line {number}", stamp, f"a time after {last}")
        last = stamp
        files.append(file)
    return files


def _check_trajectory(report: Report, path: Path) -> None:
    def load(file: Path) -> list[list[float]]:
        return [[float(word) for word in line.split()] for line in file.read_text().splitlines()
                if line and not line.startswith("#")]  # fmt: skip

    last = -np.inf
    for k, row in enumerate(report.read(path, load) or [], start=1):
        if report.holds(len(row) == 8, path, f"pose {k}", f"{len(row)} numbers", "time, tx ty tz, qx qy qz qw"):
            report.near(path, f"pose {k}, quaternion", float(np.linalg.norm(row[4:])), 1.0, 1e-3)
            report.holds(row[0] > last, path, f"pose {k}", row[0], f"a time after {last}")
            last = row[0]
