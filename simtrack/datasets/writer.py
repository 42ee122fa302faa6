"""The seam between generation and file formats."""

from pathlib import Path
from typing import Protocol, runtime_checkable

from simtrack.datasets.frame import DatasetInfo, LabelledFrame, SceneInfo


@runtime_checkable
class DatasetWriter(Protocol):
    """Writes one format. Scenes are independent, so that workers write them at the same time and in any order.

    A scene's files go into a staging folder of its own whose layout below it is that of the finished data set: the
    caller moves them into place when the scene is complete. What formats want in one file for all scenes is written
    by `finish` from fragments that each scene left, in the order of scenes; called again, it does the same again.
    The bytes depend on the frames alone.
    """

    name: str
    """Of the format, and of its folder in the data set."""

    def begin(self, root: Path, info: DatasetInfo) -> None:
        """Write what needs no frame (models, camera files) under ``root / name``. Called once per run, repeatable."""
        ...

    def open_scene(self, staging: Path, info: DatasetInfo, scene: SceneInfo) -> "SceneWriter":
        """Start a scene whose files go under ``staging / name``."""
        ...

    def finish(self, root: Path, info: DatasetInfo, scenes: int) -> None:
        """Write what is said once for all scenes 0..scenes-1, which lie complete under ``root / name``."""
        ...


class SceneWriter(Protocol):
    """Takes the frames of one scene, in order."""

    def write(self, frame: LabelledFrame) -> None:
        """Write a frame."""
        ...

    def close(self) -> None:
        """Write what belongs to the whole scene and release files; called after the last frame."""
        ...
