"""YOLO as Ultralytics reads it: pose and segment, as told on https://docs.ultralytics.com/datasets .

Each task is a data set of its own, ``pose`` and ``segment``, whose images are the same files. Coordinates are shares of
the image's width and height measured from its edges, so that pixel 0's centre lies at half a pixel.
"""

from pathlib import Path
from typing import Any, Literal, TypeAlias

from pydantic import Field

from simtrack.datasets.frame import DatasetInfo, InstanceLabel, LabelledFrame, SceneInfo
from simtrack.datasets.writers.box_keypoints import NAMES, flip_index
from simtrack.datasets.writers.images import ColourJpeg, ColourPng, SharedImages
from simtrack.datasets.writers.masks import polygon, visible_mask
from simtrack.datasets.writers.streams import scene_name, split_of, write_whole
from simtrack.simulation.strict_file import Strict

Task: TypeAlias = Literal["pose", "segment"]

_HEADERS: dict[str, str] = {
    "pose": (
        "# Keypoints: corners of the boxes and their centre; 0 0 0 = outside the image, 1 = hidden, 2 = seen.\n"
        "# flip_idx holds for objects that are their own mirror image; train with fliplr=0 if yours are not.\n"
    ),
    "segment": "# Polygons around what is seen; parts and holes of one instance hang together by bridges.\n",
}


class YoloOptions(Strict):
    """What a recipe may say of the writer."""

    tasks: tuple[Task, ...] = Field(default=("pose", "segment"), min_length=1)
    image: Literal["jpg", "png"] = "jpg"
    """How colour images are encoded; jpg has quality 95."""
    min_pixels: int = Field(default=10, ge=1, le=1_000_000)
    """Instances of which fewer pixels are seen are left out."""


class YoloWriter:
    """Writes YOLO; see `simtrack.datasets.writer.DatasetWriter`."""

    name = "yolo"

    def __init__(self, options: YoloOptions) -> None:
        self.options = options

    def begin(self, root: Path, info: DatasetInfo) -> None:
        """Nothing is known before the scenes are."""

    def open_scene(self, staging: Path, info: DatasetInfo, scene: SceneInfo) -> "YoloSceneWriter":
        """Start a scene."""
        return YoloSceneWriter(staging, self, info, scene)

    def finish(self, root: Path, info: DatasetInfo, scenes: int) -> None:
        """Write ``data.yaml``. Without a scene for validation, the images for training serve for it too."""
        import yaml

        splits = {split_of(info, scene) for scene in range(scenes)}
        ways = {split: f"images/{split}" if split in splits else f"images/{info.split}" for split in ("train", "val")}
        if info.split == "test":
            ways["test"] = "images/test"
        for task in self.options.tasks:
            about: dict[str, Any] = ways | {"names": {c.id - 1: c.model.name for c in info.categories}}
            if task == "pose":
                about |= {"kpt_shape": [len(NAMES), 3], "flip_idx": flip_index(info.categories)}
                about |= {"kpt_names": {c.id - 1: list(NAMES) for c in info.categories}}
            text = yaml.safe_dump(about, sort_keys=False, default_flow_style=None, width=120)
            (root / self.name / task).mkdir(parents=True, exist_ok=True)
            write_whole(root / self.name / task / "data.yaml", _HEADERS[task] + text)


class YoloSceneWriter:
    """Writes one scene."""

    def __init__(self, staging: Path, writer: YoloWriter, info: DatasetInfo, scene: SceneInfo) -> None:
        self._options, self._shared = writer.options, SharedImages.of(staging)
        self._colour = ColourJpeg() if writer.options.image == "jpg" else ColourPng()
        self._way = Path(split_of(info, scene.scene), scene_name(scene.scene))
        self._root = staging / writer.name
        for task in writer.options.tasks:
            for kind in ("images", "labels"):
                (self._root / task / kind / self._way).mkdir(parents=True)

    def write(self, frame: LabelledFrame) -> None:
        """Write a frame."""
        for task in self._options.tasks:
            describe = pose_line if task == "pose" else segment_line
            shown = [label for label in frame.targets() if label.pixels_visible >= self._options.min_pixels]
            text = "".join(describe(frame, label) + "\n" for label in shown)
            image, folder = f"{frame.index:06d}", self._root / task
            self._shared.save(frame, self._colour, folder / "images" / self._way / f"{image}{self._colour.suffix}")
            (folder / "labels" / self._way / f"{image}.txt").write_text(text, encoding="ascii", newline="\n")

    def close(self) -> None:
        """Nothing is left to write."""


def pose_line(frame: LabelledFrame, label: InstanceLabel) -> str:
    """Class, box of what is seen, keypoints."""
    assert label.category is not None
    width, height = frame.intrinsics.width, frame.intrinsics.height
    left, top, wide, high = visible_mask(frame, label).box
    box = [(left + 0.5 * wide) / width, (top + 0.5 * high) / height, wide / width, high / height]
    words = [str(label.category - 1), *(f"{value:.6f}" for value in box)]
    for (u, v), visibility in zip(label.keypoints.tolist(), label.keypoint_visibility.tolist(), strict=True):
        words.append(f"{(u + 0.5) / width:.6f} {(v + 0.5) / height:.6f} {visibility}" if visibility else "0 0 0")
    return " ".join(words)


def segment_line(frame: LabelledFrame, label: InstanceLabel) -> str:
    """Class and polygon."""
    assert label.category is not None
    points = (polygon(visible_mask(frame, label)) + 0.5) / [frame.intrinsics.width, frame.intrinsics.height]
    return f"{label.category - 1}" + " %.6f" * points.size % tuple(points.ravel().tolist())
