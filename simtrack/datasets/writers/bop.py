"""BOP, scene by scene: https://github.com/thodan/bop_toolkit, docs/bop_datasets_format.md.

Millimetres exist here only. Every target of a scene is in the lists of every image, in the same place, seen or not, so
that the number of an entry names an instance throughout the scene.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from simtrack.contracts import CameraIntrinsics
from simtrack.datasets.frame import DatasetInfo, InstanceLabel, LabelledFrame, SceneInfo
from simtrack.datasets.writers.images import ColourJpeg, ColourPng, DepthPng, SharedImages, linked, mask_png
from simtrack.datasets.writers.masks import Mask, uncompressed_rle, visible_mask, whole_mask
from simtrack.datasets.writers.streams import CocoFile, JsonObject, compact, scene_name, write_whole
from simtrack.geometry.transforms import inverse
from simtrack.objects.export import MILLIMETRES, models_info, write_ply
from simtrack.simulation.strict_file import Strict

EVALUATED = 0.1
"""Visible fraction from which an instance counts in the lists of targets."""
IMAGE_FILES = ("scene_camera", "scene_gt", "scene_gt_info")
"""Files of a scene with one entry an image."""


class BopOptions(Strict):
    """What a recipe may say of the BOP writers."""

    split_type: Literal["pbr", "plain"] = "pbr"
    """pbr: folder ``train_pbr``, colour as JPEG; plain: folder ``train``, colour as PNG."""
    depth_scale: float = Field(default=0.1, gt=0.0, le=10.0)
    """Millimetres in a step of the depth images; 16 bits reach 65535 steps far."""

    @property
    def colour(self) -> ColourJpeg | ColourPng:
        """How colour images are encoded."""
        return ColourJpeg() if self.split_type == "pbr" else ColourPng()

    @property
    def depth(self) -> DepthPng:
        """How depth images are encoded."""
        return DepthPng(MILLIMETRES / self.depth_scale)

    def split_folder(self, info: DatasetInfo) -> str:
        """Name of the folder of all scenes."""
        return f"{info.split}_pbr" if self.split_type == "pbr" else info.split


class BopWriter:
    """Writes the scene-wise format; see `simtrack.datasets.writer.DatasetWriter`."""

    name = "bop"

    def __init__(self, options: BopOptions) -> None:
        self.options = options

    def begin(self, root: Path, info: DatasetInfo) -> None:
        """Write the models and the camera."""
        write_models(root / self.name, info)
        write_camera(root / self.name, info.intrinsics, self.options)

    def open_scene(self, staging: Path, info: DatasetInfo, scene: SceneInfo) -> "BopSceneWriter":
        """Start a scene."""
        return BopSceneWriter(staging, self, info, scene)

    def finish(self, root: Path, info: DatasetInfo, scenes: int) -> None:
        """Write which objects are to be found in which images, if this is a test split."""
        if info.split != "test":
            return
        folder = root / self.name
        split = folder / self.options.split_folder(info)
        for name, rows in (
            ("test_targets_bop19.json", targets_bop19(split, scenes)),
            ("test_targets_bop24.json", targets_bop24(split, scenes)),
        ):
            part = folder / f".{name}.part"
            with part.open("w", encoding="utf-8", newline="\n") as stream:
                separator = "[\n"
                for row in rows:
                    stream.write(separator + compact(row))
                    separator = ",\n"
                stream.write("\n]\n" if separator == ",\n" else "[]\n")
            part.replace(folder / name)


class BopSceneWriter:
    """Writes one scene."""

    def __init__(self, staging: Path, writer: BopWriter, info: DatasetInfo, scene: SceneInfo) -> None:
        self._options, self._images = writer.options, SharedImages.of(staging)
        self._folder = staging / writer.name / writer.options.split_folder(info) / scene_name(scene.scene)
        for name in ("rgb", "depth", "mask", "mask_visib"):
            (self._folder / name).mkdir(parents=True)
        self._files = {name: JsonObject(self._folder / f"{name}.json") for name in IMAGE_FILES}
        categories = [{"id": c.id, "name": c.model.name, "supercategory": info.name} for c in info.categories]
        head = {"info": {"description": info.description}, "licenses": [], "categories": categories}
        self._coco = CocoFile(self._folder / "scene_gt_coco.json", head)
        self._annotations = 0

    def write(self, frame: LabelledFrame) -> None:
        """Write a frame."""
        options, image = self._options, f"{frame.index:06d}"
        colour, depth = f"rgb/{image}{options.colour.suffix}", f"depth/{image}{options.depth.suffix}"
        self._images.save(frame, options.colour, self._folder / colour)
        self._images.save(frame, options.depth, self._folder / depth)
        for name, value in zip(IMAGE_FILES, image_entries(frame, options), strict=True):
            self._files[name].add(frame.index, value)
        camera = frame.intrinsics
        about = {"id": frame.index, "file_name": colour, "width": camera.width, "height": camera.height}
        self._coco.add_image(compact(about))
        for number, label in enumerate(frame.targets()):
            whole, visible = whole_mask(label), visible_mask(frame, label)
            name = f"{image}_{number:06d}.png"
            (self._folder / "mask" / name).write_bytes(mask_png(whole))
            (self._folder / "mask_visib" / name).write_bytes(mask_png(visible))
            if label.pixels_visible:
                self._annotate(frame, label, whole, visible)

    def close(self) -> None:
        """Complete the scene's JSON files."""
        for file in self._files.values():
            file.close()
        self._coco.close()

    def _annotate(self, frame: LabelledFrame, label: InstanceLabel, whole: Mask, visible: Mask) -> None:
        self._annotations += 1
        entry = {
            "id": self._annotations,
            "image_id": frame.index,
            "category_id": label.category,
            "iscrowd": 0,
            "area": label.pixels_visible,
            "bbox": whole.box,
            "segmentation": uncompressed_rle(visible),
            "width": frame.intrinsics.width,
            "height": frame.intrinsics.height,
            "ignore": label.visible_fraction < EVALUATED,
        }
        self._coco.add_annotation(compact(entry))


