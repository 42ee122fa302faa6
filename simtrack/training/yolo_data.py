"""What ultralytics' YOLOv8 learns from: the YOLO part of a generated data set, laid out for one training.

Images stay where they are, behind links. Labels are written anew: ultralytics keeps a cache beside them, which is not
to be left in the data set. Where there is a BOP part, too, boxes become those of whole objects, hidden parts included,
as the search for poses expects them, and objects that look alike in several poses get the keypoints of one of them (see
`canonical_view`), since a network that is taught all of them answers with their mean.
"""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64
from simtrack.datasets.writers.box_keypoints import NAMES
from simtrack.errors import DatasetError, FileFormatError, UnknownNameError
from simtrack.geometry.transforms import apply
from simtrack.objects import load_object
from simtrack.objects.export import MILLIMETRES
from simtrack.sensors.camera import project
from simtrack.simulation.oracles.detector import canonical_view
from simtrack.training.shards import is_held_out
from simtrack.training.source import Source, open_source, read_json

COLUMNS = 5 + 3 * len(NAMES)
"""Of a label: class, box, keypoints with visibility."""
SPLITS = ("train", "val")


@dataclass(frozen=True, slots=True)
class YoloData:
    """A data set as ultralytics reads it."""

    path: Path
    """Of data.yaml."""
    classes: tuple[str, ...]
    """In the order of their indices."""
    images: Mapping[str, int]
    """How many there are for train and, held out, for val."""


def prepare_yolo(root: Path, folder: Path) -> YoloData:
    """Lay a data set out for a training; what was in the folder before is removed.

    Images are held out by the data set's own division (`val_share` of the recipe, by scenes), or, where it has none,
    every 20th scene is.

    Args:
        root: of a data set that `simtrack generate` made.
        folder: where links, labels and data.yaml are put.

    Raises:
        DatasetError: it has no YOLO part, too few scenes, a class that no training image shows, or objects that look
            alike in several poses without a BOP part that tells their poses.
        FileFormatError: its keypoints are others than those of `simtrack.objects`, or a file is missing or damaged.
    """
    part = root / "yolo" / "pose"
    about = _about(root, part / "data.yaml")
    classes = tuple(about["names"].values())
    scenes = _scenes(root, part, about)
    poses = _Poses.of(root, classes)
    shutil.rmtree(folder, ignore_errors=True)
    seen: set[int] = set()
    counts: dict[str, int] = dict.fromkeys(SPLITS, 0)
    for split in SPLITS:
        for images in scenes[split]:
            shown = _lay_out(part, images, folder, split, len(classes), poses)
            counts[split] += len(shown)
            seen |= set().union(*shown) if split == "train" else set()
    missing = [name for index, name in enumerate(classes) if index not in seen]
    if missing:
        reason = f"no training image shows {', '.join(missing)}; generate more, or leave them out"
        raise DatasetError(root, reason)
    return YoloData(_written(folder, about), classes, counts)


def _about(root: Path, path: Path) -> dict[str, Any]:
    """What data.yaml says, checked."""
    import yaml

    if not path.is_file():
        raise DatasetError(root, f"no {path.relative_to(root)} to learn from; add yolo to the recipe's writers")
    try:
        about = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (ValueError, yaml.YAMLError) as error:
        raise FileFormatError(path, "", f"cannot be read: {error}") from error
    about = about if isinstance(about, dict) else {}
    names = about.get("names")
    if not isinstance(names, dict) or not names or sorted(names) != list(range(len(names))):
        raise FileFormatError(path, "names", "expected names of the classes 0, 1, ...")
    about["names"] = {index: str(names[index]) for index in sorted(names)}
    if about.get("kpt_shape") != [len(NAMES), 3]:
        reason = f"is {about.get('kpt_shape')}; expected [{len(NAMES)}, 3]: {', '.join(NAMES)}, with visibility"
        raise FileFormatError(path, "kpt_shape", reason)
    if about.get("kpt_names") != {index: list(NAMES) for index in names}:
        raise FileFormatError(
            path, "kpt_names", f"missing or in another order; expected {', '.join(NAMES)} of each class"
        )
    return about


