"""Runs a generation: which scenes are missing, who makes them, and how they get into the data set's folder.

The bytes of a data set depend on recipe and seed alone, neither on the number of workers or the engine nor on how often
the run was killed and started again.
"""

import shutil
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from simtrack.datasets.estimate import expected_bytes_per_frame, known_bytes_per_frame
from simtrack.datasets.folder import SPACE_ERRORS, DatasetFolder, SceneMarker, remove
from simtrack.datasets.local import LocalPool
from simtrack.datasets.scene_maker import Event, Failure, FrameWritten, SceneFailed, SceneReady, SourceFactory
from simtrack.datasets.writer import DatasetWriter
from simtrack.errors import DatasetError, InvalidValueError

MAX_ATTEMPTS = 3
"""How often a scene is tried whose worker dies."""
MAX_FAILED_SCENES = 3
"""After so many scenes that cannot be made no other is started."""
MAX_SCENES = 1_000_000
"""Formats number scenes with six digits."""
SPACE_MARGIN = 1.05
"""Free space that is asked for, in multiples of what the scenes are expected to need."""
_RATE_WINDOW = 60.0
_POLL = 0.5


class Pool(Protocol):
    """Workers that make scenes."""

    @property
    def idle(self) -> bool:
        """Whether another scene can be started."""
        ...

    def start(self, scene: int, staging: Path) -> None:
        """Have a scene made under the folder `staging`."""
        ...

    def wait(self, timeout: float) -> list[Event]:
        """What has happened since; after `timeout` seconds at the latest."""
        ...

    def close(self) -> None:
        """End all workers."""
        ...


PoolFactory = Callable[[SourceFactory, Sequence[DatasetWriter], Path], Pool]
"""Makes the workers; the path is the existing folder that scenes are staged under."""


@dataclass(frozen=True, slots=True)
class GenerationProgress:
    """How far a generation is."""

    frames: int
    """Written, those of earlier runs and of unfinished scenes included."""
    total_frames: int
    scenes: int
    """Complete."""
    total_scenes: int
    rate: float
    """Frames a second in the last minute, 0 while none is written."""
    bytes: int
    """Of complete scenes."""

    @property
    def seconds_left(self) -> float | None:
        """At the present rate; None while there is none."""
        return (self.total_frames - self.frames) / self.rate if self.rate else None


@dataclass(frozen=True, slots=True)
class GenerationSummary:
    """What a generation did."""

    scenes: int
    frames: int
    made: int
    """Frames made in this run."""
    bytes: int
    seconds: float
    """Wall time of making frames."""


Report = Callable[[GenerationProgress], None]
Say = Callable[[str], None]


def generate(
    factory: SourceFactory,
    writers: Sequence[DatasetWriter],
    out: Path,
    count: int,
    pool: PoolFactory | None = None,
    report: Report = lambda progress: None,
    say: Say = lambda text: None,
) -> GenerationSummary:
    """Make the scenes that `out` lacks to hold `count` frames, and what is written once for all of them.

    Args:
        factory: makes the source of frames, here and in each worker.
        writers: of the formats; can be pickled.
        out: the data set's folder: new, empty, or of the same recipe and seed.
        count: frames asked for; whole scenes are made.
        pool: makes the workers; one local process if None.
        report: is told of progress.
        say: is told what is being done before and after frames are made.

    Raises:
        DatasetError: the folder holds something else or is in use, the disk is too small, or scenes could not be made;
            complete scenes are kept, and the same call carries on.
    """
    if count < 1:
        raise InvalidValueError("count", count, "1 or more")
    with closing(factory()) as source:
        info, scenes = source.info, source.scenes(count)
        if scenes > MAX_SCENES:
            raise InvalidValueError("count", count, f"no more than {MAX_SCENES} scenes hold")
        lengths = [source.scene_info(scene).frames for scene in range(scenes)]
    with DatasetFolder.open(out, info, [writer.name for writer in writers]) as folder:
        done = folder.markers()
        _check_extension(folder, done, lengths)
        begun, already = time.monotonic(), sum(marker.frames for marker in done.values())
        if len(done) < scenes or not folder.is_complete(scenes):
            folder.describe(scenes, sum(lengths), complete=False)
            try:
                say("writing models")
                for writer in writers:
                    writer.begin(out, info)
                run = _Run(folder, lengths, done, report)
                run.check_space(known_bytes_per_frame(done.values()) or expected_bytes_per_frame(info, folder.formats))
                make_pool = pool or local_pool(1)
                if len(done) < scenes:
                    with closing(make_pool(factory, writers, folder.staging)) as workers:
                        run.go(workers)
                say("writing what all scenes share")
                for writer in writers:
                    writer.finish(out, info, scenes)
            except OSError as error:
                raise _disk_error(out, error) from error
            folder.describe(scenes, sum(lengths), complete=True)
        size = sum(marker.bytes for marker in done.values())
        return GenerationSummary(scenes, sum(lengths), sum(lengths) - already, size, time.monotonic() - begun)


def local_pool(workers: int) -> PoolFactory:
    """Worker processes on this machine."""
    return lambda factory, writers, staging: LocalPool(factory, writers, workers)


