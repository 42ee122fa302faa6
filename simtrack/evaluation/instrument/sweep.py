"""Curves of every metric over conditions, with confidence bands over seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from simtrack.errors import InvalidValueError, SimtrackError
from simtrack.evaluation.instrument.cases import Case, Runner
from simtrack.evaluation.instrument.conditions import AXES, Conditions, changed
from simtrack.evaluation.instrument.statistics import Estimate, estimate

MOST_VALUES = 100
DEFAULT_VALUES = 5


@dataclass(frozen=True, slots=True)
class Axis:
    """A condition and the values that it takes."""

    name: str
    values: tuple[float, ...]


def parse_axes(text: str) -> tuple[Axis, ...]:
    """Axes such as ``noise=0:3,latency=0:0.5:6,occlusion=0;2;4``.

    A range LOW:HIGH is walked in five values, LOW:HIGH:N in N; single values are separated by semicolons. Conditions
    of whole numbers keep the values of a range that are.

    Raises:
        SimtrackError: an unknown condition, a value out of its range, or what is no number.
    """
    axes = []
    for part in text.split(","):
        name, equals, given = part.strip().partition("=")
        if not equals:
            raise InvalidValueError("over", part, f"NAME=LOW:HIGH, of {', '.join(AXES)}")
        axes.append(Axis(name, _values(name, given)))
        for value in axes[-1].values:
            changed(Conditions(), name, value)
    if len({axis.name for axis in axes}) < len(axes):
        raise InvalidValueError("over", text, "every condition once")
    return tuple(axes)


def _values(name: str, given: str) -> tuple[float, ...]:
    allowed = "LOW:HIGH, LOW:HIGH:N or values separated by semicolons"
    try:
        if ":" not in given:
            return tuple(float(value) for value in given.split(";"))
        low, high, *more = given.split(":")
        count = int(more[0]) if more else DEFAULT_VALUES
        if len(more) > 1 or not 2 <= count <= MOST_VALUES or not float(low) < float(high):
            raise InvalidValueError(name, given, f"{allowed}, LOW below HIGH, 2 to {MOST_VALUES} values")
        walked = np.linspace(float(low), float(high), count)
    except ValueError as error:
        raise InvalidValueError(name, given, allowed) from error
    if AXES.get(name) is int:
        walked = np.unique(np.round(walked))
    return tuple(float(f"{value:.12g}") for value in walked)


@dataclass(frozen=True, slots=True)
class Curve:
    """A metric along an axis."""

    axis: str
    metric: str
    unit: str
    values: tuple[float, ...]
    points: tuple[Estimate | None, ...]
    """Over the seeds, one an axis value; None where no run could measure it."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """What a sweep found."""

    curves: tuple[Curve, ...]
    failed: Mapping[Case, SimtrackError]


def sweep(base: Case, axes: Sequence[Axis], seeds: int, runner: Runner) -> Sweep:
    """Run a scene at every value of every axis, one axis at a time, on `seeds` seeds from the base's on.

    Raises:
        InvalidValueError: no seeds, or a working folder that cannot be used.
    """
    if not 1 <= seeds <= 1000:
        raise InvalidValueError("seeds", seeds, "1 to 1000")
    grid = {
        (axis.name, value): [
            replace(base, seed=base.seed + k, conditions=changed(base.conditions, axis.name, value))
            for k in range(seeds)
        ]
        for axis in axes
        for value in axis.values
    }
    outcomes = runner.run([case for cases in grid.values() for case in cases])
    failed = {case: outcome for case, outcome in outcomes.items() if isinstance(outcome, SimtrackError)}
    units = {
        name: metric.unit
        for outcome in outcomes.values()
        if not isinstance(outcome, SimtrackError)
        for name, metric in outcome.items()
    }
    curves = []
    for axis in axes:
        for name in sorted(units):
            points = [_point([outcomes[case] for case in grid[axis.name, value]], name) for value in axis.values]
            if any(point is not None for point in points):
                curves.append(Curve(axis.name, name, units[name], axis.values, tuple(points)))
    return Sweep(tuple(curves), failed)


def _point(outcomes: Sequence[Any], name: str) -> Estimate | None:
    numbers = []
    for outcome in outcomes:
        metric = None if isinstance(outcome, SimtrackError) else outcome.get(name)
        if metric is not None and metric.value is not None:
            numbers.append(float(metric.value))
    return estimate(numbers)
