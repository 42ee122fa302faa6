import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simtrack.contracts import Relation, StaticMap, Track
from simtrack.errors import FileFormatError, OutputExistsError, QueryError
from simtrack.geometry.transforms import look_at, transform
from simtrack.perception.scene_graph import (
    RELATIONS,
    ModelLike,
    Query,
    SceneFacts,
    SceneGraph,
    load_graph,
    parse_query,
)

TAXONOMY = {
    "tool": ("artifact",),
    "multimeter": ("tool",),
    "container": ("artifact",),
    "component": ("artifact",),
    "table": ("furniture",),
}
VIEWER = look_at(np.array([1.5, 0.0, 1.5]), np.array([0.0, 0.0, 0.8]))


@pytest.fixture
def graph(static_map: StaticMap, models: dict[str, ModelLike], track: Callable[..., Track]) -> SceneGraph:
    graph = SceneGraph(static_map, models, parents=TAXONOMY)
    places = {
        ("multimeter", 1): (0.1, 0.0, 0.825),
        ("relay", 2): (0.1, 0.2, 0.825),
        ("relay", 3): (-0.2, 0.5, 0.835),
        ("tub", 4): (-0.2, 0.5, 0.875),
        ("tray", 5): (0.0, -0.6, 0.815),
    }
    graph.update(1_000_000_000, [track(*key, transform(None, xyz), 1) for key, xyz in places.items()])
    places["relay", 2] = (0.0, -0.6, 0.855)
    del places["tub", 4]
    graph.update(2_000_000_000, [track(*key, transform(None, xyz), 2) for key, xyz in places.items()])
    return graph


def facts(answer: list[Relation]) -> set[tuple[str, str, str]]:
    return {(r.subject, r.name, r.reference) for r in answer}


# ------------------------------------------------------------------------------------------------------------ text form


@pytest.mark.parametrize(
    ("text", "query"),
    [
        ("on workbench", Query("on", "workbench")),
        ("? left-of multimeter", Query("left-of", "multimeter")),
        ("relay ? materialbox", Query(None, "materialbox", "relay")),
        ("relay on", Query("on", None, "relay")),
        ("near", Query("near")),
        ("? in:strict tub-1", Query("in", "tub-1", strict=True)),
        ("left-of:half-space:relaxed x", Query("left-of", "x", strict=False, projection=False)),
        ("on tray @ 12.5", Query("on", "tray", at=12_500_000_000)),
    ],
)
def test_text_forms(text: str, query: Query) -> None:
    assert parse_query(text) == query


@pytest.mark.parametrize(
    ("text", "tells"),
    [
        ("", "left-of"),
        ("workbench", "left-of"),
        ("relay beside workbench", "in-front-of"),
        ("a b c d", r"\[SUBJECT\]"),
        ("on:loosely workbench", "half-space"),
        ("on workbench @ noon", "seconds"),
        ("on workbench @ inf", "seconds"),
        ("on workbench @", "seconds"),
    ],
)
def test_unreadable_texts_say_what_would_have_worked(text: str, tells: str) -> None:
    with pytest.raises(QueryError, match=tells):
        parse_query(text)


# -------------------------------------------------------------------------------------------------------------- queries


def test_names_classes_and_background_classes(graph: SceneGraph) -> None:
    assert facts(graph.ask("on workbench")) == {
        (name, "on", "workbench") for name in ("multimeter-1", "relay-3", "tray-5")
    }
    assert facts(graph.ask("relay on ?")) == {("relay-2", "on", "tray-5"), ("relay-3", "on", "workbench")}
    assert facts(graph.ask("on workbench @ 1.5")) >= {("relay-2", "on", "workbench"), ("tub-4", "on", "workbench")}
    assert facts(graph.ask("? left-of multimeter @ 1")) == {("relay-2", "left-of", "multimeter-1")}
    assert facts(graph.ask("tool on furniture")) == {("multimeter-1", "on", "workbench")}
    on_bench = graph.query(relation="on", reference="workbench", semantic_class="container")
    assert facts(on_bench) == {("tray-5", "on", "workbench")}
    assert graph.query("on", "workbench", semantic_class="component", at=0) == []
    assert facts(graph.ask("multimeter ? tray")) == {("multimeter-1", "left-of", "tray-5")}


