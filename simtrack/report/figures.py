"""The report's figures, drawn with matplotlib as SVG that follows the page's theme and width.

Each figure is drawn twice, for wide and for narrow pages, with type of the same size; CSS shows the one that fits.
"""

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64, MapEntity
from simtrack.evaluation.record import Interval, LidarPicture, RunRecord
from simtrack.evaluation.tracking import ObjectFrame
from simtrack.report.colors import ACCENT, BAD, CSS_VARIABLES, FACE, GRID, INK, MUTED, PALETTE, UNKNOWN

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDE, HALF, NARROW = 11.0, 5.5, 4.2
"""Inches: the page's whole width, half of it, and a telephone's."""
ERROR_SPAN = 0.1, 150.0
"""Millimetres: what the axis of objects' errors shows at least."""
MOST_SHOWN = 10_000.0
"""Millimetres: larger errors of objects are drawn as this."""
MAX_SAMPLES = 400
"""Points of a curve in the page."""
_STYLE: dict[Any, Any] = {
    "font.size": 8.5, "axes.titlesize": 8.5, "axes.labelsize": 8.5, "xtick.labelsize": 8, "ytick.labelsize": 8,
    "legend.fontsize": 8, "svg.fonttype": "none", "svg.hashsalt": "simtrack", "text.color": INK, "axes.labelcolor":
    MUTED, "xtick.color": MUTED, "ytick.color": MUTED, "axes.edgecolor": GRID, "axes.spines.top": False,
    "axes.spines.right": False, "grid.color": GRID, "grid.linewidth": 0.6, "axes.facecolor": "none",
    "figure.facecolor": "none", "legend.frameon": False, "legend.labelcolor": INK, "lines.linewidth": 1.3,
    "lines.solid_capstyle": "round", "axes.axisbelow": True,
}  # fmt: skip


def both_widths(
    draw: "Callable[[Figure, float], None]", heights: tuple[float, float], description: str, wide_width: float = WIDE
) -> str:
    """HTML of a figure in two widths; `draw` fills a figure of the width (inches) that it is told."""
    wide, narrow = (_svg(draw, width, h) for width, h in zip((wide_width, NARROW), heights, strict=True))
    return (
        f'<div class="figure wide" role="img" aria-label="{description}">{wide}</div>'
        f'<div class="figure narrow" role="img" aria-label="{description}">{narrow}</div>'
    )


def _svg(draw: "Callable[[Figure, float], None]", width: float, height: float) -> str:
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        draw(figure, width)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None}, dpi=144)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"(<svg[^>]*?) height=\"[^\"]*\"", r"\1", text, count=1)
    text = re.sub(r"(<svg[^>]*?) width=\"[^\"]*\"", r"\1", text, count=1)
    text = re.sub(r"'DejaVu Sans'(, [^;\"]*)?", "inherit", text)
    for color, variable in CSS_VARIABLES.items():
        text = text.replace(color, variable)
    return text


# ----------------------------------------------------------------------------------------------------------- trajectory


def floor_plan(record: RunRecord, colors: Mapping[str, str]) -> str:
    """The robot's true and believed path among the surveyed furniture, and the objects at the end."""
    path = np.array([T[:2, 3] for T in record.true]) if len(record.true) else np.zeros((0, 2))
    believed = np.array([T[:2, 3] for T in record.estimated]) if len(record.estimated) else np.zeros((0, 2))
    last = _last_frames(record.object_frames)
    low, high = _extent([*path, *believed, *(T[:2, 3] for T in (f.track.T_map_object for f in last if f.track))])

    def draw(figure: "Figure", width: float) -> None:
        axes = figure.subplots()
        for room in record.static_map.rooms:
            axes.fill(*room.polygon.T, color=FACE, zorder=0)
        for entity in record.static_map.entities:
            _footprint(axes, entity, names=width == WIDE and len(record.static_map.entities) < 60)
        axes.plot(*path.T, color=INK, linewidth=2.4, label="true path")
        axes.plot(*believed.T, color=ACCENT, linewidth=1.1, linestyle=(0, (3, 2)), label="believed path")
        if len(path):
            axes.plot(*path[0], marker="o", color=INK, markersize=5)
            axes.plot(*path[-1], marker="s", color=INK, markersize=5)
        for thing in last:
            if thing.track is not None:
                x, y = thing.track.T_map_object[:2, 3]
                axes.plot(x, y, marker="o", markersize=4.5, color=colors[thing.class_name], markeredgecolor=FACE)
        _show(axes, low, high, figure)
        axes.set_xlabel("x in m")
        axes.set_ylabel("y in m")
        axes.grid(True)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)

    shape = float((high[1] - low[1]) / (high[0] - low[0]))
    return both_widths(draw, (min(6.0, max(4.0, WIDE * shape)), min(5.0, max(3.2, NARROW * shape))), "floor plan")


