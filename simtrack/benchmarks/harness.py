"""What benchmarks share: fair timing, the figures they report, and the machine they were taken on.

Machines are shared and noisy: figures are medians, contestants take turns within one run, and CPU time of the whole
process (all its threads) stands beside wall time. Ratios between contestants carry over to other machines; seconds do
not.
"""

import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

PRIMING = 0.02
"""See `measure`."""


@dataclass(frozen=True, slots=True)
class Options:
    """What a user asks of a benchmark."""

    threads: int = 1
    """Threads of the compiled kernels."""
    seed: int = 0
    quick: bool = False
    """Fewer repetitions and smaller sizes: to see that it works, not to quote."""
    say: Callable[[str], None] = lambda _: None
    """Told in a few words what is being done."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Medians over repetitions, seconds."""

    cpu: float
    """CPU time of all threads of the process."""
    wall: float
    repeats: int


@dataclass(frozen=True, slots=True)
class Row:
    """A line of a benchmark's table."""

    name: str
    """What was done and by whom, e.g. ``pinhole 640x480: simtrack``."""
    timing: Timing | None = None
    value: float | None = None
    """A figure that is not a time (a ratio, an error, a count), in `unit`."""
    unit: str = ""
    asked: float | None = None
    """What the project asks of the figure (of the CPU time, in seconds, if there is no `value`)."""
    sense: Literal["at most", "at least"] = "at most"
    note: str = ""

    @property
    def figure(self) -> float | None:
        """What `asked` is compared with."""
        return self.value if self.value is not None else self.timing.cpu if self.timing is not None else None

    @property
    def met(self) -> bool | None:
        """Whether the figure is as asked; None if nothing is asked or nothing was measured."""
        if self.asked is None or self.figure is None:
            return None
        return self.figure <= self.asked if self.sense == "at most" else self.figure >= self.asked


@dataclass(slots=True)
class Benchmark:
    """Results of one benchmark."""

    name: str
    rows: list[Row] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """Sentences a reader needs: missing peers, what limits a figure."""
    series: dict[str, list[float]] = field(default_factory=dict)
    """Curves for plots and for the JSON file."""
    plots: dict[str, Callable[[Path], None]] = field(default_factory=dict)
    """File name -> what draws it there."""

    def add(self, name: str, timing: Timing | None = None, value: float | None = None, **more: Any) -> None:
        """Append a row; see `Row`."""
        self.rows.append(Row(name, timing, value, **more))

    def to_json(self, options: Options) -> dict[str, Any]:
        """Everything as plain data, with machine and versions."""
        rows = [{**asdict(row), "met": row.met} for row in self.rows]
        return {
            "benchmark": self.name,
            "threads": options.threads,
            "seed": options.seed,
            "quick": options.quick,
            "machine": machine(),
            "rows": rows,
            "notes": self.notes,
            "series": self.series,
        }


def resident(process: int | None = None) -> int:
    """Bytes of main memory that a process holds; this one, if no number of another is given."""
    fields = Path(f"/proc/{process or 'self'}/statm").read_text(encoding="utf-8").split()
    return int(fields[1]) * os.sysconf("SC_PAGE_SIZE")


def measure(
    contestants: Mapping[str, Callable[[], object]],
    repeats: int = 15,
    warmup: int = 2,
    before: Callable[[], object] | None = None,
    primed: bool = False,
) -> dict[str, Timing]:
    """Time functions fairly: they take turns, so that a busy moment of the machine hits all of them.

    Args:
        contestants: name -> what to time.
        repeats: turns of each; the medians are returned.
        warmup: turns that do not count (compilation, caches).
        before: called before each turn, not timed.
        primed: before each timed go others that are not, for `PRIMING` seconds: nobody pays for the caches that the
            one before left behind, nor for a processor that wakes up. For what may be done again at once.
    """
    rest()
    cpu: dict[str, list[float]] = {name: [] for name in contestants}
    wall: dict[str, list[float]] = {name: [] for name in contestants}
    for turn in range(warmup + repeats):
        for name, work in contestants.items():
            if before is not None:
                before()
            awake = time.perf_counter() + PRIMING
            while primed and time.perf_counter() < awake:
                work()
            cpu_start, wall_start = time.process_time(), time.perf_counter()
            work()
            wall_end, cpu_end = time.perf_counter(), time.process_time()
            if turn >= warmup:
                cpu[name].append(cpu_end - cpu_start)
                wall[name].append(wall_end - wall_start)
    return {n: Timing(statistics.median(cpu[n]), statistics.median(wall[n]), repeats) for n in contestants}


def rest() -> None:
    """Wait, for a second at most, until all other threads of the process sleep.

    Those of BLAS and TBB wait busily for more work, for a tenth of a second: CPU time that is not what comes next.
    """
    deadline = time.perf_counter() + 1.0
    while time.perf_counter() < deadline:
        start = time.process_time()
        time.sleep(0.02)
        if time.process_time() - start < 0.002:
            return


def machine() -> dict[str, Any]:
    """Processor, instruction set as Embree sees it, and versions of what the figures depend on."""
    from simtrack.raycast.embree import available, embree

    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    packages: Sequence[str] = ("simtrack", "numpy", "numba", "embreex", "mujoco", "open3d", "small_gicp", "trimesh")
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "packet_width": embree().packet_width if available() else None,
        "python": platform.python_version(),
        "versions": {name: version for name in packages if (version := _version(name))},
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