def _scenes(root: Path, part: Path, about: Mapping[str, Any]) -> dict[str, list[Path]]:
    """Folders of images of complete scenes, no scene in both splits."""
    done = {path.stem for path in (root / "scenes").glob("*.json")}
    found = {}
    for split in SPLITS:
        way = Path(str(about.get(split, "")))
        if way.parts[:1] != ("images",) or ".." in way.parts:
            raise FileFormatError(part / "data.yaml", split, f"is {way}; expected a folder in images/")
        found[split] = sorted(p for p in (part / way).glob("*") if p.name in done) if (part / way).is_dir() else []
    if about["train"] == about["val"]:
        scenes = found["train"]
        found = {split: [p for p in scenes if is_held_out(int(p.name)) == (split == "val")] for split in SPLITS}
    if not found["train"] or not found["val"]:
        counts = f"{len(found['train'])} complete scenes for training, {len(found['val'])} held out"
        raise DatasetError(root, f"{counts}; at least one of each is needed, so generate more images")
    return found


def _lay_out(
    part: Path, images: Path, folder: Path, split: str, classes: int, poses: "_Poses | None"
) -> list[set[int]]:
    """Link the images of a scene and write its labels; returns the classes that each of its images shows."""
    link, labels = (folder / kind / split / images.name for kind in ("images", "labels"))
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(images.resolve(), target_is_directory=True)
    labels.mkdir(parents=True)
    placed = poses.scene(images.name) if poses else {}
    source = part / "labels" / images.relative_to(part / "images")
    shown = []
    for image in sorted(images.glob("*.[jp][pn]g")):
        path = source / f"{image.stem}.txt"
        rows = _rows(path, classes)
        if poses:
            rows = [poses.row(path, row, placed.get(int(image.stem), [])) for row in rows]
        text = "".join(f"{int(row[0])} " + " ".join(f"{value:.6g}" for value in row[1:]) + "\n" for row in rows)
        (labels / path.name).write_text(text, encoding="ascii")
        shown.append({int(row[0]) for row in rows})
    return shown


def _rows(path: Path, classes: int) -> list[Float64]:
    """The labels (COLUMNS,) of an image."""
    if not path.is_file():
        raise FileFormatError(path, "", "no such file; expected the labels of an image, none if it shows nothing")
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            row = np.array([float(word) for word in line.split()])
        except ValueError as error:
            raise FileFormatError(path, f"line {number}", str(error)) from error
        if len(row) != COLUMNS or row[0] not in range(classes):
            reason = f"{len(row)} numbers; expected {COLUMNS}, the first one a class below {classes}"
            raise FileFormatError(path, f"line {number}", reason)
        rows.append(row)
    return rows


@dataclass(frozen=True, slots=True)
class _Placed:
    """An object in an image, as the BOP part has it."""

    index: int
    """Of its class."""
    visible: Float64
    """(4,), box of what is seen: left, top, right, bottom edge, pixels."""
    whole: Float64
    """(4,), of the silhouette as far as it lies in the image, likewise."""
    T_camera_object: Float64
    K: CameraIntrinsics


