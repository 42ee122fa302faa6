"""Where training and its evaluation get images with labels from: the BOP part of a generated data set.

It has the objects' poses, and with them every keypoint, inside the image or not.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Float64, Uint8
from simtrack.errors import DatasetError, FileFormatError, UnknownNameError
from simtrack.objects import ObjectModel, load_object
from simtrack.objects.export import MILLIMETRES
from simtrack.objects.model import BOX_CORNERS
from simtrack.recordings.files import read_depth, read_rgb


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
    about = read_json(path)
    names = about.get("categories")
    if not isinstance(names, dict) or not names:
        raise FileFormatError(path, "categories", "missing; expected object ids with the names of their models")
    corners = np.asarray(about.get("cuboid_corners", []), dtype=float)
    if corners.shape != BOX_CORNERS.shape or not np.array_equal(corners, BOX_CORNERS):
        order = BOX_CORNERS.astype(int).tolist()
        raise FileFormatError(path, "cuboid_corners", f"keypoints in another order; expected {order}")
    split = next(
        (p for p in sorted((root / "bop").glob("*")) if p.name.split("_")[0] in ("train", "val", "test")), None
    )
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
    try:
        return load_object(name)
    except UnknownNameError as error:
        reason = f"no model of its object '{name}'; name its folder in $SIMTRACK_OBJECTS. {error}"
        raise DatasetError(root, reason) from error


@dataclass(frozen=True, slots=True, eq=False)
class Label:
    """One object that is seen in an image."""

    class_index: int
    T_camera_object: Float64
    """(4, 4)."""
    box: Float64
    """(4,), of the whole silhouette as far as it lies in the image: x min, y min, x max, y max, pixels."""
    visible: float
    """Share of the silhouette that is seen, 0 to 1."""
    pixels: int
    """That are seen."""
    mask: Path
    """Image of what is seen."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledImage:
    """An image with what is seen in it."""

    index: int
    rgb: Uint8
    """(H, W, 3)."""
    depth: Float32
    """(H, W), metres, 0 = no reading."""
    intrinsics: CameraIntrinsics
    labels: tuple[Label, ...]


def images(source: Source, scene: Path) -> Iterator[LabelledImage]:
    """The images of one scene.

    Raises:
        FileFormatError: a file is missing or damaged.
    """
    cameras, poses = read_json(scene / "scene_camera.json"), read_json(scene / "scene_gt.json")
    infos = read_json(scene / "scene_gt_info.json")
    for image in sorted(cameras, key=int):
        name = f"{int(image):06d}"
        files = [scene / "rgb" / f"{name}{suffix}" for suffix in (".jpg", ".png")]
        colour = next((file for file in files if file.is_file()), None)
        if colour is None:
            raise FileFormatError(files[0], "", "no such file, and no .png in its place")
        rgb = np.asarray(read_rgb(colour), np.uint8)
        try:
            camera = cameras[image]
            scale = float(camera.get("depth_scale", 1.0)) / MILLIMETRES
            fx, _, cx, _, fy, cy, *_ = (float(value) for value in camera["cam_K"])
            labels = tuple(_labels(source, scene, name, poses[image], infos[image], rgb.shape))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            reason = f"image {image} has no complete entry: {type(error).__name__} {error}"
            raise FileFormatError(scene, "scene_camera.json, scene_gt.json, scene_gt_info.json", reason) from error
        depth = np.asarray(read_depth(scene / "depth" / f"{name}.png", scale), np.float32)
        if depth.shape != rgb.shape[:2]:
            raise FileFormatError(scene, f"image {image}", "colour and depth differ in size")
        intrinsics = CameraIntrinsics(rgb.shape[1], rgb.shape[0], fx, fy, cx, cy)
        yield LabelledImage(int(image), rgb, depth, intrinsics, labels)


def _labels(source: Source, scene: Path, image: str, poses: Any, infos: Any, shape: tuple[int, ...]) -> Iterator[Label]:
    limit = np.array([shape[1] - 1, shape[0] - 1] * 2, float)
    for number, (pose, info) in enumerate(zip(poses, infos, strict=True)):
        if info["px_count_visib"] <= 0:
            continue
        T = np.eye(4)
        T[:3, :3] = np.reshape(pose["cam_R_m2c"], (3, 3))
        T[:3, 3] = np.asarray(pose["cam_t_m2c"]) / MILLIMETRES
        x, y, w, h = info["bbox_obj"]
        box = np.clip(np.array([x, y, x + w, y + h], float), 0.0, limit)
        mask = scene / "mask_visib" / f"{image}_{number:06d}.png"
        index = source.class_of[pose["obj_id"]]
        yield Label(index, T, box, float(info["visib_fract"]), int(info["px_count_visib"]), mask)


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object; raises FileFormatError."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileFormatError(path, "", f"cannot be read: {error}") from error
    if not isinstance(data, dict):
        raise FileFormatError(path, "", "expected a JSON object")
    return data
