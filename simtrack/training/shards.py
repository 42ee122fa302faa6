"""A data set made ready for training: small images and windows about objects, in files that are mapped into memory.

Read from the BOP part of a data set that `simtrack generate` made: it has the objects' poses, and with them every
keypoint, inside the image or not.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import DatasetError, FileFormatError
from simtrack.objects import ObjectModel, load_object
from simtrack.objects.export import MILLIMETRES
from simtrack.objects.model import BOX_CORNERS
from simtrack.perception.detection.boxes import overlap
from simtrack.perception.detection.views import WINDOW, Pyramid, reduced, warped, window_about
from simtrack.recordings.files import read_depth, read_rgb

IMAGE_WIDTH, IMAGE_HEIGHT = 320, 240
"""Pixels, of what the box network is trained on."""
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
        ("boxes", np.float32, (MAX_OBJECTS, 4)),
        ("classes", np.int16, MAX_OBJECTS),
        ("visible", np.float32, MAX_OBJECTS),
    ]
)
"""Boxes in pixels of the small image, of the whole silhouettes as far as they lie in the image; class -1 = no object."""
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


@dataclass(frozen=True, slots=True)
class Source:
    """The part of a data set that is read."""

    root: Path
    models: tuple[ObjectModel, ...]
    """In the order of the classes' indices."""
    class_of: Mapping[int, int]
    """BOP's object id -> class index."""
    scenes: tuple[Path, ...]
    """Folders of complete scenes."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """In the order of their indices."""
        return tuple(model.name for model in self.models)


def open_source(root: Path) -> Source:
    """Find what a data set offers.

    Raises:
        FileFormatError: it is no data set of ours, or its keypoints are others than those of `simtrack.objects`.
        DatasetError: it has no BOP part, no scene, or objects without a model.
    """
    path = root / "dataset.json"
    if not path.is_file():
        raise DatasetError(root, "no dataset.json; expected a folder that `simtrack generate` made")
    about = _json(path)
    names = about.get("categories")
    if not isinstance(names, dict) or not names:
        raise FileFormatError(path, "categories", "missing; expected object ids with the names of their models")
    corners = np.asarray(about.get("cuboid_corners", []), dtype=float)
    if corners.shape != BOX_CORNERS.shape or not np.array_equal(corners, BOX_CORNERS):
        order = BOX_CORNERS.astype(int).tolist()
        raise FileFormatError(path, "cuboid_corners", f"keypoints in another order; expected {order}")
    split = next((p for p in sorted((root / "bop").glob("*")) if p.name.split("_")[0] in ("train", "val", "test")), None)
    if split is None:
        raise DatasetError(root, "no BOP part to take poses and keypoints from; add bop to the recipe's writers")
    markers = {p.stem for p in (root / "scenes").glob("*.json")}
    scenes = tuple(p for p in sorted(split.iterdir()) if p.name in markers)
    if not scenes:
        raise DatasetError(root, f"no complete scene in {split.relative_to(root)}")
    ids = sorted(int(key) for key in names)
    models = tuple(_model(root, str(names[str(i)])) for i in ids)
    return Source(root, models, {bop_id: index for index, bop_id in enumerate(ids)}, scenes)


def _model(root: Path, name: str) -> ObjectModel:
    from simtrack.errors import UnknownNameError

    try:
        return load_object(name)
    except UnknownNameError as error:
        reason = f"no model of its object '{name}'; name its folder in $SIMTRACK_OBJECTS. {error}"
        raise DatasetError(root, reason) from error


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
    os.replace(part, path)


def _json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileFormatError(path, "", f"cannot be read: {error}") from error
    if not isinstance(data, dict):
        raise FileFormatError(path, "", "expected a JSON object")
    return data


def _read_scene(source: Source, scene: Path) -> tuple[np.ndarray, np.ndarray]:
    cameras, poses = _json(scene / "scene_camera.json"), _json(scene / "scene_gt.json")
    infos = _json(scene / "scene_gt_info.json")
    images = np.zeros(len(cameras), IMAGES)
    crops: list[np.ndarray] = []
    for record, image in zip(images, sorted(cameras, key=int), strict=True):
        camera = cameras[image]
        name = f"{int(image):06d}"
        colour = next((scene / "rgb" / f"{name}{s}" for s in (".jpg", ".png") if (scene / "rgb" / f"{name}{s}").is_file()), None)
        if colour is None:
            raise FileFormatError(scene / "rgb", name, "no colour image; expected .jpg or .png")
        rgb = read_rgb(colour)
        depth = read_depth(scene / "depth" / f"{name}.png", float(camera.get("depth_scale", 1.0)) / MILLIMETRES)
        labels = list(_labels(source, scene, name, poses[image], infos[image], rgb.shape[:2]))
        _fill_image(record, rgb, depth, labels)
        K = np.asarray(camera["cam_K"], float)[[0, 4, 2, 5]]
        crops += _crops(rgb, depth, K, labels, np.random.default_rng([int(scene.name), int(image)]))
    return images, np.array(crops, CROPS)


@dataclass(frozen=True, slots=True)
class _Label:
    class_index: int
    T_camera_object: Float64
    box: Float64
    visible: float
    pixels: int
    mask: Path


def _labels(source: Source, scene: Path, image: str, poses: Any, infos: Any, shape: tuple[int, ...]) -> Iterator[_Label]:
    limit = np.array([shape[1] - 1, shape[0] - 1] * 2, float)
    for number, (pose, info) in enumerate(zip(poses, infos, strict=True)):
        if info["px_count_visib"] <= 0:
            continue
        T = np.eye(4)
        T[:3, :3] = np.reshape(pose["cam_R_m2c"], (3, 3))
        T[:3, 3] = np.asarray(pose["cam_t_m2c"]) / MILLIMETRES
        x, y, w, h = info["bbox_obj"]
        box = np.clip(np.array([x, y, x + w, y + h], float), 0.0, limit)
        yield _Label(
            source.class_of[pose["obj_id"]], T, box, float(info["visib_fract"]), int(info["px_count_visib"]),
            scene / "mask_visib" / f"{image}_{number:06d}.png",
        )  # fmt: skip


def _fill_image(record: Any, rgb: np.ndarray, depth: np.ndarray, labels: list[_Label]) -> None:
    record["rgb"], record["depth"] = reduced(rgb, depth, IMAGE_WIDTH, IMAGE_HEIGHT)
    record["classes"] = BACKGROUND
    scale = np.array([IMAGE_WIDTH / rgb.shape[1], IMAGE_HEIGHT / rgb.shape[0]] * 2)
    for k, label in enumerate(labels[:MAX_OBJECTS]):
        # Pixel centres lie at integer indices: the image begins half a pixel before the first one.
        record["boxes"][k] = (label.box + 0.5) * scale - 0.5
        record["classes"][k], record["visible"][k] = label.class_index, label.visible


def _crops(rgb: np.ndarray, depth: np.ndarray, K: Float64, labels: list[_Label], rng: np.random.Generator) -> list[np.ndarray]:
    import cv2

    pyramid, crops = Pyramid(rgb), list[np.ndarray]()
    height, width = depth.shape

    def crop(box: Float64, class_index: int) -> np.ndarray:
        record = np.zeros((), CROPS)
        window = window_about(box, PATCH_WINDOW)
        pixels = window.pixels_of(PATCH)
        record["rgb"] = pyramid.cut(pixels, PATCH)
        record["depth"] = warped(depth, pixels, PATCH, smooth=False)
        record["window"] = window.u, window.v, window.side
        record["intrinsics"], record["box"], record["class_index"] = K, box, class_index
        record["T_camera_object"] = np.eye(4)
        return record

    for label in labels:
        if label.visible < LEAST_VISIBLE or label.pixels < LEAST_PIXELS:
            continue
        record = crop(label.box, label.class_index)
        mask = cv2.imread(str(label.mask), cv2.IMREAD_GRAYSCALE)
        if mask is None:
            raise FileFormatError(label.mask, "", "no mask of what is seen of an object")
        window = window_about(label.box, PATCH_WINDOW)
        record["mask"] = warped(np.asarray(mask), window.pixels_of(PATCH), PATCH, smooth=False) > 0
        record["T_camera_object"], record["visible"] = label.T_camera_object, label.visible
        crops.append(record)
    for _ in range(BACKGROUND_WINDOWS):
        side = rng.uniform(30.0, 200.0)
        u, v = rng.uniform(0.0, width), rng.uniform(0.0, height)
        box = np.array([u - side / 2, v - side / 2, u + side / 2, v + side / 2])
        if all(overlap(box, label.box) < 0.1 for label in labels):
            crops.append(crop(box, BACKGROUND))
    return crops

