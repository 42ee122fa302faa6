"""A contact graph in formats of others: GraphML, RDF (N-Triples, Turtle, ...) and Spark-DSG's JSON.

Spark-DSG: the scene-graph library of MIT SPARK (Hydra, Khronos). Its layers hold the scene as a room, layout and
objects as objects; support runs within and between layers as edges whose metadata say what they are.
"""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import quaternion_from_rotation
from simtrack.perception.scene_graph.contact.graph import ContactGraph
from simtrack.perception.scene_graph.contact.nodes import SCENE, EntityNode

_SCENE_ID = "scene"
_SPARK_LAYERS = {"OBJECTS": 2, "AGENTS": 2, "PLACES": 3, "ROOMS": 4, "BUILDINGS": 5}
_SPARK_VERSION = {"major": 1, "minor": 1, "patch": 3}


def edges_of(graph: ContactGraph) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Every edge as (source, target, attributes): supporter to child, leaning to what carries it, proximal pairs."""
    for main, supports in ((True, graph.supports.values()), (False, graph.others)):
        for s in supports:
            numbers = {"area": s.area, "score": s.score, "height": s.height, "distance": s.distance}
            yield (
                s.parent,
                s.child,
                {"relation": "supports", "kind": s.kind.value, "main": main, "touching": s.touching}
                | {name: float(value) for name, value in numbers.items() if np.isfinite(value)},
            )
    for lean in graph.leaning:
        yield lean.child, lean.against, {"relation": "leans-on"}
    for edge in graph.proximal:
        volumes = {"box_volume": edge.box_volume, "volume": edge.volume, "exact": edge.exact}
        yield edge.first, edge.second, {"relation": "proximal"} | volumes


def to_graphml(graph: ContactGraph) -> str:
    """GraphML text, to be opened with networkx, yEd, Gephi or Cytoscape; the scene node is called ``scene``.

    Raises:
        InvalidValueError: a node is called ``scene``, too.
    """
    import networkx as nx

    if _SCENE_ID in graph.nodes:
        raise InvalidValueError("graph.nodes", _SCENE_ID, "names other than that of the scene node")
    out = nx.MultiDiGraph()
    out.add_node(_SCENE_ID, kind="scene", semantic_class="")
    for node in graph.nodes.values():
        centre, size = node.box.T_map_box[:3, 3], node.box.extents
        box = {f"centre_{k}": float(v) for k, v in zip("xyz", centre, strict=True)}
        box |= {f"size_{k}": float(v) for k, v in zip("xyz", size, strict=True)}
        out.add_node(node.name, kind=node.kind.value, semantic_class=node.semantic_class, **box, yaw=_yaw(node))
    for source, target, attributes in edges_of(graph):
        out.add_edge(source or _SCENE_ID, target, **attributes)
    return "\n".join(nx.generate_graphml(out))


def _yaw(node: EntityNode) -> float:
    return float(np.arctan2(node.box.T_map_box[1, 0], node.box.T_map_box[0, 0]))


def to_rdf(graph: ContactGraph, format_name: str = "nt") -> str:
    """RDF text in the scene graph's namespace: ``:cup a :Cup ; :on :table ; :parent :table``.

    Relations are ``on``, ``in``, ``hangs-on``, ``leans-on`` and ``proximal``; the last are given in both directions.

    Args:
        graph: the graph.
        format_name: file name ending of the syntax: nt, ttl, rdf (XML), ...

    Raises:
        InvalidValueError: no such syntax.
    """
    import pyoxigraph as ox

    from simtrack.perception.scene_graph.sparql import PREFIXES, class_iri, entity_iri

    syntax = ox.RdfFormat.from_extension(format_name)
    if syntax is None:
        raise InvalidValueError("format_name", format_name, "nt, ttl, n3, rdf, jsonld")
    rdf_type = ox.NamedNode(f"{PREFIXES['rdf']}type")
    triples = []

    def add(subject: str, predicate: str, value: str | float | None, *, entity: bool = False) -> None:
        target = entity_iri(str(value)) if entity else ox.Literal(value)  # pyright: ignore[reportArgumentType]
        triples.append(ox.Triple(entity_iri(subject), entity_iri(predicate), target))

    for node in graph.nodes.values():
        triples.append(
            ox.Triple(entity_iri(node.name), rdf_type, entity_iri(class_iri(node.semantic_class or "thing")))
        )
        add(node.name, "name", node.name)
        add(node.name, "kind", node.kind.value)
        if graph.supports[node.name].parent:
            add(node.name, "parent", graph.supports[node.name].parent, entity=True)
    relations = {"on": "on", "inside": "in", "hung": "hangs-on"}
    for s in (*graph.supports.values(), *graph.others):
        if s.parent:
            add(s.child, relations[s.kind.value], s.parent, entity=True)
    for lean in graph.leaning:
        add(lean.child, "leans-on", lean.against, entity=True)
    for edge in graph.proximal:
        add(edge.first, "proximal", edge.second, entity=True)
        add(edge.second, "proximal", edge.first, entity=True)
    data = ox.serialize(triples, format=syntax, prefixes=PREFIXES)
    return data.decode() if data else ""


def to_spark_dsg(graph: ContactGraph) -> str:
    """JSON text that Spark-DSG's `DynamicSceneGraph.load` reads (version 1.1).

    Entities are object nodes ``O(i)`` in the order of the graph's nodes, with upright boxes; the scene is the room node
    ``R(0)`` and parent of what stands in it directly. The semantic label is the index among the sorted classes, which
    the graph's metadata list.
    """
    classes = sorted({node.semantic_class for node in graph.nodes.values()})
    ids = {SCENE: _symbol("R", 0)} | {name: _symbol("O", i) for i, name in enumerate(graph.nodes)}
    centre = np.mean([node.box.T_map_box[:3, 3] for node in graph.nodes.values()] or [np.zeros(3)], axis=0)
    nodes = [{"attributes": _spark_room(centre), "id": ids[SCENE], "layer": _SPARK_LAYERS["ROOMS"], "partition": 0}]
    for name, node in graph.nodes.items():
        attributes = _spark_object(node, classes.index(node.semantic_class))
        nodes.append({"attributes": attributes, "id": ids[name], "layer": _SPARK_LAYERS["OBJECTS"], "partition": 0})
    joined: dict[tuple[int, int], list[dict[str, Any]]] = {}
    for source, target, attributes in edges_of(graph):  # one edge a pair there: the first is the tree's
        pair, converse = (ids[source], ids[target]), (ids[target], ids[source])
        joined.setdefault(converse if converse in joined else pair, []).append(
            attributes | {"source": source, "target": target}
        )
    edges = [
        {
            "info": {"metadata": {"relations": found}, "type": "EdgeAttributes", "weight": 1.0, "weighted": False},
            "source": source,
            "target": target,
        }
        for (source, target), found in joined.items()
    ]
    layers = {name: {"layer": layer, "partition": 0} for name, layer in _SPARK_LAYERS.items()}
    data = {
        "SPARK_DSG_header": {"project_name": "main", "version": _SPARK_VERSION},
        "directed": False,
        "multigraph": False,
        "metadata": {"semantic_classes": classes},
        "layer_keys": [{"layer": layer, "partition": 0} for layer in sorted(set(_SPARK_LAYERS.values()))],
        "layer_names": layers,
        "nodes": nodes,
        "edges": edges,
    }
    return json.dumps(data, allow_nan=False)


def _symbol(letter: str, index: int) -> int:
    """Spark-DSG's node id: a letter in the highest byte."""
    return ord(letter) << 56 | index


