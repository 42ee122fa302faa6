"""The report of a panoptic map: one HTML file with the map beside the truth, entities and figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

import simtrack
from simtrack.contracts import CameraIntrinsics, Float64, Uint8
from simtrack.evaluation.mapping import MappedScene
from simtrack.evaluation.metrics import Metrics, write_atomically
from simtrack.evaluation.record import encode_jpeg
from simtrack.geometry.meshes import Mesh, area
from simtrack.geometry.transforms import look_at, transform
from simtrack.perception.mapping.panoptic.entities import STUFF_FIRST, extract_surface
from simtrack.report.colors import class_colors
from simtrack.report.headline import format_metric
from simtrack.report.overlay import svg_image
from simtrack.report.page import template
from simtrack.report.room_view import FOV, HEIGHT, LAYOUT_COLOR, SUPERSAMPLING, WIDTH, shaded, varied

_STUFF_COLORS = {"floor": (196, 186, 172), "wall": LAYOUT_COLOR, "ceiling": (240, 240, 240)}
_UNKNOWN = (120, 120, 120)
HEADLINE = (
    ("panoptic.pq", "PQ, all classes"), ("panoptic.stuff.pq", "PQ, stuff"), ("panoptic.things.pq", "PQ, things"),
    ("instances.map50", "instances, mAP@0.5"), ("boxes_refined.map50", "boxes, mAP@0.5"),
    ("surface.accuracy.median", "off the true surface"), ("graph.distance_per_node", "GED / nodes"),
    ("map.entities", "entities"), ("map.frames", "frames"),
)  # fmt: skip


def write_map_page(mapped: MappedScene, metrics: Metrics, path: Path) -> None:
    """Write the page to `path`."""
    write_atomically(path, render(mapped, metrics))


def render(mapped: MappedScene, metrics: Metrics) -> str:
    """The page as HTML."""
    room = None if mapped.seen is None else mapped.seen.room
    names = {e.semantic_class for e in mapped.entities} | {e.semantic_class for e in (room.entities if room else ())}
    colors = class_colors(names - set(STUFF_FIRST))
    found = [(e.semantic_class, e.mesh) for e in mapped.entities]
    true = [(e.semantic_class, e.mesh) for e in room.entities] if room else []
    whole = extract_surface(mapped.map.volume, mapped.map.config.entities.least_weight)
    surface = whole.mesh
    extent = surface if len(surface.faces) else None
    pictures = []
    if extent is not None:
        for title, T, camera, reach in _cameras(extent, mapped):
            views = [("map, by class", _classes(found, colors)), ("truth", _classes(true, colors))]
            views = [view for view in views if view[1]]
            views.append(("map, as it looked", [(surface, _own_colors(surface))]))
            pictures.append(
                (title, [(name, _picture(shaded(meshes, T, camera, reach, backs=False), f"{title}: {name}"))
                         for name, meshes in views])
            )  # fmt: skip
    rows = [
        (e.name, e.semantic_class, colors.get(e.semantic_class, "#c8c8c8"), f"{100 * e.score:.0f} %",
         f"{area(e.mesh):.3f}", " x ".join(f"{side:.2f}" for side in e.mesh.extents), len(e.mesh.faces))
        for e in mapped.entities
    ]  # fmt: skip
    return template("map.html").render(
        name=mapped.name,
        version=simtrack.__version__,
        cards=[(format_metric(metrics[key]), label) for key, label in HEADLINE if key in metrics],
        legend=list(colors.items()),
        pictures=pictures,
        rows=rows,
        skipped=sorted(mapped.map.skipped.items()),
        figures=[(key, format_metric(value)) for key, value in metrics.items()],
    )


def _cameras(mesh: Mesh, mapped: MappedScene) -> list[tuple[str, Float64, CameraIntrinsics, float]]:
    """From above and from the side: title, T_map_camera, intrinsics and reach.

    Nobody knows which way is up in a recording; it is looked at from behind its camera's first place.
    """
    low, high = mesh.bounds
    middle, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    f = 0.5 * SUPERSAMPLING * WIDTH / np.tan(0.5 * FOV)
    w, h = SUPERSAMPLING * WIDTH, SUPERSAMPLING * HEIGHT
    camera = CameraIntrinsics(w, h, f, f, (w - 1) / 2, (h - 1) / 2)
    far = radius / np.tan(0.5 * FOV)
    if mapped.seen is None and mapped.T_map_first is not None:
        behind = mapped.T_map_first @ transform(None, (0.0, 0.0, -0.25 * radius))
        return [("From behind the camera", behind, camera, 6.0 * far)]
    above = look_at(middle + [0.0, -1e-3, 1.15 * far], middle, np.array([0.0, 1.0, 0.0]))
    side = look_at(middle + far * np.array([-0.5, -0.75, 0.75]), middle)
    return [("From above", above, camera, 6.0 * far), ("From the side", side, camera, 6.0 * far)]


def _classes(entities: Sequence[tuple[str, Mesh]], colors: Mapping[str, str]) -> list[tuple[Mesh, Float64]]:
    """Meshes in the colours of their classes, slightly varied."""
    painted = []
    for number, (name, mesh) in enumerate(entities):
        color = _STUFF_COLORS.get(name) or (varied(colors[name], number) if name in colors else _UNKNOWN)
        painted.append((mesh, np.tile(np.array(color, float), (len(mesh.faces), 1))))
    return painted


def _own_colors(mesh: Mesh) -> Float64:
    grey = np.tile(np.array(_UNKNOWN, float), (len(mesh.faces), 1))
    return grey if mesh.face_colors is None else mesh.face_colors.astype(float)


def _picture(image: Uint8, title: str) -> str:
    return svg_image(encode_jpeg(image, 85), "image/jpeg", image.shape[1], image.shape[0], title=title)
