"""The report of a reconstruction: one HTML file with the paper's panels, that needs nothing else.

Entities, contact graph as a tree, functional scene (at rest and with everything opened), models with their errors,
findings, verdict.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from math import isnan
from pathlib import Path

import numpy as np

import simtrack
from simtrack.evaluation.metrics import write_atomically
from simtrack.evaluation.record import encode_jpeg
from simtrack.perception.reconstruction.kinematic_tree import scaled_mass
from simtrack.perception.reconstruction.reconstruct import Choice, Reconstruction
from simtrack.perception.scene_graph.contact.graph import ContactGraph, SupportKind, is_layout
from simtrack.perception.scene_graph.contact.nodes import SCENE
from simtrack.plausibility.verdict import CheckReport, EngineResult
from simtrack.report.colors import class_colors
from simtrack.report.overlay import svg_image
from simtrack.report.page import template
from simtrack.report.room_view import RoomView

ROW, COLUMN, BOX = 24.0, 190.0, (164.0, 19.0)
"""Pixels of the drawn tree: between rows, between columns, of a node."""
DASHES = {SupportKind.INSIDE: "5 3", SupportKind.HUNG: "1.5 3"}
OPENED = 0.7
"""Share of their range at which joints are shown open."""


@dataclass(frozen=True, slots=True)
class ModelRow:
    """One line of the table of models."""

    entity: str
    color: str
    semantic_class: str
    model: str
    scale: str
    ME: str
    AE: str
    shift: str
    residual: str
    parent: str
    joint: str
    mass: str
    rejected: tuple[str, ...]


def write_reconstruction_page(made: Reconstruction, check: CheckReport, folder: Path, path: Path) -> None:
    """Write the page to `path`; `folder` holds the pictures of the check."""
    write_atomically(path, render(made, check, folder))


def render(made: Reconstruction, check: CheckReport, folder: Path) -> str:
    """The page as HTML."""
    graph = made.graph
    colors = class_colors(node.semantic_class for node in graph.nodes.values() if not is_layout(node))
    view = RoomView(graph)
    opened = {
        name: body.joint.upper if body.joint.upper > 0.0 else body.joint.lower
        for name, body in made.tree.joints.items()
        if body.joint is not None
    }
    return template("reconstruction.html").render(
        made=made,
        check=check,
        version=simtrack.__version__,
        cards=_cards(made, check),
        legend=list(colors.items()),
        entities=_picture(view.entities(graph, colors), "entities as they were seen"),
        scene=_picture(view.scene(made.tree), "functional scene"),
        opened=_picture(view.scene(made.tree, {n: OPENED * at for n, at in opened.items()}), "everything opened")
        if opened
        else "",
        joints=len(opened),
        tree=tree_svg(graph, colors),
        guessed=[s.child for s in graph.supports.values() if not s.touching],
        proximal=len(graph.proximal),
        rows=[_row(name, choice, made, colors) for name, choice in made.choices.items()],
        graph_findings=graph.findings,
        engines=[(e.engine, e.version, f"{1e3 * e.margin:g} mm", _worst(e)) for e in check.engines],
        pictures=[
            (name, _png(folder / f"{name}.png")) for name in ("before", "after") if (folder / f"{name}.png").is_file()
        ],
    )


def _picture(image: np.ndarray, title: str) -> str:
    return svg_image(encode_jpeg(image, 85), "image/jpeg", image.shape[1], image.shape[0], title=title)


def _png(path: Path) -> str:
    import cv2

    image = cv2.imread(str(path))
    return "" if image is None else _picture(image[..., ::-1], path.stem)


def _cards(made: Reconstruction, check: CheckReport) -> list[tuple[str, str, str]]:
    choices = made.choices.values()
    cad = [choice for choice in choices if not choice.own_mesh]
    errors = [choice.candidate.alignment_error for choice in cad]
    cards = [(check.verdict, "verdict", {"plausible": "good", "not plausible": "bad"}.get(check.verdict, ""))]
    cards.append((str(len(made.graph.nodes)), "entities", ""))
    cards.append((f"{len(cad)} of {len(made.choices)}", "with a CAD model", ""))
    if errors:
        cards.append((f"{1e3 * float(np.median(errors)):.1f} mm", "AE, median", ""))
    free = [part for part in made.tree.components if not part.static]
    cards += [(str(len(free)), "can be lifted", ""), (str(len(made.tree.joints)), "joints of models", "")]
    if check.agreement is not None:
        cards.append((f"{100 * check.agreement:.0f} %", "engines agree", ""))
    return cards


def _row(name: str, choice: Choice, made: Reconstruction, colors: Mapping[str, str]) -> ModelRow:
    candidate, node = choice.candidate, made.graph.nodes[name]
    body = made.tree.by_name.get(name)
    return ModelRow(
        entity=name,
        color=colors[node.semantic_class],
        semantic_class=node.semantic_class,
        model="its own mesh" if choice.own_mesh else candidate.model.name,
        scale="" if choice.own_mesh else f"{candidate.scale:.3f}",
        ME="" if choice.own_mesh else f"{candidate.matching_error:.4f}",
        AE="" if choice.own_mesh else f"{1e3 * candidate.alignment_error:.1f} mm",
        shift=f"{1e3 * float(np.linalg.norm(choice.shift)):.1f} mm",
        residual="" if isnan(choice.residual) else f"{abs(1e3 * choice.residual):.2f} mm",
        parent=made.graph.parent(name) or "scene",
        joint=body.joint.kind if body is not None and body.joint is not None else "",
        mass=f"{scaled_mass(candidate):.2f} kg",
        rejected=tuple(f"{r.model}: {r.reason}" for r in choice.rejected),
    )


def _worst(engine: EngineResult) -> str:
    bodies = [body for body in engine.bodies if not body.static]
    if not bodies:
        return "nothing is free"
    drift, tilt = max(b.drift for b in bodies), max(b.tilt for b in bodies)
    deep = max(max(b.penetration_start, b.penetration_end) for b in bodies)
    gap = max((b.gap for b in bodies if b.gap is not None), default=0.0)
    return (
        f"{len(bodies)} free bodies; at worst {1e3 * drift:.1f} mm of drift, {np.degrees(tilt):.1f}° of tilt, "
        f"{1e3 * deep:.1f} mm of penetration, {1e3 * gap:.1f} mm of gap"
    )


# ----------------------------------------------------------------------------------------------------------------- tree


def tree_svg(graph: ContactGraph, colors: Mapping[str, str]) -> str:
    """The support tree from left to right: solid on, dashed inside, dotted hung; a ring where the parent is guessed."""
    places: dict[str, tuple[float, float]] = {}
    rows = _place(graph, SCENE, 0, 0, places)
    depth = max(x for x, _ in places.values())
    width, height = depth * COLUMN + BOX[0] + 8, rows * ROW + 8
    edges, nodes = [], []
    for name, (column, row) in places.items():
        x, y = 4 + column * COLUMN, 4 + row * ROW
        layout = name != SCENE and is_layout(graph.nodes[name])
        fill = "var(--grid)" if name == SCENE or layout else colors[graph.nodes[name].semantic_class]
        title = "scene" if name == SCENE else f"{name}: {graph.nodes[name].semantic_class}"
        if name != SCENE:
            edges.append(_edge(graph, name, places))
        nodes.append(
            f'<g><title>{escape(title)}</title><rect x="{x:.1f}" y="{y:.1f}" width="{BOX[0]:g}" height="{BOX[1]:g}"'
            f' rx="5" fill="{fill}" fill-opacity=".28" stroke="{fill}"/><text x="{x + 8:.1f}" y="{y + 13.5:.1f}">'
            f"{escape(_short(name or 'scene'))}</text></g>"
        )
    return (
        f'<svg class="tree" viewBox="0 0 {width:.0f} {height:.0f}" style="max-width:{width:.0f}px" role="img"'
        f' aria-label="contact graph as a tree">{"".join(edges)}{"".join(nodes)}</svg>'
    )


def _place(graph: ContactGraph, name: str, column: int, row: float, places: dict[str, tuple[float, float]]) -> float:
    """Give a node and all below it their places; returns the first free row."""
    children = graph.children(name)
    start = row
    for child in children:
        row = _place(graph, child, column + 1, row, places)
    places[name] = float(column), start if not children else 0.5 * (places[children[0]][1] + places[children[-1]][1])
    return max(row, start + 1.0)


def _edge(graph: ContactGraph, name: str, places: Mapping[str, tuple[float, float]]) -> str:
    support = graph.supports[name]
    (column, row), (_, parent) = places[name], places[support.parent]
    x1, y1 = 4 + (column - 1) * COLUMN + BOX[0], 4 + parent * ROW + BOX[1] / 2
    x2, y2 = 4 + column * COLUMN, 4 + row * ROW + BOX[1] / 2
    dash = f' stroke-dasharray="{DASHES[support.kind]}"' if support.kind in DASHES else ""
    middle = (x1 + x2) / 2
    title = f"{name} {support.kind} {support.parent or 'scene'}, score {support.score:.2f}, area {support.area:.2f}"
    ring = "" if support.touching else f'<circle cx="{x2:.1f}" cy="{y2:.1f}" r="4" fill="none" stroke="var(--bad)"/>'
    return (
        f'<path d="M{x1:.1f},{y1:.1f}C{middle:.1f},{y1:.1f} {middle:.1f},{y2:.1f} {x2:.1f},{y2:.1f}" fill="none"'
        f' stroke="var(--muted)"{dash}><title>{escape(title)}</title></path>{ring}'
    )


def _short(name: str, length: int = 24) -> str:
    return name if len(name) <= length else name[: length - 1] + "…"
