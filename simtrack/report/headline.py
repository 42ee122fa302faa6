"""What was asked and what was measured, as a person reads it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.evaluation.metrics import Metric
from simtrack.evaluation.targets import Target

FLOORS = {
    f"tracking.{kind}": f"tracking.floor.{kind}"
    for kind in (
        "static.translation_error.median", "static.translation_error.p95", "moving.translation_error.median",
        "moving.translation_error.p95", "rotation_error.median",
    )
}  # fmt: skip
"""Metric -> the metric of its noise floor."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the headline table."""

    name: str
    value: str
    asked: str
    floor: str
    verdict: str
    """``good``, ``bad`` or empty."""
    reason: str


def table(metrics: Mapping[str, Metric], names: Sequence[str], targets: Mapping[str, Target]) -> list[Row]:
    """Lines of the headline table."""
    rows = []
    for name in names:
        metric, target = metrics[name], targets.get(name)
        met = target.met(metric) if target else None
        floor = metrics.get(FLOORS.get(name, ""))
        asked = (
            f"{target.sign.replace('<=', '≤').replace('>=', '≥')} {format_value(target.limit, metric.unit)}"
            if target
            else ""
        )
        rows.append(
            Row(name, format_metric(metric), asked, format_metric(floor) if floor and floor.value is not None else "",
                {True: "good", False: "bad", None: ""}[met], metric.reason)
        )  # fmt: skip
    return rows


def format_metric(metric: Metric) -> str:
    """A value as a person reads it: millimetres, degrees, percent."""
    return "not measured" if metric.value is None else format_value(metric.value, metric.unit)


def format_value(value: float, unit: str) -> str:
    """A number of a unit as a person reads it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    match unit:
        case "m":
            return f"{1000 * value:.2f} mm" if abs(value) < 0.1 else f"{value:.2f} m"
        case "rad":
            return f"{np.degrees(value):.3g}°"
        case "s":
            return f"{1000 * value:.1f} ms" if 0 < abs(value) < 0.1 else f"{value:.2f} s"
        case "bytes":
            return f"{value / 1e9:.2f} GB" if value >= 1e8 else f"{value / 1e6:.1f} MB"
        case "Hz":
            return f"{value:.1f} Hz"
        case _:
            whole = isinstance(value, int) or (float(value).is_integer() and abs(value) > 1)
            return f"{value}" if whole else f"{value:.3f}"
