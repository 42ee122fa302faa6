"""Evaluates panoptic maps over many rooms and methods; carries on where it was stopped.

What came of a room is kept in a file as soon as it is there; results of other code are made anew.
"""

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.errors import InvalidValueError, SimtrackError
from simtrack.evaluation.map_sources import ORACLE, Poses, opened_segmenter, room_source, with_poses
from simtrack.evaluation.mapping import MapScores, class_means, map_scenes, score_map, score_metrics
from simtrack.evaluation.metrics import write_atomically
from simtrack.evaluation.panoptic import PAPER_CLASSES, STUFF, PanopticCount, ScoredClass, mean_precision
from simtrack.evaluation.workers import code_digest
from simtrack.perception.mapping.panoptic.panoptic_map import Method, PanopticMapConfig
from simtrack.perception.segmentation.learned import network_file
from simtrack.perception.segmentation.loading import LEARNED
from simtrack.simulation.building.rooms.film import FilmConfig

Results = Mapping[str, MapScores]
"""Method -> scores."""


@dataclass(frozen=True, slots=True)
class RoomMapTask:
    """One room, mapped by several methods from the same film."""

    seed: int
    kitchen: bool
    methods: tuple[Method, ...]
    strength: float
    frames: int
    voxel: float
    sensor: str = "xtion"
    segmenter: str = ORACLE
    """As `simtrack.evaluation.map_sources.map_source` takes it."""
    poses: Poses = "true"

    @property
    def room(self) -> str:
        """Its name on the command line."""
        return f"{'kitchen' if self.kitchen else 'rooms'}:{self.seed}"

    @property
    def file(self) -> str:
        """Name of the file that its outcome is kept in."""
        parts = (self.room.replace(":", "-"), f"{self.strength:g}", str(self.frames), f"{self.voxel:g}", self.sensor)
        return "-".join((*parts, *self.methods)) + self.variant.replace("_", "-") + ".json"

    @property
    def variant(self) -> str:
        """What sets it apart from the oracle's segments on true poses, as part of a file's name."""
        segmenter = "" if self.segmenter == ORACLE else "_" + re.sub(r"[^A-Za-z0-9]+", "-", self.segmenter).strip("-")
        strength = "" if segmenter or self.strength == 1.0 else f"_strength-{self.strength:g}"
        return segmenter + strength + ("" if self.poses == "true" else f"_{self.poses}")

    def code(self) -> str:
        """Hash of what the outcome follows from, beside the fields: the package's code, and the network."""
        if self.segmenter != LEARNED and not Path(self.segmenter).exists():
            return code_digest()
        file = network_file(None if self.segmenter == LEARNED else Path(self.segmenter))
        network = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""
        return f"{code_digest()}-{network[:16]}"

    def run(self, progress: Callable[[int, int], None] | None = None) -> dict[str, MapScores]:
        """Map and compare; the contact graph is built of the full method's map alone."""
        film = FilmConfig(frames=self.frames, sensor=self.sensor)
        room = room_source(self.seed, "kitchen" if self.kitchen else None, film, self.strength)
        chosen = opened_segmenter(self.segmenter)
        source = with_poses(room if chosen is None else replace(room, segmenter=chosen), self.poses)
        configs = [PanopticMapConfig.of_method(method, self.voxel) for method in self.methods]
        mapped = map_scenes(source, configs, progress)
        scores = {}
        for method, made in zip(self.methods, mapped, strict=True):
            assert made.seen is not None
            scores[method] = score_map(made.entities, made.seen, graph=method == "full")
        return scores


