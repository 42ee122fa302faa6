"""A look at a data set: one HTML file with images, all labels drawn over them, and statistics."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import simtrack
from simtrack.contracts import Bool, Float32, Float64
from simtrack.datasets.inspection import Inspection, SeenImage, SeenInstance, Statistics
from simtrack.evaluation.metrics import write_atomically
from simtrack.evaluation.record import encode_jpeg
from simtrack.objects.model import BOX_EDGES
from simtrack.report.colors import ACCENT, GRID, INK, class_colors
from simtrack.report.figures import HALF, both_widths
from simtrack.report.overlay import path_data, svg_image
from simtrack.report.page import template

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LAYERS = ("masks", "boxes", "cuboids", "keypoints", "axes", "depth")
"""What the page can show and hide."""
SHOWN = frozenset(LAYERS) - {"depth"}
"""At first."""
LABELLED = 0.1
"""Visible fraction from which an instance counts as seen in the tables."""
AXIS_COLORS = ("#ff4d4d", "#35d04f", "#4d8dff")
"""Of the object frame's x, y and z."""
MAX_DRAWN = 4000.0
"""Pixels from the image's corner beyond which nothing is drawn."""
_SHADE = "#3d8bfd"


@dataclass(frozen=True, slots=True)
class ClassRow:
    """One line of the table of classes."""

    name: str
    color: str
    instances: int
    seen: int
    fraction: str
    distance: str
    pixels: str


def write_dataset_page(inspection: Inspection, path: Path) -> None:
    """Write the page to `path`."""
    write_atomically(path, render(inspection))


def render(inspection: Inspection) -> str:
    """The page as HTML."""
    statistics = inspection.statistics
    colors = class_colors(statistics.classes)
    seen = statistics.fraction >= LABELLED if len(statistics.fraction) else np.ones(len(statistics.category), bool)
    return template("dataset.html").render(
        inspection=inspection,
        statistics=statistics,
        version=simtrack.__version__,
        cards=_cards(inspection, seen),
        layers=[layer for layer in LAYERS if layer != "depth" or any(i.depth is not None for i in inspection.images)],
        shown=SHOWN,
        sheet=[(picture(image, colors), image.name, _caption(image)) for image in inspection.images],
        legend=[(name, colors[name]) for name in statistics.classes],
        rows=[_class_row(statistics, k, seen, colors) for k in range(len(statistics.classes))],
        labelled=f"{LABELLED:.0%}",
        figures=_figures(statistics, colors, seen),
        coverage=coverage(statistics, seen) if len(statistics.viewpoint) else "",
    )


# --------------------------------------------------------------------------------------------------------------- images


def picture(image: SeenImage, colors: Mapping[str, str]) -> str:
    """An image as SVG with its labels in layers, which the page shows and hides."""
    height, width = image.rgb.shape[:2]
    far_first = sorted(image.instances, key=lambda instance: -_depth_order(instance))
    shown = [i for i in far_first if i.box is not None]
    groups = {
        "depth": [_depth_layer(image.depth)] if image.depth is not None else [],
        "masks": [_mask(i.visible, colors[i.class_name]) for i in shown if i.visible is not None],
        "boxes": [_box(i, colors[i.class_name]) for i in shown],
        "cuboids": [_cuboid(i.cuboid, colors[i.class_name]) for i in shown if i.cuboid is not None],
        "axes": [_axes(i.axes) for i in shown if i.axes is not None],
        "keypoints": [*_all_keypoints(image, shown)],
    }
    layers = [f'<g class="{name}">{"".join(parts)}</g>' for name, parts in groups.items() if parts]
    return svg_image(encode_jpeg(image.rgb, 80), "image/jpeg", width, height, layers, image.name)


def _depth_order(instance: SeenInstance) -> float:
    """Larger boxes first, so that smaller ones are drawn over them."""
    if instance.box is None:
        return 0.0
    u0, v0, u1, v1 = instance.box
    return float((u1 - u0 + 1) * (v1 - v0 + 1))


def _mask(mask: Bool, color: str) -> str:
    import cv2

    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_TC89_L1)
    outlines = [ring[:, 0].astype(float) for ring in found if len(ring) > 2]
    return (
        f'<path d="{path_data(outlines)}" fill="{color}" fill-opacity=".38" fill-rule="evenodd" stroke="{color}"'
        ' stroke-width="1.1" stroke-linejoin="round"/>'
    )


def _box(instance: SeenInstance, color: str) -> str:
    assert instance.box is not None
    u0, v0, u1, v1 = instance.box
    title = instance.class_name
    if instance.fraction is not None:
        title += f", {instance.fraction:.0%} visible"
    return (
        f'<rect x="{u0 - 0.5}" y="{v0 - 0.5}" width="{u1 - u0 + 1}" height="{v1 - v0 + 1}" fill="#fff" fill-opacity="0"'
        f' stroke="{color}" stroke-width="1"><title>{escape(title)}</title></rect>'
    )


