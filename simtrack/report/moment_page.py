"""A picture of one frame done again: depth with outlines, residuals of the registered models, a table of objects."""

import textwrap
from pathlib import Path

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64
from simtrack.errors import InvalidValueError
from simtrack.evaluation.instrument.examination import Examination, ObjectExamination
from simtrack.evaluation.instrument.moments import StoredMoment
from simtrack.evaluation.tracking import GATE

LEAST_SHOWN = 0.005
"""Metres at which the colours of residuals end at least."""
OUTLINES = {"true": "#23c552", "predicted": "#9aa4b2", "registered": "#ff9f1c"}
MARGIN = 15
"""Pixels around the worst object in the close-up."""
COLUMNS = ("object", "track", "seen", "predicted", "registered", "support", "residual", "misfit", "observed")


def told_error(moment: StoredMoment) -> str:
    """What is wrong at a moment."""
    untracked = any(o.name == moment.worst and o.track is None for o in moment.objects)
    return "is not tracked" if untracked else f"is off by {1e3 * moment.error:.1f} mm"


def caption(moment: StoredMoment) -> str:
    """Whose outlines and residuals are drawn beside those of tracked objects; empty if nobody's."""
    owned = {o.track for o in moment.objects}
    others = [f"{track} ({name})" for track, name in sorted(moment.classes.items()) if track not in owned]
    if not others:
        return ""
    return (
        f"Outlines and residuals also of tracks that are no object's: {', '.join(others)}. "
        f"They are tentative, or no object of their class is within {100 * GATE:.0f} cm."
    )


def rows(found: Examination) -> list[tuple[str, ...]]:
    """The table under `COLUMNS` of what can be seen, the worst object first."""

    def pose(error: tuple[float, float] | None) -> str:
        return "-" if error is None else f"{1e3 * error[0]:.2f} mm {np.degrees(error[1]):.2f} deg"

    def row(thing: ObjectExamination) -> tuple[str, ...]:
        result, track = thing.result, thing.true.track
        figures = ("-",) * 4
        if result is not None:
            figures = (
                f"{result.support:.2f} of {result.rays} rays", f"{1e3 * result.residual:.2f} mm",
                f"{result.misfit:.2f}", f"{result.constrained} of 6",
            )  # fmt: skip
        head = thing.true.name, "none" if track is None else str(track), f"{thing.true.visible_fraction:.2f}"
        return (*head, pose(thing.predicted), pose(thing.registered), *figures)

    return [row(thing) for thing in found.objects if thing.true.visible_fraction > 0.0 or thing.result is not None]


def write_picture(found: Examination, path: Path) -> None:
    """Write the picture as PNG.

    Raises:
        InvalidValueError: the file cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    moment = found.moment
    depth = np.where(moment.depth > 0.0, moment.depth, np.nan)
    u0, v0, u1, v1 = _window(found)
    figure = Figure(figsize=(14.0, 6.2), layout="constrained")
    figure.suptitle(f"frame {moment.frame}, {moment.stamp / NANOSECONDS:.2f} s: {moment.worst} {told_error(moment)}")
    panels = figure.subplots(2, 3, height_ratios=(3, 1.5), width_ratios=(4, 3, 3.4))
    for axes, title, (a, b, c, d) in (
        (panels[0, 0], "depth, whole image", (0, 0, depth.shape[1], depth.shape[0])),
        (panels[0, 1], f"depth around {moment.worst}", (u0, v0, u1, v1)),
    ):
        part = depth[b:d, a:c]
        low, high = np.nanquantile(part, (0.02, 0.98)) if np.isfinite(part).any() else (0.0, 1.0)
        axes.imshow(part, cmap="bone_r", vmin=low, vmax=high, extent=(a, c, d, b), interpolation="nearest")
        for name, color in OUTLINES.items():
            v, u = np.nonzero(found.outlines[name][b:d, a:c])
            axes.scatter(
                u + a + 0.5, v + b + 0.5, s=1.2 if (c - a) < depth.shape[1] else 0.25, color=color, linewidths=0
            )
        for name, _, T in moment.hypotheses:
            u, v = _pixel(found, T)
            axes.annotate(name, (u, v), color="#e0567a", fontsize=8, annotation_clip=True, ha="center")
            axes.plot(u, v, marker="x", color="#e0567a", markersize=6)
        axes.set_title(title, fontsize=10)
        axes.set_xlim(a, c)
        axes.set_ylim(d, b)
    axes = panels[0, 2]
    part = found.residuals[v0:v1, u0:u1]
    most = max(LEAST_SHOWN, 4.0 * float(np.nanmedian(np.abs(part))) if np.isfinite(part).any() else 0.0)
    image = axes.imshow(
        1e3 * part, cmap="RdBu", vmin=-1e3 * most, vmax=1e3 * most, extent=(u0, u1, v1, v0), interpolation="nearest"
    )
    axes.set_facecolor("0.85")
    axes.set_title("measured minus registered model, mm", fontsize=10)
    figure.colorbar(image, ax=axes, shrink=0.7)
    for axes in panels[1]:
        axes.axis("off")
    handles = [Line2D([], [], color=color, label=f"{name} outline") for name, color in OUTLINES.items()]
    handles.append(Line2D([], [], color="#e0567a", marker="x", linestyle="", label="detection that came in"))
    panels[1, 0].legend(handles=handles, loc="upper left", frameon=False, fontsize=9)
    said = panels[1, 0].text(0.01, 0.4, textwrap.fill(caption(moment), 50), fontsize=9, va="top")
    said.set_in_layout(False)
    grid = panels[1, 1].table(cellText=rows(found)[:8], colLabels=COLUMNS, loc="upper center", cellLoc="left")
    grid.auto_set_font_size(False)
    grid.set_fontsize(7.5)
    grid.auto_set_column_width(list(range(len(COLUMNS))))
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise InvalidValueError("out", str(path), f"a file that can be written ({error.strerror})") from error


def _window(found: Examination) -> tuple[int, int, int, int]:
    """Pixel box (u0, v0, u1, v1) around the worst object, true and registered, within the image."""
    moment = found.moment
    poses = [o.T_camera_object for o in moment.objects if o.name == moment.worst]
    poses += [o.result.T_camera_object for o in found.objects if o.true.name == moment.worst and o.result is not None]
    pixels = np.array([_pixel(found, T) for T in poses])
    reach = MARGIN + 0.15 * moment.intrinsics.fx / max(min(float(T[2, 3]) for T in poses), 0.2)
    height, width = moment.depth.shape
    low, high = pixels.min(axis=0) - reach, pixels.max(axis=0) + reach
    u0, u1 = (int(np.clip(value, 0, width)) for value in (low[0], high[0]))
    v0, v1 = (int(np.clip(value, 0, height)) for value in (low[1], high[1]))
    return (u0, v0, u1, v1) if u1 - u0 > 8 and v1 - v0 > 8 else (0, 0, width, height)


def _pixel(found: Examination, T_camera_object: Float64) -> tuple[float, float]:
    K, (x, y, z) = found.moment.intrinsics, T_camera_object[:3, 3]
    z = max(float(z), 0.05)
    return K.fx * float(x) / z + K.cx, K.fy * float(y) / z + K.cy
