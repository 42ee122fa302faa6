"""Which stage causes an end-to-end error: the same run again, with one stage after the other replaced by an oracle.

The robot goes the way of the measured run in all of them: its commands are given again, so that the same physics happen
before the same sensors whatever is believed. A stage's share is what the error loses when that stage becomes perfect
after those before it in the list (the waterfall); beside it stands what the error loses when it alone becomes perfect.
What is left in the end is the tracker's own: exact readings, true shapes, a known pose, and still an error.

The order goes from what reaches the stack first to what it does itself; shares of stages that mask each other depend on
it, which is why both figures are given.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from simtrack.errors import SimtrackError, UnknownNameError
from simtrack.evaluation.instrument.cases import Case, Runner
from simtrack.evaluation.metrics import Metrics
from simtrack.evaluation.run_config import ORACLE

MEASURES: Mapping[str, tuple[str, bool]] = {
    "tracking.map.translation_error.median": ("m", False),
    "tracking.static.translation_error.median": ("m", False),
    "tracking.moving.translation_error.median": ("m", False),
    "tracking.rotation_error.median": ("rad", False),
    "tracking.add_s_auc": ("1", True),
    "tracking.recall": ("1", True),
    "tracking.bop.ar": ("1", True),
    "localization.ate_rmse": ("m", False),
    "localization.rotation_rmse": ("rad", False),
}
"""Metric -> unit, and whether the error is what it lacks to 1."""


def _calibration(case: Case) -> Case:
    conditions = replace(case.conditions, calibration=0.0, extrinsics=0.0, time_offset=0.0, lidar_mirrored=0)
    return replace(case, conditions=conditions)


def _noise(case: Case) -> Case:
    return replace(case, conditions=replace(case.conditions, noise=0.0))


def _models(case: Case) -> Case:
    return replace(case, conditions=replace(case.conditions, model_error=0.0, model_scale=0.0, false_symmetry=0))


def _latency(case: Case) -> Case:
    return replace(case, conditions=replace(case.conditions, latency=0.0))


def _detection(case: Case) -> Case:
    return replace(case, detector=ORACLE, conditions=replace(case.conditions, detection=0.0, detector_bias=0.0))


def _localization(case: Case) -> Case:
    return replace(case, localizer=ORACLE)


STAGES = {
    "calibration": _calibration,
    "noise": _noise,
    "models": _models,
    "latency": _latency,
    "detection": _detection,
    "localization": _localization,
}
"""What is replaced by an oracle, in the order of the waterfall: what each of them makes of a case."""
REST = "tracker"
"""What the error is put down to that is left when all stages are perfect."""


@dataclass(frozen=True, slots=True)
class Waterfall:
    """Where one measure's error comes from."""

    measure: str
    unit: str
    total: float
    """Error of the run as it was."""
    after: Mapping[str, float]
    """Stage -> error once it and all before it are perfect, in the waterfall's order."""
    alone: Mapping[str, float]
    """Stage -> error once it alone is perfect; empty if that was not asked."""

    @property
    def shares(self) -> dict[str, float]:
        """Stage -> what the error loses by it; the tracker's is what is left. They sum to `total`."""
        found, before = {}, self.total
        for stage, left in self.after.items():
            found[stage] = before - left
            before = left
        return {**found, REST: before}

    @property
    def largest(self) -> str:
        """The stage to which most of the error is put down."""
        shares = self.shares
        return max(shares, key=lambda stage: shares[stage])


def variants(
    base: Case, stages: Sequence[str] = tuple(STAGES), each: bool = True
) -> tuple[dict[str, Case], dict[str, Case]]:
    """Cases with all stages up to each perfect, and (`each`) with each alone perfect; they follow the base's way.

    Raises:
        UnknownNameError: there is no such stage.
    """
    for stage in stages:
        if stage not in STAGES:
            raise UnknownNameError("stage", stage, STAGES)
    start = replace(base, follows=base)
    after, case = {}, start
    for stage in stages:
        case = STAGES[stage](case)
        after[stage] = case
    return after, {stage: STAGES[stage](start) for stage in stages} if each else {}


def attribute(
    base: Case,
    runner: Runner,
    stages: Sequence[str] = tuple(STAGES),
    measures: Sequence[str] = tuple(MEASURES),
    each: bool = True,
) -> list[Waterfall]:
    """Waterfalls of the measures that all runs could take.

    Args:
        base: the run whose error is to be explained.
        runner: runs the variants.
        stages: which stages become perfect, in this order.
        measures: of `MEASURES`.
        each: also make each stage perfect alone, which takes as many runs again.

    Raises:
        UnknownNameError: an unknown stage or measure.
        SimtrackError: a run failed.
    """
    for measure in measures:
        if measure not in MEASURES:
            raise UnknownNameError("measure", measure, MEASURES)
    after, alone = variants(base, stages, each)
    first = runner.run([base])[base]
    outcomes = {base: first}
    if not isinstance(first, SimtrackError):
        outcomes |= runner.run([*after.values(), *alone.values()])
    for outcome in outcomes.values():
        if isinstance(outcome, SimtrackError):
            raise outcome
    found = []
    for measure in measures:
        errors = {case: _error(outcome, measure) for case, outcome in outcomes.items()}
        known = {case: error for case, error in errors.items() if error is not None}
        if len(known) == len(errors):
            found.append(
                Waterfall(
                    measure, MEASURES[measure][0], known[base],
                    {stage: known[case] for stage, case in after.items()},
                    {stage: known[case] for stage, case in alone.items()},
                )
            )  # fmt: skip
    return found


def _error(outcome: Metrics | SimtrackError, measure: str) -> float | None:
    metric = outcome.get(measure) if not isinstance(outcome, SimtrackError) else None
    if metric is None or metric.value is None:
        return None
    return 1.0 - float(metric.value) if MEASURES[measure][1] else float(metric.value)