def _spark_attributes(kind: str, name: str, position: Float64, label: int) -> dict[str, Any]:
    return {
        "type": kind,
        "name": name,
        "position": position.tolist(),
        "semantic_label": label,
        "color": {"r": 160, "g": 160, "b": 160, "a": 255},
        "semantic_feature": {"rows": 0, "cols": 0, "data": None},
        "bounding_box": _spark_box("INVALID", np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])),
        "is_active": False,
        "is_predicted": False,
        "last_update_time_ns": 0,
        "metadata": {},
    }


def _spark_box(kind: str, centre: Float64, size: Float64, wxyz: Float64) -> dict[str, Any]:
    return {
        "type": kind,
        "dimensions": size.tolist(),
        "world_P_center": centre.tolist(),
        "world_R_center": dict(zip("wxyz", wxyz.tolist(), strict=True)),
    }


def _spark_room(position: Float64) -> dict[str, Any]:
    return _spark_attributes("RoomNodeAttributes", _SCENE_ID, position, 0)


def _spark_object(node: EntityNode, label: int) -> dict[str, Any]:
    T = node.box.T_map_box
    own = quaternion_from_rotation(node.T_map_entity[:3, :3])
    attributes = _spark_attributes("ObjectNodeAttributes", node.name, T[:3, 3], label)
    return attributes | {
        "bounding_box": _spark_box("OBB", T[:3, 3], node.box.extents, quaternion_from_rotation(T[:3, :3])),
        "metadata": {"kind": node.kind.value, "semantic_class": node.semantic_class},
        "registered": False,
        "mesh_connections": [],
        "world_R_object": dict(zip("wxyz", own.tolist(), strict=True)),
    }
