"""What makes a run start fast, how long it took to, and what to say while it takes longer than usual."""

import gc
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path


def relax_collector() -> Callable[[], None]:
    """Collect garbage rarely until the function that is returned is called.

    A start makes half a million objects that stay. To look through them again and again takes a tenth of its time.
    """
    thresholds = gc.get_threshold()
    gc.set_threshold(200_000, *thresholds[1:])
    return lambda: gc.set_threshold(*thresholds)


def warm_up(opengl: bool) -> None:
    """Load what the first compiled function needs and, if asked for, OpenGL; made to run in a thread.

    The thread waits for libraries and drivers while another one builds the world. What fails here fails again, and is
    told, where it is needed.
    """
    import numpy as np

    from simtrack.geometry.boxes import separation

    box = np.zeros(3), np.eye(3), np.ones(3)
    separation(*box, *box)
    if opengl:
        os.environ.setdefault("MUJOCO_GL", "egl")
        with suppress(Exception):
            import mujoco.egl  # noqa: F401  # pyright: ignore[reportUnusedImport]


def process_start() -> float:
    """When this process started, seconds on the clock of `time.monotonic`; now where the system does not tell."""
    now = time.monotonic()
    try:
        ticks = int(Path("/proc/self/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19])
        return now - (time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK"))
    except (OSError, ValueError, IndexError, AttributeError):
        return now


@contextmanager
def cold_start_told(say: Callable[[str, str], None]) -> Iterator[None]:
    """Tell what is made once and kept: functions that are compiled, models, buildings and surveys.

    Args:
        say: takes what is being done, and to what.
    """
    from numba.core import event

    class Compilation(event.Listener):
        def on_start(self, event: event.Event) -> None:
            function = getattr(event.data["dispatcher"], "py_func", None) if event.data else None
            say("compiling (first run only)", getattr(function, "__name__", ""))

        def on_end(self, event: event.Event) -> None:
            pass

    class Cache(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            what, _, thing = record.getMessage().partition(": ")
            say(f"{what} (kept for later runs)", thing)

    log, handler = logging.getLogger("simtrack.cache"), Cache(logging.INFO)
    level, propagate = log.level, log.propagate
    with ExitStack() as exits:
        exits.enter_context(event.install_listener("numba:compile", Compilation()))
        log.addHandler(handler)
        exits.callback(log.removeHandler, handler)
        log.setLevel(logging.INFO)
        exits.callback(log.setLevel, level)
        log.propagate = False
        exits.callback(setattr, log, "propagate", propagate)
        yield
