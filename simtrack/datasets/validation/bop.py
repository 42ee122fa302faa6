"""BOP data sets, ours and others': folders of scenes and webdataset shards.

Rules are those of https://github.com/thodan/bop_toolkit (docs/bop_datasets_format.md, scripts/calc_gt_info.py,
scripts/calc_gt_coco.py).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from simtrack.contracts import Bool, CameraIntrinsics
from simtrack.datasets.validation.bop_images import (
    SCENE,
    BopImage,
    BopScene,
    Box,
    GtInfo,
    read_image,
    read_scene,
    scene_folders,
    shard_images,
)
from simtrack.datasets.validation.findings import Entry, Report
from simtrack.datasets.validation.masks import box, decoded
from simtrack.datasets.validation.models import Models, read_models
from simtrack.datasets.validation.rerender import Rerenderer

NOTHING: Box = (-1, -1, -1, -1)
EVALUATED = 0.1
"""Visible fraction from which an instance is among the targets of an evaluation."""


class CameraFile(Entry):
    """``camera.json``."""

    fx: Annotated[float, Field(gt=0.0)]
    fy: Annotated[float, Field(gt=0.0)]
    cx: float
    cy: float
    width: Annotated[int, Field(gt=0)]
    height: Annotated[int, Field(gt=0)]
    depth_scale: Annotated[float, Field(gt=0.0)] = 1.0

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """As frames carry them."""
        return CameraIntrinsics(self.width, self.height, self.fx, self.fy, self.cx, self.cy)


@dataclass(frozen=True, slots=True)
class Expectations:
    """What is known of a data set beside its files."""

    exact: bool
    """Made by simtrack: ids come from rays, masks are disjoint, one camera took all images."""


def is_bop(root: Path) -> bool:
    """Whether a folder looks like a BOP data set."""
    return (root / "models").is_dir() and (bool(scene_folders(root)) or any(root.glob("*/shard-*.tar")))


def validate_bop(report: Report, root: Path, expected: Expectations, rerenderer: Rerenderer, sample: int) -> int:
    """Check a data set, re-rendering about `sample` of its images; returns the number of its images."""
    models = read_models(report, root / "models")
    if (root / "models_eval").is_dir():
        read_models(report, root / "models_eval")
    camera = report.document(root / "camera.json", CameraFile) if (root / "camera.json").exists() else None
    folders = scene_folders(root)
    count = 0
    step = max(1, _count(folders) // max(sample, 1))
    for image in _images(report, root, folders):
        _check_image(report, image, models, camera if expected.exact else None, expected)
        if models is not None and sample > 0 and count % step == step // 2:
            rerenderer.check(report, image, models)
        count += 1
    for name in ("test_targets_bop19.json", "test_targets_bop24.json"):
        if (root / name).exists():
            _check_targets(report, root / name, folders)
    return count


def _count(folders: list[Path]) -> int:
    return sum(1 for folder in folders for _ in (folder / "depth").glob("*.png"))


def _images(report: Report, root: Path, folders: list[Path]) -> Iterator[BopImage]:
    for folder in folders:
        scene = read_scene(report, folder)
        if scene is None:
            continue
        _check_listing(report, scene)
        coco = _SceneCoco.read(report, scene)
        for number in sorted(scene.cameras):
            image = read_image(report, scene, number)
            if coco is not None:
                coco.check(report, image)
            yield image
        if coco is not None:
            coco.end(report)
    for folder in sorted({shard.parent for shard in root.glob("*/shard-*.tar")}):
        yield from shard_images(report, folder)


def _check_listing(report: Report, scene: BopScene) -> None:
    """Images and masks of which no JSON file speaks."""
    for kind in ("rgb", "gray", "depth"):
        for file in sorted((scene.folder / kind).glob("*")):
            known = file.stem.isdigit() and int(file.stem) in scene.cameras
            report.holds(known, file, "", "an image", "an entry in scene_camera.json")
    for kind in ("mask", "mask_visib"):
        for file in sorted((scene.folder / kind).glob("*")):
            image, _, number = file.stem.partition("_")
            known = image.isdigit() and number.isdigit() and int(number) < len(scene.poses.get(int(image), []))
            report.holds(known, file, "", "a mask", "an entry in scene_gt.json")


# ------------------------------------------------------------------------------------------------------------ one image


def _check_image(
    report: Report, image: BopImage, models: Models | None, camera: CameraFile | None, expected: Expectations
) -> None:
    _check_camera(report, image, camera)
    path, place = image.about["gt"]
    for k, pose in enumerate(image.poses):
        report.rigid(path, f"{place}.{k}.cam_R_m2c", pose.T_camera_object)
        if models is not None:
            known = sorted(models.info)
            report.holds(pose.obj_id in models.info, path, f"{place}.{k}.obj_id", pose.obj_id, f"one of {known}")
    _check_masks(report, image, expected)
    if image.infos is not None:
        path, place = image.about["gt_info"]
        if report.equal(path, f"{place} (length)", len(image.infos), len(image.poses)):
            for k, info in enumerate(image.infos):
                _check_info(report, path, f"{place}.{k}", info, image, k)


def _check_camera(report: Report, image: BopImage, camera: CameraFile | None) -> None:
    path, place = image.about["camera"]
    K = image.K
    good = K[0, 0] > 0 and K[1, 1] > 0 and (K[2] == (0, 0, 1)).all() and K[1, 0] == 0
    report.holds(bool(good), path, f"{place}.cam_K", image.camera.cam_K, "fx s cx 0 fy cy 0 0 1 with fx, fy > 0")
    R, t = image.camera.cam_R_w2c, image.camera.cam_t_w2c
    report.holds((R is None) == (t is None), path, f"{place}.cam_t_w2c", t, "both or neither of cam_R_w2c, cam_t_w2c")
    if R is not None:
        T = np.eye(4)
        T[:3, :3] = np.reshape(R, (3, 3))
        report.rigid(path, f"{place}.cam_R_w2c", T)
    if camera is not None:
        for name, row, column in (("fx", 0, 0), ("fy", 1, 1), ("cx", 0, 2), ("cy", 1, 2)):
            report.near(path, f"{place}.cam_K ({name})", float(K[row, column]), getattr(camera, name), 1e-6)
        report.near(path, f"{place}.depth_scale", image.camera.depth_scale, camera.depth_scale, 1e-9)
    shape = (camera.height, camera.width) if camera is not None else image.shape
    arrays = {"rgb": [image.rgb], "depth": [image.depth], "mask": image.masks, "mask_visib": image.visible}
    for name, found in arrays.items():
        for k, array in enumerate(found):
            if array is not None:
                file, inside = _mask_place(image, name, k)
                report.equal(file, f"{inside} (size)".strip(), list(array.shape[:2]), list(shape or ()))


def _mask_place(image: BopImage, name: str, k: int) -> tuple[Path, str]:
    path, place = image.about[name]
    if name in ("rgb", "depth"):
        return path, place
    return (path, f"{place}.{k}") if path.suffix == ".tar" else (path.with_name(f"{path.name}{k:06d}.png"), "")


def _check_masks(report: Report, image: BopImage, expected: Expectations) -> None:
    taken: Bool | None = None
    for k, (whole, seen) in enumerate(zip(image.masks, image.visible, strict=True)):
        if whole is None or seen is None or whole.shape != seen.shape:
            continue
        path, place = _mask_place(image, "mask_visib", k)
        outside = int(np.count_nonzero(seen & ~whole))
        report.holds(outside == 0, path, place, f"{outside} pixels outside of the silhouette in mask", "0")
        if expected.exact and taken is not None and taken.shape == seen.shape:
            twice = int(np.count_nonzero(seen & taken))
            report.holds(twice == 0, path, place, f"{twice} pixels that another instance has too", "disjoint masks")
        taken = seen.copy() if taken is None or taken.shape != seen.shape else taken | seen


def _check_info(report: Report, path: Path, place: str, info: GtInfo, image: BopImage, k: int) -> None:
    whole, seen, depth = image.masks[k], image.visible[k], image.depth
    fraction = info.px_count_visib / info.px_count_all if info.px_count_all else 0.0
    report.near(path, f"{place}.visib_fract", info.visib_fract, fraction, 1e-4)
    if seen is not None:
        report.equal(path, f"{place}.px_count_visib", info.px_count_visib, int(np.count_nonzero(seen)))
        report.equal(path, f"{place}.bbox_visib", info.bbox_visib, bop_box(box(seen)))
    if whole is None:
        return
    inside = int(np.count_nonzero(whole))
    report.holds(info.px_count_all >= inside, path, f"{place}.px_count_all", info.px_count_all, f"{inside} or more")
    if depth is not None and depth.shape == whole.shape:
        valid = int(np.count_nonzero(whole & (depth > 0)))
        report.equal(path, f"{place}.px_count_valid", info.px_count_valid, valid)
    if not info.px_count_visib:
        report.equal(path, f"{place}.bbox_obj", info.bbox_obj, NOTHING)
    else:
        _check_amodal_box(report, path, f"{place}.bbox_obj", info.bbox_obj, whole)


def _check_amodal_box(report: Report, path: Path, place: str, amodal: Box, whole: Bool) -> None:
    """The box of the silhouette: that of its mask, or one that holds it and leads out of the image."""
    inside = bop_box(box(whole))
    height, width = whole.shape
    last = (amodal[0] + amodal[2], amodal[1] + amodal[3])
    if amodal[0] >= 0 and amodal[1] >= 0 and last[0] < width and last[1] < height:
        report.equal(path, place, amodal, inside)
    elif inside != NOTHING:
        holds = amodal[0] <= inside[0] and amodal[1] <= inside[1]
        holds &= last[0] >= inside[0] + inside[2] and last[1] >= inside[1] + inside[3]
        report.holds(holds, path, place, list(amodal), f"a box around {list(inside)}, that of mask")


def bop_box(found: tuple[int, int, int, int] | None) -> Box:
    """BOP's [u, v, w, h] with w = last - first pixel."""
    return NOTHING if found is None else (found[0], found[1], found[2] - found[0], found[3] - found[1])


