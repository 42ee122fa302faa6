"""``simtrack debug``: one of a run's worst moments done again, looked at closely."""

from pathlib import Path
from typing import Annotated

import tyro


def debug(
    run: Annotated[Path, tyro.conf.Positional],
    frame: int | None = None,
    out: Path | None = None,
    rrd: Path | None = None,
) -> int:
    """Do the tracker's registration of one frame again, exactly, and show what it was given and what it made of it.

    A run keeps its ten worst frames: those with the largest error of an object that should be tracked. The picture has
    the depth image with outlines of truth, prediction and registration, the detections that came in, and what is left
    between measured and registered surface. Without --frame the kept frames are listed.

    Args:
        run: Folder of `simtrack run`.
        frame: Number of the image, from 0.
        out: Picture (PNG); RUN/moments/FRAME.png if not given.
        rrd: Write the same in 3D for rerun to this file (needs the extra viz).
    """
    from simtrack.cli import console
    from simtrack.evaluation.instrument.examination import examine
    from simtrack.evaluation.instrument.moments import FOLDER, read_moment, stored_frames
    from simtrack.evaluation.instrument.rebuilding import rebuilt_models
    from simtrack.perception.stack_config import StackConfig
    from simtrack.report.moment_page import COLUMNS, rows, told_error, write_picture

    if frame is None:
        kept = [read_moment(run, number) for number in stored_frames(run)]
        lines = [(m.frame, f"{m.stamp / 1e9:.2f} s", m.worst, told_error(m)) for m in kept]
        console.show_table(("frame", "time", "object", "error"), lines, right=(0, 1))
        return 0
    moment = read_moment(run, frame)
    with console.ProgressLine(f"debug {run.name}", "making the tracker's models") as line:
        models = rebuilt_models(run)
        line.say("registering")
        found = examine(moment, models, StackConfig().tracker.registration)
    console.show_table(COLUMNS, rows(found), right=())
    if found.largest_change > 0.0:
        console.show_error(f"not the same as in the run: poses differ by up to {found.largest_change:.3g} m or rad")
    picture = out if out is not None else run / FOLDER / f"{frame}.png"
    write_picture(found, picture)
    written = [picture.name]
    if rrd is not None:
        from simtrack.report.rerun_log import log_examination

        log_examination(found, models, rrd)
        written.append(str(rrd))
    console.show_written(picture.parent, written)
    return 0 if found.largest_change == 0.0 else 1