@pytest.mark.parametrize(
    ("call", "tells"),
    [
        ({"relation": "beside"}, "left-of"),
        ({"relation": "on", "reference": "mars"}, "workbench"),
        ({"relation": "on", "semantic_class": "planet"}, "tool"),
        ({"relation": "left-of", "strict": True, "at": 5}, "live"),
        ({"relation": "left-of", "viewer": VIEWER, "at": 5}, "live"),
    ],
)
def test_bad_queries_list_what_is_known(graph: SceneGraph, call: dict[str, Any], tells: str) -> None:
    with pytest.raises(QueryError, match=tells):
        graph.query(**call)


def test_all_variants_agree_with_their_margins(graph: SceneGraph) -> None:
    names = [e.name for e in graph.entities.values() if e.name not in graph.rooms]
    for name in ("above", "left-of", "in-front-of", "in"):
        for strict in (False, True):
            for projection in (False, True):
                for viewer in (None, VIEWER):
                    answer = graph.query(name, strict=strict, projection=projection, viewer=viewer)
                    options: dict[str, Any] = {"strict": strict, "projection": projection, "viewer": viewer}
                    expected = {
                        (a, name, b)
                        for a in names
                        for b in names
                        if a != b and graph.margin(a, name, b, **options) >= 0
                    }
                    assert facts([r for r in answer if r.reference not in graph.rooms]) == expected


def test_seen_from_the_other_side_of_the_bench(graph: SceneGraph) -> None:
    assert facts(graph.query("left-of", "multimeter", "relay-3", projection=False)) == {
        ("relay-3", "left-of", "multimeter-1")
    }
    assert graph.query("left-of", "multimeter", "relay-3", projection=False, viewer=VIEWER) == []


# ----------------------------------------------------------------------------------------------------------------- JSON


def test_a_loaded_graph_answers_the_same(graph: SceneGraph, tmp_path: Path) -> None:
    path = tmp_path / "graph.json"
    path.write_text(graph.to_json())
    loaded = load_graph(path)
    assert loaded.to_json() == graph.to_json()
    assert loaded.relations == graph.relations
    for relation in RELATIONS:
        for at in (None, 0, 1_000_000_000, 1_999_999_999, 2_000_000_000):
            assert loaded.query(relation, at=at) == graph.query(relation, at=at)
        for strict in (False, True):
            for projection in (False, True):
                for viewer in (None, VIEWER):
                    options: dict[str, Any] = {"strict": strict, "projection": projection, "viewer": viewer}
                    assert loaded.query(relation, **options) == graph.query(relation, **options)
    for text in ("on workbench", "relay ? ?", "tool on furniture", "in lab", "? ? tub-4 @ 1.2"):
        assert loaded.ask(text) == graph.ask(text)
    assert loaded.history("tub-4", "on", "workbench") == ((1_000_000_000, 2_000_000_000),)
    query = "SELECT ?x ?y WHERE { ?x :on ?y . ?x a :Artifact } ORDER BY ?x"
    assert loaded.sparql(query) == graph.sparql(query)
    assert loaded.distance("relay-3", "tray-5").signed == graph.distance("relay-3", "tray-5").signed


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda g: g.update(version=2), "version"),
        (lambda g: g.pop("relations"), "relations"),
        (lambda g: g["entities"][0].update(extents=[1, 1, 0]), "entities.0.extents"),
        (lambda g: g["entities"][0]["T_map"][0].__setitem__(0, 2.0), "entities.0.T_map"),
        (lambda g: g["entities"][0].update(parent="mars"), "entities.0.parent"),
        (lambda g: g["entities"].append(g["entities"][0]), "entities"),
        (lambda g: g["relations"][0].update(name="beside"), "relations.0.name"),
        (lambda g: g["relations"][0].update(subject="mars"), "relations.0.subject"),
        (lambda g: g["relations"][0].update(intervals=[[5, 5]]), "relations.0.intervals"),
        (lambda g: g["relations"][0].update(intervals=[[5, None], [7, 8]]), "relations.0.intervals"),
        (lambda g: g["relations"][0].update(intervals=[]), "relations.0.intervals"),
        (lambda g: g["config"].update(near_range=-1.0), "config"),
        (lambda g: g.update(surprise=1), "surprise"),
    ],
)
def test_broken_files_are_told_by_file_field_and_reason(
    graph: SceneGraph, change: Callable[[dict[str, Any]], Any], field: str
) -> None:
    data = json.loads(graph.to_json())
    change(data)
    with pytest.raises(FileFormatError) as caught:
        SceneFacts.from_json(json.dumps(data), "run/graph.json")
    assert caught.value.field.startswith(field)
    assert "run/graph.json" in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"format": 1e999}', b"\xff\xfe"])
