"""``simtrack bench``: measure speed, beside peers in the same run."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from simtrack.benchmarks.harness import Benchmark, Row

Name = Literal["raycast", "tracking", "localization", "relations", "scaling", "realtime", "datasets", "envs"]


def bench(
    name: Annotated[Name, tyro.conf.Positional],
    json_file: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    plots: Path | None = None,
    threads: int = 1,
    seed: int = 0,
    quick: bool = False,
) -> int:
    """Measure the speed of a part: medians of CPU and wall time, and ratios to peers (extra ``bench``).

    Args:
        name: What is measured: raycast, tracking, localization, relations, scaling, realtime, datasets or envs.
        json_file: Write the figures, with machine and versions, to this file.
        plots: Draw the benchmark's plots into this folder.
        threads: Threads of the compiled kernels.
        seed: Of scenes and noise.
        quick: Fewer repetitions and smaller sizes: to see that it works, not to quote.
    """
    import importlib

    from simtrack.benchmarks.harness import Options
    from simtrack.errors import InvalidValueError
    from simtrack.evaluation.process import set_threads

    if threads < 1:
        raise InvalidValueError("threads", threads, "1 or more")
    set_threads(threads)
    options = Options(threads, seed, quick, say=lambda text: print(f"{name}: {text}", file=sys.stderr, flush=True))
    result: Benchmark = importlib.import_module(f"simtrack.benchmarks.{name}").run(options)
    show(result)
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps(result.to_json(options), indent=1) + "\n")
    if plots is not None:
        plots.mkdir(parents=True, exist_ok=True)
        for file, draw in result.plots.items():
            draw(plots / file)
    return 0


def show(result: "Benchmark") -> None:
    """Print a benchmark's table, the machine it ran on and its notes."""
    from simtrack.benchmarks.harness import machine
    from simtrack.cli import console

    rows = [
        (
            row.name,
            f"{1e3 * row.timing.cpu:.3g}" if row.timing else "",
            f"{1e3 * row.timing.wall:.3g}" if row.timing else "",
            f"{row.value:.4g} {row.unit}".strip() if row.value is not None else "",
            _asked(row),
            row.note,
        )
        for row in result.rows
    ]
    console.show_table(("", "CPU ms", "wall ms", "value", "asked", "note"), rows, right=(1, 2, 3))
    m = machine()
    versions = ", ".join(f"{name} {version}" for name, version in m["versions"].items())
    print(f"{m['processor']}, {m['cores']} cores, packets of {m['packet_width']} rays; {versions}")
    for note in result.notes:
        print(note)


def _asked(row: "Row") -> str:
    if row.asked is None:
        return ""
    verdict = {True: "met", False: "not met", None: "not measured"}[row.met]
    asked = f"{row.asked:g} {row.unit}" if row.value is not None else f"{1e3 * row.asked:g} ms"
    return f"{'<=' if row.sense == 'at most' else '>='} {asked.strip()}: {verdict}"