def evaluate_maps(
    tasks: Sequence[RoomMapTask], folder: Path, report: Callable[[str, float], None] | None = None
) -> tuple[dict[RoomMapTask, Results], list[tuple[str, str]]]:
    """Map rooms one after the other, or read what was kept of them.

    Args:
        tasks: rooms.
        folder: where outcomes are kept, created if missing.
        report: hears what is going on, and the share that is done.

    Returns:
        What came of the rooms, and those that could not be mapped with the reason.

    Raises:
        InvalidValueError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidValueError("work", str(folder), f"a folder that can be written ({error.strerror})") from error
    say = report or (lambda what, share: None)
    done: dict[RoomMapTask, Results] = {}
    failed: list[tuple[str, str]] = []
    for number, task in enumerate(tasks):
        code = task.code()
        with suppress(OSError, ValueError, KeyError, TypeError):
            document = json.loads((folder / task.file).read_text(encoding="utf-8"))
            if document["code"] == code:
                done[task] = {m: scores_from_json(document["scores"][m]) for m in task.methods}
                continue
        start = number / len(tasks)
        say(f"{task.room}", start)
        try:
            found = task.run(lambda k, n, s=start, t=task: say(f"{t.room}: frame {k} of {n}", s + k / n / len(tasks)))
        except SimtrackError as error:
            failed.append((task.room, str(error)))
            continue
        done[task] = found
        document = {"code": code, "scores": {m: scores_to_json(s) for m, s in found.items()}}
        write_atomically(folder / task.file, json.dumps(document, indent=1) + "\n")
    return done, failed


def scores_to_json(scores: MapScores) -> dict[str, Any]:
    """Scores as plain values."""
    return asdict(scores)


def scores_from_json(document: Mapping[str, Any]) -> MapScores:
    """What `scores_to_json` wrote; raises KeyError, TypeError or ValueError for anything else."""

    def panoptic(rows: Mapping[str, Any]) -> dict[str, PanopticCount]:
        return {name: PanopticCount(**row) for name, row in rows.items()}

    def scored(rows: Mapping[str, Any]) -> dict[str, ScoredClass]:
        return {
            n: ScoredClass(tuple((float(s), bool(r)) for s, r in row["hits"]), row["true"]) for n, row in rows.items()
        }

    return MapScores(
        panoptic=panoptic(document["panoptic"]),
        panoptic_all=panoptic(document["panoptic_all"]),
        panoptic_lenient=panoptic(document["panoptic_lenient"]),
        instances=scored(document["instances"]),
        boxes=scored(document["boxes"]),
        refined=scored(document["refined"]),
        accuracy=(float(document["accuracy"][0]), float(document["accuracy"][1])),
        completeness=float(document["completeness"]),
        distance=int(document["distance"]),
        nodes=int(document["nodes"]),
        edits=int(document.get("edits", 0)),
        distance_by_class=int(document.get("distance_by_class", 0)),
    )


def summed(scores: Sequence[MapScores]) -> MapScores:
    """Counts of several rooms added up; means of what is measured in metres and shares."""

    def added(name: str, zero: Any) -> dict[str, Any]:
        total: dict[str, Any] = {}
        for each in scores:
            for key, value in getattr(each, name).items():
                total[key] = total.get(key, zero) + value
        return total

    accuracy = np.mean([each.accuracy for each in scores], axis=0)
    return MapScores(
        panoptic=added("panoptic", PanopticCount()),
        panoptic_all=added("panoptic_all", PanopticCount()),
        panoptic_lenient=added("panoptic_lenient", PanopticCount()),
        instances=added("instances", ScoredClass()),
        boxes=added("boxes", ScoredClass()),
        refined=added("refined", ScoredClass()),
        accuracy=(float(accuracy[0]), float(accuracy[1])),
        completeness=float(np.mean([each.completeness for each in scores])),
        distance=sum(each.distance for each in scores),
        nodes=sum(each.nodes for each in scores),
        edits=sum(each.edits for each in scores),
        distance_by_class=sum(each.distance_by_class for each in scores),
    )


# --------------------------------------------------------------------------------------------------------------- tables


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.1f}"


def table_1(done: Mapping[RoomMapTask, Results]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows as in Table 1 of the reconstruction paper: rooms, means over classes; instances' mAP@0.5."""
    methods = list(dict.fromkeys(m for results in done.values() for m in results))
    columns = ["room", *(f"{m} {name}" for m in methods for name in ("PQ", "SQ", "RQ", "mAP"))]
    rows = []
    for task, results in done.items():
        row = [task.room]
        for method in methods:
            means = class_means(results[method].panoptic) if method in results else None
            row += [_percent(None if means is None else value) for value in (means or (None,) * 3)]
            row.append(_percent(mean_precision(results[method].instances) if method in results else None))
        rows.append(row)
    return columns, rows


def table_2(total: Mapping[str, MapScores]) -> tuple[list[str], list[list[str]]]:
    """As Table 2: PQ, SQ, RQ by class over all rooms; all, stuff and things are means over classes."""
    present = sorted({n for s in total.values() for n, c in s.panoptic.items() if c.matched + c.missed})
    classes = [n for n in PAPER_CLASSES if n in present] + [n for n in present if n not in PAPER_CLASSES]
    groups = {
        "all": frozenset(classes), "stuff": STUFF, "thing": frozenset(classes) - STUFF,
        "paper's ten": frozenset(PAPER_CLASSES),
    }  # fmt: skip
    rows = []
    for method, scores in total.items():
        for k, name in enumerate(("pq", "sq", "rq")):
            means = [class_means(scores.panoptic, only) for only in groups.values()]
            single = [scores.panoptic.get(n, PanopticCount()) for n in classes]
            values = [None if m is None else m[k] for m in means] + [getattr(c, name) for c in single]
            rows.append([method, name.upper(), *map(_percent, values)])
    return ["method", "", *groups, *classes], rows


