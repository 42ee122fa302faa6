"""COCO: instances, keypoints and panoptic segments (https://cocodataset.org/#format-data)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from simtrack.contracts import Bool
from simtrack.datasets.validation.findings import Entry, Report
from simtrack.datasets.validation.masks import box, decoded
from simtrack.recordings.files import image_size, read_bytes, read_rgb

OUTSIDE = 0.5
"""Pixels by which a keypoint may lie beyond the outermost pixels' centres."""


class _Image(Entry):
    id: int
    file_name: str
    width: Annotated[int, Field(gt=0)]
    height: Annotated[int, Field(gt=0)]


class _Category(Entry):
    id: Annotated[int, Field(ge=1)]
    name: str
    keypoints: list[str] | None = None
    skeleton: tuple[tuple[int, int], ...] = ()
    isthing: Literal[0, 1] | None = None


class _Rle(Entry):
    counts: str | list[int]
    size: tuple[int, int]


class _Segment(Entry):
    id: Annotated[int, Field(ge=1)]
    category_id: int
    area: int
    bbox: tuple[int, int, int, int]
    iscrowd: Literal[0, 1] = 0


class _Annotation(Entry):
    image_id: int
    id: int | None = None
    category_id: int | None = None
    area: float | None = None
    bbox: tuple[float, float, float, float] | None = None
    segmentation: _Rle | list[list[float]] | None = None
    iscrowd: Literal[0, 1] = 0
    keypoints: list[float] | None = None
    num_keypoints: int | None = None
    file_name: str | None = None
    segments_info: list[_Segment] | None = None


class _Document(Entry):
    images: list[_Image]
    annotations: list[_Annotation]
    categories: list[_Category]


def is_coco(root: Path) -> bool:
    """Whether a folder looks like a COCO data set."""
    return any((root / "annotations").glob("*.json"))


def validate_coco(report: Report, root: Path, disjoint: bool) -> int:
    """Check all annotation files; returns the number of images. `disjoint`: no pixel belongs to two instances."""
    images: dict[str, tuple[int, int]] = {}
    for path in sorted((root / "annotations").glob("*.json")):
        document: _Document | None = report.document(path, _Document)
        if document is not None:
            _Checker(report, root, path, document, disjoint).run(images)
    used = {root / "images" / name for name in images}
    for file in sorted((root / "images").rglob("*")):
        if file.is_file():
            report.holds(file in used, file, "", "an image", "an entry in a file of annotations")
    return len(images)


