"""COCO: instances, keypoints and panoptic segments, as told on https://cocodataset.org/#format-data .

Coordinates of keypoints are pixel indices, as COCO's own; boxes are [u, v, width, height] of what is seen.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from pydantic import Field

from simtrack.datasets.frame import DatasetInfo, InstanceLabel, LabelledFrame, SceneInfo
from simtrack.datasets.writers.box_keypoints import NAMES, SKELETON
from simtrack.datasets.writers.images import ColourJpeg, ColourPng, SharedImages, label_png
from simtrack.datasets.writers.masks import compressed_rle, visible_mask
from simtrack.datasets.writers.streams import FRAGMENTS, CocoFile, compact, fragments, scene_name, split_of
from simtrack.simulation.strict_file import Strict

Part: TypeAlias = Literal["instances", "keypoints", "panoptic"]

_IMAGE, _INSTANCE, _KEYPOINTS, _SEGMENTS = "iaks"
"""First letters of lines in a scene's fragment. JSON objects follow that lack their opening brace and the ids, which
count through all scenes."""
_PARTS: dict[str, Part] = {_INSTANCE: "instances", _KEYPOINTS: "keypoints", _SEGMENTS: "panoptic"}
"""Kind of a line -> part that it belongs to; images belong to all."""


class CocoOptions(Strict):
    """What a recipe may say of the writer."""

    parts: tuple[Part, ...] = Field(default=("instances", "keypoints", "panoptic"), min_length=1)
    image: Literal["jpg", "png"] = "jpg"
    """How colour images are encoded; jpg has quality 95."""
    min_pixels: int = Field(default=1, ge=1, le=1_000_000)
    """Instances of which fewer pixels are seen are left out of instances and keypoints."""


class CocoWriter:
    """Writes COCO; see `simtrack.datasets.writer.DatasetWriter`."""

    name = "coco"

    def __init__(self, options: CocoOptions) -> None:
        self.options = options

    def begin(self, root: Path, info: DatasetInfo) -> None:
        """Nothing is known before the scenes are."""

    def open_scene(self, staging: Path, info: DatasetInfo, scene: SceneInfo) -> "CocoSceneWriter":
        """Start a scene."""
        return CocoSceneWriter(staging, self, info, scene)

    def finish(self, root: Path, info: DatasetInfo, scenes: int) -> None:
        """Write ``annotations/PART_SPLIT.json`` from what the scenes left."""
        folder = root / self.name / "annotations"
        folder.mkdir(parents=True, exist_ok=True)
        splits = [split_of(info, scene) for scene in range(scenes)]
        for stale in folder.iterdir():
            if stale.name not in {f"{part}_{split}.json" for part in self.options.parts for split in splits}:
                stale.unlink()
        counts = dict.fromkeys((_IMAGE, *_PARTS), 0)
        with ExitStack() as exits:
            files: dict[tuple[Part, str], CocoFile] = {}
            for part in self.options.parts:
                for split in sorted(set(splits)):
                    files[part, split] = CocoFile(folder / f"{part}_{split}.json", _head(info, part))
                    exits.callback(files[part, split].discard)
            for scene, fragment in fragments(root / self.name, range(scenes), ".jsonl"):
                for kind, rest in _lines(fragment):
                    counts[kind] += 1
                    if kind == _IMAGE:
                        for part in self.options.parts:
                            files[part, splits[scene]].add_image(f'{{"id":{counts[_IMAGE]},{rest}')
                    else:
                        own = "" if kind == _SEGMENTS else f'"id":{counts[kind]},'
                        file = files[_PARTS[kind], splits[scene]]
                        file.add_annotation(f'{{{own}"image_id":{counts[_IMAGE]},{rest}')
            for file in files.values():
                file.close()


class CocoSceneWriter:
    """Writes one scene: its images, and a fragment of the annotations."""

    def __init__(self, staging: Path, writer: CocoWriter, info: DatasetInfo, scene: SceneInfo) -> None:
        self._options, self._shared = writer.options, SharedImages.of(staging)
        self._colour = ColourJpeg() if writer.options.image == "jpg" else ColourPng()
        self._things = {c.id for c in info.categories} | {c.id for c in info.stuff if c.thing}
        root, name = staging / writer.name, scene_name(scene.scene)
        self._images, self._panoptic = root / "images" / name, root / "panoptic" / name
        self._images.mkdir(parents=True)
        if "panoptic" in writer.options.parts:
            self._panoptic.mkdir(parents=True)
        (root / FRAGMENTS).mkdir(parents=True)
        self._fragment = (root / FRAGMENTS / f"{name}.jsonl").open("w", encoding="utf-8", newline="\n")

    def write(self, frame: LabelledFrame) -> None:
        """Write a frame."""
        image = f"{frame.index:06d}"
        path = self._images / f"{image}{self._colour.suffix}"
        self._shared.save(frame, self._colour, path)
        camera, parts = frame.intrinsics, self._options.parts
        file_name = f"{self._images.name}/{path.name}"
        self._line(_IMAGE, {"file_name": file_name, "width": camera.width, "height": camera.height})
        for label in frame.targets():
            if label.pixels_visible < self._options.min_pixels:
                continue
            annotation = _annotation(frame, label)
            if "instances" in parts:
                self._line(_INSTANCE, annotation)
            if "keypoints" in parts:
                self._line(_KEYPOINTS, annotation | _keypoints(label))
        if "panoptic" in parts:
            pixels, segments = panoptic(frame, self._things)
            (self._panoptic / f"{image}.png").write_bytes(label_png(pixels))
            file_name = f"{self._panoptic.name}/{image}.png"
            self._line(_SEGMENTS, {"file_name": file_name, "segments_info": segments})

    def close(self) -> None:
        """Complete the fragment."""
        self._fragment.close()

    def _line(self, kind: str, value: dict[str, Any]) -> None:
        self._fragment.write(kind + compact(value)[1:] + "\n")


def _lines(fragment: Path) -> Iterator[tuple[str, str]]:
    """(kind, JSON object without its opening brace) of each line."""
    with fragment.open(encoding="utf-8") as stream:
        for line in stream:
            yield line[0], line[1:-1]


def _annotation(frame: LabelledFrame, label: InstanceLabel) -> dict[str, Any]:
    mask = visible_mask(frame, label)
    return {
        "category_id": label.category,
        "iscrowd": 0,
        "area": label.pixels_visible,
        "bbox": [float(value) for value in mask.box],
        "segmentation": compressed_rle(mask),
    }


def _keypoints(label: InstanceLabel) -> dict[str, Any]:
    flat: list[float] = []
    for (u, v), visibility in zip(label.keypoints.tolist(), label.keypoint_visibility.tolist(), strict=True):
        flat += [round(u, 3), round(v, 3), visibility] if visibility else [0, 0, 0]
    return {"keypoints": flat, "num_keypoints": int(np.count_nonzero(label.keypoint_visibility))}


def panoptic(frame: LabelledFrame, things: set[int]) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """(H, W, 3) uint8 image of segment ids and what is said of each segment.

    A thing's segment has its instance's id plus one; stuff of one category is one segment, with the id that the first
    of its instances would have. Zero is where nothing is.
    """
    from simtrack.datasets.label_kernels import visible_parts

    categories = frame.segment_categories.tolist()
    first = {category: number for number, category in reversed(list(enumerate(categories)))}
    segment = np.zeros(len(categories) + 1, np.int64)
    segment[1:] = [1 + (k if category in things else first[category]) for k, category in enumerate(categories)]
    bytes_of = np.stack([segment & 255, segment >> 8 & 255, segment >> 16], axis=1).astype(np.uint8)
    image = np.zeros((*frame.ids.shape, 3), np.uint8)
    places = frame.ids + 1
    for channel in range(3):
        if bytes_of[:, channel].any():
            bytes_of[:, channel].take(places, out=image[..., channel], mode="clip")
    pixels, boxes = visible_parts(frame.ids, len(categories))
    found: dict[int, list[int]] = {}
    for k in np.flatnonzero(pixels).tolist():
        found.setdefault(int(segment[k + 1]), []).append(k)
    segments = []
    for number, members in sorted(found.items()):
        u0, v0 = boxes[members, :2].min(axis=0).tolist()
        u1, v1 = boxes[members, 2:].max(axis=0).tolist()
        segments.append(
            {
                "id": number,
                "category_id": categories[members[0]],
                "area": int(pixels[members].sum()),
                "bbox": [u0, v0, u1 - u0 + 1, v1 - v0 + 1],
                "iscrowd": 0,
            }
        )
    return image, segments


def _head(info: DatasetInfo, part: str) -> dict[str, Any]:
    """What stands before the images."""
    box = {"keypoints": NAMES, "skeleton": SKELETON} if part == "keypoints" else {}
    thing = {"isthing": 1} if part == "panoptic" else {}
    categories: list[dict[str, Any]] = [
        {"id": c.id, "name": c.model.name, "supercategory": c.model.semantic_class} | box | thing
        for c in info.categories
    ]
    if part == "panoptic":
        categories += [
            {"id": c.id, "name": c.name, "supercategory": c.name, "isthing": int(c.thing)} for c in info.stuff
        ]
        for category in categories:
            category["color"] = _colour(category["id"])
    about = {"description": f"{info.name}: {info.description}", "version": "1.0"}
    return {"info": about, "licenses": [], "categories": categories}


def _colour(category: int) -> list[int]:
    """A colour that tells a category from its neighbours: hues in steps of the golden angle."""
    import colorsys

    hue = (category * 0.61803398875) % 1.0
    return [round(255 * channel) for channel in colorsys.hsv_to_rgb(hue, 0.75, 0.95)]