def precision_table(total: Mapping[str, MapScores], boxes: bool) -> tuple[list[str], list[list[str]]]:
    """As Tables 3 and 4: average precision at an IoU of 0.5 by class, of instances or of upright boxes.

    Means are over all classes, and over the eight classes of things that the paper's are over.
    """
    tables = {m: (s.boxes if boxes else s.instances) for m, s in total.items()}
    named = {str(m): t for m, t in tables.items()}
    if boxes and "full" in total:
        named["full (refined)"] = total["full"].refined
    classes = sorted({n for t in named.values() for n, c in t.items() if c.true})
    rows = [
        [
            name, _percent(mean_precision(t)), _percent(mean_precision(t, only=PAPER_CLASSES)),
            *(_percent(t.get(n, ScoredClass()).average_precision()) for n in classes),
        ]
        for name, t in named.items()
    ]  # fmt: skip
    return ["method", "all", "paper's eight", *classes], rows


def table_5(done: Mapping[RoomMapTask, Results]) -> tuple[list[str], list[list[str]]]:
    """As Table 5: distance of the contact graph of the full method's map, 2 W + M + E; by class; five operations."""
    rows = [
        [
            task.room,
            str(r["full"].nodes),
            *(
                text
                for value in (r["full"].distance, r["full"].distance_by_class, r["full"].edits)
                for text in (str(value), f"{value / max(r['full'].nodes, 1):.2f}")
            ),
        ]
        for task, r in done.items()
        if "full" in r
    ]
    return ["room", "nodes", "distance", "per node", "by class", "per node", "edits", "per node"], rows


def ordering(done: Mapping[RoomMapTask, Results], better: str, worse: str) -> tuple[int, int]:
    """Rooms in which one method's PQ (mean over classes) is above another's, of how many."""
    pairs = [
        (class_means(r[better].panoptic), class_means(r[worse].panoptic))
        for r in done.values()
        if {better, worse} <= r.keys()
    ]
    return sum(a is not None and b is not None and a[0] > b[0] for a, b in pairs), len(pairs)


def write_panoptic(done: Mapping[RoomMapTask, Results], folder: Path) -> list[str]:
    """Write ``panoptic.json`` (figures and rooms) and ``panoptic.txt`` (tables); returns their names.

    Other segmenters, strengths and poses than the oracle's 1 on true poses are in the names: ``panoptic_learned.json``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    methods = list(dict.fromkeys(m for results in done.values() for m in results))
    total = {m: summed([r[m] for r in done.values() if m in r]) for m in methods}
    first = next(iter(done))
    how = {"strength": first.strength, "frames": first.frames, "voxel": first.voxel, "sensor": first.sensor}
    how |= {"segmenter": first.segmenter, "poses": first.poses}
    names = [f"panoptic{first.variant}.{suffix}" for suffix in ("json", "txt")]
    document = {
        "how": how,
        "figures": {m: {k: asdict(v) for k, v in score_metrics(s).items()} for m, s in total.items()},
        "rooms": [{"room": t.room, "scores": {m: scores_to_json(s) for m, s in r.items()}} for t, r in done.items()],
    }
    write_atomically(folder / names[0], json.dumps(document) + "\n")
    filmed = f"{len(done)} rooms, {first.frames} frames each ({first.sensor}), voxels of {1e3 * first.voxel:g} mm"
    lines = [f"{filmed}, {_told_of(first)}", ""]
    for title, (columns, rows) in tables_of(done, total).items():
        wide = [max(len(row[k]) for row in (columns, *rows)) for k in range(len(columns))]
        lines += [
            title,
            *("  ".join(c.rjust(w) for c, w in zip(row, wide, strict=True)) for row in (columns, *rows)),
            "",
        ]
    for better, worse in (("full", "no-joint-fusion"), ("no-joint-fusion", "voxbloxpp"), ("full", "voxbloxpp")):
        more, of = ordering(done, better, worse)
        if of:
            lines.append(f"PQ of {better} above that of {worse} in {more} of {of} rooms")
    for method, scores in total.items():
        lines += ["", method]
        for name, metric in score_metrics(scores).items():
            value = f"({metric.reason})" if metric.value is None else f"{metric.value:.4g} {metric.unit}"
            lines.append(f"  {name:<40} {value}")
    write_atomically(folder / names[1], "\n".join(lines) + "\n")
    return names


def _told_of(task: RoomMapTask) -> str:
    by = f"oracle at strength {task.strength:g}" if task.segmenter == ORACLE else f"segmenter {task.segmenter}"
    return by + ("" if task.poses == "true" else f", {task.poses} poses")


def tables_of(
    done: Mapping[RoomMapTask, Results], total: Mapping[str, MapScores]
) -> dict[str, tuple[list[str], list[list[str]]]]:
    """Title -> columns and rows of all tables."""
    return {
        "Table 1: PQ, SQ, RQ, mAP@0.5 by room": table_1(done),
        "Table 2: PQ, SQ, RQ by class": table_2(total),
        "Table 3: instances, AP@0.5": precision_table(total, boxes=False),
        "Table 4: upright boxes, AP@0.5": precision_table(total, boxes=True),
        "Table 5: contact graph": table_5(done),
    }
