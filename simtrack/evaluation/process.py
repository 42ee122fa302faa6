"""What a run needs of its process: wall time by stage, a wish to stop, threads, memory."""

import signal
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from simtrack.errors import InvalidValueError
from simtrack.evaluation.metrics import Metric, measured, unmeasured

LOOP = ("simulation", "stack", "agent")
"""What counts into the speed."""


class Clock:
    """Wall time by what it was spent on."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, list[float]] = defaultdict(list)
        self.total: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time a block."""
        start = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - start
            self.seconds[stage].append(spent)
            self.total[stage] += spent

    @property
    def loop(self) -> float:
        """Seconds spent so far on what counts into the speed."""
        return sum(self.total[stage] for stage in LOOP)


class StopSignal:
    """Turns the first Ctrl-C or kill into the wish to stop at the next frame; the second one ends at once."""

    def __init__(self) -> None:
        self.asked = False
        self._old: dict[signal.Signals, object] = {}

    def __enter__(self) -> "StopSignal":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._old[number] = signal.signal(number, self._ask)
        return self

    def _ask(self, number: int, frame: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)  # type: ignore[arg-type]


def set_threads(threads: int | None) -> None:
    """Set the number of threads of compiled kernels; OpenCV gets one, so that bytes repeat."""
    import cv2
    import numba

    most = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    if threads is not None and not 1 <= threads <= most:
        raise InvalidValueError("threads", threads, f"1 to {most}")
    numba.set_num_threads(threads or most)
    cv2.setNumThreads(1)


def peak_memory() -> Metric:
    """Largest resident memory of this process so far."""
    try:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
    except OSError as error:
        return unmeasured("bytes", f"the system does not tell ({error.strerror})")
    line = next((line for line in status.splitlines() if line.startswith("VmHWM:")), None)
    return (
        unmeasured("bytes", "the system does not tell")
        if line is None
        else measured(1024 * int(line.split()[1]), "bytes")
    )
