"""Evaluates reconstruction over many rooms, in worker processes; carries on where it was stopped.

The outcome of a room is kept in a file as soon as it is there; those of other code are made anew.
"""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from simtrack.errors import InvalidValueError
from simtrack.evaluation.metrics import Metrics, write_atomically
from simtrack.evaluation.reconstruction import (
    ENTITIES,
    Entities,
    RoomOutcome,
    evaluate_room,
    outcome_from_json,
    outcome_to_json,
    summary,
)
from simtrack.evaluation.workers import as_done, code_digest

Stages: TypeAlias = Literal["graph", "models", "physics"]
MOST_ROOMS = 10_000


@dataclass(frozen=True, slots=True)
class RoomTask:
    """One room from one kind of entities."""

    seed: int
    kitchen: bool
    entities: Entities
    stages: Stages

    @property
    def room(self) -> str:
        """Its name on the command line."""
        return f"{'kitchen' if self.kitchen else 'rooms'}:{self.seed}"

    @property
    def file(self) -> str:
        """Name of the file that its outcome is kept in."""
        return f"{self.room.replace(':', '-')}-{self.entities}-{self.stages}.json"

    def run(self) -> RoomOutcome:
        """Evaluate it."""
        return evaluate_room(self.seed, self.entities, kind="kitchen" if self.kitchen else None, stages=self.stages)


@dataclass(frozen=True, slots=True)
class Outcomes:
    """What came of the tasks."""

    done: tuple[RoomOutcome, ...]
    """In the order of the tasks."""
    failed: tuple[tuple[str, str], ...]
    """Rooms that could not be evaluated, and why."""


def parse_rooms(text: str) -> list[tuple[int, bool]]:
    """(seed, whether it is a kitchen) of rooms such as ``all``, ``101,102``, ``1-20``, ``kitchen:2``.

    Raises:
        InvalidValueError: it is none of that.
    """
    from simtrack.simulation.building.rooms.evaluation import evaluation_rooms

    rooms: list[tuple[int, bool]] = []
    for entry in text.split(","):
        kind, _, numbers = entry.strip().rpartition(":")
        first, _, last = numbers.partition("-")
        if numbers == "all" and not kind:
            rooms += [(seed, False) for seed in evaluation_rooms()]
        elif kind in ("", "rooms", "kitchen") and first.isdecimal() and (last or first).isdecimal():
            low, high = int(first), int(last or first)
            if not low <= high < low + MOST_ROOMS:
                raise InvalidValueError("rooms", entry, f"a range of 1 to {MOST_ROOMS} rooms, the first one first")
            rooms += [(seed, kind == "kitchen") for seed in range(low, high + 1)]
        else:
            raise InvalidValueError("rooms", entry, "all, or seeds such as 101, 1-20, kitchen:2, separated by commas")
    return list(dict.fromkeys(rooms))


def evaluate_rooms(
    tasks: Sequence[RoomTask],
    folder: Path,
    workers: int,
    report: Callable[[int, int, str], None] | None = None,
) -> Outcomes:
    """Evaluate rooms, or read what was kept of them.

    Args:
        tasks: rooms.
        folder: where outcomes are kept, created if missing.
        workers: processes.
        report: hears how many rooms are done, of how many, and what came last.

    Raises:
        InvalidValueError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidValueError("work", str(folder), f"a folder that can be written ({error.strerror})") from error
    code = code_digest()
    outcomes: dict[RoomTask, RoomOutcome] = {}
    failed: list[tuple[str, str]] = []
    for task in tasks:
        with suppress(OSError, ValueError, KeyError, TypeError):
            document = json.loads((folder / task.file).read_text(encoding="utf-8"))
            if document["code"] == code:
                outcomes[task] = outcome_from_json(document["outcome"])
    say = report or (lambda done, of, what: None)
    say(len(outcomes), len(tasks), f"{len(outcomes)} rooms were done before" if outcomes else "starting")
    for task, result in as_done([task for task in tasks if task not in outcomes], RoomTask.run, workers):
        if isinstance(result, RoomOutcome):
            outcomes[task] = result
            document = {"code": code, "outcome": outcome_to_json(result)}
            write_atomically(folder / task.file, json.dumps(document, indent=1) + "\n")
            what = f"distance {result.distance} of {result.nodes} nodes, {result.verdict}, {result.seconds:.0f} s"
        else:
            failed.append((f"{task.room} ({task.entities})", str(result)))
            what = f"failed: {result}"
        say(len(outcomes) + len(failed), len(tasks), f"{task.room} ({task.entities}): {what}")
    return Outcomes(tuple(outcomes[task] for task in tasks if task in outcomes), tuple(failed))


def table_5(outcomes: Sequence[RoomOutcome]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows as in Table 5 of the reconstruction paper.

    cg_ours is the graph from entities as a camera saw them, cg_map the one from complete entities; a dash stands for
    what was not evaluated. The last row has the means.
    """
    columns = ["scene", "nodes"]
    for name in ("distance", "wrong support", "missing", "wrong detection"):
        columns += [f"{name} cg_ours", "cg_map"]
    found: dict[str, dict[str, RoomOutcome]] = {}
    for outcome in outcomes:
        found.setdefault(outcome.room, {})[outcome.entities] = outcome
    rows, numbers = [], []
    for room, kinds in found.items():
        values: list[float | None] = [float(next(iter(kinds.values())).nodes)]
        pair = [kinds.get("partial"), kinds.get("true")]
        for count in (
            lambda o: o.distance, lambda o: len(o.wrong_support), lambda o: len(o.missing), lambda o: len(o.extra)
        ):  # fmt: skip
            values += [None if each is None else float(count(each)) for each in pair]
        numbers.append(values)
        rows.append([room, *("-" if value is None else f"{value:.0f}" for value in values)])
    means = []
    for column in zip(*numbers, strict=True):
        known = [value for value in column if value is not None]
        means.append(f"{sum(known) / len(known):.2f}" if known else "-")
    return columns, [*rows, ["mean", *means]]


def figures(outcomes: Sequence[RoomOutcome]) -> Metrics:
    """The summaries of both kinds of entities, their names before those of the figures."""
    metrics: Metrics = {}
    for kind in ENTITIES:
        chosen = [outcome for outcome in outcomes if outcome.entities == kind]
        if chosen:
            metrics |= {f"{kind}.{name}": metric for name, metric in summary(chosen).items()}
    return metrics


def write_results(outcomes: Sequence[RoomOutcome], folder: Path) -> list[str]:
    """Write ``reconstruction.json`` (figures and rooms) and ``reconstruction.txt`` (tables); returns their names."""
    from dataclasses import asdict

    folder.mkdir(parents=True, exist_ok=True)
    metrics = figures(outcomes)
    document = {
        "figures": {name: asdict(metric) for name, metric in sorted(metrics.items())},
        "rooms": [outcome_to_json(outcome) for outcome in outcomes],
    }
    write_atomically(folder / "reconstruction.json", json.dumps(document, indent=1, allow_nan=False) + "\n")
    columns, rows = table_5(outcomes)
    wide = [max(len(row[k]) for row in (columns, *rows)) for k in range(len(columns))]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, wide, strict=True)) for row in (columns, *rows)]
    lines += ["", "Distance = 2 x wrong support + missing + wrong detection; nodes include floor and walls.", ""]
    for name, metric in metrics.items():
        value = f"({metric.reason})" if metric.value is None else f"{metric.value:.4g} {metric.unit}"
        lines.append(f"{name:<36} {value}")
    write_atomically(folder / "reconstruction.txt", "\n".join(lines) + "\n")
    return ["reconstruction.json", "reconstruction.txt"]
