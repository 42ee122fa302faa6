"""Independent pieces of an evaluation in worker processes, here or on a Ray cluster, as they end."""

import hashlib
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import simtrack
from simtrack.datasets.local import follow_parent
from simtrack.errors import SimtrackError

Task = TypeVar("Task")
Result = TypeVar("Result")


@cache
def code_digest() -> str:
    """Hash of the package's code: results of other code are not carried on."""
    sha = hashlib.sha256()
    for source in sorted(Path(simtrack.__file__).parent.rglob("*.py")):
        sha.update(source.read_bytes())
    return sha.hexdigest()[:16]


def as_done(
    tasks: Sequence[Task], work: Callable[[Task], Result], workers: int
) -> Iterator[tuple[Task, Result | BaseException]]:
    """Tasks with what came of them, as they end, from spawned processes; those are ended at once if the caller stops.

    Args:
        tasks: can be pickled.
        work: likewise.
        workers: processes.

    Yields:
        A task with its result, or with the error of this package that it raised or the death of its process; any other
        error is raised.
    """
    if not tasks:
        return
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), follow_parent)
    try:
        running: dict[Future[Result], Task] = {pool.submit(work, task): task for task in tasks}
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                task = running.pop(future)
                error = future.exception()
                if error is None:
                    yield task, future.result()
                elif isinstance(error, (SimtrackError, BrokenProcessPool)):
                    yield task, error
                else:
                    raise error
    finally:
        for process in multiprocessing.active_children():
            process.terminate()
        pool.shutdown(wait=True, cancel_futures=True)


def as_done_on_ray(
    tasks: Sequence[Task], work: Callable[[Task], Result], workers: int, address: str | None = None
) -> Iterator[tuple[Task, Result | BaseException]]:
    """As `as_done`, on a Ray cluster (extra ``distributed``) whose machines share a file system.

    Args:
        tasks: see there.
        work: see there.
        workers: cores of the cluster that is started here, without `address`.
        address: of a running cluster, ``auto`` or ``HOST:PORT``.

    Raises:
        InvalidValueError: Ray is not installed, or there is no such cluster.
    """
    if not tasks:
        return
    from simtrack.datasets.distributed import connected

    ray, started = connected(workers, address)
    remote: Any = ray.remote(num_cpus=1)(work)
    running = {remote.remote(task): task for task in tasks}
    try:
        while running:
            ready, _ = ray.wait(list(running), num_returns=1)
            for reference in ready:
                task = running.pop(reference)
                try:
                    yield task, ray.get(reference)
                except SimtrackError as error:
                    yield task, error
                except ray.exceptions.RayError as error:
                    if isinstance(getattr(error, "cause", None), SimtrackError):
                        yield task, error.cause
                    elif isinstance(error, ray.exceptions.WorkerCrashedError):
                        yield task, error
                    else:
                        raise
    finally:
        for reference in running:
            ray.cancel(reference, force=True)
        if started:
            ray.shutdown()