def _cuboid(corners: Float64, color: str) -> str:
    lines = [(corners[a], corners[b]) for a, b in BOX_EDGES]
    return f'<path d="{_lines(lines)}" fill="none" stroke="{color}" stroke-width="1" stroke-opacity=".9"/>'


def _axes(points: Float64) -> str:
    return "".join(
        f'<path d="{_lines([(points[0], points[k + 1])])}" stroke="{color}" stroke-width="2.2" stroke-linecap="round"/>'
        for k, color in enumerate(AXIS_COLORS)
    )


def _lines(lines: Iterable[tuple[Float64, Float64]]) -> str:
    return "".join(
        f"M{a[0]:.1f},{a[1]:.1f}L{b[0]:.1f},{b[1]:.1f}"
        for a, b in lines
        if max(np.abs(a).max(), np.abs(b).max()) < MAX_DRAWN
    )


def _all_keypoints(image: SeenImage, shown: Sequence[SeenInstance]) -> Iterable[str]:
    """Filled where seen, hollow where hidden; corners of boxes of which no file tells the visibility are hollow."""
    own = [instance.keypoints for instance in shown if instance.keypoints is not None]
    if image.keypoints is not None:
        own = [image.keypoints]
    if not own:
        own = [np.column_stack([i.cuboid, np.ones(len(i.cuboid))]) for i in shown if i.cuboid is not None]
    for u, v, visibility in np.concatenate([*own, np.empty((0, 3))]).tolist():
        if visibility > 0 and max(abs(u), abs(v)) < MAX_DRAWN:
            fill = "#ffd60a" if visibility == 2 else "none"
            yield f'<circle cx="{u:.1f}" cy="{v:.1f}" r="2.2" fill="{fill}" stroke="#ffd60a" stroke-width=".9"/>'


