"""What a look at a data set needs: some images with all labels, and statistics of all of them, from the files."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtrack.contracts import Bool, Float32, Float64, Uint8
from simtrack.datasets.folder import DESCRIPTION, read_json
from simtrack.datasets.validation.bop import is_bop
from simtrack.datasets.validation.bop_images import BopImage, read_image, read_scene, scene_folders
from simtrack.datasets.validation.findings import Report
from simtrack.datasets.validation.masks import box, decoded
from simtrack.datasets.validation.models import MILLIMETRES, ModelInfo
from simtrack.errors import DatasetError
from simtrack.geometry.transforms import apply
from simtrack.objects.model import BOX_CORNERS
from simtrack.recordings.files import inside, read_rgb

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class SeenInstance:
    """One labelled object in an image."""

    class_name: str
    visible: Bool | None
    """(H, W)."""
    box: tuple[int, int, int, int] | None
    """(u0, v0, u1, v1), first and last pixel of what is seen."""
    fraction: float | None
    """0 to 1, seen of the whole silhouette."""
    cuboid: Float64 | None = None
    """(9, 2), pixels: corners of the model's box in the order of `BOX_CORNERS`, then its centre; None behind the
    camera or without a pose."""
    axes: Float64 | None = None
    """(4, 2), pixels: origin and tips of the object frame's x, y and z axes."""
    keypoints: Float64 | None = None
    """(K, 3), u, v and visibility as COCO's: 0 not labelled, 1 hidden, 2 seen."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenImage:
    """One image with its labels."""

    name: str
    """For people: scene and number."""
    rgb: Uint8
    """(H, W, 3)."""
    depth: Float32 | None
    """(H, W), metres."""
    instances: tuple[SeenInstance, ...]
    keypoints: Float64 | None = None
    """(K, 3), of all instances, as in `SeenInstance`, where a file holds them image by image."""


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """One row an instance, of all images; columns that the data set does not tell are empty."""

    classes: tuple[str, ...]
    images: int
    scenes: int
    category: np.ndarray
    """(N,), index into `classes`."""
    image: np.ndarray
    """(N,), number of its image in the data set."""
    fraction: Float64
    """(N,), visible fraction."""
    pixels: Float64
    """(N,), that are seen."""
    middle: Float64
    """(N, 2), of the box of what is seen, in shares of the image's width and height; NaN of what is not seen."""
    distance: Float64
    """(N,), metres from the camera to the object frame's origin."""
    viewpoint: Float64
    """(N, 3), unit vector from the object to the camera, in the object frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Inspection:
    """A data set to be shown."""

    name: str
    source: str
    """Format that was read."""
    about: Mapping[str, object]
    """Content of ``dataset.json``, empty for a data set of others."""
    statistics: Statistics
    images: tuple[SeenImage, ...]


def inspect(root: Path, count: int = 12, say: Say = lambda text: None) -> Inspection:
    """Look at a data set: all of its labels, and `count` of its images, evenly spread.

    Raises:
        DatasetError: neither BOP nor COCO is there.
    """
    if not root.is_dir():
        raise DatasetError(root, "is no folder")
    about = read_json(root / DESCRIPTION) if (root / DESCRIPTION).is_file() else {}
    name = str(about.get("name", root.resolve().name))
    for folder in (root / "bop", root):
        if folder.is_dir() and is_bop(folder) and scene_folders(folder):
            names = about.get("categories")
            look = _BopLook(root, folder, names if isinstance(names, dict) else {}, say)
            return Inspection(name, "BOP", about, *look.take(count))
    for folder in (root / "coco", root):
        if any((folder / "annotations").glob("*.json")):
            return Inspection(name, "COCO", about, *_CocoLook(folder, say).take(count))
    raise DatasetError(root, "holds neither BOP (scenes of images) nor COCO; logs are looked at with simtrack replay")


def spread(total: int, count: int) -> list[int]:
    """`count` numbers below `total`, evenly spread; all if there are no more."""
    count = min(count, total)
    return [int((k + 0.5) * total / count) for k in range(count)]


# ------------------------------------------------------------------------------------------------------------------ BOP


class _BopLook:
    """Reads a BOP data set; what is damaged is left out, see `simtrack.datasets.validation`."""

    def __init__(self, root: Path, folder: Path, names: Mapping[str, object], say: Say) -> None:
        self._root, self._folder, self._report, self._say = root, folder, Report(root), say
        models = self._report.document(folder / "models" / "models_info.json", dict[int, ModelInfo])
        self._models: dict[int, ModelInfo] = models or {}
        self._names = {number: str(names.get(str(number), f"obj_{number:06d}")) for number in self._models}

    def take(self, count: int) -> tuple[Statistics, tuple[SeenImage, ...]]:
        """Statistics, and `count` images."""
        self._say("reading labels")
        folders = scene_folders(self._folder)
        rows: list[tuple[float, ...]] = []
        places: list[tuple[Path, int]] = []
        for folder in folders:
            scene = read_scene(self._report, folder)
            for number in sorted(scene.cameras) if scene is not None else ():
                assert scene is not None
                size = self._size(folder)
                for pose, info in zip(scene.poses.get(number, []), scene.infos.get(number, []), strict=False):
                    T = pose.T_camera_object
                    distance = float(np.linalg.norm(T[:3, 3]))
                    direction = -(T[:3, :3].T @ T[:3, 3]) / max(distance, 1e-9)
                    u, v, w, h = info.bbox_visib
                    seen = info.px_count_visib > 0
                    middle = ((u + w / 2) / size[0], (v + h / 2) / size[1]) if seen else (np.nan, np.nan)
                    row = (pose.obj_id, len(places), info.visib_fract, info.px_count_visib, *middle, distance)
                    rows.append((*row, *direction))
                places.append((folder, number))
        if not places:
            raise DatasetError(self._root, "holds no image whose labels can be read; simtrack validate tells why")
        self._say("drawing images")
        images = [self._image(*places[k]) for k in spread(len(places), count)]
        return self._statistics(rows, len(places), len(folders)), tuple(i for i in images if i is not None)

    def _size(self, folder: Path) -> tuple[int, int]:
        camera = self._folder / "camera.json"
        if camera.is_file():
            about = read_json(camera)
            return int(about["width"]), int(about["height"])
        first = next(iter(sorted((folder / "rgb").glob("*")) + sorted((folder / "gray").glob("*"))))
        height, width = read_rgb(first).shape[:2]
        return width, height

    def _statistics(self, rows: Sequence[tuple[float, ...]], images: int, scenes: int) -> Statistics:
        table = np.array(rows, float).reshape(len(rows), 10)
        numbers = sorted(self._models.keys() | {int(row[0]) for row in rows})
        classes = tuple(self._names.get(number, f"obj_{number:06d}") for number in numbers)
        category = np.searchsorted(numbers, table[:, 0].astype(int))
        columns = table[:, 1].astype(int), table[:, 2], table[:, 3], table[:, 4:6], table[:, 6], table[:, 7:10]
        return Statistics(classes, images, scenes, category, *columns)

    def _image(self, folder: Path, number: int) -> SeenImage | None:
        scene = read_scene(self._report, folder)
        if scene is None:
            return None
        image = read_image(self._report, scene, number)
        if image.rgb is None:
            return None
        instances = tuple(self._instance(image, k) for k in range(len(image.poses)))
        name = f"scene {int(folder.name)}, image {number}"
        return SeenImage(name, image.rgb, image.depth, instances, self._keypoints(image))

    def _instance(self, image: BopImage, k: int) -> SeenInstance:
        pose, visible = image.poses[k], image.visible[k]
        info = image.infos[k] if image.infos is not None and k < len(image.infos) else None
        about = self._models.get(pose.obj_id)
        points = None
        if about is not None:
            low = np.array([about.min_x, about.min_y, about.min_z]) / MILLIMETRES
            size = np.array([about.size_x, about.size_y, about.size_z]) / MILLIMETRES
            corners = low + 0.5 * size + 0.5 * np.vstack([BOX_CORNERS, np.zeros(3)]) * size
            tips = np.vstack([np.zeros(3), 0.6 * float(size.max()) * np.eye(3)])
            points = apply(pose.T_camera_object, np.vstack([corners, tips]))
        drawable = points is not None and bool((points[:, 2] > 0.01).all())
        pixels = None
        if points is not None and drawable:
            projected = points @ image.K.T
            pixels = projected[:, :2] / projected[:, 2:]
        return SeenInstance(
            self._names.get(pose.obj_id, f"obj_{pose.obj_id:06d}"), visible,
            None if visible is None else box(visible), None if info is None else info.visib_fract,
            None if pixels is None else pixels[:9], None if pixels is None else pixels[9:],
        )  # fmt: skip

    def _keypoints(self, image: BopImage) -> Float64 | None:
        """Keypoints with visibility from the YOLO labels of the same image, if there are any."""
        name = f"{image.scene:06d}/{image.image:06d}.txt"
        for file in sorted((self._root / "yolo" / "pose" / "labels").glob(f"*/{name}")):
            lines = [line.split() for line in file.read_text(encoding="ascii").splitlines()]
            if lines and image.shape is not None and all((len(line) - 5) % 3 == 0 for line in lines):
                height, width = image.shape
                points = np.concatenate([np.array(line[5:], float).reshape(-1, 3) for line in lines])
                return points * (width, height, 1.0) - (0.5, 0.5, 0.0)
        return None


# ----------------------------------------------------------------------------------------------------------------- COCO


class _CocoLook:
    """Reads the COCO files of a folder: those with keypoints if there are some, else those with instances."""

    def __init__(self, folder: Path, say: Say) -> None:
        self._folder, self._say = folder, say
        files = sorted((folder / "annotations").glob("*.json"))
        chosen = [file for kind in ("keypoints", "instances") for file in files if kind in file.name]
        kind = chosen[0].name.split("_")[0] if chosen else ""
        self._files = [file for file in files if not kind or file.name.startswith(kind)]

    def take(self, count: int) -> tuple[Statistics, tuple[SeenImage, ...]]:
        """Statistics, and `count` images."""
        self._say("reading labels")
        names: dict[int, str] = {}
        images: list[dict] = []
        labels: list[list[dict]] = []
        for file in self._files:
            document = read_json(file)
            names |= {c["id"]: c["name"] for c in document["categories"]}
            places = {image["id"]: len(images) + k for k, image in enumerate(document["images"])}
            images += document["images"]
            labels += [[] for _ in document["images"]]
            for annotation in document["annotations"]:
                if "bbox" in annotation and annotation.get("image_id") in places:
                    labels[places[annotation["image_id"]]].append(annotation)
        if not images:
            raise DatasetError(self._folder, "holds no image")
        self._say("drawing images")
        shown = tuple(self._image(images[k], labels[k], names) for k in spread(len(images), count))
        return _coco_statistics(images, labels, names), shown

    def _image(self, about: Mapping, labels: Sequence[Mapping], names: Mapping[int, str]) -> SeenImage:
        path = inside(self._folder / "images", about["file_name"], self._files[0], "file_name")
        instances = []
        for label in labels:
            u, v, w, h = label["bbox"]
            edges = (int(u), int(v), int(u + w) - 1, int(v + h) - 1)
            keypoints = np.reshape(label["keypoints"], (-1, 3)).astype(float) if label.get("keypoints") else None
            mask = _coco_mask(label.get("segmentation"))
            instances.append(SeenInstance(names[label["category_id"]], mask, edges, None, keypoints=keypoints))
        return SeenImage(about["file_name"], read_rgb(path), None, tuple(instances))


def _coco_mask(segmentation: object) -> Bool | None:
    if isinstance(segmentation, dict):
        height, width = segmentation["size"]
        return decoded((height, width), segmentation["counts"])
    return None


def _coco_statistics(
    images: Sequence[Mapping], labels: Sequence[Sequence[Mapping]], names: Mapping[int, str]
) -> Statistics:
    def rows() -> Iterator[tuple[float, ...]]:
        for k, (image, annotations) in enumerate(zip(images, labels, strict=True)):
            for a in annotations:
                u, v, w, h = a["bbox"]
                yield (
                    a["category_id"],
                    k,
                    a.get("area", w * h),
                    (u + w / 2) / image["width"],
                    (v + h / 2) / image["height"],
                )

    table = np.array(list(rows()), float).reshape(-1, 5)
    numbers = sorted(names)
    none, scenes = np.empty(0), {str(Path(image["file_name"]).parent) for image in images}
    return Statistics(
        tuple(names[number] for number in numbers), len(images), len(scenes),
        np.searchsorted(numbers, table[:, 0].astype(int)), table[:, 1].astype(int), none, table[:, 2], table[:, 3:5],
        none, np.empty((0, 3)),
    )  # fmt: skip