def _footprint(axes: "Axes", entity: MapEntity, names: bool) -> None:
    if entity.semantic_class in ("floor", "ceiling", "lamp"):
        return
    half = entity.extents / 2
    corners = np.array([[-half[0], -half[1]], [half[0], -half[1]], [half[0], half[1]], [-half[0], half[1]]])
    outline = corners @ entity.T_map_entity[:2, :2].T + entity.T_map_entity[:2, 3]
    wall = entity.semantic_class == "wall"
    axes.fill(
        *outline.T, facecolor=MUTED if wall else GRID, edgecolor=MUTED, linewidth=0.5, alpha=0.9 if wall else 0.55
    )
    if names and not wall and min(entity.extents[:2]) > 0.3 and "/" not in entity.name:
        axes.annotate(
            entity.name,
            tuple(entity.T_map_entity[:2, 3]),
            ha="center",
            va="center",
            fontsize=7,
            color=MUTED,
            clip_on=True,
            annotation_clip=True,
        )


def _show(axes: "Axes", low: Float64, high: Float64, figure: "Figure") -> None:
    """Show at least this part of the plan, and as much around it as fills the figure."""
    width, height = figure.get_size_inches() - (0.7, 0.9)  # without labels and legend
    size = high - low
    wanted = np.maximum(size, [size[1] * width / height, size[0] * height / width])
    middle = (low + high) / 2
    axes.set_xlim(middle[0] - wanted[0] / 2, middle[0] + wanted[0] / 2)
    axes.set_ylim(middle[1] - wanted[1] / 2, middle[1] + wanted[1] / 2)
    axes.set_aspect("equal", adjustable="box")


def _extent(points: Sequence[Float64], margin: float = 1.6, least: float = 5.0) -> tuple[Float64, Float64]:
    """Lower and upper corner of the part of the plan around what happened, at least `least` metres wide and high."""
    around = np.array(points).reshape(-1, 2) if len(points) else np.zeros((1, 2))
    low, high = around.min(axis=0) - margin, around.max(axis=0) + margin
    missing = np.maximum(least - (high - low), 0.0) / 2
    return low - missing, high + missing


def pose_error(record: RunRecord, translation: Float64, rotation: Float64) -> str:
    """Translation and rotation error of the robot's pose over time."""
    seconds = _seconds(record, np.asarray(record.stamps))

    def draw(figure: "Figure", width: float) -> None:
        upper, lower = figure.subplots(2, 1, sharex=True)
        for axes, errors, label in ((upper, 1e3 * translation, "mm"), (lower, np.degrees(rotation), "deg")):
            axes.plot(*_thin(seconds, errors), color=ACCENT)
            axes.set_ylim(bottom=0)
            axes.set_ylabel(label)
            axes.grid(True, axis="y")
        lower.set_xlabel("time in s")
        lower.margins(x=0.01)

    return both_widths(draw, (2.6, 2.6), "error of the robot's pose over time")


# -------------------------------------------------------------------------------------------------------------- objects


