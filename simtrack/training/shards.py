"""A data set made ready for training: small images and windows about objects, in files that are mapped into memory."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64
from simtrack.errors import DatasetError, FileFormatError
from simtrack.perception.detection.boxes import overlap
from simtrack.perception.detection.views import WINDOW, Pyramid, Window, reduced, warped, window_about
from simtrack.training.source import Label, LabelledImage, Source, images

IMAGE_WIDTH, IMAGE_HEIGHT = 480, 360
"""Pixels, of the images that the box network looks at."""
PATCH = 96
"""Pixels a side of the stored windows: larger than what is shown, so that it can be shifted, scaled and turned."""
PATCH_WINDOW = 1.5 * WINDOW
"""Their side in shares of the box's longer side."""
MAX_OBJECTS = 40
"""Labelled in an image."""
LEAST_VISIBLE = 0.1
"""Objects of which less is seen are neither to be found nor a mistake if found."""
LEAST_PIXELS = 120
"""Fewest visible pixels of an object whose keypoints are to be learned."""
BACKGROUND_WINDOWS = 2
"""An image: windows in which no object is."""
BACKGROUND = -1
"""Class of these."""

IMAGES = np.dtype(
    [
        ("rgb", np.uint8, (IMAGE_HEIGHT, IMAGE_WIDTH, 3)),
        ("depth", np.float16, (IMAGE_HEIGHT, IMAGE_WIDTH)),
        ("index", np.uint8, (IMAGE_HEIGHT, IMAGE_WIDTH)),
        ("boxes", np.float32, (MAX_OBJECTS, 4)),
        ("classes", np.int16, MAX_OBJECTS),
        ("visible", np.float32, MAX_OBJECTS),
    ]
)
"""Boxes in pixels of the small image, of whole silhouettes as far as they lie in the image; class -1 = no object. The
index tells which object a pixel shows, from 1; 0 = none."""
CROPS = np.dtype(
    [
        ("rgb", np.uint8, (PATCH, PATCH, 3)),
        ("depth", np.float16, (PATCH, PATCH)),
        ("mask", np.uint8, (PATCH, PATCH)),
        ("window", np.float64, 3),
        ("intrinsics", np.float64, 4),
        ("T_camera_object", np.float64, (4, 4)),
        ("box", np.float32, 4),
        ("class_index", np.int16),
        ("visible", np.float32),
    ]
)
"""Windows (u, v, side in pixels of the full image), what is seen of the object in them, intrinsics fx fy cx cy."""


def prepare(source: Source, folder: Path, told: Callable[[int, int], None] | None = None) -> None:
    """Write the shards of all scenes that have none yet; `told` gets how many of how many are done."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, scene in enumerate(source.scenes):
        if not shard(folder, scene.name, "crops").is_file():
            images, crops = _read_scene(source, scene)
            _save(shard(folder, scene.name, "images"), images)
            _save(shard(folder, scene.name, "crops"), crops)
        if told is not None:
            told(number + 1, len(source.scenes))


def shard(folder: Path, scene: str, kind: str) -> Path:
    """File of one scene's ``images`` or ``crops``."""
    return folder / f"{scene}.{kind}.npy"


def is_held_out(scene: int) -> bool:
    """Whether a scene is kept for validation."""
    return scene % 20 == 0


class Shards:
    """All samples of one kind, as one sequence of records mapped from files."""

    def __init__(self, folder: Path, kind: str, dtype: np.dtype, *, held_out: bool) -> None:
        self._parts: list[np.ndarray] = []
        for path in sorted(folder.glob(f"*.{kind}.npy")):
            if is_held_out(int(path.name.split(".")[0])) == held_out:
                part = np.load(path, mmap_mode="r", allow_pickle=False)
                if part.dtype != dtype:
                    raise FileFormatError(path, "", "made by another version; remove the folder of shards")
                self._parts.append(part)
        self._ends = np.cumsum([len(part) for part in self._parts])
        if not len(self):
            share = "every 20th scene is held out, so at least 2 scenes are needed"
            raise DatasetError(folder, f"no {kind} for {'validation' if held_out else 'training'}; {share}")

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._parts) else 0

    def __getitem__(self, index: int) -> Any:
        if not 0 <= index < len(self):
            raise IndexError(index)
        part = int(np.searchsorted(self._ends, index, side="right"))
        return self._parts[part][index - (int(self._ends[part - 1]) if part else 0)]

    def column(self, name: str) -> np.ndarray:
        """One field of all samples."""
        return np.concatenate([part[name] for part in self._parts])


