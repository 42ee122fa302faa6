"""Formats with one JSON file an image: simtrack's own labels and DOPE's. Poses, boxes and keypoints have to agree."""

import csv
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from simtrack.contracts import Float64
from simtrack.datasets.validation.findings import Entry, Report
from simtrack.datasets.validation.masks import box
from simtrack.geometry.transforms import apply, rotation_from_quaternion
from simtrack.objects.model import box_keypoints
from simtrack.recordings.files import image_size, read_bytes

PIXEL = 1e-3
"""Pixels to which a projected point is the same."""
METRE = 1e-6

Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix = Annotated[list[Row], Field(min_length=4, max_length=4)]


class _Intrinsics(Entry):
    fx: Annotated[float, Field(gt=0)]
    fy: Annotated[float, Field(gt=0)]
    cx: float
    cy: float

    def project(self, points: Float64) -> Float64:
        """(N, 2) pixels of (N, 3) points; NaN behind the camera."""
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        return np.stack([self.fx * points[:, 0] / z + self.cx, self.fy * points[:, 1] / z + self.cy], axis=1)


class _Object(Entry):
    instance: int
    name: str
    T_map_object: Matrix
    T_camera_object: Matrix
    extents: tuple[float, float, float]
    pixels_all: int
    pixels_visible: int
    visible_fraction: float
    box_visible: tuple[int, int, int, int] | None
    keypoints: list[tuple[float, float]]
    keypoint_visibility: list[Annotated[int, Field(ge=0, le=2)]]


class _Labels(Entry):
    stamp: int
    intrinsics: _Intrinsics
    T_map_camera: Matrix
    names: list[str]
    categories: list[int]
    objects: list[_Object]
    support: list[dict[str, str]]
    relations: list[tuple[str, str, str]]


def is_labels(root: Path) -> bool:
    """Whether a folder holds simtrack's own labels."""
    return any(root.glob("*/trajectory.csv"))


def validate_labels(report: Report, root: Path) -> int:
    """Check all scenes; returns the number of images."""
    count = 0
    for folder in sorted(path.parent for path in root.glob("*/trajectory.csv")):
        stamps: list[int] = []
        for path in sorted(folder.glob("[0-9]*.json")):
            labels: _Labels | None = report.document(path, _Labels)
            arrays = report.read(path.with_suffix(".npz"), _arrays)
            if labels is not None and arrays is not None:
                stamps.append(labels.stamp)
                _check_labels(report, path, labels, arrays)
            count += 1
        found = report.read(folder / "trajectory.csv", _stamps) or []
        report.equal(folder / "trajectory.csv", "stamp", found, stamps)
    return count


def _arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _stamps(path: Path) -> list[int]:
    with path.open(encoding="ascii", newline="") as stream:
        return [int(row["stamp"]) for row in csv.DictReader(stream)]


def _check_labels(report: Report, path: Path, labels: _Labels, arrays: dict[str, np.ndarray]) -> None:
    archive, ids = path.with_suffix(".npz"), arrays.get("ids")
    if not report.holds(ids is not None and ids.ndim == 2, archive, "ids", "nothing", "an image of ids"):
        return
    assert ids is not None
    good = ids.size == 0 or (int(ids.min()) >= -1 and int(ids.max()) < len(labels.names))
    report.holds(good, archive, "ids", [int(ids.min()), int(ids.max())], f"-1 to {len(labels.names) - 1}")
    report.equal(path, "categories (length)", len(labels.categories), len(labels.names))
    normals = arrays.get("normals")
    if normals is not None:
        lengths = np.linalg.norm(normals.astype(float) / 127.0, axis=-1)
        good = bool(((np.abs(lengths - 1.0) < 0.02) | (lengths == 0.0)).all())
        report.holds(good, archive, "normals", "vectors of other lengths", "unit vectors times 127, or 0")
    T_map_camera = np.array(labels.T_map_camera)
    report.rigid(path, "T_map_camera", T_map_camera)
    for k, thing in enumerate(labels.objects):
        place = f"objects.{k}"
        report.equal(path, f"{place}.name", thing.name, labels.names[thing.instance])
        seen = ids == thing.instance
        report.equal(path, f"{place}.pixels_visible", thing.pixels_visible, int(np.count_nonzero(seen)))
        report.equal(path, f"{place}.box_visible", thing.box_visible, box(seen))
        share = thing.pixels_visible / thing.pixels_all if thing.pixels_all else 0.0
        report.near(path, f"{place}.visible_fraction", thing.visible_fraction, share, 1e-9)
        T = np.array(thing.T_camera_object)
        if report.rigid(path, f"{place}.T_camera_object", T):
            off = float(np.abs(T_map_camera @ T - np.array(thing.T_map_object)).max())
            report.holds(off < METRE, path, f"{place}.T_map_object", f"{off:.2g} off", "T_map_camera T_camera_object")
            expected = labels.intrinsics.project(apply(T, box_keypoints(np.array(thing.extents))))
            _check_points(report, path, f"{place}.keypoints", thing.keypoints, expected)