# ----------------------------------------------------------------------------------------------------- entries of files


def image_entries(frame: LabelledFrame, options: BopOptions) -> tuple[dict[str, Any], list[Any], list[Any]]:
    """What ``scene_camera``, ``scene_gt`` and ``scene_gt_info`` say of an image."""
    T_camera_map = inverse(frame.T_map_camera)
    camera = {
        "cam_K": frame.intrinsics.matrix.ravel().tolist(),
        "depth_scale": options.depth_scale,
        "cam_R_w2c": T_camera_map[:3, :3].ravel().tolist(),
        "cam_t_w2c": (T_camera_map[:3, 3] * MILLIMETRES).tolist(),
    }
    too_deep = frame.depth.max(initial=0.0) * options.depth.per_metre >= 65535.5
    readings = options.depth.steps(frame) > 0 if too_deep else None
    poses, infos = [], []
    for label in frame.targets():
        T = label.T_camera_object
        pose = {"cam_R_m2c": T[:3, :3].ravel().tolist(), "cam_t_m2c": (T[:3, 3] * MILLIMETRES).tolist()}
        poses.append(pose | {"obj_id": label.category})
        valid = label.pixels_valid if readings is None else int(np.count_nonzero(readings & label.amodal))
        infos.append(_gt_info(label, valid))
    return camera, poses, infos


def _gt_info(label: InstanceLabel, pixels_valid: int) -> dict[str, Any]:
    visible = label.box_visible is not None
    return {
        "bbox_obj": _box(label.box_amodal if visible else None),
        "bbox_visib": _box(label.box_visible),
        "px_count_all": label.pixels_all,
        "px_count_valid": pixels_valid,
        "px_count_visib": label.pixels_visible,
        "visib_fract": label.visible_fraction,
    }


def _box(box: tuple[int, int, int, int] | None) -> list[int]:
    """BOP's box: [u, v, w, h] with w = last - first."""
    return [-1, -1, -1, -1] if box is None else [box[0], box[1], box[2] - box[0], box[3] - box[1]]


# ------------------------------------------------------------------------------------------------ files of the data set


def write_models(folder: Path, info: DatasetInfo) -> None:
    """``models`` and ``models_eval``, which are the same: what frames show is what poses are judged by."""
    table = {str(category.id): models_info(category.model) for category in info.categories}
    for name in ("models", "models_eval"):
        (folder / name).mkdir(parents=True, exist_ok=True)
        write_whole(folder / name / "models_info.json", compact(table) + "\n")
    for category in info.categories:
        first, second = (folder / name / f"obj_{category.id:06d}.ply" for name in ("models", "models_eval"))
        part = first.with_name(f".{first.name}.part")
        write_ply(part, category.model.mesh, scale=MILLIMETRES)
        second.unlink(missing_ok=True)
        if not linked(part, second):
            second.write_bytes(part.read_bytes())
        part.replace(first)


def write_camera(folder: Path, intrinsics: CameraIntrinsics, options: BopOptions) -> None:
    """``camera.json``."""
    names = ("fx", "fy", "cx", "cy", "width", "height")
    camera = {name: getattr(intrinsics, name) for name in names} | {"depth_scale": options.depth_scale}
    write_whole(folder / "camera.json", compact(camera) + "\n")


def targets_bop19(split: Path, scenes: int) -> Iterator[dict[str, int]]:
    """How many instances of which object are to be found in each image: those visible to a tenth at least."""
    for scene in range(scenes):
        for image, poses, infos in _scene_entries(split / scene_name(scene)):
            counts: dict[int, int] = {}
            for pose, about in zip(poses, infos, strict=True):
                if about["visib_fract"] >= EVALUATED:
                    counts[pose["obj_id"]] = counts.get(pose["obj_id"], 0) + 1
            for category, count in sorted(counts.items()):
                yield {"scene_id": scene, "im_id": image, "obj_id": category, "inst_count": count}


def targets_bop24(split: Path, scenes: int) -> Iterator[dict[str, int]]:
    """The images in which objects are to be detected."""
    for scene in range(scenes):
        for image, _, _ in _scene_entries(split / scene_name(scene)):
            yield {"scene_id": scene, "im_id": image}


def _scene_entries(folder: Path) -> Iterator[tuple[int, list[Any], list[Any]]]:
    """(image, its entry in scene_gt, its entry in scene_gt_info) of one scene."""
    import json

    poses, infos = (
        json.loads((folder / f"{name}.json").read_text(encoding="utf-8")) for name in ("scene_gt", "scene_gt_info")
    )
    for image, entries in poses.items():
        yield int(image), entries, infos[image]
