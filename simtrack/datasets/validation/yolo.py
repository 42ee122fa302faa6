"""YOLO as Ultralytics' own checker reads it: detect, segment and pose (https://docs.ultralytics.com/datasets)."""

import re
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from simtrack.datasets.validation.findings import Entry, Report
from simtrack.recordings.files import image_size, read_bytes

LOW, HIGH = -0.01, 1.01
"""Values beyond make Ultralytics skip the whole image."""
IMAGES = (".jpg", ".jpeg", ".png")


class DataFile(Entry):
    """``data.yaml``."""

    train: str
    val: str
    test: str | None = None
    names: dict[int, str]
    kpt_shape: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=2, le=3)]] | None = None
    flip_idx: list[int] | None = None


def yolo_folders(root: Path) -> list[Path]:
    """Folders with a ``data.yaml``: the given one, or those in it."""
    return [folder for folder in (root, *sorted(p for p in root.iterdir() if p.is_dir()))
            if (folder / "data.yaml").is_file()]  # fmt: skip


def validate_yolo(report: Report, root: Path) -> int:
    """Check all data sets of a folder; returns the number of images of the largest."""
    return max((_validate(report, folder) for folder in yolo_folders(root)), default=0)


def _validate(report: Report, folder: Path) -> int:
    path = folder / "data.yaml"
    data = report.read(path, _yaml)
    about: DataFile | None = None if data is None else report.typed(path, data, DataFile)
    if about is None:
        return 0
    report.equal(path, "names", sorted(about.names), list(range(len(about.names))))
    if about.kpt_shape is not None and about.flip_idx is not None:
        report.equal(path, "flip_idx", sorted(about.flip_idx), list(range(about.kpt_shape[0])))
        twice = [about.flip_idx[k] for k in about.flip_idx] if max(about.flip_idx) < len(about.flip_idx) else []
        report.equal(path, "flip_idx (applied twice)", twice, list(range(len(about.flip_idx))))
    for split in ("train", "val", "test"):
        where = getattr(about, split)
        report.holds(where is None or (folder / where).is_dir(), path, split, where, "a folder of images")
    images = [file for file in sorted((folder / "images").rglob("*")) if file.suffix.lower() in IMAGES]
    for image in images:
        data = report.read(image, read_bytes)
        report.holds(data is None or image_size(data) is not None, image, "", "no image", "a JPEG or PNG image")
        label = folder / "labels" / image.relative_to(folder / "images").with_suffix(".txt")
        _check_labels(report, label, about)
    expected = {folder / "labels" / image.relative_to(folder / "images").with_suffix(".txt") for image in images}
    for file in sorted((folder / "labels").rglob("*.txt")):
        report.holds(file in expected, file, "", "labels", "an image of the same name")
    return len(images)


def _yaml(path: Path) -> object:
    from yaml import YAMLError, safe_load

    try:
        return safe_load(path.read_text(encoding="utf-8"))
    except YAMLError as error:
        raise ValueError(f"no YAML: {error}") from error


def _check_labels(report: Report, path: Path, about: DataFile) -> None:
    text = report.read(path, lambda file: file.read_text(encoding="ascii"))
    lines = [] if text is None else text.splitlines()
    for number, line in enumerate(lines, start=1):
        place = f"line {number}"
        words = line.split()
        if not all(re.fullmatch(r"-?\d+(\.\d+)?(e-?\d+)?", word) for word in words) or not words:
            report.add(path, place, line, "numbers")
            continue
        values = np.array(words[1:], float)
        known = words[0].isdigit() and int(words[0]) in about.names
        report.holds(known, path, f"{place}, class", words[0], f"0 to {len(about.names) - 1}")
        outside = values[(values < LOW) | (values > HIGH)] if about.kpt_shape is None else _beyond(values, about)
        report.holds(len(outside) == 0, path, place, outside[:4].tolist(), "shares of the image, 0 to 1")
        _check_columns(report, path, place, values, about)
    repeated = len(lines) - len(set(lines))
    report.holds(repeated == 0, path, "", f"{repeated} lines twice", "each object once")


def _beyond(values: np.ndarray, about: DataFile) -> np.ndarray:
    """Coordinates outside the image, visibilities left out."""
    assert about.kpt_shape is not None
    count, columns = about.kpt_shape
    points = values[4:]
    if columns == 3 and len(points) == 3 * count:
        points = points.reshape(count, 3)[:, :2].ravel()
    coordinates = np.concatenate([values[:4], points])
    return coordinates[(coordinates < LOW) | (coordinates > HIGH)]


def _check_columns(report: Report, path: Path, place: str, values: np.ndarray, about: DataFile) -> None:
    if about.kpt_shape is None:
        if len(values) != 4:
            good = len(values) >= 6 and len(values) % 2 == 0
            report.holds(good, path, place, f"{len(values)} numbers", "a box of 4, or 3 or more points of 2")
            return
    else:
        count, columns = about.kpt_shape
        expected = 4 + count * columns
        if not report.holds(len(values) == expected, path, place, f"{len(values)} numbers", expected):
            return
        if columns == 3:
            points = values[4:].reshape(count, 3)
            good = np.isin(points[:, 2], (0, 1, 2)).all()
            report.holds(bool(good), path, f"{place}, visibility", points[:, 2].tolist(), "0, 1 or 2")
            hidden = points[points[:, 2] == 0]
            report.holds(not hidden.any(), path, place, hidden.tolist(), "0 0 0 for keypoints that are not labelled")
    if about.kpt_shape is not None or len(values) == 4:
        u, v, w, h = values[:4].tolist()
        slack = 1e-5  # six digits
        inside = min(u - w / 2, v - h / 2) >= -slack and max(u + w / 2, v + h / 2) <= 1 + slack and w > 0 and h > 0
        report.holds(inside, path, f"{place}, box", [u, v, w, h], "a box inside the image")
