"""``simtrack compare``: runs of several methods in one table, with what is significant."""

from difflib import get_close_matches
from itertools import repeat
from pathlib import Path
from typing import Annotated

import tyro


def compare(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN_DIR...")],
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
    from simtrack.errors import InvalidValueError, MissingValueError
    from simtrack.evaluation.instrument.comparison import HEADLINE, read_run
    from simtrack.evaluation.instrument.comparison import compare as compare_runs
    from simtrack.report.instrument_pages import cell_text, write_comparison

    if not runs:
        raise MissingValueError("RUN_DIR", "folders of `simtrack run`, as in simtrack compare runs/own-* runs/other-*")
    read = [read_run(path) for path in runs]
    asked = [name.strip() for name in metrics.split(",") if name.strip()]
    known = {name for run in read for name in run.metrics}
    for name in asked:
        if name not in known:
            near = get_close_matches(name, sorted(known), 5, 0.0)
            raise InvalidValueError("metrics", name, f"names in metrics.json of the runs, such as {', '.join(near)}")
    found = compare_runs(read)
    chosen = asked or list(HEADLINE)
    by_name = {row.metric: row for row in found.rows}
    nothing = ("-",) * len(found.methods)
    rows = [
        (name, *(map(cell_text, by_name[name].cells, repeat(by_name[name].unit)) if name in by_name else nothing))
        for name in chosen
        if name in by_name or asked
    ]
    console.show_table(("metric", *found.methods), rows, right=range(1, len(found.methods) + 1))
    for method, seeds in found.seeds.items():
        console.out().print(
            f"{method}: {len(seeds)} run{'' if len(seeds) == 1 else 's'}", highlight=False, markup=False
        )
    for remark in found.remarks:
        console.out().print(remark, style="yellow", highlight=False, markup=False, soft_wrap=True)
    console.show_written(out, write_comparison(found, chosen, out))
    return 0