def _check_points(report: Report, path: Path, field: str, found: Any, expected: Float64) -> None:
    """Points have to lie where they are projected to; those behind the camera may lie anywhere."""
    if not found:  # distractors have none
        return
    points = np.array(found, float)
    if report.equal(path, f"{field} (number)", len(points), len(expected)):
        apart = np.abs(points - expected)
        off = float(np.nanmax(np.where(np.isfinite(expected), apart, 0.0)))
        report.holds(off <= PIXEL * max(1.0, np.abs(points[np.isfinite(points)]).max(initial=1.0) / 1e3), path, field,
                     f"points {off:.3g} px off", "the box's corners and centre, projected")  # fmt: skip


# ----------------------------------------------------------------------------------------------------------------- DOPE


class _DopeCamera(Entry):
    width: int
    height: int
    intrinsics: _Intrinsics


Signs = tuple[int, int, int]


class _DopeObject(Entry):
    model_config = Entry.model_config | {"populate_by_name": True}
    kind: Annotated[str, Field(alias="class")]
    visibility: Annotated[float, Field(ge=0, le=1)]
    location: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]
    projected_cuboid: Annotated[list[tuple[float, float]], Field(min_length=9, max_length=9)]


class _DopeImage(Entry):
    camera_data: _DopeCamera
    objects: list[_DopeObject]


class _Conventions(Entry):
    cuboid_corners: Annotated[list[Signs], Field(min_length=8, max_length=8)]
    dimensions: dict[str, tuple[float, float, float]]


def validate_dope(report: Report, root: Path) -> int:
    """Check all images; returns their number."""
    conventions: _Conventions | None = report.document(root / "conventions.json", _Conventions)
    paths = sorted(root.glob("*/[0-9]*.json"))
    for path in paths:
        document: _DopeImage | None = report.document(path, _DopeImage)
        if document is None:
            continue
        image = next((path.with_suffix(s) for s in (".jpg", ".png") if path.with_suffix(s).exists()), None)
        if report.holds(image is not None, path, "", "no image beside it", "a JPEG or PNG image"):
            assert image is not None
            data = report.read(image, read_bytes)
            size = (document.camera_data.width, document.camera_data.height)
            report.equal(image, "(size)", image_size(data) if data else None, size)
        for k, thing in enumerate(document.objects):
            if conventions is not None:
                _check_cuboid(report, path, f"objects.{k}", thing, document.camera_data.intrinsics, conventions)
    return len(paths)


def _check_cuboid(
    report: Report, path: Path, place: str, thing: _DopeObject, camera: _Intrinsics, conventions: _Conventions
) -> None:
    extents = conventions.dimensions.get(thing.kind)
    known = sorted(conventions.dimensions)
    if not report.holds(extents is not None, path, f"{place}.class", thing.kind, f"one of {known}"):
        return
    x, y, z, w = thing.quaternion_xyzw
    length = float(np.linalg.norm(thing.quaternion_xyzw))
    if not report.near(path, f"{place}.quaternion_xyzw", length, 1.0, 1e-6):
        return
    R = rotation_from_quaternion(np.array([w, x, y, z]))
    corners = np.vstack([0.5 * np.array(conventions.cuboid_corners) * np.array(extents), np.zeros(3)])
    expected = camera.project(corners @ R.T + np.array(thing.location))
    _check_points(report, path, f"{place}.projected_cuboid", thing.projected_cuboid, expected)
