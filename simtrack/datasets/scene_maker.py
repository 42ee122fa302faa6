"""What a worker does, whatever runs it: makes one scene after the other, each in a folder of its own."""

import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Protocol, TypeAlias

from simtrack.datasets.folder import SPACE_ERRORS, SceneMarker, scene_units, sync_tree
from simtrack.datasets.frame import DatasetInfo, LabelledFrame, SceneInfo
from simtrack.datasets.writer import DatasetWriter
from simtrack.errors import DatasetError, SimtrackError


class FrameSource(Protocol):
    """Where frames come from (`simtrack.datasets.generator.Generator`)."""

    @property
    def info(self) -> DatasetInfo:
        """What all frames have in common."""
        ...

    def scenes(self, count: int) -> int:
        """Number of scenes that hold `count` frames."""
        ...

    def scene_info(self, scene: int) -> SceneInfo:
        """What all frames of a scene have in common."""
        ...

    def frames(self, scene: int) -> Iterator[LabelledFrame]:
        """The frames of a scene, in order."""
        ...

    def close(self) -> None:
        """Release what is held."""
        ...


SourceFactory: TypeAlias = Callable[[], FrameSource]
"""Makes the source in the process that uses it; can be pickled."""


class Failure(StrEnum):
    """Why a scene was not made."""

    DIED = "died"
    """Its worker's process ended: worth another try."""
    SPACE = "space"
    """Nothing more can be written: no scene can be made."""
    REFUSED = "refused"
    """The recipe cannot be followed in this scene."""
    ERROR = "error"
    """Anything else that was raised."""


@dataclass(frozen=True, slots=True)
class FrameWritten:
    """One more frame of a scene is written."""

    scene: int


@dataclass(frozen=True, slots=True)
class SceneReady:
    """A scene lies complete in its staging folder, synced."""

    scene: int
    marker: SceneMarker


@dataclass(frozen=True, slots=True)
class SceneFailed:
    """A scene was not made."""

    scene: int
    failure: Failure
    message: str


Event: TypeAlias = FrameWritten | SceneReady | SceneFailed


class SceneMaker:
    """Makes scenes with a source of its own, which is made with the first scene and kept."""

    def __init__(self, factory: SourceFactory, writers: Sequence[DatasetWriter]) -> None:
        self._factory = factory
        self._writers = tuple(writers)
        self._source: FrameSource | None = None

    def make(self, scene: int, staging: Path) -> Iterator[Event]:
        """Make a scene under the new folder `staging`; the last event is `SceneReady` or `SceneFailed`."""
        try:
            yield from self._make(scene, staging)
        except SimtrackError as error:
            yield SceneFailed(scene, Failure.REFUSED, str(error))
        except OSError as error:
            full = error.errno in SPACE_ERRORS
            text = str(error) if full else traceback.format_exc()
            yield SceneFailed(scene, Failure.SPACE if full else Failure.ERROR, text)
        except Exception:  # whatever it is, the other scenes are not concerned
            yield SceneFailed(scene, Failure.ERROR, traceback.format_exc())

    def _make(self, scene: int, staging: Path) -> Iterator[Event]:
        if self._source is None:
            self._source = self._factory()
        staging.mkdir(parents=True)
        info, about = self._source.info, self._source.scene_info(scene)
        writers = [writer.open_scene(staging, info, about) for writer in self._writers]
        frames = 0
        for frame in self._source.frames(scene):
            for writer in writers:
                writer.write(frame)
            frames += 1
            yield FrameWritten(scene)
        for writer in writers:
            writer.close()
        if frames != about.frames:
            raise DatasetError(staging, f"scene {scene} was said to have {about.frames} frames and has {frames}")
        marker = SceneMarker.of(staging, scene, frames, scene_units(staging, scene))
        sync_tree(staging)
        yield SceneReady(scene, marker)
