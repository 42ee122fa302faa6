"""Metrics as a flat mapping ``name -> value, unit``, written so that a reader never sees half a file."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from simtrack.errors import FileFormatError


@dataclass(frozen=True, slots=True)
class Metric:
    """One measured number."""

    value: float | int | bool | None
    """None where it could not be measured; never NaN or infinite."""
    unit: str
    """``m``, ``rad``, ``s``, ``Hz``, ``bytes``, ``1`` for shares and counts."""
    reason: str = ""
    """Why there is no value; or a remark on the one that there is."""


Metrics: TypeAlias = dict[str, Metric]


def measured(value: float | np.integer | np.floating, unit: str) -> Metric:
    """A metric with a value; one that is not finite becomes a metric without."""
    if isinstance(value, (bool, np.bool_)):
        return Metric(bool(value), unit)
    if isinstance(value, (int, np.integer)):
        return Metric(int(value), unit)
    number = float(value)
    return Metric(number, unit) if math.isfinite(number) else unmeasured(unit, f"the value is {number}")


def unmeasured(unit: str, reason: str) -> Metric:
    """A metric that says why it has no value."""
    return Metric(None, unit, reason)


def quantile(errors: npt.ArrayLike, share: float, unit: str, missing: str) -> Metric:
    """Quantile of a sample (0.5 = median), or the reason `missing` if the sample is empty."""
    sample = np.asarray(errors, dtype=float)
    return measured(np.quantile(sample, share), unit) if sample.size else unmeasured(unit, missing)


def ratio(part: float | np.integer, whole: float | np.integer, missing: str) -> Metric:
    """Share of a whole, or the reason `missing` if the whole is nothing."""
    return measured(part / whole, "1") if whole else unmeasured("1", missing)


def write_metrics(path: Path, metrics: Mapping[str, Metric]) -> None:
    """Write ``{name: {"value": v, "unit": u}}``, names sorted; replaces an older file in one step."""
    rows = {
        name: {"value": m.value, "unit": m.unit} | ({"reason": m.reason} if m.reason else {})
        for name, m in sorted(metrics.items())
    }
    write_atomically(path, json.dumps(rows, indent=1, allow_nan=False) + "\n")


def read_metrics(path: Path) -> Metrics:
    """Read what `write_metrics` wrote; FileFormatError if it is not that."""
    try:
        rows = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileFormatError(path, "", str(error)) from error
    if not isinstance(rows, dict):
        raise FileFormatError(path, "", "expected an object of metrics")
    metrics: Metrics = {}
    for name, row in rows.items():
        if not isinstance(row, dict) or "value" not in row or "unit" not in row:
            raise FileFormatError(path, str(name), "expected an object with value and unit")
        metrics[str(name)] = Metric(row["value"], str(row["unit"]), str(row.get("reason", "")))
    return metrics


def write_atomically(path: Path, text: str) -> None:
    """Write a text file so that a reader or a crash finds either the old one or the new one."""
    temporary = path.with_name(f".{path.name}.part")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)  # noqa: PTH105
