"""``simtrack score``: results that were made elsewhere against the truth of a run."""

from pathlib import Path
from typing import Annotated

import tyro


def score(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_DIR")],
    results: Annotated[Path, tyro.conf.Positional],
    out: Path | None = None,
) -> int:
    """Score results that were made elsewhere, from a run's log, against the truth in the run's folder.

    Objects as BOP's results (scene_id,im_id,obj_id,score,R,t,time: scene_id is 1; im_id counts the images from 0, or is
    the stamp in nanoseconds; obj_id numbers the scene's models in alphabetical order from 1; T_camera_object), or the
    robot's pose as a TUM trajectory (stamp in seconds, T_map_base). The metrics have the names of metrics.json.

    Args:
        run: Folder of `simtrack run`.
        results: The file.
        out: JSON file for the metrics; RESULTS.metrics.json if not given.
    """
    from simtrack.cli import console
    from simtrack.evaluation import score as scoring
    from simtrack.evaluation.metrics import write_metrics
    from simtrack.report.headline import table

    found = scoring.score(run, results)
    rows = [(row.name, row.value) for row in table(found.metrics, list(found.metrics), {})]
    console.show_table(("metric", "value"), rows, right=(1,))
    for finding in found.findings:
        console.out().print(finding, style="yellow", highlight=False, markup=False, soft_wrap=True)
    path = out if out is not None else results.with_suffix(".metrics.json")
    write_metrics(path, found.metrics)
    console.show_written(path.parent, [path.name])
    return 0