@dataclass(frozen=True, slots=True)
class _Poses:
    """What the BOP part tells beyond the YOLO part."""

    source: Source
    size: Float64
    """(2,), width and height of images, pixels."""

    @classmethod
    def of(cls, root: Path, classes: tuple[str, ...]) -> "_Poses | None":
        """None where there is no BOP part, and none is needed."""
        try:
            trivial = all(load_object(name).symmetries.trivial for name in classes)
        except UnknownNameError as error:
            reason = f"no model of one of its objects; name their folder in $SIMTRACK_OBJECTS. {error}"
            raise DatasetError(root, reason) from error
        if trivial and not (root / "bop").is_dir():
            return None
        source = open_source(root)
        if source.class_names != classes:
            raise DatasetError(root, f"its BOP part has the classes {source.class_names}, its YOLO part {classes}")
        path = root / "bop" / "camera.json"
        camera = read_json(path)
        try:
            return cls(source, np.array([float(camera["width"]), float(camera["height"])]))
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(path, "width, height", "expected the images' size in pixels") from error

    def scene(self, name: str) -> dict[int, list[_Placed]]:
        """The objects of each image."""
        folder = next((path for path in self.source.scenes if path.name == name), None)
        if folder is None:
            raise DatasetError(self.source.root, f"its BOP part lacks scene {name}, which its YOLO part has")
        cameras, poses, infos = (read_json(folder / f"scene_{kind}.json") for kind in ("camera", "gt", "gt_info"))
        try:
            return {int(image): self._placed(camera, poses[image], infos[image]) for image, camera in cameras.items()}
        except (KeyError, TypeError, ValueError) as error:
            reason = f"no complete entry: {type(error).__name__} {error}"
            raise FileFormatError(folder, "scene_camera.json, scene_gt.json, scene_gt_info.json", reason) from error

    def _placed(self, camera: Any, poses: Any, infos: Any) -> list[_Placed]:
        width, height = (int(value) for value in self.size)
        fx, _, cx, _, fy, cy, *_ = (float(value) for value in camera["cam_K"])
        K, limit = CameraIntrinsics(width, height, fx, fy, cx, cy), np.tile(self.size, 2)
        placed = []
        for pose, info in zip(poses, infos, strict=True):
            if info["px_count_visib"] <= 0:
                continue
            T = np.eye(4)
            T[:3, :3] = np.reshape(pose["cam_R_m2c"], (3, 3))
            T[:3, 3] = np.asarray(pose["cam_t_m2c"]) / MILLIMETRES
            # BOP's widths and heights are differences between the first pixel and the last.
            visible, whole = (
                np.array([x, y, x + w + 1, y + h + 1], float) for x, y, w, h in (info["bbox_visib"], info["bbox_obj"])
            )
            index = self.source.class_of[pose["obj_id"]]
            placed.append(_Placed(index, visible, np.clip(whole, 0.0, limit), T, K))
        return placed

    def row(self, path: Path, row: Float64, placed: list[_Placed]) -> Float64:
        """A label with the box of the whole object and, where it looks alike in others, keypoints of one pose."""
        model = self.source.models[int(row[0])]
        box = np.concatenate([row[1:3] - row[3:5] / 2, row[1:3] + row[3:5] / 2]) * np.tile(self.size, 2)
        same = [p for p in placed if p.index == row[0] and np.allclose(p.visible, box, atol=0.1)]
        if not same:
            reason = f"{model.name} with the box {box.round().astype(int).tolist()} is not in the BOP part"
            raise FileFormatError(path, "", reason)
        low, high = same[0].whole[:2] / self.size, same[0].whole[2:] / self.size
        points = row[5:]
        if not model.symmetries.trivial:
            T = canonical_view(same[0].T_camera_object, model)
            shares = (project(apply(T, model.keypoints), same[0].K) + 0.5) / self.size
            inside = np.all((shares >= 0.0) & (shares <= 1.0), axis=1)
            # Whether a keypoint is seen or hidden makes no difference to ultralytics, only whether it is labelled.
            points = np.where(inside[:, None], np.column_stack([shares, np.full(len(shares), 2.0)]), 0.0).ravel()
        return np.concatenate([row[:1], (low + high) / 2, high - low, points])


def _written(folder: Path, about: Mapping[str, Any]) -> Path:
    import yaml

    kept = {key: about[key] for key in ("names", "kpt_shape", "flip_idx", "kpt_names") if key in about}
    text = yaml.safe_dump(
        {"path": str(folder)} | {split: f"images/{split}" for split in SPLITS} | kept, sort_keys=False
    )
    path = folder / "data.yaml"
    path.write_text(text, encoding="utf-8")
    return path
