"""The facts of a scene graph as RDF, to be asked in SPARQL (pyoxigraph).

Entities, relations and classes live in one namespace, bound to the empty prefix: ``:relay-3 :on :workbench``,
``:relay-3 a :Relay, :Tool``. Class names are in CamelCase; the closure of ``rdfs:subClassOf`` is materialised. When a
relation held stands in reified form: an ``:Interval`` with ``:subject``, ``:relation``, ``:reference``, ``:begin`` and,
once it has ended, ``:end`` (nanoseconds). Prefixes ``:``, ``rdf``, ``rdfs`` and ``xsd`` need no declaration.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias
from urllib.parse import quote, unquote

import pyoxigraph as ox

from simtrack.contracts import Relation
from simtrack.errors import OutputExistsError, QueryError
from simtrack.perception.scene_graph.relations import RELATIONS

if TYPE_CHECKING:
    from simtrack.perception.scene_graph.facts import SceneFacts

NAMESPACE = "urn:simtrack:"
_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
_RDFS = "http://www.w3.org/2000/01/rdf-schema#"
_XSD = "http://www.w3.org/2001/XMLSchema#"
PREFIXES = {"": NAMESPACE, "rdf": _RDF, "rdfs": _RDFS, "xsd": _XSD}
_TYPE, _SUBCLASS = ox.NamedNode(f"{_RDF}type"), ox.NamedNode(f"{_RDFS}subClassOf")
_INTEGER, _DECIMALS = f"{_XSD}integer", {f"{_XSD}decimal", f"{_XSD}double", f"{_XSD}float"}

Value: TypeAlias = str | int | float | bool | None
"""An entity, relation or class without its namespace, a literal, or None where a variable is unbound."""
SparqlResult: TypeAlias = list[dict[str, Value]] | bool | list[tuple[Value, Value, Value]]
"""Rows of a SELECT, the answer of an ASK, the triples of a CONSTRUCT or DESCRIBE."""


def class_iri(name: str) -> str:
    """Local name of a class: ``hand tool`` or ``hand-tool`` -> ``HandTool``."""
    return "".join(part[:1].upper() + part[1:] for part in re.split(r"[^0-9A-Za-z]+", name) if part)


class TripleStore:
    """The triples of one graph; `synchronise` adds and removes only what changed since the last time.

    Args:
        path: folder for a store on disk, new or empty; None keeps the triples in memory.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        if path is not None and Path(path).exists() and any(Path(path).iterdir()):
            raise OutputExistsError(path)
        self._store = ox.Store() if path is None else ox.Store(str(path))
        self._cursor = 0
        self._entities: dict[str, str | None] = {}
        self._open: dict[Relation, ox.NamedNode] = {}
        self._intervals = 0
        self._taxonomy_written = False

    def __len__(self) -> int:
        return len(self._store)

    def synchronise(self, facts: "SceneFacts") -> None:
        """Bring the triples up to date with the graph."""
        if not self._taxonomy_written:
            self._store.extend(_taxonomy(facts))
            self._taxonomy_written = True
        self._update_entities(facts)
        events = facts.recorded.events
        for event in events[self._cursor :]:
            if event.begins:
                self._begin(event.stamp, event.relation)
            else:
                self._end(event.stamp, event.relation)
        self._cursor = len(events)

    def _update_entities(self, facts: "SceneFacts") -> None:
        entities = facts.entities
        for name in facts.known:
            state = entities[name].parent if name in entities else None
            if name in self._entities and self._entities[name] == state:
                continue
            old = frozenset() if name not in self._entities else _entity_quads(facts, name, self._entities[name])
            new = _entity_quads(facts, name, state)
            for quad in old - new:
                self._store.remove(quad)
            self._store.extend(new - old)
            self._entities[name] = state

    def _begin(self, stamp: int, relation: Relation) -> None:
        node = entity_iri(f"interval/{self._intervals}")
        self._intervals += 1
        self._open[relation] = node
        subject, name, reference = (
            entity_iri(relation.subject),
            entity_iri(relation.name),
            entity_iri(relation.reference),
        )
        self._store.extend(
            [
                ox.Quad(subject, name, reference),
                ox.Quad(node, _TYPE, entity_iri("Interval")),
                ox.Quad(node, entity_iri("subject"), subject),
                ox.Quad(node, entity_iri("relation"), name),
                ox.Quad(node, entity_iri("reference"), reference),
                ox.Quad(node, entity_iri("begin"), ox.Literal(stamp)),
            ]
        )

    def _end(self, stamp: int, relation: Relation) -> None:
        node = self._open.pop(relation)
        self._store.add(ox.Quad(node, entity_iri("end"), ox.Literal(stamp)))
        self._store.remove(
            ox.Quad(entity_iri(relation.subject), entity_iri(relation.name), entity_iri(relation.reference))
        )

    def query(self, text: str) -> SparqlResult:
        """Answer a SPARQL 1.1 query. SERVICE is refused: a query reads this store and nothing else.

        Raises:
            QueryError: no valid query, or one that asks a remote service.
        """
        if re.search(r"\bSERVICE\b", re.sub(r'"[^"\n]*"|<[^>\s]*>|#[^\n]*', " ", text), re.IGNORECASE):
            raise QueryError("SERVICE is not supported: queries see the scene graph only")
        try:
            answer = self._store.query(text, prefixes=PREFIXES)
            if isinstance(answer, ox.QueryBoolean):
                return bool(answer)
            if isinstance(answer, ox.QuerySolutions):
                names = [variable.value for variable in answer.variables]
                return [{name: _value(row[name]) for name in names} for row in answer]
            return [(_value(t.subject), _value(t.predicate), _value(t.object)) for t in answer]
        except (SyntaxError, ValueError, OSError) as error:
            prefixes = ", ".join(f"{prefix}: <{iri}>" for prefix, iri in PREFIXES.items())
            raise QueryError(f"SPARQL: {error}. Prefixes: {prefixes}. Relations: {', '.join(RELATIONS)}") from None


