"""``simtrack sweep``: every metric over conditions, with confidence bands over seeds."""

from pathlib import Path
from typing import Annotated, Literal

import tyro


def sweep(
    scene: Annotated[str, tyro.conf.Positional],
    over: str,
    seeds: int = 3,
    seed: int = 0,
    duration: float | None = 10.0,
    given: str = "",
    tracker: str | None = None,
    localizer: str | None = None,
    detector: str = "oracle",
    renderer: Literal["mujoco", "embree"] = "mujoco",
    metrics: str = "tracking.recall,tracking.add_s_auc,tracking.map.translation_error.median,localization.ate_rmse",
    out: Path | None = None,
    work: Path = Path("runs/cases"),
    workers: int = 1,
    engine: Literal["local", "ray"] = "local",
    address: str | None = None,
) -> int:
    """Run a scene over values of conditions, one condition at a time, on several seeds; draw every metric as a curve.

    Conditions: noise, model_error, calibration, detection, speed (factors, 1 changes nothing), model_scale and
    detector_bias (shares), extrinsics (degrees), time_offset and latency (seconds), occlusion (things in the way),
    false_symmetry and lidar_mirrored (1: the models, the lidar are said to be other than they are).
    The same command carries on where a stopped one was; runs are kept by their content.

    Args:
        scene: Name of a scene, or path of its folder or YAML file.
        over: For example noise=0:3,latency=0:0.5:6,occlusion=0;2;4 - LOW:HIGH is walked in five values.
        seeds: Seeds a value; bands are 95 % bootstrap intervals of the median over them.
        seed: The first of them.
        duration: Simulated seconds; None: the scene's own.
        given: Conditions that hold everywhere: noise=2,speed=0.5.
        tracker: A tracker of yours, package.module:Class or exec:PROGRAM (docs/bring_your_own.md).
        localizer: A localizer of yours, package.module:Class, or oracle.
        detector: What detects objects in images: oracle, keypoints, or another as of `simtrack run`.
        renderer: mujoco needs OpenGL (EGL), embree needs none.
        metrics: Which are printed and drawn first; the files have all.
        out: Folder for sweep.json, sweep.csv and sweep.html; runs/SCENE-sweep if not given.
        work: Folder where runs are kept.
        workers: Runs at a time.
        engine: local uses processes of this machine, ray those of a cluster with a shared file system.
        address: Of a running Ray cluster: auto, or HOST:PORT; with --engine ray.
    """
    from simtrack.cli import console
    from simtrack.errors import InvalidValueError
    from simtrack.evaluation.instrument.cases import Case, Runner, name_of
    from simtrack.evaluation.instrument.conditions import parse_conditions
    from simtrack.evaluation.instrument.sweep import parse_axes
    from simtrack.evaluation.instrument.sweep import sweep as run_sweep
    from simtrack.report.headline import format_value
    from simtrack.report.instrument_pages import write_sweep

    if workers < 1:
        raise InvalidValueError("workers", workers, "1 or more")
    if address is not None and engine != "ray":
        raise InvalidValueError("address", address, "nothing without --engine ray")
    axes = parse_axes(over)
    base = Case(scene, seed, duration, parse_conditions(given), tracker, localizer, detector, renderer)
    base.config(work)
    folder = out if out is not None else Path("runs") / f"{Path(scene).stem}-sweep"
    with console.ProgressLine(f"sweep {scene}", "looking for runs that are done") as line:
        report = lambda done, of, what: line.show(f"{done}/{of} · {what}", done / of)  # noqa: E731
        try:
            found = run_sweep(base, axes, seeds, Runner(work, workers, engine, address, report))
        except KeyboardInterrupt:
            console.show_error("stopped: runs that are done are kept, and the same command carries on")
            return 130
    for case, error in found.failed.items():
        console.show_error(f"{name_of(case)}: {error}")
    chosen = [name for name in metrics.split(",") if name]
    for axis in axes:
        curves = {curve.metric: curve for curve in found.curves if curve.axis == axis.name}
        shown = [curves[name] for name in chosen if name in curves]
        rows = []
        for k, value in enumerate(axis.values):
            cells = []
            for curve in shown:
                point = curve.points[k]
                cells.append("-" if point is None else format_value(point.median, curve.unit))
            rows.append((f"{value:g}", *cells))
        console.show_table((axis.name, *(curve.metric for curve in shown)), rows, right=range(len(shown) + 1))
    if not found.curves:
        return 2
    console.show_written(folder, write_sweep(base, found, chosen, folder))
    return 2 if found.failed else 0