# --------------------------------------------------------------------------------------------------- scene_gt_coco.json


class _Image(Entry):
    id: int
    file_name: str
    width: int
    height: int


class _Rle(Entry):
    counts: str | list[int]
    size: tuple[int, int]


class _Annotation(Entry):
    id: int
    image_id: int
    category_id: int
    area: int
    bbox: tuple[float, float, float, float]
    segmentation: _Rle
    ignore: bool = False


class _Document(Entry):
    images: list[_Image]
    annotations: list[_Annotation]


@dataclass(frozen=True, slots=True, eq=False)
class _SceneCoco:
    """``scene_gt_coco.json``, compared image by image."""

    path: Path
    images: dict[int, _Image]
    annotations: dict[int, list[_Annotation]]
    seen: set[int]

    @staticmethod
    def read(report: Report, scene: BopScene) -> "_SceneCoco | None":
        path = scene.folder / "scene_gt_coco.json"
        document: _Document | None = report.document(path, _Document) if path.exists() else None
        if document is None:
            return None
        by_image: dict[int, list[_Annotation]] = {}
        for annotation in document.annotations:
            by_image.setdefault(annotation.image_id, []).append(annotation)
        numbers = [annotation.id for annotation in document.annotations]
        report.holds(len(set(numbers)) == len(numbers), path, "annotations.id", "a number twice", "unique numbers")
        return _SceneCoco(path, {image.id: image for image in document.images}, by_image, set())

    def check(self, report: Report, image: BopImage) -> None:
        """Compare with masks and poses, which come in the order of scene_gt."""
        self.seen.add(image.image)
        about = self.images.get(image.image)
        if not report.holds(about is not None, self.path, f"images.{image.image}", "nothing", "an entry"):
            return
        assert about is not None
        file = image.about["rgb"][0].relative_to(self.path.parent).as_posix()
        report.equal(self.path, f"images.{image.image}.file_name", about.file_name, file)
        shown = [k for k, mask in enumerate(image.visible) if mask is not None and mask.any()]
        annotations = self.annotations.get(image.image, [])
        place = f"annotations of image {image.image}"
        if not report.equal(self.path, f"{place} (number)", len(annotations), len(shown)):
            return
        for k, annotation in zip(shown, annotations, strict=True):
            self._check(report, f"{place}, id {annotation.id}", annotation, image, k)

    def _check(self, report: Report, place: str, found: _Annotation, image: BopImage, k: int) -> None:
        seen, whole = image.visible[k], image.masks[k]
        assert seen is not None
        report.equal(self.path, f"{place}.category_id", found.category_id, image.poses[k].obj_id)
        report.equal(self.path, f"{place}.area", found.area, int(np.count_nonzero(seen)))
        try:
            same = np.array_equal(decoded(found.segmentation.size, found.segmentation.counts), seen)
            report.holds(same, self.path, f"{place}.segmentation", "another mask", "that of mask_visib")
        except ValueError as error:
            report.add(self.path, f"{place}.segmentation", error, "run lengths of a mask")
        edges = None if whole is None else box(whole)
        if edges is not None:
            amodal = [edges[0], edges[1], edges[2] - edges[0] + 1, edges[3] - edges[1] + 1]
            report.equal(self.path, f"{place}.bbox", [int(value) for value in found.bbox], amodal)
        if image.infos is not None and k < len(image.infos):
            report.equal(self.path, f"{place}.ignore", found.ignore, image.infos[k].visib_fract < EVALUATED)

    def end(self, report: Report) -> None:
        """Entries of images that are not there."""
        for number in sorted((self.images.keys() | self.annotations.keys()) - self.seen):
            report.add(self.path, f"images.{number}", "an entry", "an image of scene_camera.json")


