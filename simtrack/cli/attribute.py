"""``simtrack attribute``: of an end-to-end error, how much comes from which stage."""

from pathlib import Path
from typing import Annotated, Literal

import tyro


def attribute(
    scene: Annotated[str, tyro.conf.Positional] = "workbench",
    seed: int = 0,
    duration: float | None = 10.0,
    given: str = "",
    stages: str = "calibration,noise,models,latency,detection,localization",
    tracker: str | None = None,
    localizer: str | None = None,
    detector: str = "oracle",
    renderer: Literal["mujoco", "embree"] = "mujoco",
    alone: bool = True,
    out: Path | None = None,
    work: Path = Path("runs/cases"),
    workers: int = 1,
) -> int:
    """Run a scene, then again on the same way with one stage after the other replaced by an oracle.

    The waterfall says of the error how much is lost as each stage becomes perfect after those before it; "alone" how
    much is lost as it alone becomes perfect; what is left is the tracker's own. The same command carries on where a
    stopped one was.

    Args:
        scene: Name of a scene, or path of its folder or YAML file.
        seed: Of everything random.
        duration: Simulated seconds; the scene's own if none.
        given: Conditions of the run to explain: noise=2,extrinsics=1 (see `simtrack sweep`).
        stages: What becomes perfect, in this order.
        tracker: A tracker of yours, package.module:Class or exec:PROGRAM (docs/bring_your_own.md).
        localizer: A localizer of yours, package.module:Class.
        detector: What detects objects in images: oracle, keypoints, or another as of `simtrack run`.
        renderer: mujoco needs OpenGL (EGL), embree needs none.
        alone: Also make each stage perfect alone; without, half as many runs.
        out: Folder for attribution.json and attribution.html; runs/SCENE-SEED-attribution if not given.
        work: Folder where runs are kept.
        workers: Runs at a time.
    """
    from simtrack.cli import console
    from simtrack.errors import InvalidValueError
    from simtrack.evaluation.instrument.attribution import REST
    from simtrack.evaluation.instrument.attribution import attribute as explain
    from simtrack.evaluation.instrument.cases import Case, Runner
    from simtrack.evaluation.instrument.conditions import parse_conditions
    from simtrack.report.headline import format_value
    from simtrack.report.instrument_pages import write_attribution

    if workers < 1:
        raise InvalidValueError("workers", workers, "1 or more")
    base = Case(scene, seed, duration, parse_conditions(given), tracker, localizer, detector, renderer)
    base.config(work)  # what cannot be run is told before anything is
    folder = out if out is not None else Path("runs") / f"{Path(scene).stem}-{seed}-attribution"
    with console.ProgressLine(f"attribute {scene}", "looking for runs that are done") as line:
        runner = Runner(work, workers, report=lambda done, of, what: line.show(f"{done}/{of} · {what}", done / of))
        try:
            waterfalls = explain(base, runner, tuple(name for name in stages.split(",") if name), each=alone)
        except KeyboardInterrupt:
            console.show_error("stopped: runs that are done are kept, and the same command carries on")
            return 130
    columns = ("measure", "error", *stages.split(","), REST)
    rows = [
        (w.measure, format_value(w.total, w.unit), *(format_value(share, w.unit) for share in w.shares.values()))
        for w in waterfalls
    ]
    console.show_table(columns, rows, right=range(1, len(columns)))
    console.show_written(folder, write_attribution(base, waterfalls, folder))
    return 0
