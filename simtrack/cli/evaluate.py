"""``simtrack evaluate``: what a stage achieves over many scenes, against the truth."""

import os
from pathlib import Path
from typing import Annotated, Literal

import tyro


def evaluate(
    what: Annotated[Literal["reconstruction", "detector"], tyro.conf.Positional],
    rooms: str = "all",
    entities: Literal["true", "partial", "both"] = "both",
    stages: Literal["graph", "models", "physics"] = "physics",
    out: Path = Path("reports"),
    work: Path = Path("runs/evaluate-reconstruction"),
    workers: int | None = None,
    data: Path | None = None,
    detector: str = "keypoints",
    count: int | None = None,
) -> int:
    """Measure a part against the truth: reconstruction of many rooms, or the detector on labelled images.

    Reconstruction: contact graph, CAD models, physics. The same command carries on where a stopped one was; rooms that
    the same code has done are not done again.

    Args:
        what: What is evaluated.
        rooms: Reconstruction: all evaluation rooms, or some: 101,102 or 1-20 or kitchen:2.
        entities: Complete meshes, or partial ones as a camera sees them on a walk, or both.
        stages: How far to go: the contact graph alone, CAD models too, or the check of physics as well.
        out: Folder for the results, WHAT.json and WHAT.txt.
        work: Folder where rooms are kept as they are done.
        workers: Processes; one a core if not given.
        data: Detector: folder of a generated data set with the format bop that it was not trained on.
        detector: keypoints (the networks that come along), or a folder that `simtrack train detector` wrote.
        count: Images at most.
    """
    if what == "detector":
        return _detector(data, detector, count, out)
    return _reconstruction(rooms, entities, stages, out, work, workers)


def _detector(data: Path | None, detector: str, count: int | None, out: Path) -> int:
    from simtrack.cli import console
    from simtrack.errors import InvalidValueError
    from simtrack.evaluation.detector import evaluate_detector, write_scores
    from simtrack.perception.detection.keypoint_detector import KeypointDetector
    from simtrack.perception.detection.loading import KEYPOINTS
    from simtrack.training.source import open_source

    if data is None:
        raise InvalidValueError("data", None, "the folder of a generated data set")
    if count is not None and count < 1:
        raise InvalidValueError("count", count, "1 or more")
    source = open_source(data)
    models = {model.name: model for model in source.models}
    opened = KeypointDetector(models, None if detector == KEYPOINTS else Path(detector))
    with console.ProgressLine("evaluate detector", "compiling") as line:
        scores = evaluate_detector(source, opened, count, lambda done, of: line.show(f"{done}/{of} images", done / of))
    metrics = scores.metrics()
    rows = [(n, f"({m.reason})" if m.value is None else f"{m.value:.4g}", m.unit) for n, m in metrics.items()]
    console.show_table(("figure", "value", "unit"), rows, right=(1,))
    console.show_written(out, write_scores(metrics, len(scores.found), data.name, out))
    return 0


def _reconstruction(
    rooms: str,
    entities: Literal["true", "partial", "both"],
    stages: Literal["graph", "models", "physics"],
    out: Path,
    work: Path,
    workers: int | None,
) -> int:
    from simtrack.cli import console
    from simtrack.errors import InvalidValueError
    from simtrack.evaluation.reconstruction import ENTITIES
    from simtrack.evaluation.reconstruction_rooms import (
        RoomTask,
        evaluate_rooms,
        figures,
        parse_rooms,
        table_5,
        write_results,
    )

    if workers is not None and workers < 1:
        raise InvalidValueError("workers", workers, "1 or more")
    if out.exists() and not out.is_dir():
        raise InvalidValueError("out", str(out), "a folder, but this is a file")
    kinds = ENTITIES if entities == "both" else (entities,)
    tasks = [RoomTask(seed, kitchen, kind, stages) for seed, kitchen in parse_rooms(rooms) for kind in kinds]
    size = min(workers or len(os.sched_getaffinity(0)), len(tasks))
    with console.ProgressLine("evaluate reconstruction", "looking for rooms that are done") as line:
        try:
            results = evaluate_rooms(
                tasks, work, size, lambda done, of, state: line.show(f"{done}/{of} · {state}", done / of)
            )
        except KeyboardInterrupt:
            console.show_error("stopped: rooms that are done are kept, and the same command carries on")
            return 130
    for room, reason in results.failed:
        console.show_error(f"{room} could not be evaluated: {reason}")
    if not results.done:
        return 2
    columns, rows = table_5(results.done)
    console.show_table(columns, rows, right=range(1, len(columns)))
    values = [
        (name, f"({m.reason})" if m.value is None else f"{m.value:.4g}", m.unit)
        for name, m in figures(results.done).items()
    ]
    console.show_table(("figure", "value", "unit"), values, right=(1,))
    console.show_written(out, write_results(results.done, out))
    return 2 if results.failed else 0
