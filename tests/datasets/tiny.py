"""A source of small frames, a writer of plain files, and ways to go wrong; made anew in worker processes."""

import errno
import hashlib
import json
import os
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from simtrack.contracts import CameraIntrinsics
from simtrack.datasets.frame import Category, DatasetInfo, LabelledFrame, SceneInfo, StuffCategory
from simtrack.datasets.scene_maker import Event, SceneMaker, SourceFactory
from simtrack.datasets.writer import DatasetWriter
from simtrack.errors import MeshError
from simtrack.geometry.meshes import box_mesh
from simtrack.objects.model import ObjectModel, Symmetries, build_model

INTRINSICS = CameraIntrinsics(32, 24, 30.0, 30.0, 15.5, 11.5)
FRAMES_PER_SCENE = 4


def brick() -> ObjectModel:
    mesh = box_mesh((0.2, 0.1, 0.06), (200, 80, 40))
    return build_model(
        name="brick", semantic_class="component", mesh=mesh, visual=mesh, collision=[mesh], mass=1.0, friction=0.5,
        symmetries=Symmetries(), trackable=True,
    )  # fmt: skip


@dataclass(frozen=True)
class TinyFactory:
    """Makes `TinySource`; `trouble` maps scenes to what happens in the middle of them."""

    seed: int = 0
    recipe: str = "name: tiny\nobjects: {count: 3}\n"
    trouble: dict[int, str] = field(default_factory=dict)
    scratch: Path | None = None
    """Where attempts are counted."""
    delay: float = 0.0
    """Seconds a frame."""

    def __call__(self) -> "TinySource":
        return TinySource(self)


class TinySource:
    def __init__(self, settings: TinyFactory) -> None:
        self._settings = settings
        categories, stuff = (Category(1, brick()),), (StuffCategory(2, "floor", False),)
        self.info = DatasetInfo(
            "tiny", "Noise.", settings.seed, settings.recipe, INTRINSICS, categories, stuff, val_share=0.25
        )

    def scenes(self, count: int) -> int:
        return -(-count // FRAMES_PER_SCENE)

    def scene_info(self, scene: int) -> SceneInfo:
        return SceneInfo(scene, FRAMES_PER_SCENE)

    def frames(self, scene: int) -> Iterator[LabelledFrame]:
        for index in range(FRAMES_PER_SCENE):
            if index == 2 and scene in self._settings.trouble:
                self._go_wrong(scene, self._settings.trouble[scene])
            time.sleep(self._settings.delay)
            yield self._frame(scene, index)

    def close(self) -> None:
        pass

    def _frame(self, scene: int, index: int) -> LabelledFrame:
        rng = np.random.default_rng(np.random.SeedSequence([self._settings.seed, scene, index]))
        height, width = INTRINSICS.height, INTRINSICS.width
        depth = rng.uniform(0.5, 2.0, (height, width)).astype(np.float32)
        return LabelledFrame(
            scene=scene, index=index, stamp=index * 33_000_000, intrinsics=INTRINSICS, T_map_camera=np.eye(4),
            rgb=rng.integers(0, 256, (height, width, 3), dtype=np.uint8), depth=depth, clean_depth=depth,
            normals=np.zeros((height, width, 3), np.float32), ids=np.zeros((height, width), np.int32),
            names=("floor",), segment_categories=np.array([2], np.int32), labels=(),
        )  # fmt: skip

    def _go_wrong(self, scene: int, how: str) -> None:
        assert self._settings.scratch is not None
        tries = self._settings.scratch / f"tries-{scene}"
        with tries.open("a") as stream:
            stream.write("x")
        if how == "die once" and tries.stat().st_size > 1:
            return
        if how in ("die", "die once"):
            os.kill(os.getpid(), signal.SIGKILL)
        if how == "raise":
            raise ZeroDivisionError("a mistake")
        if how == "refuse":
            raise MeshError("brick", "cannot be placed after 100 tries")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "some file")


@dataclass
class PlainWriter:
    """A folder a scene, a log file a scene, and an index of all scenes."""

    name: str = "plain"

    def begin(self, root: Path, info: DatasetInfo) -> None:
        models = root / self.name / "models"
        models.mkdir(parents=True, exist_ok=True)
        for category in info.categories:
            (models / f"obj_{category.id:06d}.txt").write_text(category.model.name)

    def open_scene(self, staging: Path, info: DatasetInfo, scene: SceneInfo) -> "PlainSceneWriter":
        return PlainSceneWriter(staging / self.name, scene.scene)

    def finish(self, root: Path, info: DatasetInfo, scenes: int) -> None:
        index = [json.loads((root / self.name / "logs" / f"{scene:06d}.json").read_text()) for scene in range(scenes)]
        (root / self.name / "index.json").write_text(json.dumps(index, sort_keys=True))


class PlainSceneWriter:
    def __init__(self, folder: Path, scene: int) -> None:
        self._images, self._log = folder / "images" / f"{scene:06d}", folder / "logs" / f"{scene:06d}.json"
        self._images.mkdir(parents=True)
        self._log.parent.mkdir(parents=True)
        self._sums: list[str] = []

    def write(self, frame: LabelledFrame) -> None:
        path = self._images / f"{frame.index:06d}.bin"
        path.write_bytes(frame.rgb.tobytes() + frame.depth.tobytes())
        (self._images / f"{frame.index:06d}.link").hardlink_to(path)
        self._sums.append(hashlib.sha256(path.read_bytes()).hexdigest())

    def close(self) -> None:
        self._log.write_text(json.dumps(self._sums))


class InlinePool:
    """Makes scenes in this process."""

    def __init__(self, factory: SourceFactory, writers: Sequence[DatasetWriter], staging: Path) -> None:
        self._maker = SceneMaker(factory, writers)
        self._events: list[Event] = []

    @property
    def idle(self) -> bool:
        return not self._events

    def start(self, scene: int, staging: Path) -> None:
        self._events += self._maker.make(scene, staging)

    def wait(self, timeout: float) -> list[Event]:
        events, self._events = self._events, []
        return events

    def close(self) -> None:
        pass


def tree(root: Path) -> dict[str, bytes]:
    """Every file below a folder with its content."""
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}