def _save(path: Path, records: np.ndarray) -> None:
    part = path.with_suffix(f".{os.getpid()}.part")  # both networks' processes may be making it
    with part.open("wb") as stream:
        np.save(stream, records, allow_pickle=False)
    part.replace(path)


def _read_scene(source: Source, scene: Path) -> tuple[np.ndarray, np.ndarray]:
    small: list[np.ndarray] = []
    crops: list[np.ndarray] = []
    for image in images(source, scene):
        small.append(_small(image))
        crops += _crops(image, np.random.default_rng([int(scene.name), image.index]))
    return np.array(small, IMAGES), np.array(crops, CROPS)


def _small(image: LabelledImage) -> np.ndarray:
    record = np.zeros((), IMAGES)
    record["rgb"], record["depth"] = reduced(image.rgb, image.depth, IMAGE_WIDTH, IMAGE_HEIGHT)
    record["classes"] = BACKGROUND
    scale = np.array([IMAGE_WIDTH / image.intrinsics.width, IMAGE_HEIGHT / image.intrinsics.height] * 2)
    for k, label in enumerate(image.labels[:MAX_OBJECTS]):
        # Pixel centres lie at integer indices: the image begins half a pixel before the first one.
        record["boxes"][k] = (label.box + 0.5) * scale - 0.5
        record["classes"][k], record["visible"][k] = label.class_index, label.visible
        record["index"][_small_mask(label)] = k + 1
    return record


def _crops(image: LabelledImage, rng: np.random.Generator) -> list[np.ndarray]:
    pyramid, crops = Pyramid(image.rgb), list[np.ndarray]()

    def crop(box: Float64, class_index: int) -> tuple[np.ndarray, Window]:
        record = np.zeros((), CROPS)
        window, camera = window_about(box, PATCH_WINDOW), image.intrinsics
        pixels = window.pixels_of(PATCH)
        record["rgb"] = pyramid.cut(pixels, PATCH)
        record["depth"] = warped(image.depth, pixels, PATCH, smooth=False)
        record["window"] = window.u, window.v, window.side
        record["intrinsics"] = camera.fx, camera.fy, camera.cx, camera.cy
        record["box"], record["class_index"], record["T_camera_object"] = box, class_index, np.eye(4)
        return record, window

    for label in image.labels:
        if label.visible < LEAST_VISIBLE or label.pixels < LEAST_PIXELS:
            continue
        record, window = crop(label.box, label.class_index)
        record["mask"] = warped(_mask(label), window.pixels_of(PATCH), PATCH, smooth=False) > 0
        record["T_camera_object"], record["visible"] = label.T_camera_object, label.visible
        crops.append(record)
    for box in _free_boxes(image.intrinsics, image.labels, rng):
        crops.append(crop(box, BACKGROUND)[0])
    return crops


def _free_boxes(camera: CameraIntrinsics, labels: Sequence[Label], rng: np.random.Generator) -> list[Float64]:
    found: list[Float64] = []
    for _ in range(BACKGROUND_WINDOWS):
        half = rng.uniform(15.0, 100.0)
        u, v = rng.uniform(0.0, camera.width), rng.uniform(0.0, camera.height)
        box = np.array([u - half, v - half, u + half, v + half])
        if all(overlap(box, label.box) < 0.1 for label in labels):
            found.append(box)
    return found


def _small_mask(label: Label) -> np.ndarray:
    import cv2

    size = (IMAGE_WIDTH, IMAGE_HEIGHT)
    return np.asarray(cv2.resize(_mask(label), size, interpolation=cv2.INTER_NEAREST)) > 0


def _mask(label: Label) -> np.ndarray:
    import cv2

    mask = cv2.imread(str(label.mask), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise FileFormatError(label.mask, "", "no mask of what is seen of an object")
    return np.asarray(mask)
