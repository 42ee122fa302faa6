"""``simtrack evaluate``: what a stage achieves over many scenes, against the truth."""

import os
from pathlib import Path
from typing import Annotated, Literal

import tyro


def evaluate(
    what: Annotated[Literal["reconstruction"], tyro.conf.Positional],
    rooms: str = "all",
    entities: Literal["true", "partial", "both"] = "both",
    stages: Literal["graph", "models", "physics"] = "physics",
    out: Path = Path("reports"),
    work: Path = Path("runs/evaluate-reconstruction"),
    workers: int | None = None,
) -> int:
    """Reconstruct many rooms and compare with the truth: contact graph, CAD models, physics.

    The same command carries on where a stopped one was; rooms that the same code has done are not done again.

    Args:
        what: What is evaluated.
        rooms: all evaluation rooms, or some: 101,102 or 1-20 or kitchen:2.
        entities: Complete meshes, or partial ones as a camera sees them on a walk, or both.
        stages: How far to go: the contact graph alone, CAD models too, or the check of physics as well.
        out: Folder for reconstruction.json and reconstruction.txt.
        work: Folder where rooms are kept as they are done.
        workers: Processes; one a core if not given.
    """
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
    with console.ProgressLine(f"evaluate {what}", "looking for rooms that are done") as line:
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
