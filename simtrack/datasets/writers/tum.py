"""RGB-D sequences in the format of the TUM benchmark.

https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats

One folder a scene. Depth has 5000 steps in a metre; the ground truth is the pose of the camera's optical frame in the
map. ``camera.json`` holds width, height, fx, fy, cx, cy, for which the benchmark has no file.
"""

from pathlib import Path
from typing import Literal

from simtrack.contracts import NANOSECONDS, Float64
from simtrack.datasets.frame import DatasetInfo, LabelledFrame, SceneInfo
from simtrack.datasets.writers.images import ColourJpeg, ColourPng, DepthPng, SharedImages
from simtrack.datasets.writers.streams import compact, scene_name, write_whole
from simtrack.geometry.transforms import quaternion_from_rotation
from simtrack.simulation.strict_file import Strict

DEPTH = DepthPng(5000.0)

_HEADERS = {
    "rgb.txt": "# color images\n# timestamp filename\n",
    "depth.txt": "# depth maps\n# timestamp filename\n",
    "associations.txt": "# timestamp of colour, filename, timestamp of depth, filename\n",
    "groundtruth.txt": "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n",
}


class TumOptions(Strict):
    """What a recipe may say of the writer."""

    image: Literal["jpg", "png"] = "png"
    """How colour images are encoded; jpg has quality 95."""


class TumWriter:
    """Writes sequences; see `simtrack.datasets.writer.DatasetWriter`."""

    name = "tum"

    def __init__(self, options: TumOptions) -> None:
        self.options = options

    def begin(self, root: Path, info: DatasetInfo) -> None:
        """Nothing is said for all scenes together."""

    def open_scene(self, staging: Path, info: DatasetInfo, scene: SceneInfo) -> "TumSceneWriter":
        """Start a scene."""
        return TumSceneWriter(staging, self, info, scene)

    def finish(self, root: Path, info: DatasetInfo, scenes: int) -> None:
        """Nothing is said for all scenes together."""


class TumSceneWriter:
    """Writes one scene."""

    def __init__(self, staging: Path, writer: TumWriter, info: DatasetInfo, scene: SceneInfo) -> None:
        self._images = SharedImages.of(staging)
        self._colour = ColourJpeg() if writer.options.image == "jpg" else ColourPng()
        self._folder = staging / writer.name / scene_name(scene.scene)
        for name in ("rgb", "depth"):
            (self._folder / name).mkdir(parents=True)
        self._files = {name: (self._folder / name).open("w", encoding="ascii", newline="\n") for name in _HEADERS}
        for name, header in _HEADERS.items():
            self._files[name].write(header)
        camera = {name: getattr(info.intrinsics, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        write_whole(self._folder / "camera.json", compact(camera) + "\n")

    def write(self, frame: LabelledFrame) -> None:
        """Write a frame."""
        time = f"{frame.stamp // NANOSECONDS}.{frame.stamp % NANOSECONDS:09d}"
        colour, depth = f"rgb/{time}{self._colour.suffix}", f"depth/{time}{DEPTH.suffix}"
        self._images.save(frame, self._colour, self._folder / colour)
        self._images.save(frame, DEPTH, self._folder / depth)
        lines = {
            "rgb.txt": f"{time} {colour}",
            "depth.txt": f"{time} {depth}",
            "associations.txt": f"{time} {colour} {time} {depth}",
            "groundtruth.txt": f"{time} {_pose(frame.T_map_camera)}",
        }
        for name, line in lines.items():
            self._files[name].write(line + "\n")

    def close(self) -> None:
        """Release the files."""
        for file in self._files.values():
            file.close()


def _pose(T: Float64) -> str:
    w, x, y, z = quaternion_from_rotation(T[:3, :3]).tolist()
    return " ".join(f"{value:.9f}" for value in (*T[:3, 3].tolist(), x, y, z, w))
