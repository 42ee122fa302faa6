"""Pages and files of the instrument: waterfalls, curves over conditions, methods beside each other."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import simtrack
from simtrack.errors import InvalidValueError
from simtrack.evaluation.instrument.attribution import REST, Waterfall
from simtrack.evaluation.instrument.cases import Case, name_of
from simtrack.evaluation.instrument.comparison import Cell, Comparison
from simtrack.evaluation.instrument.sweep import Curve, Sweep
from simtrack.evaluation.metrics import write_atomically
from simtrack.report.colors import ACCENT, BAD, GOOD, INK, MUTED
from simtrack.report.figures import both_widths
from simtrack.report.headline import format_value
from simtrack.report.page import template

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MARKS = {True: "+", False: "-", None: ""}
_SCALES = {"m": (1e3, "mm"), "rad": (57.29577951308232, "deg"), "s": (1e3, "ms"), "1": (1.0, "")}


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page."""

    title: str
    text: str
    figure: str
    """SVG, or empty."""
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


def write_attribution(case: Case, waterfalls: Sequence[Waterfall], folder: Path) -> list[str]:
    """Write ``attribution.json`` and ``attribution.html``; returns their names.

    Raises:
        InvalidValueError: the folder cannot be written.
    """
    document = {
        "case": asdict(case),
        "waterfalls": [
            {"measure": w.measure, "unit": w.unit, "total": w.total, "shares": w.shares, "after": dict(w.after),
             "alone": dict(w.alone), "largest": w.largest}
            for w in waterfalls
        ],
    }  # fmt: skip
    sections = []
    for w in waterfalls:
        rows = [
            (stage, format_value(share, w.unit), format_value(w.total - left, w.unit) if left is not None else "")
            for stage, share in w.shares.items()
            for left in [w.alone.get(stage)]
        ]
        text = f"Error of the run: {format_value(w.total, w.unit)}. Most of it is put down to: {w.largest}."
        columns = ("stage", "in the waterfall", "alone")
        sections.append(Section(w.measure, text, _waterfall_figure(w), columns, rows))
    lead = (
        "The same way again, with one stage after the other replaced by an oracle. A bar is what the error loses as "
        "its stage becomes perfect after those to the left; the last is what is left, the tracker's own."
    )
    return _write(folder, "attribution", document, f"{name_of(case)}: where the error comes from", lead, sections)


def write_sweep(case: Case, found: Sweep, first: Sequence[str], folder: Path) -> list[str]:
    """Write ``sweep.json``, ``sweep.csv`` and ``sweep.html``, the metrics `first` drawn first; returns their names.

    Raises:
        InvalidValueError: the folder cannot be written.
    """
    document = {
        "case": asdict(case),
        "curves": [asdict(curve) for curve in found.curves],
        "failed": {name_of(one): str(error) for one, error in found.failed.items()},
    }
    order = {name: k for k, name in enumerate(first)}
    curves = sorted(found.curves, key=lambda c: (order.get(c.metric, len(order)), c.metric, c.axis))
    shown = [curve for curve in curves if curve.metric in order] or curves
    sections = [Section(f"{c.metric} over {c.axis}", "", _curve_figure(c), *_curve_table(c)) for c in shown]
    lead = "Medians over seeds; bands are 95 % bootstrap intervals of the median. All metrics are in sweep.csv."
    names = _write(folder, "sweep", document, f"{name_of(case)}: sweep", lead, sections)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("axis", "value", "metric", "unit", "median", "low", "high", "runs"))
    for curve in found.curves:
        for value, point in zip(curve.values, curve.points, strict=True):
            if point is not None:
                numbers = (point.median, point.low, point.high)
                writer.writerow((curve.axis, f"{value:g}", curve.metric, curve.unit, *map("{:.6g}".format, numbers),
                                 point.count))  # fmt: skip
    write_atomically(folder / "sweep.csv", text.getvalue())
    return [*names, "sweep.csv"]