def entity_iri(name: str) -> ox.NamedNode:
    """Node of an entity, relation or class of this name."""
    return ox.NamedNode(NAMESPACE + quote(name, safe="/-_.~"))


def _taxonomy(facts: "SceneFacts") -> Iterable[ox.Quad]:
    """Every class below all of its superclasses."""
    classes = {*facts.parents, *facts.models.values(), *(semantic for _, semantic, _ in facts.known.values())}
    pairs = [(name, above) for name in sorted(classes) for above in facts.ancestors(name)[1:]]
    pairs += [(model, above) for model, own in facts.models.items() for above in facts.ancestors(own)]
    return [
        ox.Quad(entity_iri(class_iri(low)), _SUBCLASS, entity_iri(class_iri(high)))
        for low, high in pairs
        if class_iri(low) != class_iri(high)
    ]


def _entity_quads(facts: "SceneFacts", name: str, parent: str | None) -> frozenset[ox.Quad]:
    """Types, name and layer of an entity and what it stands on or in; `parent` is None if it does not exist now."""
    node = entity_iri(name)
    class_name, semantic_class, layer = facts.known[name]
    quads = {ox.Quad(node, _TYPE, entity_iri(class_iri(c))) for c in (class_name, *facts.ancestors(semantic_class))}
    quads.add(ox.Quad(node, entity_iri("name"), ox.Literal(name)))
    quads.add(ox.Quad(node, entity_iri("layer"), ox.Literal(layer.value)))
    quads.add(ox.Quad(node, entity_iri("exists"), ox.Literal(parent is not None)))
    if parent:
        quads.add(ox.Quad(node, entity_iri("parent"), entity_iri(parent)))
    return frozenset(quads)


def _value(term: object) -> Value:
    if term is None:
        return None
    if isinstance(term, ox.NamedNode):
        return unquote(term.value.removeprefix(NAMESPACE))
    if isinstance(term, ox.Literal):
        datatype = term.datatype.value
        if datatype == _INTEGER:
            return int(term.value)
        if datatype in _DECIMALS:
            return float(term.value)
        if datatype == f"{_XSD}boolean":
            return term.value == "true"
        return term.value
    return str(term)
