"""Images of BOP data sets with all that is said of them, from folders of scenes and from webdataset shards alike."""

import json
import re
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from simtrack.contracts import Bool, Float32, Float64, Uint8
from simtrack.datasets.validation.findings import Entry, Report
from simtrack.datasets.validation.masks import decoded
from simtrack.datasets.validation.models import MILLIMETRES
from simtrack.errors import FileFormatError
from simtrack.recordings.files import decoded_depth, decoded_image, decoded_rgb, read_bytes

SCENE = re.compile(r"\d{6}")
Matrix = Annotated[list[float], Field(min_length=9, max_length=9)]
Vector = tuple[float, float, float]
Box = tuple[int, int, int, int]


class Camera(Entry):
    """An entry of ``scene_camera.json``."""

    cam_K: Matrix
    depth_scale: Annotated[float, Field(gt=0.0)] = 1.0
    cam_R_w2c: Matrix | None = None
    cam_t_w2c: Vector | None = None


class Pose(Entry):
    """An entry of ``scene_gt.json``."""

    obj_id: Annotated[int, Field(ge=1)]
    cam_R_m2c: Matrix
    cam_t_m2c: Vector

    @property
    def T_camera_object(self) -> Float64:
        """(4, 4), metres."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.reshape(self.cam_R_m2c, (3, 3)), np.array(self.cam_t_m2c) / MILLIMETRES
        return T


class GtInfo(Entry):
    """An entry of ``scene_gt_info.json``."""

    bbox_obj: Box
    bbox_visib: Box
    px_count_all: Annotated[int, Field(ge=0)]
    px_count_valid: Annotated[int, Field(ge=0)]
    px_count_visib: Annotated[int, Field(ge=0)]
    visib_fract: Annotated[float, Field(ge=0.0, le=1.0)]


@dataclass(frozen=True, slots=True, eq=False)
class BopImage:
    """One image. Parts that could not be read are None; why has been told."""

    scene: int
    image: int
    about: "dict[str, tuple[Path, str]]"
    """camera, gt, gt_info, rgb, depth, mask, mask_visib -> (file, place in it), for findings."""
    camera: Camera
    poses: list[Pose]
    infos: list[GtInfo] | None
    rgb: Uint8 | None
    """(H, W, 3)."""
    depth: Float32 | None
    """(H, W), metres, 0 = no reading."""
    masks: list[Bool | None]
    """(H, W) each, one a pose."""
    visible: list[Bool | None]

    @property
    def K(self) -> Float64:
        """(3, 3)."""
        return np.reshape(self.camera.cam_K, (3, 3))

    @property
    def shape(self) -> tuple[int, int] | None:
        """(H, W), as the image that is there says."""
        found = self.rgb if self.rgb is not None else self.depth
        return None if found is None else (found.shape[0], found.shape[1])


# --------------------------------------------------------------------------------------------------- folders of scenes


def scene_folders(root: Path) -> list[Path]:
    """The scenes of a data set in BOP's layout, of all its splits."""
    return sorted(
        folder
        for split in root.iterdir()
        if split.is_dir() and re.match(r"(train|val|test)(_\w+)?$", split.name)
        for folder in split.iterdir()
        if SCENE.fullmatch(folder.name) and folder.is_dir()
    )


@dataclass(frozen=True, slots=True, eq=False)
class BopScene:
    """The JSON files of a scene."""

    folder: Path
    cameras: dict[int, Camera]
    poses: dict[int, list[Pose]]
    infos: dict[int, list[GtInfo]]


def read_scene(report: Report, folder: Path) -> BopScene | None:
    """The scene's JSON files, and whether they speak of the same images; None if one of them cannot be used."""
    cameras = report.document(folder / "scene_camera.json", dict[int, Camera])
    poses = report.document(folder / "scene_gt.json", dict[int, list[Pose]])
    infos = {}
    if (folder / "scene_gt_info.json").exists():
        infos = report.document(folder / "scene_gt_info.json", dict[int, list[GtInfo]])
    if cameras is None or poses is None or infos is None:
        return None
    for name, entries in (("scene_gt.json", poses), *([("scene_gt_info.json", infos)] if infos else [])):
        for image in sorted(cameras.keys() ^ entries.keys()):
            there = "nothing" if image in cameras else "an entry"
            report.add(folder / name, str(image), there, "an entry for each of scene_camera.json")
    return BopScene(folder, cameras, poses, infos)


def read_image(report: Report, scene: BopScene, image: int) -> BopImage:
    """One image of a scene."""
    folder, name = scene.folder, f"{image:06d}"
    camera, poses = scene.cameras[image], scene.poses.get(image, [])
    colour = _colour_file(folder, name)
    about = {kind: (folder / f"scene_{kind}.json", str(image)) for kind in ("camera", "gt", "gt_info")}
    about |= {"rgb": (colour, ""), "depth": (folder / "depth" / f"{name}.png", "")}
    masks = {
        kind: [folder / kind / f"{name}_{k:06d}.png" for k in range(len(poses))] for kind in ("mask", "mask_visib")
    }
    about |= {kind: (folder / kind / f"{name}_", "") for kind in masks}
    depth_file = about["depth"][0]
    has_depth, has_masks = depth_file.parent.is_dir(), (folder / "mask_visib").is_dir()
    return BopImage(
        int(folder.name), image, about, camera, poses, scene.infos.get(image),
        rgb=report.read(colour, lambda file: decoded_rgb(read_bytes(file), file)),
        depth=report.read(depth_file, lambda file: _depth(read_bytes(file), file, camera)) if has_depth else None,
        masks=[_mask_file(report, file) if has_masks else None for file in masks["mask"]],
        visible=[_mask_file(report, file) if has_masks else None for file in masks["mask_visib"]],
    )  # fmt: skip


