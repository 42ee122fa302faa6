"""``simtrack compare``: runs of several methods in one table, with what is significant."""

from pathlib import Path
from typing import Annotated

import tyro


def compare(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    metrics: str = "",
    out: Path = Path("runs/comparison"),
) -> int:
    """Table of methods by metrics: medians over runs, 95 % bootstrap intervals, paired differences to the first method.

    Runs of the same stages are one method; the same scene and seed pairs runs of two methods. + marks what is
    significantly better than the first run's method, - what is worse; fewer than five pairs are never significant.

    Args:
        runs: Folders of `simtrack run`.
        metrics: Which are printed, separated by commas; the headline if not given. The files have all.
        out: Folder for comparison.json and comparison.html.
    """
    from simtrack.cli import console
    from simtrack.evaluation.instrument.comparison import HEADLINE, read_run
    from simtrack.evaluation.instrument.comparison import compare as compare_runs
    from simtrack.report.instrument_pages import cell_text, write_comparison

    found = compare_runs([read_run(path) for path in runs])
    chosen = [name for name in metrics.split(",") if name] or list(HEADLINE)
    by_name = {row.metric: row for row in found.rows}
    rows = [
        (name, *(cell_text(cell, by_name[name].unit) for cell in by_name[name].cells))
        for name in chosen
        if name in by_name
    ]
    console.show_table(("metric", *found.methods), rows, right=range(1, len(found.methods) + 1))
    for method, seeds in found.seeds.items():
        console.out().print(f"{method}: {len(seeds)} runs", highlight=False, markup=False)
    console.show_written(out, write_comparison(found, chosen, out))
    return 0