class _Checker:
    """One file of annotations."""

    def __init__(self, report: Report, root: Path, path: Path, document: _Document, disjoint: bool) -> None:
        self._report, self._root, self._path, self._document = report, root, path, document
        self._disjoint = disjoint
        self._images = {image.id: image for image in document.images}
        self._categories = {category.id: category for category in document.categories}

    def run(self, sizes: dict[str, tuple[int, int]]) -> None:
        """Check everything; `sizes` holds those of images that were looked at already."""
        self._unique("images", [image.id for image in self._document.images])
        self._unique("images (file_name)", [image.file_name for image in self._document.images])
        self._unique("categories", [category.id for category in self._document.categories])
        self._unique("annotations", [a.id for a in self._document.annotations if a.id is not None])
        for image in self._document.images:
            self._check_image(image, sizes)
        for category in self._document.categories:
            names = category.keypoints or []
            good = all(1 <= end <= len(names) for edge in category.skeleton for end in edge)
            self._expect(good, f"categories.{category.id}.skeleton", category.skeleton, f"keypoints 1 to {len(names)}")
        by_image: dict[int, list[tuple[int, _Annotation]]] = {}
        for k, annotation in enumerate(self._document.annotations):
            known = annotation.image_id in self._images
            if self._expect(known, f"annotations.{k}.image_id", annotation.image_id, "the id of an image"):
                by_image.setdefault(annotation.image_id, []).append((k, annotation))
        for number, annotations in by_image.items():
            self._check_annotations(self._images[number], annotations)

    def _expect(self, condition: bool, field: str, found: object, expected: object) -> bool:
        return self._report.holds(condition, self._path, field, found, expected)

    def _unique(self, field: str, values: Sequence[object]) -> None:
        twice = {value for value in values if values.count(value) > 1} if len(set(values)) < len(values) else set()
        self._expect(not twice, field, f"{sorted(map(str, twice))[:5]} several times", "unique values")

    def _check_image(self, image: _Image, sizes: dict[str, tuple[int, int]]) -> None:
        if image.file_name not in sizes:
            data = self._report.read(self._root / "images" / image.file_name, read_bytes)
            sizes[image.file_name] = (image_size(data) if data else None) or (0, 0)
        if sizes[image.file_name] != (0, 0):
            self._expect(
                sizes[image.file_name] == (image.width, image.height), f"images.{image.id} (size)",
                (image.width, image.height), f"{sizes[image.file_name]} of the file",
            )  # fmt: skip

    def _check_annotations(self, image: _Image, annotations: list[tuple[int, _Annotation]]) -> None:
        taken = np.zeros((image.height, image.width), np.bool_)
        for k, annotation in annotations:
            place = f"annotations.{k}"
            if annotation.segments_info is not None:
                self._check_panoptic(place, image, annotation)
                continue
            known = annotation.category_id in self._categories
            self._expect(known, f"{place}.category_id", annotation.category_id, sorted(self._categories))
            mask = self._mask(place, image, annotation)
            if mask is not None and self._disjoint:
                twice = int(np.count_nonzero(mask & taken))
                self._expect(twice == 0, f"{place}.segmentation", f"{twice} pixels of another instance", "0")
                taken |= mask
            if annotation.keypoints is not None and known and annotation.category_id is not None:
                self._check_keypoints(place, image, annotation, self._categories[annotation.category_id])

    def _mask(self, place: str, image: _Image, annotation: _Annotation) -> Bool | None:
        """The decoded mask, its area and box compared."""
        if not isinstance(annotation.segmentation, _Rle):
            return None
        try:
            mask = decoded(annotation.segmentation.size, annotation.segmentation.counts)
        except ValueError as error:
            self._expect(False, f"{place}.segmentation", error, "run lengths of a mask")
            return None
        size = (image.height, image.width)
        if not self._expect(mask.shape == size, f"{place}.segmentation.size", mask.shape, size):
            return None
        self._expect(annotation.area == np.count_nonzero(mask), f"{place}.area", annotation.area, int(mask.sum()))
        edges = box(mask)
        expected = [0, 0, 0, 0] if edges is None else _coco_box(edges)
        found = [] if annotation.bbox is None else list(annotation.bbox)
        self._expect(found == expected, f"{place}.bbox", found, expected)
        return mask

    def _check_keypoints(self, place: str, image: _Image, annotation: _Annotation, category: _Category) -> None:
        values, count = annotation.keypoints or [], len(category.keypoints or [])
        if not self._expect(len(values) == 3 * count, f"{place}.keypoints", len(values), f"{3 * count} numbers"):
            return
        points = np.reshape(values, (count, 3))
        named = int(np.count_nonzero(points[:, 2]))
        self._expect(annotation.num_keypoints == named, f"{place}.num_keypoints", annotation.num_keypoints, named)
        for k, (u, v, visibility) in enumerate(points.tolist()):
            field = f"{place}.keypoints.{k}"
            if visibility == 0:
                self._expect((u, v) == (0, 0), field, [u, v, visibility], "0, 0, 0 for what is not labelled")
            else:
                inside = -OUTSIDE <= u <= image.width - 1 + OUTSIDE and -OUTSIDE <= v <= image.height - 1 + OUTSIDE
                good = visibility in (1, 2) and inside
                self._expect(good, field, [u, v, visibility], "a place in the image, and 0, 1 or 2")

    def _check_panoptic(self, place: str, image: _Image, annotation: _Annotation) -> None:
        path = self._root / "panoptic" / (annotation.file_name or "")
        colours = self._report.read(path, read_rgb)
        if colours is None:
            return
        size = [image.height, image.width]
        if not self._report.equal(path, "(size)", list(colours.shape[:2]), size):
            return
        ids = colours.astype(np.int64) @ np.array([1, 256, 65536])
        segments = {segment.id: segment for segment in annotation.segments_info or []}
        there = set(np.unique(ids).tolist()) - {0}
        only = sorted(segments.keys() ^ there)
        self._expect(not only, f"{place}.segments_info", f"{only[:5]} in one of file and image only", "the same ids")
        stuff: set[int] = set()
        for number in sorted(segments.keys() & there):
            segment, field, mask = segments[number], f"{place}.segments_info (id {number})", ids == number
            category = self._categories.get(segment.category_id)
            if not self._expect(category is not None, f"{field}.category_id", segment.category_id, "a category"):
                continue
            self._expect(segment.area == mask.sum(), f"{field}.area", segment.area, int(mask.sum()))
            edges = box(mask)
            assert edges is not None and category is not None
            self._expect(list(segment.bbox) == _coco_box(edges), f"{field}.bbox", segment.bbox, _coco_box(edges))
            if category.isthing == 0:
                self._expect(category.id not in stuff, field, f"another segment of {category.name}", "one")
                stuff.add(category.id)


def _coco_box(edges: tuple[int, int, int, int]) -> list[int]:
    u0, v0, u1, v1 = edges
    return [u0, v0, u1 - u0 + 1, v1 - v0 + 1]
