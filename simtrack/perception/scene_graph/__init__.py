"""Scene graph: entities, support tree, spatial relations that are kept live, their history, and queries.

    graph = SceneGraph(static_map, models)
    graph.update(stamp, tracks)
    graph.query(relation="on", reference="workbench")

Names are imported on first use: the kernels behind them are compiled code.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simtrack.perception.scene_graph.bodies import Body
    from simtrack.perception.scene_graph.facts import Entity, Layer, SceneFacts, load_graph
    from simtrack.perception.scene_graph.graph import SceneGraph, SceneGraphConfig
    from simtrack.perception.scene_graph.history import Event, History, Interval
    from simtrack.perception.scene_graph.query import Query, parse_query
    from simtrack.perception.scene_graph.relations import (
        DIRECTIONS,
        RELATIONS,
        MarginMeter,
        RelationConfig,
        relation_margin,
        relation_margins,
    )
    from simtrack.perception.scene_graph.shapes import (
        HeightField,
        Interior,
        ModelLike,
        Shape,
        box_shape,
        map_entity_shape,
        model_shape,
        model_shapes,
    )

_HOME = {
    "bodies": ("Body",),
    "facts": ("Entity", "Layer", "SceneFacts", "load_graph"),
    "graph": ("SceneGraph", "SceneGraphConfig"),
    "history": ("Event", "History", "Interval"),
    "query": ("Query", "parse_query"),
    "relations": ("DIRECTIONS", "RELATIONS", "MarginMeter", "RelationConfig", "relation_margin", "relation_margins"),
    "shapes": (
        "HeightField",
        "Interior",
        "ModelLike",
        "Shape",
        "box_shape",
        "map_entity_shape",
        "model_shape",
        "model_shapes",
    ),
}
_MODULES = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "DIRECTIONS",
    "RELATIONS",
    "Body",
    "Entity",
    "Event",
    "HeightField",
    "History",
    "Interior",
    "Interval",
    "Layer",
    "MarginMeter",
    "ModelLike",
    "Query",
    "RelationConfig",
    "SceneFacts",
    "SceneGraph",
    "SceneGraphConfig",
    "Shape",
    "box_shape",
    "load_graph",
    "map_entity_shape",
    "model_shape",
    "model_shapes",
    "parse_query",
    "relation_margin",
    "relation_margins",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