def write_comparison(found: Comparison, first: Sequence[str], folder: Path) -> list[str]:
    """Write ``comparison.json`` and ``comparison.html``, the metrics `first` on top; returns their names.

    Raises:
        InvalidValueError: the folder cannot be written.
    """
    order = {name: k for k, name in enumerate(first)}
    rows = sorted(found.rows, key=lambda row: (order.get(row.metric, len(order)), row.metric))

    def table(headline: bool) -> list[tuple[str, ...]]:
        part = [row for row in rows if (row.metric in order) == headline]
        return [(row.metric, *(cell_text(cell, row.unit) for cell in row.cells)) for row in part]

    columns = ("metric", *found.methods)
    sections = [
        Section("Headline", "", "", columns, table(headline=True)),
        Section("All metrics", "", "", columns, table(headline=False)),
        Section(
            "Runs",
            " ".join(f"{remark[0].upper()}{remark[1:]}." for remark in found.remarks),
            "",
            ("method", "scene:seed"),
            [(m, ", ".join(s)) for m, s in found.seeds.items()],
        ),
    ]
    lead = (
        "Medians over runs with 95 % bootstrap intervals. + marks what is significantly better than "
        f"{found.methods[0]} on the same scenes and seeds (paired bootstrap of the mean "
        "difference), - what is worse; nothing is called significant with fewer than five pairs."
    )
    return _write(folder, "comparison", asdict(found), "Methods beside each other", lead, sections)


def cell_text(cell: Cell, unit: str) -> str:
    """A method's value as a person reads it."""
    if cell.estimate is None:
        return "-"
    e = cell.estimate
    around = "" if e.count < 2 else f" [{format_value(e.low, unit)}, {format_value(e.high, unit)}]"
    return f"{format_value(e.median, unit)}{around} {MARKS[cell.better]}".rstrip()


# ------------------------------------------------------------------------------------------------------------- figures


def _waterfall_figure(w: Waterfall) -> str:
    scale, unit = _SCALES.get(w.unit, (1.0, w.unit))

    def draw(figure: "Figure", width: float) -> None:
        axes = figure.subplots()
        names, level = ["error", *w.after, REST], scale * w.total
        axes.bar(0, level, color=MUTED)
        for k, (stage, share) in enumerate(w.shares.items(), start=1):
            height = scale * share
            low = 0.0 if stage == REST else level - height
            axes.bar(k, height, bottom=low, color=ACCENT if stage == REST else (GOOD if share >= 0.0 else BAD))
            axes.annotate(f"{height:.3g}", (k, max(low + height, low)), ha="center", va="bottom", color=INK, fontsize=8)
            if stage != REST:
                axes.plot([k - 0.4, k + 1.4], [level - height] * 2, color=MUTED, linewidth=0.6)
                level -= height
        axes.annotate(f"{scale * w.total:.3g}", (0, scale * w.total), ha="center", va="bottom", color=INK, fontsize=8)
        axes.set_xticks(range(len(names)), names, rotation=0 if width > 5 else 60)
        axes.set_ylabel(f"{unit}" if unit else "share that is lacking")
        axes.margins(y=0.12)
        axes.grid(True, axis="y")

    return both_widths(draw, (3.0, 3.4), f"waterfall of {w.measure}")


def _curve_figure(curve: Curve) -> str:
    scale, unit = _SCALES.get(curve.unit, (1.0, curve.unit))
    known = [(value, point) for value, point in zip(curve.values, curve.points, strict=True) if point is not None]

    def draw(figure: "Figure", width: float) -> None:
        axes = figure.subplots()
        x = [value for value, _ in known]
        axes.fill_between(
            x, [scale * p.low for _, p in known], [scale * p.high for _, p in known], color=ACCENT, alpha=0.25,
            linewidth=0,
        )  # fmt: skip
        axes.plot(x, [scale * p.median for _, p in known], color=ACCENT, marker="o", markersize=3.5)
        axes.set_xlabel(curve.axis)
        axes.set_ylabel(unit or "share")
        axes.grid(True, axis="y")

    return both_widths(draw, (2.6, 2.6), f"{curve.metric} over {curve.axis}")


def _curve_table(curve: Curve) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    rows = []
    for value, point in zip(curve.values, curve.points, strict=True):
        numbers = ("-",) * 3 if point is None else (point.median, point.low, point.high)
        cells = (n if isinstance(n, str) else format_value(n, curve.unit) for n in numbers)
        rows.append((f"{value:g}", *cells, str(0 if point is None else point.count)))
    return (curve.axis, "median", "low", "high", "runs"), rows


def _write(folder: Path, name: str, document: object, title: str, lead: str, sections: Sequence[Section]) -> list[str]:
    page = template("instrument.html").render(title=title, lead=lead, sections=sections, version=simtrack.__version__)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / f"{name}.json", json.dumps(document, indent=1, default=str) + "\n")
        write_atomically(folder / f"{name}.html", page)
    except OSError as error:
        raise InvalidValueError("out", str(folder), f"a folder that can be written ({error.strerror})") from error
    return [f"{name}.json", f"{name}.html"]
