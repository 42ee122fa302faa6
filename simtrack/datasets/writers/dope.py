"""DOPE's training data: an image and a JSON file each, metres and pixels, poses in the camera's optical frame.

https://github.com/NVlabs/Deep_Object_Pose, data_generation/readme.md. The object frame there is the one here (x to the
front, y to the left, z up, origin in the middle of the box).
"""

from pathlib import Path
from typing import Any, Literal

import numpy as np

from simtrack.datasets.frame import DatasetInfo, InstanceLabel, LabelledFrame, SceneInfo
from simtrack.datasets.writers.images import ColourJpeg, ColourPng, SharedImages
from simtrack.datasets.writers.streams import compact, scene_name, write_whole
from simtrack.geometry.transforms import inverse, quaternion_from_rotation
from simtrack.objects.model import BOX_CORNERS
from simtrack.simulation.strict_file import Strict

CORNERS = np.array(
    [[1, 1, -1], [1, -1, -1], [1, -1, 1], [1, 1, 1], [-1, 1, -1], [-1, -1, -1], [-1, -1, 1], [-1, 1, 1]], float
)
"""(8, 3), signs of the corners in DOPE's order, as drawn in its readme since 10 June 2024; 8 is the centre."""
ORDER = [*(int(np.flatnonzero((corner == BOX_CORNERS).all(axis=1))[0]) for corner in CORNERS), len(BOX_CORNERS)]
"""Which of our keypoints is DOPE's 0, 1, ..., 8."""


class DopeOptions(Strict):
    """What a recipe may say of the writer."""

    image: Literal["jpg", "png"] = "jpg"
    """How colour images are encoded; jpg has quality 95."""


class DopeWriter:
    """Writes DOPE's format; see `simtrack.datasets.writer.DatasetWriter`."""

    name = "dope"

    def __init__(self, options: DopeOptions) -> None:
        self.options = options

    def begin(self, root: Path, info: DatasetInfo) -> None:
        """Write the order of the corners, which the files themselves do not tell."""
        about = {
            "cuboid_corners": CORNERS.astype(int).tolist(),
            "cuboid_order": "Deep_Object_Pose data_generation/readme.md since 10 June 2024; the centre is number 8",
            "dimensions": {category.model.name: category.model.extents.tolist() for category in info.categories},
        }
        (root / self.name).mkdir(parents=True, exist_ok=True)
        write_whole(root / self.name / "conventions.json", compact(about) + "\n")

    def open_scene(self, staging: Path, info: DatasetInfo, scene: SceneInfo) -> "DopeSceneWriter":
        """Start a scene."""
        return DopeSceneWriter(staging, self, info, scene)

    def finish(self, root: Path, info: DatasetInfo, scenes: int) -> None:
        """Nothing is said for all scenes together."""


class DopeSceneWriter:
    """Writes one scene."""

    def __init__(self, staging: Path, writer: DopeWriter, info: DatasetInfo, scene: SceneInfo) -> None:
        self._images = SharedImages.of(staging)
        self._colour = ColourJpeg() if writer.options.image == "jpg" else ColourPng()
        self._classes = {category.id: category.model.name for category in info.categories}
        self._folder = staging / writer.name / scene_name(scene.scene)
        self._folder.mkdir(parents=True)

    def write(self, frame: LabelledFrame) -> None:
        """Write a frame."""
        self._images.save(frame, self._colour, self._folder / f"{frame.index:06d}{self._colour.suffix}")
        objects = [self._describe(label) for label in frame.targets() if label.pixels_visible]
        document = {"camera_data": _camera(frame), "objects": objects}
        (self._folder / f"{frame.index:06d}.json").write_text(compact(document) + "\n", encoding="utf-8", newline="\n")

    def close(self) -> None:
        """Nothing is left to write."""

    def _describe(self, label: InstanceLabel) -> dict[str, Any]:
        assert label.category is not None
        return {
            "class": self._classes[label.category],
            "name": label.name,
            "visibility": label.visible_fraction,
            "location": label.T_camera_object[:3, 3].tolist(),
            "quaternion_xyzw": _xyzw(label.T_camera_object),
            "local_to_world_matrix": label.T_map_object.tolist(),
            "projected_cuboid": label.keypoints[ORDER].tolist(),
        }


def _camera(frame: LabelledFrame) -> dict[str, Any]:
    camera = frame.intrinsics
    return {
        "width": camera.width,
        "height": camera.height,
        "intrinsics": {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
        "camera_view_matrix": inverse(frame.T_map_camera).tolist(),
        "location_world": frame.T_map_camera[:3, 3].tolist(),
        "quaternion_world_xyzw": _xyzw(frame.T_map_camera),
    }


def _xyzw(T: np.ndarray) -> list[float]:
    w, x, y, z = quaternion_from_rotation(T[:3, :3]).tolist()
    return [x, y, z, w]
