"""Methods beside each other: runs grouped by what ran in them, paired by scene and seed."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.evaluation.instrument.statistics import LEAST_PAIRS, Difference, Estimate, difference, estimate
from simtrack.evaluation.metrics import Metrics, read_metrics
from simtrack.evaluation.run_config import ORACLE

STAGES = ("tracker", "localizer", "scene_graph")
MORE_IS_BETTER = (
    "recall", "auc", "bop", "hota", "accuracy", "f1", "known_share", "known_rejected", "unknown_recall",
    "objects_found", "trusted_share", "inside_share", "frames_per_second", "gaze_gain", "reduction",
)  # fmt: skip
"""Parts of the names of metrics of which more is better; of all others less is."""
HEADLINE = (
    "tracking.recall", "tracking.occluded.recall", "tracking.add_s_auc", "tracking.hota",
    "tracking.occluded.translation_error.median", "tracking.static.translation_error.median",
    "tracking.static.translation_error.p95", "tracking.moving.translation_error.median",
    "tracking.rotation_error.median", "tracking.map.translation_error.median", "tracking.false_tracks",
    "tracking.id_switches", "tracking.reacquisition_time.p95", "localization.ate_rmse", "relations.f1",
    "speed.frames_per_second",
)  # fmt: skip


def more_is_better(metric: str) -> bool:
    """Whether a larger value of a metric is the better one."""
    return any(part in metric for part in MORE_IS_BETTER)


@dataclass(frozen=True, slots=True)
class Run:
    """A folder of `simtrack run`."""

    path: Path
    scene: str
    seed: int
    method: str
    """Its stages that are not simtrack's own, or ``simtrack``."""
    duration: float | None
    """Simulated seconds; None where the folder does not tell."""
    metrics: Metrics


def read_run(path: Path) -> Run:
    """Read a run's folder.

    Raises:
        FileFormatError: it is none, or the run is partial.
    """
    import yaml

    file = path / "config.yaml"
    try:
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
        scene, seed = str(config["scene"]), int(config["seed"])
        duration = float(config["duration"]) if config.get("duration") is not None else None
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(file, "", "not the folder of a run: no scene and seed in config.yaml") from error
    metrics = read_metrics(path / "metrics.json")
    partial = metrics.get("run.partial")
    if partial is None or partial.value is not False:
        raise FileFormatError(path / "metrics.json", "run.partial", "the run was stopped before its end")
    foreign = [str(config[stage]) for stage in STAGES if config.get(stage)]
    foreign += [str(config["detector"])] if config.get("detector", ORACLE) != ORACLE else []
    return Run(path, scene, seed, " + ".join(foreign) or "simtrack", duration, metrics)


@dataclass(frozen=True, slots=True)
class Cell:
    """One method's value of one metric."""

    estimate: Estimate | None
    difference: Difference | None
    """To the first method on the seeds that both have; None of the first itself."""
    better: bool | None
    """Whether the difference, if significant, is for the better."""


@dataclass(frozen=True, slots=True)
class Row:
    """A metric over the methods."""

    metric: str
    unit: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True, slots=True)
class Comparison:
    """The table of methods and metrics."""

    methods: tuple[str, ...]
    """The first one is what the others are compared with."""
    seeds: Mapping[str, tuple[str, ...]]
    """Method -> scenes with their seeds."""
    rows: tuple[Row, ...]
    remarks: tuple[str, ...]
    """What is to be known of the comparison, a sentence each: unequal durations, too few pairs."""


def compare(runs: Sequence[Run], metrics: Sequence[str] | None = None) -> Comparison:
    """Methods by metrics, with bootstrap intervals over runs, and paired differences to the first run's method.

    Args:
        runs: of one or more methods; the same scene and seed pairs them.
        metrics: which, all that were measured if None.

    Raises:
        InvalidValueError: no runs, or a method with the same scene and seed twice.
    """
    if not runs:
        raise InvalidValueError("runs", "none", "folders of simtrack run")
    by_method: dict[str, dict[tuple[str, int], Run]] = {}
    for run in runs:
        place = by_method.setdefault(run.method, {})
        if (run.scene, run.seed) in place:
            twice = f"{run.path} and {place[run.scene, run.seed].path}"
            raise InvalidValueError("runs", twice, f"every scene and seed once for {run.method}")
        place[run.scene, run.seed] = run
    names = list(metrics) if metrics is not None else sorted({name for run in runs for name in run.metrics})
    first = next(iter(by_method))
    rows = []
    for name in names:
        unit = next((run.metrics[name].unit for run in runs if name in run.metrics), None)
        if unit is None:
            continue
        reference = _values(by_method[first], name)
        cells = tuple(
            _cell(_values(of, name), None if method == first else reference, more_is_better(name))
            for method, of in by_method.items()
        )
        if any(cell.estimate is not None for cell in cells):
            rows.append(Row(name, unit, cells))
    seeds = {method: tuple(f"{scene}:{seed}" for scene, seed in of) for method, of in by_method.items()}
    remarks = [*_unequal(runs), *_too_few(by_method)]
    return Comparison(tuple(by_method), seeds, tuple(rows), tuple(remarks))


def _unequal(runs: Sequence[Run]) -> list[str]:
    """A remark on each scene whose runs took different times: what they measure is not of the same events."""
    durations: defaultdict[str, set[float]] = defaultdict(set)
    for run in runs:
        if run.duration is not None:
            durations[run.scene].add(run.duration)
    return [
        f"runs of {scene} are of different duration ({', '.join(f'{d:g}' for d in sorted(found))} s): "
        "differences between them are also those of what happened meanwhile"
        for scene, found in durations.items()
        if len(found) > 1
    ]


def _too_few(by_method: Mapping[str, Mapping[tuple[str, int], Run]]) -> list[str]:
    """A remark on each method whose difference to the first cannot be significant."""
    first, *others = by_method
    pairs = {method: len(by_method[method].keys() & by_method[first].keys()) for method in others}
    return [
        f"nothing can be significant between {method} and {first}: "
        f"{count} pair{'' if count == 1 else 's'} of scene and seed, {LEAST_PAIRS} are needed"
        for method, count in pairs.items()
        if count < LEAST_PAIRS
    ]


def _values(runs: Mapping[tuple[str, int], Run], name: str) -> dict[tuple[str, int], float]:
    found = {key: run.metrics[name].value for key, run in runs.items() if name in run.metrics}
    return {key: float(value) for key, value in found.items() if value is not None}


def _cell(ours: Mapping[tuple[str, int], float], reference: Mapping[tuple[str, int], float] | None, more: bool) -> Cell:
    gap = None
    if reference is not None:
        shared = [key for key in ours if key in reference]
        gap = difference([ours[key] for key in shared], [reference[key] for key in shared])
    better = None if gap is None or not gap.significant else (gap.mean > 0.0) == more
    return Cell(estimate(list(ours.values())), gap, better)
