"""What a test says of runs: bounds on their metrics, and that they are no worse than stored ones."""

import json
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from simtrack.errors import FileFormatError, InvalidValueError, SimtrackError

if TYPE_CHECKING:
    from simtrack.evaluation.instrument.cases import Case, Runner
    from simtrack.evaluation.metrics import Metrics

_COMPARISONS: Mapping[str, Callable[[float, float], bool]] = {
    ">=": operator.ge, "<=": operator.le, "==": operator.eq, ">": operator.gt, "<": operator.lt,
}  # fmt: skip
_GRAMMAR = re.compile(r"(?:(median|worst|mean)\s+)?([\w.-]+)\s*(>=|<=|==|>|<)\s*(\S+)\s*(mm|cm|deg|ms)?")
_UNITS = {"": (1.0, ""), "mm": (1e-3, "m"), "cm": (1e-2, "m"), "ms": (1e-3, "s"), "deg": (np.pi / 180, "rad")}
"""By what a number is multiplied, and the unit of the metrics that it may be given for."""
TOLERANCE = 0.05
"""Share by which a median may be worse than a stored one, significantly or not."""


@dataclass(frozen=True, slots=True)
class Runs:
    """A scene under conditions with stages, of which any number of seeds can be run; runs are kept and read again."""

    case: "Case"
    """Of the first seed."""
    runner: "Runner"

    def metrics(self, seeds: int) -> "dict[int, Metrics]":
        """Seed -> metrics, of `seeds` seeds from the case's on.

        Raises:
            SimtrackError: a run failed.
        """
        if seeds < 1:
            raise InvalidValueError("seeds", seeds, "1 or more")
        cases = [replace(self.case, seed=self.case.seed + k) for k in range(seeds)]
        outcomes = self.runner.run(cases)
        found: dict[int, Metrics] = {}
        for case in cases:
            outcome = outcomes[case]
            if isinstance(outcome, SimtrackError):
                raise outcome
            found[case.seed] = outcome
        return found


@dataclass(frozen=True, slots=True)
class Bound:
    """An expression such as ``worst tracking.recall >= 0.9``."""

    text: str
    over: str
    """``median``, ``mean`` or ``worst`` of the seeds."""
    metric: str
    sign: str
    limit: float
    """In the metric's own unit."""
    unit: str = ""
    """As it was given."""

    @staticmethod
    def of(text: str) -> "Bound":
        """Read ``[median|mean|worst] METRIC >= NUMBER [mm|cm|deg|ms]``, or <=, ==, >, <; SI units if none is given.

        Raises:
            InvalidValueError: it is none.
        """
        match = _GRAMMAR.fullmatch(text.strip())
        try:
            over, metric, sign, number, unit = match.groups(default="") if match else ("",) * 5
            limit = float(number) * _UNITS[unit][0]
        except ValueError as error:
            allowed = "[median|mean|worst] METRIC >= NUMBER [mm|cm|deg|ms], with >=, <=, ==, > or <"
            raise InvalidValueError("expression", text, allowed) from error
        return Bound(text, over or "median", metric, sign, limit, unit)

    def check_unit(self, unit: str) -> None:
        """Whether the metric, which has this unit, can have been meant; raises InvalidValueError."""
        if self.unit and _UNITS[self.unit][1] != unit:
            fitting = [name for name, (_, of) in _UNITS.items() if of == unit and name]
            allowed = f"{self.metric} in {' or '.join(fitting)}" if fitting else f"{self.metric} without a unit"
            raise InvalidValueError("expression", self.text, allowed)

    def told(self, value: float) -> str:
        """A value of the metric in the unit of the expression."""
        return f"{value / _UNITS[self.unit][0]:.6g} {self.unit}".strip()

    def value(self, values: Sequence[float]) -> float:
        """What is compared with the limit."""
        match self.over:
            case "worst":
                return min(values) if ">" in self.sign else max(values)
            case "mean":
                return float(np.mean(values))
            case _:
                return float(np.median(values))

    def holds(self, values: Sequence[float]) -> bool:
        """Whether the seeds' values keep the bound."""
        return _COMPARISONS[self.sign](self.value(values), self.limit)


