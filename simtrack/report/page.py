"""Puts the report together: one HTML file that needs nothing else."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import simtrack
from simtrack.contracts import NANOSECONDS
from simtrack.evaluation.metrics import Metric, write_atomically
from simtrack.evaluation.record import (
    CameraPicture,
    Interval,
    KeyFrame,
    RunRecord,
    encode_jpeg,
    graph_name,
    worst_object,
)
from simtrack.evaluation.targets import Target, targets_of
from simtrack.evaluation.trajectory import absolute_errors
from simtrack.report import figures
from simtrack.report.colors import class_colors
from simtrack.report.headline import format_metric, table
from simtrack.report.overlay import close_up, query_layers, svg_image, track_layer

CARDS = (
    ("localization.ate_rmse", "robot position, RMS"),
    ("tracking.static.translation_error.median", "still objects, median"),
    ("tracking.moving.translation_error.median", "moving objects, median"),
    ("tracking.recall", "objects tracked"),
    ("world.known_share", "of the world known"),
    ("relations.f1", "relations, F1"),
    ("presegmentation.camera.reduction", "measurements explained"),
    ("speed.frames_per_second", "frames a second"),
)
MAX_RELATION_ROWS = 28
_CHANGING_FIRST = (
    "on",
    "in",
    "touching",
    "intersects",
    "above",
    "below",
    "left-of",
    "right-of",
    "in-front-of",
    "behind",
    "near",
)


if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup


@dataclass(frozen=True, slots=True)
class Picture:
    """An image with its caption."""

    svg: str
    time: str
    caption: str


def write_report(record: RunRecord, path: Path) -> None:
    """Write the report of a run to `path`."""
    write_atomically(path, render(record))


def render(record: RunRecord) -> str:
    """The report as HTML."""
    page = template("template.html")
    colors = class_colors([f.class_name for f in record.object_frames] + list(record.meshes))
    targets = targets_of(record.scene, str(record.config.get("detector")))
    layers, answers = ([], [])
    if record.query_frame is not None:
        layers, answers = query_layers(record.query_frame, record.meshes)
    chosen = choose_relations(record.believed_relations)
    return page.render(
        record=record,
        version=simtrack.__version__,
        stages_run=_stages(record.config),
        warnings=_missed(record.metrics),
        seconds=(record.end - record.start) / NANOSECONDS,
        cards=[card for name, label in CARDS if (card := _card(record, name, label, targets)) is not None],
        headline=table(record.metrics, [n for n in targets if n in record.metrics], targets),
        others=table(record.metrics, sorted(n for n in record.metrics if n not in targets), targets),
        legend=[(name, colors[name]) for name in colors if name in {f.class_name for f in record.object_frames}],
        plan=figures.floor_plan(record, colors) if len(record.true) else "",
        pose_error=figures.pose_error(record, *absolute_errors(record.estimated, record.true))
        if len(record.true) > 1
        else "",
        objects=figures.object_errors(record, colors),
        key_frames=[_key_frame(record, frame, colors) for frame in record.key_frames],
        worst=[_worst(record, frame, colors) for frame in record.worst],
        camera=_unknown(record, record.camera) if record.camera else None,
        lidar=figures.lidar_view(record, record.lidar) if record.lidar else "",
        query=_photo(record.query_frame, layers, "relation queries") if layers and record.query_frame else "",
        answers=answers,
        relations=figures.relations(record, chosen) if chosen else "",
        relation_counts=(len({i.relation for i in chosen}), len({i.relation for i in record.believed_relations})),
        stages=figures.stage_times(record),
        config=_config_text(record.config),
    )


def _stages(config: Mapping[str, object]) -> str:
    """Whose stages were measured, in words."""
    given = [(stage.replace("_", " "), config.get(stage)) for stage in ("tracker", "localizer", "scene_graph")]
    foreign = [f"{stage} {name}" for stage, name in given if name]
    reason = f" ({config['detector_reason']})" if "detector_reason" in config else ""
    detector = f"detector {config.get('detector', 'of the recording')}{reason}"
    return " · ".join([*(foreign or ["simtrack's stages"]), detector])


def _missed(metrics: Mapping[str, Metric]) -> list[str]:
    """What is to be said of foreign stages that missed frames."""
    said = []
    for name, metric in sorted(metrics.items()):
        stage, _, what = name.removeprefix("foreign.").partition(".")
        if name.startswith("foreign.") and what == "missed_frames" and metric.value:
            of = metrics[name.removesuffix("missed_frames") + "frames"].value
            said.append(
                f"The {stage.replace('_', ' ')} missed {metric.value} of {of} frames ({metric.reason}): see faults.csv."
            )
    return said


def template(name: str) -> "Template":
    """A page's template in this folder."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["breakable"] = _breakable
    return environment.get_template(name)


