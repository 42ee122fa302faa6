"""A contact graph as JSON: versioned schema, everything but the meshes, validated when read."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.geometry.boxes import OrientedBox
from simtrack.geometry.planes import SurfacePlane
from simtrack.geometry.transforms import is_rigid
from simtrack.perception.scene_graph.contact.graph import (
    ContactGraph,
    Leaning,
    ProximalEdge,
    Support,
    SupportKind,
)
from simtrack.perception.scene_graph.contact.nodes import SCENE, EntityKind, EntityNode, Finding, FindingCode
from simtrack.perception.scene_graph.json_schema import (
    JsonModel,
    Matrix,
    Name,
    Number,
    Positive,
    Triple,
    parse_document,
    read_bounded,
)

FORMAT = "simtrack-contact-graph"
VERSION = 1


class _Plane(JsonModel):
    normal: Triple
    offset: Number
    area: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    hidden: bool


class _Node(JsonModel):
    name: Name
    semantic_class: str
    kind: EntityKind
    T_map_entity: Matrix
    T_map_box: Matrix
    extents: tuple[Positive, Positive, Positive]
    planes: list[_Plane]


class _Support(JsonModel):
    child: Name
    parent: str
    kind: SupportKind
    plane: int
    height: Number | None
    distance: Number | None
    area: Number
    score: Number
    touching: bool


class _Leaning(JsonModel):
    child: Name
    against: Name
    point: Triple


class _Proximal(JsonModel):
    first: Name
    second: Name
    box_volume: Number
    volume: Number
    exact: bool


class _Finding(JsonModel):
    code: FindingCode
    entity: str
    message: str


class _Graph(JsonModel):
    format: Literal["simtrack-contact-graph"]
    version: Literal[1]
    nodes: list[_Node]
    supports: list[_Support]
    others: list[_Support]
    leaning: list[_Leaning]
    proximal: list[_Proximal]
    findings: list[_Finding]


def dump_contact_graph(graph: ContactGraph) -> str:
    """JSON text of a graph; equal graphs give equal text."""
    data: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "nodes": [_node_fields(node) for node in graph.nodes.values()],
        "supports": [_fields(s) for s in graph.supports.values()],
        "others": [_fields(s) for s in graph.others],
        "leaning": [{"child": x.child, "against": x.against, "point": x.point.tolist()} for x in graph.leaning],
        "proximal": [_fields(edge) for edge in graph.proximal],
        "findings": [_fields(finding) for finding in graph.findings],
    }
    return json.dumps(data, allow_nan=False, indent=1)


def _fields(value: Support | ProximalEdge | Finding) -> dict[str, Any]:
    """Fields of a flat dataclass; what is not a number is null."""
    fields = {name: getattr(value, name) for name in value.__dataclass_fields__}
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in fields.items()}


def _node_fields(node: EntityNode) -> dict[str, Any]:
    return {
        "name": node.name,
        "semantic_class": node.semantic_class,
        "kind": node.kind.value,
        "T_map_entity": node.T_map_entity.tolist(),
        "T_map_box": node.box.T_map_box.tolist(),
        "extents": node.box.extents.tolist(),
        "planes": [
            {"normal": p.normal.tolist(), "offset": p.offset, "area": p.area, "hidden": p.hidden} for p in node.planes
        ],
    }


def load_contact_graph(path: str | Path) -> ContactGraph:
    """Read a saved graph; its nodes have no meshes.

    Raises:
        FileFormatError: the file cannot be read, is not of the schema, or its supports are no tree.
    """
    path = Path(path)
    return parse_contact_graph(read_bounded(path), path)


def parse_contact_graph(text: str, source: str | Path) -> ContactGraph:
    """A graph from JSON text; `source` is named in errors.

    Raises:
        FileFormatError: the text is not of the schema, or its supports are no tree; names field and reason.
    """
    data = parse_document(_Graph, text, source)
    nodes: dict[str, EntityNode] = {}
    for i, node in enumerate(data.nodes):
        if node.name in nodes:
            raise FileFormatError(source, f"nodes.{i}.name", f"{node.name!r} occurs twice")
        nodes[node.name] = _node(node, f"nodes.{i}", source)
    _require_names(data, nodes, source)
    supports = {s.child: _support(s) for s in data.supports}
    _require_tree(supports, nodes, source)
    return ContactGraph(
        nodes=nodes,
        supports=supports,
        others=tuple(_support(s) for s in data.others),
        leaning=tuple(Leaning(x.child, x.against, np.array(x.point)) for x in data.leaning),
        proximal=tuple(ProximalEdge(**edge.model_dump()) for edge in data.proximal),
        findings=tuple(Finding(**finding.model_dump()) for finding in data.findings),
    )


def _node(node: _Node, field: str, source: str | Path) -> EntityNode:
    T = np.array(node.T_map_entity)
    if not is_rigid(T, tolerance=1e-4):
        raise FileFormatError(source, f"{field}.T_map_entity", "is no rigid transform")
    try:
        box = OrientedBox(np.array(node.T_map_box), np.array(node.extents))
    except InvalidValueError as error:
        raise FileFormatError(source, f"{field}.T_map_box", str(error)) from None
    planes = tuple(
        SurfacePlane(np.array(p.normal), p.offset, p.area, np.empty(0, np.int32), p.hidden) for p in node.planes
    )
    return EntityNode(node.name, node.semantic_class, node.kind, T, box, planes, None)


def _support(support: _Support) -> Support:
    fields: dict[str, Any] = support.model_dump()
    for name in ("height", "distance"):
        fields[name] = np.nan if fields[name] is None else fields[name]
    return Support(**fields)


def _require_names(data: _Graph, nodes: dict[str, EntityNode], source: str | Path) -> None:
    """Every edge joins nodes that exist, and planes exist."""
    for table in ("supports", "others"):
        for i, edge in enumerate(getattr(data, table)):
            field = f"{table}.{i}"
            for place, name in (("child", edge.child), ("parent", edge.parent)):
                if name not in nodes and not (place == "parent" and name == SCENE):
                    raise FileFormatError(source, f"{field}.{place}", f"{name!r} is no node")
            count = len(nodes[edge.parent].planes) if edge.parent else 0
            if not -1 <= edge.plane < count:
                raise FileFormatError(source, f"{field}.plane", f"{edge.plane} is none of the parent's {count} planes")
    pairs = [("leaning", i, x.child, x.against) for i, x in enumerate(data.leaning)]
    pairs += [("proximal", i, x.first, x.second) for i, x in enumerate(data.proximal)]
    for table, i, *names in pairs:
        for name in names:
            if name not in nodes:
                raise FileFormatError(source, f"{table}.{i}", f"{name!r} is no node")


def _require_tree(supports: dict[str, Support], nodes: dict[str, EntityNode], source: str | Path) -> None:
    """Every node has one parent, and every way up ends at the scene."""
    if missing := sorted(nodes.keys() - supports.keys()):
        raise FileFormatError(source, "supports", f"none for the node {missing[0]!r}")
    for start in supports:
        path: list[str] = []
        name = start
        while name != SCENE:
            if name in path:
                raise FileFormatError(source, "supports", f"a cycle: {' -> '.join([*path[path.index(name) :], name])}")
            path.append(name)
            name = supports[name].parent
