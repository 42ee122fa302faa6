import json
from pathlib import Path

import numpy as np
import pytest

from simtrack.errors import FileFormatError
from simtrack.perception.scene_graph.contact import ContactGraph
from simtrack.perception.scene_graph.contact.export import edges_of, to_graphml, to_rdf, to_spark_dsg
from simtrack.perception.scene_graph.contact.serialization import (
    dump_contact_graph,
    load_contact_graph,
    parse_contact_graph,
)


def test_json_round_trips(graph: ContactGraph, tmp_path: Path) -> None:
    text = dump_contact_graph(graph)
    (tmp_path / "graph.json").write_text(text)
    loaded = load_contact_graph(tmp_path / "graph.json")
    assert dump_contact_graph(loaded) == text
    assert loaded.children("table") == graph.children("table")


def cycle(data: dict) -> None:
    next(s for s in data["supports"] if s["child"] == "table")["parent"] = "cup"
    next(s for s in data["supports"] if s["child"] == "table")["plane"] = 0


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda d: d["supports"].pop(), "none for the node"),
        (lambda d: d["supports"][3].update(parent="nowhere"), "'nowhere' is no node"),
        (lambda d: d["supports"][3].update(plane=99), "none of the parent's"),
        (cycle, "a cycle"),
        (lambda d: d["nodes"].append(d["nodes"][0]), "occurs twice"),
        (lambda d: d["nodes"][0].update(extents=[1, 1, -1]), "greater than 0"),
        (lambda d: d["nodes"][0].update(colour="red"), "not permitted"),
        (lambda d: d["proximal"][0].update(first="nowhere"), "is no node"),
        (lambda d: d.update(version=2), "Input should be 1"),
    ],
)
def test_files_that_are_no_graph_are_refused(graph: ContactGraph, spoil, reason: str) -> None:
    data = json.loads(dump_contact_graph(graph))
    spoil(data)
    with pytest.raises(FileFormatError, match=reason):
        parse_contact_graph(json.dumps(data), "graph.json")


def test_a_missing_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="cannot be read"):
        load_contact_graph(tmp_path / "none.json")


def test_graphml_has_every_node_and_edge(graph: ContactGraph) -> None:
    import networkx as nx

    read = nx.parse_graphml(to_graphml(graph))
    assert set(read) == {"scene", *graph.nodes}
    assert read.number_of_edges() == len(list(edges_of(graph)))
    relations = {(a, b): d["relation"] for a, b, d in read.edges(data=True)}
    assert relations["table", "cup"] == "supports"
    assert relations["board", "wall"] in ("leans-on", "proximal")


@pytest.mark.parametrize("syntax", ["nt", "ttl"])
def test_rdf_answers_questions(graph: ContactGraph, syntax: str) -> None:
    import pyoxigraph as ox

    from simtrack.perception.scene_graph.sparql import PREFIXES

    store = ox.Store()
    store.load(to_rdf(graph, syntax).encode(), format=ox.RdfFormat.from_extension(syntax))

    def ask(text: str) -> bool:
        return bool(store.query(text, prefixes=PREFIXES))

    assert ask("ASK { :egg-cup :in :bowl . :bowl :on :table . :table a :Table }")
    assert ask("ASK { :egg-cup :parent+ :floor }")
    assert ask("ASK { :picture :hangs-on :wall . :board :leans-on :wall }")
    assert not ask("ASK { :cup :on :floor }")


def test_spark_dsg_loads_it(graph: ContactGraph, tmp_path: Path) -> None:
    dsg = pytest.importorskip("spark_dsg", reason="spark-dsg is not installed")
    path = tmp_path / "dsg.json"
    path.write_text(to_spark_dsg(graph))
    read = dsg.DynamicSceneGraph.load(str(path))
    assert read.num_nodes() == len(graph.nodes) + 1
    for i, (name, node) in enumerate(graph.nodes.items()):
        found = read.get_node(dsg.NodeSymbol("O", i).value)
        assert found.attributes.name == name
        np.testing.assert_allclose(found.attributes.bounding_box.dimensions, node.box.extents, rtol=1e-5)
        np.testing.assert_allclose(found.attributes.position, node.box.T_map_box[:3, 3], atol=1e-9)
    names = list(graph.nodes)
    table, cup = (dsg.NodeSymbol("O", names.index(name)).value for name in ("table", "cup"))
    assert read.has_edge(table, cup)
    (relation,) = read.get_edge(table, cup).info.metadata.get()["relations"]
    assert (relation["source"], relation["target"], relation["relation"]) == ("table", "cup", "supports")