def choose_relations(intervals: Sequence[Interval]) -> list[Interval]:
    """Intervals of the relations that tell most: those that changed, support and contact first."""
    by_relation: dict[tuple[str, str, str], list[Interval]] = {}
    for i in intervals:
        by_relation.setdefault((i.relation.subject, i.relation.name, i.relation.reference), []).append(i)
    end = max((i.end for i in intervals), default=0)

    def rank(key: tuple[str, str, str]) -> tuple[bool, int, str, str]:
        held = by_relation[key]
        constant = len(held) == 1 and held[0].end == end
        kind = _CHANGING_FIRST.index(key[1]) if key[1] in _CHANGING_FIRST else len(_CHANGING_FIRST)
        return constant and key[1] != "on", kind, key[0], key[2]

    kept = sorted(by_relation, key=rank)[:MAX_RELATION_ROWS]
    return [interval for key in kept for interval in by_relation[key]]


def _card(record: RunRecord, name: str, label: str, targets: Mapping[str, Target]) -> tuple[str, str, str] | None:
    metric = record.metrics.get(name)
    if metric is None or metric.value is None:
        return None
    share = metric.unit == "1" and isinstance(metric.value, float) and 0 <= metric.value <= 1 and "speed" not in name
    value = f"{100 * metric.value:.1f} %" if share and name != "relations.f1" else format_metric(metric)
    met = targets[name].met(metric) if name in targets else None
    return value.replace(" Hz", ""), label, {True: "good", False: "bad", None: ""}[met]


def _time(record: RunRecord, stamp: int) -> str:
    return f"{(stamp - record.start) / NANOSECONDS:.2f} s"


def _photo(frame: KeyFrame, layers: Sequence[str], title: str) -> str:
    return svg_image(frame.jpeg, "image/jpeg", frame.intrinsics.width, frame.intrinsics.height, layers, title)


def _key_frame(record: RunRecord, frame: KeyFrame, colors: Mapping[str, str]) -> Picture:
    tracked = [o for o in frame.objects if o.scored and o.track is not None]
    missed = [o.name for o in frame.objects if o.scored and o.track is None]
    caption = f"{len(tracked)} objects in view tracked"
    if tracked:
        caption += f", median error {1e3 * np.median([o.translation_error for o in tracked]):.1f} mm"
    if missed:
        caption += f"; not tracked: {', '.join(missed)}"
    return Picture(
        _photo(frame, track_layer(frame, record.meshes, colors), caption), _time(record, frame.stamp), caption
    )


def _worst(record: RunRecord, frame: KeyFrame, colors: Mapping[str, str]) -> Picture:
    thing = worst_object(frame)
    assert thing is not None and thing.track is not None, "a worst moment is one of a tracked object"
    state = "moving" if thing.moving else "still"
    caption = (
        f"{thing.name} (track {graph_name(thing.track)}, {state}, {100 * thing.visible_fraction:.0f} % visible): "
        f"off by {1e3 * thing.translation_error:.1f} mm and {np.degrees(thing.rotation_error):.1f}°"
    )
    layers, window = close_up(frame, thing, record.meshes[thing.class_name], colors[thing.class_name])
    K = frame.intrinsics
    svg = svg_image(frame.jpeg, "image/jpeg", K.width, K.height, layers, caption, window)
    return Picture(svg, _time(record, frame.stamp), caption)


def _unknown(record: RunRecord, picture: CameraPicture) -> Picture:
    """The image in gray with what nothing explains in red; without colour, the depth stands in."""
    import cv2

    if picture.jpeg is not None:
        gray = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    else:
        near = np.where(picture.depth > 0, np.clip(picture.depth, 0.4, 4.0), 4.0)
        gray = (255 * (4.0 - near) / 3.6).astype(np.uint8)
    image = np.repeat(np.asarray(gray)[..., None], 3, axis=2).astype(float) * 0.75 + 30
    image[picture.unknown] = 0.35 * image[picture.unknown] + 0.65 * np.array([255.0, 45, 35])
    height, width = picture.unknown.shape
    valid = np.count_nonzero(picture.depth > 0)
    share = 100 * np.count_nonzero(picture.unknown) / max(valid, 1)
    caption = f"{share:.1f} % of {valid} measurements remain"
    data = encode_jpeg(image.clip(0, 255).astype(np.uint8))
    return Picture(svg_image(data, "image/jpeg", width, height, title=caption), _time(record, picture.stamp), caption)


def _breakable(name: str) -> "Markup":
    """A metric's name that may be broken after dots and underscores."""
    from markupsafe import Markup, escape

    return Markup(escape(name).replace(".", Markup(".<wbr>")).replace("_", Markup("_<wbr>")))


def _config_text(config: Mapping[str, object]) -> str:
    import yaml

    return yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True)