def _colour_file(folder: Path, name: str) -> Path:
    candidates = [folder / kind / f"{name}{suffix}" for kind in ("rgb", "gray") for suffix in (".jpg", ".png", ".tif")]
    return next((file for file in candidates if file.exists()), candidates[0])


def _depth(data: bytes, path: Path, camera: Camera) -> Float32:
    return decoded_depth(data, path, camera.depth_scale / MILLIMETRES)


def _mask_file(report: Report, path: Path) -> Bool | None:
    def load(file: Path) -> Bool:
        image = decoded_image(read_bytes(file), file)
        if image.dtype != np.uint8 or image.ndim != 2 or not np.isin(image, (0, 255)).all():
            reason = f"{image.dtype} image of shape {image.shape}; masks are 8-bit grey and have 0 and 255 only"
            raise FileFormatError(file, "", reason)
        return image > 0

    return report.read(path, load)


# ----------------------------------------------------------------------------------------------------------- webdataset


class _Rle(Entry):
    counts: str | list[int]
    size: tuple[int, int]


def shard_images(report: Report, folder: Path) -> Iterator[BopImage]:
    """The images of the shards in a folder, and whether ``key_to_shard.json`` finds them."""
    index = report.document(folder / "key_to_shard.json", dict[str, int])
    found: dict[str, int] = {}
    for shard in sorted(folder.glob("shard-[0-9]*.tar")):
        number = int(shard.stem.removeprefix("shard-"))
        members = report.read(shard, _members)
        for key, files in sorted((members or {}).items()):
            found[key] = number
            image = _shard_image(report, shard, key, files)
            if image is not None:
                yield image
    if index is not None:
        for key in sorted(index.keys() | found.keys()):
            report.equal(folder / "key_to_shard.json", key, index.get(key), found.get(key))


def _members(path: Path) -> dict[str, dict[str, bytes]]:
    """Image -> extension -> content."""
    out: dict[str, dict[str, bytes]] = {}
    try:
        with tarfile.open(path) as archive:
            for member in archive:
                key, _, extension = member.name.partition(".")
                stream = archive.extractfile(member)
                if stream is not None:
                    out.setdefault(key, {})[extension] = stream.read()
    except tarfile.TarError as error:
        raise FileFormatError(path, "", f"is no archive: {str(error).splitlines()[0]}") from error
    return out


def _shard_image(report: Report, shard: Path, key: str, files: dict[str, bytes]) -> BopImage | None:
    if not report.holds(bool(re.fullmatch(r"\d{6}_\d{6}", key)), shard, key, key, "SCENE_IMAGE, six digits each"):
        return None
    kinds = {"camera": Camera, "gt": list[Pose], "gt_info": list[GtInfo], "mask": dict[int, _Rle]}
    kinds["mask_visib"] = dict[int, _Rle]
    parts = {}
    for name, kind in kinds.items():
        member = f"{key}.{name}.json"
        if not report.holds(f"{name}.json" in files, shard, member, "nothing", "a member of the archive"):
            return None
        try:
            parts[name] = report.typed(shard, json.loads(files[f"{name}.json"]), kind, member)
        except ValueError as error:
            report.add(shard, member, error, "JSON")
            return None
    if any(part is None for part in parts.values()):
        return None
    rgb = next((name for name in ("rgb.jpg", "rgb.png", "gray.tiff") if name in files), "rgb.jpg")
    scene, image = map(int, key.split("_"))
    camera: Camera = parts["camera"]
    about = {name: (shard, f"{key}.{name}.json") for name in kinds} | {"rgb": (shard, f"{key}.{rgb}")}
    about["depth"] = (shard, f"{key}.depth.png")

    def masks(name: str) -> list[Bool | None]:
        runs: dict[int, _Rle] = parts[name]
        return [
            _decoded(report, shard, f"{key}.{name}.json.{k}", runs[k]) if k in runs else None
            for k in range(len(parts["gt"]))
        ]

    return BopImage(
        scene, image, about, camera, parts["gt"], parts["gt_info"],
        rgb=report.read(shard, lambda file: decoded_rgb(files.get(rgb, b""), file / f"{key}.{rgb}")),
        depth=report.read(shard, lambda file: _depth(files["depth.png"], file / f"{key}.depth.png", camera))
        if "depth.png" in files else None,
        masks=masks("mask"), visible=masks("mask_visib"),
    )  # fmt: skip


def _decoded(report: Report, path: Path, field: str, rle: _Rle) -> Bool | None:
    try:
        return decoded(rle.size, rle.counts)
    except ValueError as error:
        report.add(path, field, error, "run lengths of a mask")
        return None