def ray_pool(workers: int, address: str | None = None) -> PoolFactory:
    """Workers on a Ray cluster, see `RayPool`."""

    def make(factory: SourceFactory, writers: Sequence[DatasetWriter], staging: Path) -> Pool:
        from simtrack.datasets.distributed import RayPool

        return RayPool(factory, writers, workers, staging, address)

    return make


class _Run:
    """The scenes that are still to be made, and those under way; `done` is kept up to date."""

    def __init__(
        self, folder: DatasetFolder, lengths: Sequence[int], done: dict[int, SceneMarker], report: Report
    ) -> None:
        self._folder, self._lengths, self._done, self._report = folder, lengths, done, report
        self._waiting = deque(scene for scene in range(len(lengths)) if scene not in done)
        self._running: dict[int, Path] = {}
        self._attempts = Counter[int]()
        self._failed: dict[int, str] = {}
        self._written = Counter[int]()
        self._ticks: deque[float] = deque([time.monotonic()])

    def go(self, pool: Pool) -> None:
        """Make all of them."""
        while self._running or (self._waiting and len(self._failed) < MAX_FAILED_SCENES):
            while self._waiting and pool.idle and len(self._failed) < MAX_FAILED_SCENES:
                self._start(pool, self._waiting.popleft())
            for event in pool.wait(_POLL):
                self._take(event)
            self._report(self._progress())
        if self._failed:
            listing = "; ".join(f"scene {scene}: {why}" for scene, why in sorted(self._failed.items()))
            raise DatasetError(
                self._folder.root,
                f"{len(self._failed)} scenes could not be made, {len(self._done)} of {len(self._lengths)} are complete "
                f"and kept. {listing}",
            )

    def check_space(self, bytes_per_frame: float) -> None:
        """Raise DatasetError if what is missing does not fit on the disk."""
        missing = sum(self._lengths) - sum(marker.frames for marker in self._done.values())
        needed, free = SPACE_MARGIN * missing * bytes_per_frame, shutil.disk_usage(self._folder.root).free
        if needed > free:
            raise DatasetError(
                self._folder.root,
                f"{missing} frames need about {needed / 1e9:.1f} GB ({bytes_per_frame / 1e6:.2f} MB a frame) and "
                f"{free / 1e9:.1f} GB are free on the disk; free some, write fewer formats, or ask for fewer frames",
            )

    def _start(self, pool: Pool, scene: int) -> None:
        self._attempts[scene] += 1
        self._running[scene] = self._folder.staging / f"{scene:06d}.{self._attempts[scene]}"
        pool.start(scene, self._running[scene])

    def _take(self, event: Event) -> None:
        match event:
            case FrameWritten(scene):
                self._written[scene] += 1
                self._ticks.append(time.monotonic())
            case SceneReady(scene, marker):
                self._folder.commit(self._running.pop(scene), marker)
                del self._written[scene]
                self._done[scene] = marker
                if len(self._done) == 1:  # now sizes are known
                    self.check_space(known_bytes_per_frame(self._done.values()))
            case SceneFailed(scene, failure, message):
                del self._written[scene]
                remove(self._running.pop(scene))
                if failure is Failure.SPACE:
                    raise DatasetError(self._folder.root, _full(message))
                if failure is Failure.DIED and self._attempts[scene] < MAX_ATTEMPTS:
                    self._waiting.appendleft(scene)
                else:
                    tries = f", {MAX_ATTEMPTS} times" if failure is Failure.DIED else ""
                    self._failed[scene] = message.strip() + tries

    def _progress(self) -> GenerationProgress:
        now = time.monotonic()
        while len(self._ticks) > 2 and now - self._ticks[0] > _RATE_WINDOW:
            self._ticks.popleft()
        elapsed = now - self._ticks[0]
        return GenerationProgress(
            frames=sum(marker.frames for marker in self._done.values()) + self._written.total(),
            total_frames=sum(self._lengths),
            scenes=len(self._done),
            total_scenes=len(self._lengths),
            rate=(len(self._ticks) - 1) / elapsed if elapsed > 0 else 0.0,
            bytes=sum(marker.bytes for marker in self._done.values()),
        )


def _check_extension(folder: DatasetFolder, done: dict[int, SceneMarker], lengths: Sequence[int]) -> None:
    """Raise DatasetError unless the scenes that are there are the first ones of those that are asked for."""
    if done and max(done) >= len(lengths):
        held = max(done) + 1
        raise DatasetError(
            folder.root,
            f"holds {held} scenes already, and {len(lengths)} are asked for; ask for at least as many frames as there "
            f"are ({sum(marker.frames for marker in done.values())}), or name another folder",
        )
    for scene, marker in done.items():
        if marker.frames != lengths[scene]:
            raise DatasetError(
                folder.root,
                f"scene {scene} has {marker.frames} frames there and would have {lengths[scene]}; name another folder",
            )


def _full(message: str) -> str:
    return f"{message}; complete scenes are kept: free some space, and run the same command again"


def _disk_error(out: Path, error: OSError) -> DatasetError:
    where = f" ({error.filename})" if error.filename else ""
    text = f"{error.strerror or error}{where}"
    return DatasetError(out, _full(text) if error.errno in SPACE_ERRORS else text)
