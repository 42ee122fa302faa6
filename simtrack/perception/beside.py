"""Work beside the frames: in a thread of its own, with an answer that is used a fixed time of the sensor's clock later.

What is believed never depends on how fast the machine is or on how many threads it has: when an answer is taken up
follows from the stamps alone. Where the machine is fast enough the answer is there by then, and no frame waits.

A robot that cannot wait hands over ``wait=False``: an answer that is not there when its time is up is taken up by the
first frame that finds it. Then beliefs do depend on the machine.
"""

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

from simtrack.contracts import NANOSECONDS
from simtrack.errors import InvalidValueError

T = TypeVar("T")


NICENESS = 10
"""Of work that no frame waits for: where processors are short, the frames go first."""


def worker(name: str, wait: bool = True) -> ThreadPoolExecutor:
    """A thread for work beside the frames, made at first use; compiled kernels run in it on one thread each.

    Kernels release the interpreter lock, so it is a second processor that does the work.

    Args:
        name: of the thread.
        wait: whether frames wait for the work; if not, it leaves the processor to them.
    """
    return ThreadPoolExecutor(1, f"simtrack-{name}", _settle_down, (-20 if wait else NICENESS,))


def _settle_down(least_niceness: int) -> None:
    """Prepare the calling thread for work beside the frames."""
    import numba

    numba.set_num_threads(1)
    if hasattr(os, "setpriority"):
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, max(least_niceness, os.getpriority(os.PRIO_PROCESS, thread)))


class Beside(Generic[T]):
    """One piece of work at a time: begun at one stamp, settled at the first one that lies `seconds` later.

    Several may share a thread: it does their pieces one after the other, in the order in which they were begun.
    """

    def __init__(self, thread: ThreadPoolExecutor, seconds: float, wait: bool = True) -> None:
        if not seconds >= 0.0:
            raise InvalidValueError("seconds", seconds, ">= 0 s")
        self._thread, self._period, self._wait = thread, round(seconds * NANOSECONDS), wait
        self._work: tuple[int, Future[tuple[T, float]]] | None = None
        self.seconds = 0.0
        """Wall time of the piece that was settled last. Measured, not simulated."""

    @property
    def busy(self) -> bool:
        """Whether a piece has been begun and not been settled."""
        return self._work is not None

    def begin(self, stamp: int, work: Callable[[], T]) -> None:
        """Begin with a piece at `stamp`, nanoseconds. What it reads must not be changed until it is settled."""
        assert self._work is None, "the piece before it has not been settled"
        self._work = stamp, self._thread.submit(_timed, work)

    def due(self, stamp: int) -> bool:
        """Whether there is a piece whose time is up at `stamp`, nanoseconds, and that is to be settled then."""
        if self._work is None or stamp - self._work[0] < self._period:
            return False
        return self._wait or self._work[1].done()

    @property
    def keeps_waiting(self) -> bool:
        """Whether settling now would have to wait, though nobody is to wait for this piece."""
        return not self._wait and self._work is not None and not self._work[1].done()

    def settle(self) -> T:
        """End the piece and give its answer; waits for it if need be. Raises what the work raised."""
        assert self._work is not None, "no piece has been begun"
        future = self._work[1]
        self._work = None
        answer, self.seconds = future.result()
        return answer

    def drop(self) -> None:
        """Forget the piece; its thread finishes it all the same."""
        self._work = None


class Paced(Generic[T]):
    """A piece of work that counts its steps, each of which is taken to need the same time of the sensor's clock.

    For work whose length is not known before: it is settled when its own steps say so, on any machine.
    """

    def __init__(
        self,
        thread: ThreadPoolExecutor,
        seconds: float,
        work: Callable[[Callable[[], None]], T],
        wait: bool = True,
    ) -> None:
        """Begin, or queue behind what the thread has to do.

        Args:
            thread: of `worker`.
            seconds: of a step.
            work: gets a function to call before every step.
            wait: see the module.
        """
        self._step, self._wait = round(seconds * NANOSECONDS), wait
        self._steps, self._ended, self._changed = 0, False, threading.Condition()
        self._future = thread.submit(self._run, work)

    def _run(self, work: Callable[[Callable[[], None]], T]) -> T:
        try:
            return work(self._count)
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()

    def _count(self) -> None:
        with self._changed:
            self._steps += 1
            self._changed.notify()

    def end(self, start: int, stamp: int) -> int | None:
        """When the work ends that is taken to start at `start`, if that is by `stamp`; all nanoseconds.

        Waits until that is known: until the work ends, or has taken more steps than there is time for.
        """
        with self._changed:
            if not self._wait and not self._ended:
                return None
            self._changed.wait_for(lambda: self._ended or start + self._steps * self._step > stamp)
            end = start + self._steps * self._step
        return end if end <= stamp else None

    def settle(self) -> T:
        """The answer. Raises what the work raised."""
        return self._future.result()


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    start = time.perf_counter()
    return work(), time.perf_counter() - start