def object_errors(record: RunRecord, colors: Mapping[str, str]) -> str:
    """Translation error of every object over time; hidden, moving and untracked times shaded."""
    series: dict[str, list[ObjectFrame]] = {}
    for frame in record.object_frames:
        series.setdefault(frame.name, []).append(frame)
    largest = max((1e3 * f.translation_error for f in record.object_frames if f.track is not None), default=0.0)
    top = min(max(ERROR_SPAN[1], 1.5 * largest), MOST_SHOWN)

    def draw(figure: "Figure", width: float) -> None:
        rows = figure.subplots(len(series), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (name, frames) in zip(rows, series.items(), strict=True):
            _object_row(axes, record, name, frames, colors[frames[0].class_name], top)
            for stamp, switched in record.switches:
                if switched == name:
                    axes.axvline(_seconds(record, stamp), color=BAD, linewidth=1.2, linestyle=":")
        rows[-1].set_xlabel("time in s")
        rows[-1].margins(x=0.01)
        figure.supylabel("translation error in mm", fontsize=8.5, color=MUTED)

    decades = math.log10(top / ERROR_SPAN[0])
    height = (0.26 + 0.12 * decades) * len(series) + 0.5
    return both_widths(draw, (height, height * 1.1), "error over time of every object") if series else ""


def _object_row(
    axes: "Axes", record: RunRecord, name: str, frames: Sequence[ObjectFrame], color: str, top: float
) -> None:
    seconds = _seconds(record, np.array([f.stamp for f in frames]))
    seen = np.array([f.scored for f in frames])
    tracked = np.array([f.track is not None for f in frames])
    moving = np.array([f.moving for f in frames])
    errors = np.array([1e3 * f.translation_error if f.track is not None else np.nan for f in frames])
    for flags, shade, alpha, z in ((~seen, GRID, 0.75, 0), (moving, ACCENT, 0.16, 1), (seen & ~tracked, BAD, 0.35, 2)):
        for start, end in _runs(flags):
            axes.axvspan(
                seconds[start], seconds[min(end, len(seconds) - 1)], color=shade, alpha=alpha, linewidth=0, zorder=z
            )
    shown = np.clip(errors, ERROR_SPAN[0], MOST_SHOWN)
    _curve(axes, *_thin(seconds, np.where(seen, np.nan, shown)), color=color, linewidth=0.8, alpha=0.55)
    _curve(axes, *_thin(seconds, np.where(seen, shown, np.nan)), color=color)
    axes.set_yscale("log")
    axes.set_ylim(ERROR_SPAN[0], top)
    ticks = [value for value in (0.1, 1, 10, 100, 1000, 10_000) if value <= top]
    axes.set_yticks(ticks, [f"{value:g}" for value in ticks], minor=False)
    axes.minorticks_off()
    axes.grid(True, axis="y")
    median = np.median(errors[seen & tracked]) if (seen & tracked).any() else np.nan
    text = f"{name}   median {median:.1f} mm" if np.isfinite(median) else f"{name}   never tracked in view"
    axes.set_title(text, loc="left", pad=2, color=INK)


# ---------------------------------------------------------------------------------------------- the unknown, relations


def lidar_view(record: RunRecord, picture: LidarPicture) -> str:
    """A scan from above: red is what nothing explains."""
    close = np.abs(picture.points[:, :2] - picture.T_map_base[:2, 3]).max(axis=1) < 12.0
    shown = picture.points[close, :2] if close.any() else np.array([[-1.0, -1.0], [1.0, 1.0]])
    known, unknown = (picture.points[close & flags] for flags in (~picture.unknown, picture.unknown))

    def draw(figure: "Figure", width: float) -> None:
        axes = figure.subplots()
        axes.scatter(known[:, 0], known[:, 1], s=0.7, color="#8a94a0", linewidths=0, rasterized=True)
        axes.scatter(unknown[:, 0], unknown[:, 1], s=2.2, color=UNKNOWN, linewidths=0, rasterized=True)
        x, y = picture.T_map_base[:2, 3]
        forward = picture.T_map_base[:2, 0] * 0.5
        axes.annotate("", (x + forward[0], y + forward[1]), (x, y), arrowprops={"arrowstyle": "-|>", "color": ACCENT})
        axes.plot(x, y, marker="o", color=ACCENT, markersize=6)
        _show(axes, shown.min(axis=0), shown.max(axis=0), figure)
        axes.set_xlabel("x in m")
        axes.set_ylabel("y in m")

    return both_widths(draw, (4.6, 3.8), "lidar scan from above", HALF)


def relations(record: RunRecord, chosen: Sequence[Interval]) -> str:
    """When relations held, one row a relation."""
    rows: dict[str, list[Interval]] = {}
    for interval in chosen:
        r = interval.relation
        rows.setdefault(f"{r.subject} {r.name} {r.reference}", []).append(interval)
    kinds = sorted({i.relation.name for i in chosen})
    shade = {kind: PALETTE[k % len(PALETTE)] for k, kind in enumerate(kinds)}

    def draw(figure: "Figure", width: float) -> None:
        axes = figure.subplots()
        least = (record.end - record.start) / NANOSECONDS / 300
        for k, intervals in enumerate(rows.values()):
            bars = [(float(_seconds(record, i.start)), max((i.end - i.start) / NANOSECONDS, least)) for i in intervals]
            axes.broken_barh(bars, (k - 0.36, 0.72), facecolors=shade[intervals[0].relation.name], linewidth=0)
        axes.set_yticks(range(len(rows)), list(rows), color=INK)
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlim(0, (record.end - record.start) / NANOSECONDS)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel("time in s")
        axes.grid(True, axis="x")

    height = 0.21 * len(rows) + 0.5
    return both_widths(draw, (height, height), "relations over time") if rows else ""


# ---------------------------------------------------------------------------------------------------------------- speed


def stage_times(record: RunRecord) -> str:
    """Median time of each stage, with whiskers to the 95th percentile."""
    stages = {name: 1e3 * np.asarray(s) for name, s in record.stage_seconds.items() if len(s)}
    names = sorted(stages, key=lambda name: -float(np.median(stages[name])))

    def draw(figure: "Figure", width: float) -> None:
        axes = figure.subplots()
        for k, name in enumerate(names):
            median, high = np.median(stages[name]), np.quantile(stages[name], 0.95)
            axes.barh(k, median, height=0.62, color=ACCENT, linewidth=0)
            axes.plot([median, high], [k, k], color=MUTED, linewidth=1.4)
            text = f"{median:.1f} (p95 {high:.1f}) ms"
            axes.annotate(text, (high, k), (4, 0), textcoords="offset points", va="center", fontsize=8, color=INK)
        axes.set_yticks(range(len(names)), names, color=INK)
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.margins(x=1.6 / width)  # room for the numbers
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel("time in ms: bar and first number: median; line: to the 95th percentile")
        axes.grid(True, axis="x")

    height = 0.26 * len(names) + 0.6
    return both_widths(draw, (height, height), "time per stage") if names else ""


# -------------------------------------------------------------------------------------------------------------- helpers


def _seconds(record: RunRecord, stamps: np.ndarray | int) -> np.ndarray:
    return (np.asarray(stamps) - record.start) / NANOSECONDS


def _curve(axes: "Axes", x: Float64, y: Float64, **style: Any) -> None:
    """Plot a curve with gaps (NaN); what has a gap on either side, and would be no line, is a point."""
    axes.plot(x, y, **style)
    known = np.concatenate([[False], np.isfinite(y), [False]])
    alone = known[1:-1] & ~known[:-2] & ~known[2:]
    if alone.any():
        axes.plot(x[alone], y[alone], linestyle="", marker="o", markersize=3.5, markeredgewidth=0, **style)


def _thin(x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """A curve of at most `MAX_SAMPLES` points that keeps each bin's largest value, so that no peak is lost."""
    if len(x) <= MAX_SAMPLES:
        return x, y
    edges = np.linspace(0, len(x), MAX_SAMPLES + 1).astype(int)
    low = np.where(np.isnan(y), -np.inf, y)
    keep = np.array([a + int(np.argmax(low[a:b])) for a, b in pairwise(edges)])
    return x[keep], y[keep]


def _runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """Half-open ranges in which flags are set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _last_frames(frames: Sequence[ObjectFrame]) -> list[ObjectFrame]:
    return list({frame.name: frame for frame in frames}.values())