def test_files_that_are_no_graph_at_all(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "graph.json"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"graph\.json"):
        load_graph(path)
    with pytest.raises(FileFormatError, match="missing"):
        load_graph(tmp_path / "missing.json")


# --------------------------------------------------------------------------------------------------------------- SPARQL


def rows(answer: object, *names: str) -> set[tuple[Any, ...]]:
    assert isinstance(answer, list)
    return {tuple(row[name] for name in names) for row in answer}


def test_sparql_and_typed_queries_agree(graph: SceneGraph) -> None:
    for name in RELATIONS:
        answer = graph.sparql(f"SELECT ?a ?b WHERE {{ ?a :{name} ?b }}")
        assert rows(answer, "a", "b") == {(r.subject, r.reference) for r in graph.query(name)}
    tools = graph.sparql("SELECT ?x WHERE { ?x :on :workbench . ?x a :Tool }")
    assert rows(tools, "x") == {(r.subject,) for r in graph.query("on", "workbench", semantic_class="tool")}
    assert graph.sparql("ASK { :Multimeter rdfs:subClassOf :Artifact }") is True
    assert rows(graph.sparql("SELECT ?p WHERE { :relay-2 :parent ?p }"), "p") == {("tray-5",)}


def test_sparql_knows_when_relations_held(graph: SceneGraph) -> None:
    answer = graph.sparql(
        """SELECT ?x ?begin ?end WHERE {
             ?i a :Interval ; :subject ?x ; :relation :on ; :reference :workbench ; :begin ?begin
             OPTIONAL { ?i :end ?end } }"""
    )
    expected = {
        (relation.subject, span.begin, span.end)
        for relation, spans in graph.recorded
        for span in spans
        if relation.name == "on" and relation.reference == "workbench"
    }
    assert rows(answer, "x", "begin", "end") == expected
    assert graph.sparql("ASK { :tub-4 :exists false }") is True


def test_the_store_follows_the_graph(graph: SceneGraph, track: Callable[..., Track], tmp_path: Path) -> None:
    graph.open_store(tmp_path / "store")
    everything = "SELECT ?a ?b WHERE { ?a :near ?b }"
    assert rows(graph.sparql(everything), "a", "b") == {(r.subject, r.reference) for r in graph.query("near")}
    rng = np.random.default_rng(0)
    for stamp in range(3_000_000_000, 3_000_000_006):
        tracks = [
            track("relay", n, transform(None, rng.uniform(0, 1, 3)), stamp) for n in rng.choice(9, 6, replace=False)
        ]
        graph.update(stamp, tracks)
        assert rows(graph.sparql(everything), "a", "b") == {(r.subject, r.reference) for r in graph.query("near")}
        current = rows(graph.sparql("SELECT ?a WHERE { ?a :exists true }"), "a")
        assert current == {(name,) for name in graph.entities}
    fresh = SceneFacts.from_json(graph.to_json())
    count = "SELECT (COUNT(*) AS ?n) WHERE { ?s ?p ?o }"
    assert fresh.sparql(count) == graph.sparql(count)


def test_sparql_refuses_what_is_no_query_of_this_graph(graph: SceneGraph, tmp_path: Path) -> None:
    for text in ("SELECT nonsense", "INSERT DATA { :a :b :c }", "SELECT * { SERVICE <http://localhost> { ?s ?p ?o } }"):
        with pytest.raises(QueryError):
            graph.sparql(text)
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(OutputExistsError):
        graph.open_store(tmp_path)
