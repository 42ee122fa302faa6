"""The scene graph as JSON: versioned schema, complete, validated when read. See docs/scene_graph.md for the fields."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from simtrack.contracts import Float64, Relation, Room
from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.geometry.transforms import is_rigid
from simtrack.perception.scene_graph.facts import Entity, Layer, SceneFacts
from simtrack.perception.scene_graph.history import History, Interval
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
from simtrack.perception.scene_graph.relations import RELATIONS, RelationConfig
from simtrack.perception.scene_graph.shapes import Interior, Shape, box_shape

FORMAT = "simtrack-scene-graph"
VERSION = 1

_Size = tuple[Positive, Positive, Positive]


class _Room(JsonModel):
    name: Name
    polygon: Annotated[list[tuple[Number, Number]], Field(min_length=3)]
    floor: Number
    height: Positive


class _Interior(JsonModel):
    centre: Triple
    extents: _Size


class _Entity(JsonModel):
    name: Name
    layer: Layer
    class_name: str
    semantic_class: str
    T_map: Matrix
    extents: _Size
    room: str
    parent: str
    T_parent_entity: Matrix
    carried: bool
    layout: bool = False
    interior: _Interior | None = None


class _Known(JsonModel):
    name: Name
    class_name: str
    semantic_class: str
    layer: Layer


class _Relation(JsonModel):
    subject: Name
    name: Literal[RELATIONS]  # pyright: ignore[reportInvalidTypeForm]
    reference: Name
    intervals: Annotated[list[tuple[int, int | None]], Field(min_length=1)]


class _Config(JsonModel):
    projection: bool
    strict: bool
    projection_factor: Number
    on_distance: Number
    near_range: Number
    touch_distance: Number
    intersection_depth: Number
    meet_depth: Number
    enter_margin: Number
    leave_margin: Number
    container_classes: frozenset[str]
    layout_classes: frozenset[str]


class _Graph(JsonModel):
    format: Literal["simtrack-scene-graph"]
    version: Literal[1]
    stamp: int
    config: _Config
    taxonomy: dict[str, list[str]]
    models: dict[str, str]
    rooms: list[_Room]
    entities: list[_Entity]
    past_entities: list[_Known]
    relations: list[_Relation]


def dump(facts: SceneFacts) -> str:
    """JSON text of a scene graph; the same graph gives the same text."""
    config = {name: getattr(facts.relation_config, name) for name in _Config.model_fields}
    config |= {name: sorted(config[name]) for name in ("container_classes", "layout_classes")}
    graph: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "stamp": facts.stamp,
        "config": config,
        "taxonomy": {name: list(above) for name, above in sorted(facts.parents.items())},
        "models": dict(sorted(facts.models.items())),
        "rooms": [
            {"name": r.name, "polygon": np.asarray(r.polygon).tolist(), "floor": r.floor, "height": r.height}
            for r in facts.rooms.values()
        ],
        "entities": [_entity_fields(facts, entity) for entity in facts.entities.values()],
        "past_entities": [
            {"name": name, "class_name": model, "semantic_class": semantic, "layer": layer.value}
            for name, (model, semantic, layer) in facts.known.items()
            if name not in facts.entities
        ],
        "relations": [
            {"subject": r.subject, "name": r.name, "reference": r.reference, "intervals": [list(i) for i in spans]}
            for r, spans in sorted(facts.recorded, key=lambda item: (item[0].subject, item[0].name, item[0].reference))
        ],
    }
    return json.dumps(graph, allow_nan=False)


def _entity_fields(facts: SceneFacts, entity: Entity) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "name": entity.name,
        "layer": entity.layer.value,
        "class_name": entity.class_name,
        "semantic_class": entity.semantic_class,
        "T_map": entity.T_map.tolist(),
        "extents": entity.extents.tolist(),
        "room": entity.room,
        "parent": entity.parent,
        "T_parent_entity": entity.T_parent_entity.tolist(),
        "carried": entity.carried,
    }
    if entity.layer is not Layer.ROOM:
        shape = facts.body(entity.name).shape
        fields["layout"] = shape.layout
        if shape.interior is not None:
            fields["interior"] = {
                "centre": np.asarray(shape.interior.centre).tolist(),
                "extents": np.asarray(shape.interior.extents).tolist(),
            }
    return fields


def load(path: str | Path) -> SceneFacts:
    """Read a saved graph.

    Raises:
        FileFormatError: the file cannot be read or is not of the schema.
    """
    path = Path(path)
    return parse(read_bounded(path), path)


def parse(text: str, source: str | Path) -> SceneFacts:
    """Build a graph from JSON text; `source` is named in errors.

    Raises:
        FileFormatError: the text is not of the schema, names its field and reason.
    """
    graph = parse_document(_Graph, text, source)
    rooms = [Room(r.name, np.array(r.polygon), r.floor, r.height) for r in graph.rooms]
    entities = {e.name: _entity(e, i, source) for i, e in enumerate(graph.entities)}
    _require_unique([e.name for e in graph.entities] + [e.name for e in graph.past_entities], "entities", source)
    _require_unique([r.name for r in graph.rooms], "rooms", source)
    known = {e.name: (e.class_name, e.semantic_class, e.layer) for e in [*graph.entities, *graph.past_entities]}
    for i, entity in enumerate(graph.entities):
        for place, name in (("parent", entity.parent), ("room", entity.room)):
            if name and name not in entities:
                raise FileFormatError(source, f"entities.{i}.{place}", f"{name!r} is no entity")
    intervals = {}
    for i, relation in enumerate(graph.relations):
        for place, name in (("subject", relation.subject), ("reference", relation.reference)):
            if name not in known:
                raise FileFormatError(source, f"relations.{i}.{place}", f"{name!r} is no entity")
        intervals[Relation(relation.subject, relation.name, relation.reference)] = _intervals(relation, i, source)
    try:
        config = RelationConfig(**graph.config.model_dump())
    except InvalidValueError as error:
        raise FileFormatError(source, "config", str(error)) from None
    return SceneFacts(
        stamp=graph.stamp,
        entities=entities,
        shapes={e.name: _shape(e) for e in graph.entities if e.layer is not Layer.ROOM},
        rooms=rooms,
        history=History(intervals),
        config=config,
        parents=graph.taxonomy,
        models=graph.models,
        known=known,
    )


def _entity(entity: _Entity, index: int, source: str | Path) -> Entity:
    poses: dict[str, Float64] = {"T_map": np.array(entity.T_map), "T_parent_entity": np.array(entity.T_parent_entity)}
    for name, pose in poses.items():
        if not is_rigid(pose, tolerance=1e-4):
            raise FileFormatError(source, f"entities.{index}.{name}", "is no rigid transform")
    return Entity(
        name=entity.name,
        layer=entity.layer,
        class_name=entity.class_name,
        semantic_class=entity.semantic_class,
        extents=np.array(entity.extents),
        room=entity.room,
        parent=entity.parent,
        carried=entity.carried,
        **poses,
    )


def _shape(entity: _Entity) -> Shape:
    hollow = entity.interior
    interior = Interior(np.array(hollow.centre), np.array(hollow.extents)) if hollow else None
    return box_shape(np.array(entity.extents), interior=interior, layout=entity.layout)


def _intervals(relation: _Relation, index: int, source: str | Path) -> list[Interval]:
    spans = [Interval(begin, end) for begin, end in relation.intervals]
    field = f"relations.{index}.intervals"
    for span, following in zip(spans, [*spans[1:], None], strict=True):
        if span.end is not None and span.end <= span.begin:
            raise FileFormatError(source, field, f"ends at {span.end}, not after its begin {span.begin}")
        if following is not None and (span.end is None or following.begin < span.end):
            raise FileFormatError(source, field, "intervals have to be in order and disjoint")
    return spans


def _require_unique(names: Iterable[str], field: str, source: str | Path) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise FileFormatError(source, field, f"the name {name!r} occurs twice")
        seen.add(name)