def _depth_layer(depth: Float32) -> str:
    """The depth image, near bright, far dark, black where there is no reading; half its size."""
    import base64

    import cv2

    small = depth[::2, ::2]
    read = small > 0
    low, high = np.quantile(small[read], (0.01, 0.99)) if read.any() else (0.0, 1.0)
    gray = (255 * np.clip((high - small) / max(high - low, 1e-6), 0, 1) * 0.85 + 38).clip(0, 255).astype(np.uint8)
    image = cv2.cvtColor(cv2.applyColorMap(gray, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    image[~read] = 0
    data = base64.b64encode(encode_jpeg(image, 80)).decode()
    height, width = depth.shape
    source = f"data:image/jpeg;base64,{data}"
    return f'<image href="{source}" x="-0.5" y="-0.5" width="{width}" height="{height}" preserveAspectRatio="none"/>'


def _caption(image: SeenImage) -> str:
    seen = [i for i in image.instances if i.box is not None]
    text = f"{len(seen)} of {len(image.instances)} objects to be seen"
    if image.depth is not None:
        text += f", depth read at {np.mean(image.depth > 0):.0%} of the pixels"
    return text


# ----------------------------------------------------------------------------------------------------------- statistics


def _cards(inspection: Inspection, seen: np.ndarray) -> list[tuple[str, str]]:
    s = inspection.statistics
    cards = [(f"{s.images:,}", "images"), (f"{s.scenes:,}", "scenes"), (str(len(s.classes)), "classes")]
    cards.append((f"{int(seen.sum()):,}", "instances seen"))
    cards.append((f"{seen.sum() / max(s.images, 1):.1f}", "of them an image"))
    if len(s.fraction) and seen.any():
        cards.append((f"{np.median(s.fraction[seen]):.0%}", "visible, median"))
    if len(s.distance) and seen.any():
        low, high = np.quantile(s.distance[seen], (0.05, 0.95))
        cards.append((f"{low:.1f} – {high:.1f} m", "distance, 90% of them"))
    return cards


def _class_row(s: Statistics, k: int, seen: np.ndarray, colors: Mapping[str, str]) -> ClassRow:
    mine = s.category == k
    shown = mine & seen
    name = s.classes[k]

    def middle(values: np.ndarray, text: str) -> str:
        return text.format(float(np.median(values[shown]))) if len(values) and shown.any() else "–"

    return ClassRow(
        name, colors[name], int(mine.sum()), int(shown.sum()), middle(s.fraction, "{:.0%}"),
        middle(s.distance, "{:.2f} m"), middle(np.sqrt(s.pixels), "{:.0f} px"),
    )  # fmt: skip


def _figures(s: Statistics, colors: Mapping[str, str], seen: np.ndarray) -> list[tuple[str, str]]:
    """(title, HTML) of the distributions that the data set tells of."""
    per_image = np.bincount(s.image[seen], minlength=s.images)
    out = [("Instances of each class", _class_bars(s, colors, seen))]
    bins = np.arange(per_image.max(initial=0) + 2) - 0.5
    out.append(("Instances seen in an image", _histogram(per_image, bins, "instances", "images")))
    if len(s.fraction):
        shares = 100 * s.fraction[s.pixels > 0]
        out.append(("How much of them is visible", _histogram(shares, np.linspace(0, 100, 26), "%", "instances")))
    if len(s.distance):
        out.append(("Distance from the camera", _histogram(s.distance[seen], 30, "m", "instances")))
    sizes = np.sqrt(s.pixels[seen])
    out.append(("Size in the image", _histogram(sizes, 30, "px, root of the area", "instances")))
    places = s.middle[seen & np.isfinite(s.middle).all(axis=1)]
    out.append(("Where in the image", _image_plane(places)))
    return out


def _class_bars(s: Statistics, colors: Mapping[str, str], seen: np.ndarray) -> str:
    every = np.bincount(s.category, minlength=len(s.classes))
    shown = np.bincount(s.category[seen], minlength=len(s.classes))

    def draw(figure: "Figure", width: float) -> None:
        axes = figure.subplots()
        rows = np.arange(len(s.classes))
        axes.barh(rows, every, height=0.7, color=GRID, linewidth=0)
        axes.barh(rows, shown, height=0.7, color=[colors[name] for name in s.classes], linewidth=0)
        axes.set_yticks(rows, s.classes, color=INK)
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel(f"instances; grey: less than {LABELLED:.0%} visible")
        axes.grid(True, axis="x")

    height = max(2.4, 0.22 * len(s.classes) + 0.7)
    return both_widths(draw, (height, height), "instances of each class", HALF)


def _histogram(values: np.ndarray, bins: np.ndarray | int, unit: str, counted: str) -> str:
    def draw(figure: "Figure", width: float) -> None:
        axes = figure.subplots()
        axes.hist(values, bins, color=ACCENT, linewidth=0, rwidth=0.92)  # type: ignore[arg-type]
        axes.set_xlabel(unit)
        axes.set_ylabel(counted)
        axes.grid(True, axis="y")

    return both_widths(draw, (2.4, 2.4), f"histogram: {unit}", HALF)


def _image_plane(places: Float64) -> str:
    def draw(figure: "Figure", width: float) -> None:
        axes = figure.subplots()
        counts, _, _ = np.histogram2d(places[:, 1], places[:, 0], bins=(18, 24), range=((0, 1), (0, 1)))
        _heat(axes, counts, (0, 1, 1, 0))
        axes.set_xticks([0, 0.5, 1], ["left", "middle", "right"])
        axes.set_yticks([0, 0.5, 1], ["top", "", "bottom"])

    return both_widths(draw, (2.4, 2.4), "middles of boxes in the image", HALF)


def coverage(s: Statistics, seen: np.ndarray) -> str:
    """From where the objects of each class are seen: azimuth and elevation of the camera in the object frame."""
    classes = [k for k in range(len(s.classes)) if (seen & (s.category == k)).any()]

    def draw(figure: "Figure", width: float) -> None:
        columns = min(len(classes), 5 if width > HALF else 2)
        rows = -(-len(classes) // columns)
        grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for axes, k in zip(grid.flat, classes, strict=False):
            x, y, z = s.viewpoint[seen & (s.category == k)].T
            counts, _, _ = np.histogram2d(
                z, np.degrees(np.arctan2(y, x)), bins=(12, 24), range=((-1.0, 1.0), (-180.0, 180.0))
            )
            _heat(axes, counts, (-180, 180, -1, 1))
            axes.set_title(f"{s.classes[k]} ({np.count_nonzero(counts) / counts.size:.0%})", loc="left", color=INK)
            axes.set_xticks([-180, -90, 0, 90, 180], ["back", "", "front", "", "back"])
            axes.set_yticks([-1, -0.5, 0, 0.5, 1], ["-90°", "-30°", "0°", "30°", "90°"])
        for axes in grid.flat[len(classes) :]:
            axes.axis("off")

    if not classes:
        return ""
    wide, narrow = -(-len(classes) // min(len(classes), 5)), -(-len(classes) // 2)
    return both_widths(draw, (1.75 * wide + 0.2, 1.6 * narrow + 0.2), "viewpoints of each class")


def _heat(axes: "Axes", counts: np.ndarray, extent: tuple[float, float, float, float]) -> None:
    """Cells whose opacity grows with their count, legible on any ground."""
    from matplotlib.colors import to_rgb

    image = np.empty((*counts.shape, 4))
    image[..., :3] = to_rgb(_SHADE)
    image[..., 3] = (counts / max(counts.max(initial=0), 1)) ** 0.6
    upper = extent[2] > extent[3]
    axes.imshow(image, extent=extent, origin="upper" if upper else "lower", aspect="auto", interpolation="nearest")
    axes.grid(True)
