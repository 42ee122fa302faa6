"""``simtrack run``: simulate a scene in a closed loop, measure every stage, write a report."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from simtrack.evaluation.closed_loop import Observer, Progress
    from simtrack.evaluation.record import RunRecord

SURVEY = "survey"


def run(
    scene: Annotated[str, tyro.conf.Positional] = "workbench",
    duration: float | None = None,
    seed: int = 0,
    out: Path | None = None,
    agent: str | None = None,
    tracker: str | None = None,
    localizer: str | None = None,
    detector: str | None = None,
    scene_graph: str | None = None,
    stage_limit: float = 5.0,
    given: str = "",
    map: str | None = None,
    renderer: Literal["mujoco", "embree"] = "mujoco",
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    compare_gaze: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    log: Path | None = None,
    view: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    rrd: Path | None = None,
    threads: int | None = None,
) -> int:
    """Simulate a scene in a closed loop, measure every stage, write a report.

    Args:
        scene: Name of a scene (see `simtrack scenes`), NAME:SEED such as rooms:7, or path of its folder, YAML or MJCF
            (.xml) file.
        duration: Simulated seconds; the scene's own (30 for the workbench) if not given.
        seed: Of everything random.
        out: Folder for the results; runs/SCENE-SEED if not given.
        agent: Decides where the robot looks and drives: explorer, fixed-gaze, patrol, route; by default the scene's.
        tracker: A tracker of yours, package.module:Class or exec:PROGRAM (docs/bring_your_own.md).
        localizer: A localizer of yours, package.module:Class, or oracle: one that knows the truth.
        detector: What detects objects in images: keypoints (the networks that come along), oracle (knows the truth, and
            errs like a trained network), a folder that `simtrack train detector` wrote, a YOLOv8-pose .onnx file, or
            package.module:Class; by default keypoints where they know all objects of the scene, else oracle.
        scene_graph: What says how things stand to each other, of yours, package.module:Class.
        stage_limit: Seconds that a stage of yours has for a frame; after that the frame counts as missed.
        given: Conditions: noise=2,occlusion=3 (see docs/instrument.md).
        map: What the robot is localized in: survey, simulated scans that are fused to a mesh, or the folder of such a
            survey that `simtrack survey` made; by default the true surface, displaced.
        renderer: mujoco needs OpenGL (EGL), embree needs none.
        overwrite: Replace the results in an existing folder.
        compare_gaze: Run the fixed gaze on the same seed, too: what does the agent's gaze gain?
        log: Record the sensor feed to this MCAP file, for `simtrack replay`.
        view: Show the run live in rerun (needs the extra viz).
        rrd: Save the run for rerun in this file (needs the extra viz).
        threads: Threads of the compiled kernels; all cores if not given.
    """
    from simtrack.evaluation.start_up import cold_start_told, process_start, relax_collector

    restore_collector = relax_collector()
    from simtrack.cli import console
    from simtrack.evaluation.closed_loop import ClosedLoopRun
    from simtrack.evaluation.rehearsal import rehearse
    from simtrack.evaluation.run_config import RunConfig
    from simtrack.report.page import write_report
    from simtrack.simulation.oracles import OracleDetectorConfig
    from simtrack.simulation.scene_file import load_scene, surveyed_by

    loaded, oracle = load_scene(scene), OracleDetectorConfig()
    if given:
        from simtrack.evaluation.instrument.conditions import parse_conditions

        conditions = parse_conditions(given)
        loaded, oracle = conditions.scene(loaded), conditions.detector(oracle)
    if map == SURVEY:
        loaded, map = surveyed_by(loaded, "scans"), None
    folder = out if out is not None else Path("runs") / f"{loaded.name}-{seed}"
    config = RunConfig(
        scene=loaded, out=folder, duration=duration, seed=seed, agent=agent, detector=detector, renderer=renderer,
        overwrite=overwrite, log=log, compare_gaze=compare_gaze, threads=threads,
        tracker=tracker, localizer=localizer, scene_graph=scene_graph, stage_limit=stage_limit, oracle=oracle,
        static_map=None if map is None else Path(map),
    )  # fmt: skip
    observers = _observers(view, rrd)
    if detector is None:
        console.show_choice("detector", config.detector_choice.name, config.detector_choice.reason)
    with console.ProgressLine(f"{loaded.name} · seed {seed}") as line, cold_start_told(line.say):

        def show(progress: "Progress") -> None:
            restore_collector()
            line.update(progress)

        rehearse(scene, renderer, line.say)
        record = ClosedLoopRun(config, show, observers, started=process_start()).run()
    write_report(record, folder / "report.html")
    _summarise(record)
    console.show_written(folder, ["metrics.json", "report.html"])
    if record.partial:
        console.show_error(f"stopped after {record.end / 1e9:.1f} s: the results are partial")
        return 130
    return 0


def _observers(view: bool, rrd: Path | None) -> "list[Observer]":
    if not view and rrd is None:
        return []
    from simtrack.report.rerun_log import RerunLog

    return [RerunLog(view=view, path=rrd)]


def _summarise(record: "RunRecord") -> None:
    """Print what was asked and measured."""
    from rich.text import Text

    from simtrack.cli import console
    from simtrack.evaluation.targets import targets_of
    from simtrack.report.headline import table

    targets = targets_of(record.scene, str(record.config["detector"]))
    names = [name for name in (targets or record.metrics) if name in record.metrics]
    marks = {"good": Text("✓", "green"), "bad": Text("✗", "red"), "": Text("")}
    rows = [
        (row.name, row.value, row.asked, marks[row.verdict], row.floor) for row in table(record.metrics, names, targets)
    ]
    columns = ("metric", "value", "asked", "", "noise floor")
    if console.out().width < 90:
        columns, rows = columns[:4], [row[:4] for row in rows]
    console.show_table(columns, rows, right=(1, 2, 4))
    for name, metric in record.metrics.items():
        if name.endswith(".missed_frames") and metric.value:
            stage = name.split(".")[1]
            told = f"the {stage} missed {metric.value} frames: {metric.reason} (see faults.csv)"
            console.show_warning(told, UserWarning, "", 0)