def assert_metrics(runs: Runs, *expressions: str, seeds: int = 1) -> None:
    """Fail with what was measured on which seed, unless all bounds hold.

    Args:
        runs: what is run.
        expressions: see `Bound.of`, e.g. ``"tracking.recall >= 0.9"``; of several seeds the median counts.
        seeds: how many, from the first on.

    Raises:
        AssertionError: a bound does not hold, or its metric could not be measured.
        InvalidValueError: an expression cannot be read or has another unit than its metric, or no run has the metric.
        SimtrackError: a run failed.
    """
    __tracebackhide__ = True
    bounds = [Bound.of(text) for text in expressions]
    found = runs.metrics(seeds)
    broken = []
    for bound in bounds:
        values = values_of(found, bound.metric)
        bound.check_unit(next(metrics[bound.metric].unit for metrics in found.values() if bound.metric in metrics))
        missing = [
            f"seed {seed}: not measured ({found[seed][bound.metric].reason})" for seed in found if seed not in values
        ]
        if missing or not bound.holds(list(values.values())):
            told = [f"seed {seed}: {bound.told(value)}" for seed, value in values.items()] + missing
            measured = bound.told(bound.value(list(values.values()))) if values else "nothing"
            broken.append(f"{bound.text}: {bound.over} is {measured} ({', '.join(told)})")
    assert not broken, "; ".join(broken)


def assert_no_regression(
    runs: Runs, stored: Path | str, *metrics: str, seeds: int = 5, tolerance: float = TOLERANCE, store: bool = False
) -> None:
    """Fail if a metric is worse than stored results: beyond the tolerance in the median, or significantly on the seeds.

    Args:
        runs: what is run.
        stored: JSON file; made where it is missing, or if `store`.
        metrics: which; those of the file if none are named.
        seeds: how many, from the first on.
        tolerance: share by which a median may be worse.
        store: write the file anew and compare nothing.

    Raises:
        AssertionError: a metric is worse.
        FileFormatError: the file is no such file.
        SimtrackError: a run failed.
    """
    __tracebackhide__ = True
    from simtrack.evaluation.instrument.comparison import HEADLINE, more_is_better
    from simtrack.evaluation.instrument.statistics import difference

    path, found = Path(stored), runs.metrics(seeds)
    if store or not path.exists():
        names = metrics or tuple(name for name in HEADLINE if not name.startswith("speed."))
        _store(path, {name: values_of(found, name) for name in names})
        return
    before = _stored(path)
    worse = []
    for name in metrics or before:
        if name not in before:
            raise FileFormatError(path, name, f"not stored; it has: {', '.join(before)}")
        now, then = values_of(found, name), before[name]
        shared = [seed for seed in now if seed in then]
        if not shared:
            continue
        ours, theirs = [now[seed] for seed in shared], [then[seed] for seed in shared]
        sign = -1.0 if more_is_better(name) else 1.0
        gap = sign * float(np.median(ours) - np.median(theirs))
        paired = difference(ours, theirs)
        significant = paired is not None and paired.significant and sign * paired.mean > 0.0
        if gap > tolerance * abs(float(np.median(theirs))) or significant:
            how = "significantly" if significant else f"by more than {tolerance:.0%}"
            worse.append(f"{name}: {np.median(ours):.6g} is {how} worse than {np.median(theirs):.6g}")
    assert not worse, "; ".join(worse) + f" (stored in {path})"


def values_of(found: "Mapping[int, Metrics]", name: str) -> dict[int, float]:
    """Seed -> value of a metric, of those that could measure it.

    Raises:
        InvalidValueError: no run has such a metric.
    """
    if not any(name in metrics for metrics in found.values()):
        known = sorted({known for metrics in found.values() for known in metrics})
        raise InvalidValueError("metric", name, f"one of {', '.join(known)}")
    values = {seed: metrics[name].value for seed, metrics in found.items() if name in metrics}
    return {seed: float(value) for seed, value in values.items() if value is not None}


def _store(path: Path, values: Mapping[str, Mapping[int, float]]) -> None:
    from simtrack.evaluation.metrics import write_atomically

    rows = {name: {str(seed): value for seed, value in of.items()} for name, of in sorted(values.items())}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(rows, indent=1) + "\n")


def _stored(path: Path) -> dict[str, dict[int, float]]:
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        return {str(name): {int(seed): float(value) for seed, value in of.items()} for name, of in rows.items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise FileFormatError(path, "", "expected metrics with their values by seed") from error
