"""Workers on this machine: spawned processes, any of which may die without taking more than its scene along."""

import ctypes
import multiprocessing
import os
import pickle
import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from simtrack.datasets.scene_maker import Event, Failure, FrameWritten, SceneFailed, SceneMaker, SourceFactory
from simtrack.datasets.writer import DatasetWriter

_PR_SET_PDEATHSIG = 1


@dataclass(slots=True)
class _Worker:
    process: BaseProcess
    connection: Connection
    scene: int | None = None


class LocalPool:
    """A fixed number of worker processes; one that dies is replaced when the next scene is started."""

    def __init__(self, factory: SourceFactory, writers: Sequence[DatasetWriter], workers: int) -> None:
        # Pickled here: what cannot be is told at once, and unpickled in a worker where a failure can be caught.
        self._task = pickle.dumps((factory, tuple(writers)))
        self._threads = max(1, len(os.sched_getaffinity(0)) // workers)
        self._context = multiprocessing.get_context("spawn")
        self._workers: list[_Worker] = []
        self._size = workers

    @property
    def idle(self) -> bool:
        """Whether another scene can be started."""
        return sum(worker.scene is not None for worker in self._workers) < self._size

    def start(self, scene: int, staging: Path) -> None:
        """Have a scene made under the folder `staging`."""
        worker = next((w for w in self._workers if w.scene is None), None) or self._spawn()
        worker.scene = scene
        with suppress(OSError):  # it died while it had nothing to do: `wait` tells
            worker.connection.send((scene, staging))

    def wait(self, timeout: float) -> list[Event]:
        """What has happened since; after `timeout` seconds at the latest."""
        ready = wait([w.connection for w in self._workers], timeout)
        events: list[Event] = []
        for worker in [w for w in self._workers if w.connection in ready]:
            try:
                event: Event = worker.connection.recv()
            except (EOFError, OSError, pickle.UnpicklingError):  # the process is gone
                events += self._bury(worker)
                continue
            if not isinstance(event, FrameWritten):
                worker.scene = None
            events.append(event)
        return events

    def close(self) -> None:
        """End all workers at once: they hold nothing that would be missed."""
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()
            worker.connection.close()
        self._workers.clear()

    def _spawn(self) -> _Worker:
        ours, theirs = self._context.Pipe()
        arguments = (theirs, self._task, os.getpid())
        # A daemon is ended when a script ends that raised and did not close the pool; another would be waited for.
        process = self._context.Process(target=_work, args=arguments, daemon=True)
        with _environment(thread_limits(self._threads)):  # libraries read it when they are loaded
            process.start()
        theirs.close()
        self._workers.append(_Worker(process, ours))
        return self._workers[-1]

    def _bury(self, worker: _Worker) -> list[Event]:
        worker.process.join()
        worker.connection.close()
        self._workers.remove(worker)
        if worker.scene is None:
            return []
        return [SceneFailed(worker.scene, Failure.DIED, _cause(worker.process.exitcode))]


def _cause(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
        return f"its worker was ended by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")
    return f"its worker ended with exit code {code}"


def _work(connection: Connection, task: bytes, parent: int) -> None:
    """Make the scenes that are asked for until the connection is closed."""
    follow_parent()
    if os.getppid() != parent:
        return
    factory, writers = pickle.loads(task)
    maker = SceneMaker(factory, writers)
    try:
        while True:
            request: Any = connection.recv()
            for event in maker.make(*request):
                connection.send(event)
    except (EOFError, BrokenPipeError):
        return


def follow_parent() -> None:
    """Have this process end with its parent, and leave Ctrl-C, which reaches all processes, to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def thread_limits(threads: int) -> dict[str, str]:
    """Environment that has kernels, linear algebra and software rendering of a process use so many threads.

    Its heap is kept in one piece: glibc gives threads heaps of their own, up to eight a core, each of which keeps what
    was freed in it. MuJoCo's compiler, which starts threads for every model, so comes to hold 150 MB that nobody uses.
    """
    names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS")
    return dict.fromkeys(names, str(threads)) | {"MALLOC_ARENA_MAX": "1"}


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set variables that a process started meanwhile inherits."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