# -------------------------------------------------------------------------------------------------------------- targets


class _Target(Entry):
    scene_id: int
    im_id: int
    obj_id: int | None = None
    inst_count: int | None = None


def _check_targets(report: Report, path: Path, folders: list[Path]) -> None:
    """Every target has to be there as often as is said."""
    targets: list[_Target] = report.document(path, list[_Target]) or []
    scenes: dict[int, BopScene] = {}
    quiet = Report(report.root)  # what is wrong with the scenes has been told
    for folder in folders:
        if folder.parent.name.startswith("test") and SCENE.fullmatch(folder.name):
            scene = read_scene(quiet, folder)
            if scene is not None:
                scenes[int(folder.name)] = scene
    for k, target in enumerate(targets):
        scene = scenes.get(target.scene_id)
        known = scene is not None and target.im_id in scene.cameras
        if not report.holds(known, path, f"{k}", target.model_dump(), "an image of a test scene"):
            continue
        if scene is not None and target.obj_id is not None and target.im_id in scene.infos:
            entries = zip(scene.poses[target.im_id], scene.infos[target.im_id], strict=False)
            count = sum(pose.obj_id == target.obj_id and info.visib_fract >= EVALUATED for pose, info in entries)
            report.equal(path, f"{k}.inst_count", target.inst_count, count)
