"""Workers on the machines of a Ray cluster (extra ``distributed``): actors, any of which may be lost with its machine.

A worker that sees the data set's folder, as on one machine or a shared file system, makes its scenes there. One that
does not makes them on a disk of its own and sends each as an archive through Ray.
"""

import os
import platform
import shutil
import socket
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import simtrack
from simtrack.datasets.folder import SceneMarker, scene_units, sync_tree
from simtrack.datasets.local import thread_limits
from simtrack.datasets.scene_maker import Event, Failure, SceneFailed, SceneMaker, SceneReady, SourceFactory
from simtrack.datasets.writer import DatasetWriter
from simtrack.errors import InvalidValueError

CHUNK = 16_000_000
"""Bytes of an archive in one message."""
CONNECT_TIMEOUT = 10.0
"""Seconds."""
PROBE = ".probe"
"""File in the staging folder that a worker with the same file system finds."""


@dataclass(frozen=True, slots=True)
class ArchivePart:
    """A piece of a scene's archive."""

    scene: int
    data: bytes


def connected(workers: int, address: str | None) -> tuple[Any, bool]:
    """Ray, connected to a cluster, and whether that was started here; arguments and errors are those of `RayPool`."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray  # pyright: ignore[reportMissingImports] - extra `distributed`
    except ImportError as error:
        raise InvalidValueError("engine", "ray", "local; or install the extra simtrack[distributed]") from error
    if ray.is_initialized():
        return ray, False
    settings: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address is None:
        settings |= {"num_cpus": workers, "include_dashboard": False, "address": "local"}
    else:
        settings["address"] = address
    try:
        if address is not None and address != "auto":
            host, _, port = address.rpartition(":")
            # Ray itself tries for minutes.
            socket.create_connection((host, int(port)), CONNECT_TIMEOUT).close()
        ray.init(**settings)
    except (OSError, ValueError, RuntimeError) as error:
        allowed = f"auto, or HOST:PORT of a running Ray cluster ({error})"
        raise InvalidValueError("address", address, allowed) from error
    return ray, True


class RayPool:
    """A fixed number of actors; one that is lost is replaced by a new one, wherever there is room."""

    def __init__(
        self,
        factory: SourceFactory,
        writers: Sequence[DatasetWriter],
        workers: int,
        staging: Path,
        address: str | None = None,
        shared: bool = True,
    ) -> None:
        """Connect to a cluster, or start one on this machine.

        Args:
            factory: see `simtrack.datasets.engine.generate`.
            writers: see there.
            workers: number of actors, each on one core.
            staging: existing folder that scenes are staged under.
            address: of a running cluster (``auto`` or ``HOST:PORT``); None starts one here.
            shared: False has scenes sent as archives even by workers that see the folder.

        Raises:
            InvalidValueError: Ray is not installed, or there is no such cluster.
        """
        self._ray, self._started_here = connected(workers, address)
        self._address = address
        self._probe = staging / PROBE
        if shared:
            self._probe.write_text(staging.name)
        environment = {"env_vars": thread_limits(1)}
        self._remote = self._ray.remote(num_cpus=1, max_restarts=0, runtime_env=environment)(SceneActor)
        self._arguments = (factory, tuple(writers), self._probe)
        self._idle: list[Any] = []
        self._streams: dict[Any, tuple[Any, int, Path]] = {}
        """Stream of events of a scene -> its actor, its number, its folder."""
        self._size = workers
        self._environments_agree()

    def _environments_agree(self) -> None:
        """Have one worker tell its versions: others make other bytes."""
        actor = self._remote.remote(*self._arguments)
        there, here = self._ray.get(actor.versions.remote()), versions()
        self._idle.append(actor)
        different = [f"{name} {there[name]} there and {here[name]} here" for name in here if there[name] != here[name]]
        if different:
            raise InvalidValueError(
                "address", self._address, f"a cluster of the same versions ({', '.join(different)})"
            )

    @property
    def idle(self) -> bool:
        """Whether another scene can be started."""
        return len(self._streams) < self._size

    def start(self, scene: int, staging: Path) -> None:
        """Have a scene made under the folder `staging`."""
        actor = self._idle.pop() if self._idle else self._remote.remote(*self._arguments)
        stream = actor.make.options(num_returns="streaming").remote(scene, staging)
        self._streams[stream] = (actor, scene, staging)

    def wait(self, timeout: float) -> list[Event]:
        """What has happened since; after `timeout` seconds at the latest."""
        ready, _ = self._ray.wait(list(self._streams), num_returns=1, timeout=timeout, fetch_local=False)
        return [event for stream in ready for event in self._next(stream)]

    def close(self) -> None:
        """End all workers, and the cluster if it was started here."""
        for actor in [*self._idle, *(actor for actor, _, _ in self._streams.values())]:
            self._ray.kill(actor)
        self._idle.clear()
        self._streams.clear()
        if self._started_here:
            self._ray.shutdown()

    def _next(self, stream: Any) -> list[Event]:
        actor, scene, staging = self._streams[stream]
        try:
            event = self._ray.get(next(stream))
        except self._ray.exceptions.RayError as error:
            del self._streams[stream]
            self._ray.kill(actor)
            return [SceneFailed(scene, Failure.DIED, f"its worker was lost: {str(error).splitlines()[0]}")]
        archive = staging.with_suffix(f"{staging.suffix}.tar")
        if isinstance(event, ArchivePart):
            with archive.open("ab") as part:
                part.write(event.data)
            return []
        if isinstance(event, SceneReady | SceneFailed):
            del self._streams[stream]
            self._idle.append(actor)
        if isinstance(event, SceneReady) and archive.exists():
            event = self._unpack(archive, staging, event.marker)
        return [event]

    def _unpack(self, archive: Path, staging: Path, marker: SceneMarker) -> Event:
        with tarfile.open(archive) as source:
            source.extractall(staging, filter="data")
        archive.unlink()
        found = SceneMarker.of(staging, marker.scene, marker.frames, scene_units(staging, marker.scene))
        if found != marker:
            return SceneFailed(marker.scene, Failure.DIED, "its archive arrived damaged")
        sync_tree(staging)
        return SceneReady(marker.scene, marker)


class SceneActor:
    """A worker on any machine of the cluster."""

    def __init__(self, factory: SourceFactory, writers: Sequence[DatasetWriter], probe: Path) -> None:
        self._maker = SceneMaker(factory, writers)
        self._shared = probe.is_file() and probe.read_text() == probe.parent.name

    def versions(self) -> dict[str, str]:
        """See `versions`."""
        return versions()

    def make(self, scene: int, staging: Path) -> Iterator[Event | ArchivePart]:
        """Make a scene; the last event is `SceneReady` or `SceneFailed`."""
        if self._shared:
            yield from self._maker.make(scene, staging)
            return
        with tempfile.TemporaryDirectory(prefix="simtrack-scene-") as scratch:
            for event in self._maker.make(scene, Path(scratch, "scene")):
                if isinstance(event, SceneReady):
                    yield from _archive(scene, Path(scratch))
                yield event


def _archive(scene: int, scratch: Path) -> Iterator[ArchivePart]:
    archive = scratch / "scene.tar"
    with tarfile.open(archive, "w") as target:  # keeps hard links
        target.add(scratch / "scene", arcname=".")
    shutil.rmtree(scratch / "scene")
    with archive.open("rb") as stream:
        while data := stream.read(CHUNK):
            yield ArchivePart(scene, data)


def versions() -> dict[str, str]:
    """What the bytes of a data set may depend on in this process."""
    return {"simtrack": simtrack.__version__, "Python": platform.python_version(), "numpy": np.__version__}
