"""What a scene graph knows: entities, relations, their history; and the ways to ask it."""

from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from simtrack.contracts import Float64, Relation, Room
from simtrack.errors import QueryError, UnknownNameError
from simtrack.geometry.boxes import BoxProximity, OrientedBox, proximity
from simtrack.perception.scene_graph import kernels
from simtrack.perception.scene_graph.bodies import Body, BodyArrays
from simtrack.perception.scene_graph.history import History, Interval
from simtrack.perception.scene_graph.query import Query, parse_query
from simtrack.perception.scene_graph.relations import DIRECTIONS, RELATIONS, RelationConfig, relation_margin
from simtrack.perception.scene_graph.rooms import room_margins
from simtrack.perception.scene_graph.shapes import Shape

if TYPE_CHECKING:
    from simtrack.perception.scene_graph.sparql import SparqlResult, TripleStore


class Layer(StrEnum):
    """Layers of the graph, from the top."""

    ROOM = "room"
    STATIC = "static"
    """A labelled piece of the static map."""
    OBJECT = "object"
    """A believed track."""


@dataclass(frozen=True, slots=True)
class Entity:
    """A node of the scene graph."""

    name: str
    """Unique: ``relay-3``, ``workbench``, ``lab``."""
    layer: Layer
    class_name: str
    """Name of the model (``relay``) of an object, semantic class of anything else."""
    semantic_class: str
    """Class in the taxonomy (``tool``, ``table``, ``room``)."""
    T_map: Float64
    """(4, 4), map <- entity, origin in the centre of the box, z up."""
    extents: Float64
    """(3,), full side lengths of the box, metres."""
    room: str
    """Room in which its centre lies, or empty."""
    parent: str
    """What it stands on or in; the room if on nothing known; empty at the root."""
    T_parent_entity: Float64
    """(4, 4), parent <- entity; equals `T_map` at the root."""
    carried: bool = False
    """The pose follows from the supporter's motion since the object itself was last seen."""

    @property
    def box(self) -> OrientedBox:
        """Oriented box in the map."""
        return OrientedBox(self.T_map, self.extents)


class SceneFacts:
    """Entities, relations, history, to be asked; `SceneGraph` keeps them up to date, `load_graph` reads them back."""

    def __init__(
        self,
        *,
        stamp: int,
        entities: Mapping[str, Entity],
        shapes: Mapping[str, Shape],
        rooms: Iterable[Room],
        history: History,
        config: RelationConfig,
        parents: Mapping[str, Sequence[str]],
        models: Mapping[str, str],
        known: Mapping[str, tuple[str, str, Layer]] | None = None,
    ) -> None:
        self.stamp = stamp
        """Nanoseconds, of the last update."""
        self.rooms = {room.name: room for room in rooms}
        self.recorded = history
        """All intervals and events."""
        self.relation_config = config
        self.parents = {name: tuple(above) for name, above in parents.items()}
        """Taxonomy: semantic class -> its direct superclasses."""
        self.models = dict(models)
        """Object models that there can be instances of: name -> semantic class."""
        self.known = dict(known or {})
        """All entities that ever were: name -> (class name, semantic class, layer)."""
        self._entities = dict(entities)
        self._shapes = dict(shapes)
        self._store: TripleStore | None = None
        for entity in entities.values():
            self.known[entity.name] = (entity.class_name, entity.semantic_class, entity.layer)

    # ------------------------------------------------------------------------------------------------------- entities

    @property
    def entities(self) -> Mapping[str, Entity]:
        """Entities that exist now, by name."""
        return self._entities

    def entity(self, name: str) -> Entity:
        """One entity.

        Raises:
            UnknownNameError: it does not exist now.
        """
        try:
            return self.entities[name]
        except KeyError:
            raise UnknownNameError("entity", name, self.entities) from None

    def children(self, name: str) -> tuple[Entity, ...]:
        """What stands on or in an entity, directly."""
        self.entity(name)
        return tuple(entity for entity in self.entities.values() if entity.parent == name)

    def body(self, name: str) -> Body:
        """Shape and pose of a static entity or an object."""
        entity = self.entity(name)
        if entity.layer is Layer.ROOM:
            bodies = [e.name for e in self.entities.values() if e.layer is not Layer.ROOM]
            raise UnknownNameError("body", name, bodies)
        return Body(self._shape(name), entity.T_map)

    def _shape(self, name: str) -> Shape:
        return self._shapes[name]

    def ancestors(self, semantic_class: str) -> tuple[str, ...]:
        """A semantic class and all its superclasses, nearer before farther ones."""
        found = [semantic_class]
        for known in found:
            found.extend(above for above in self.parents.get(known, ()) if above not in found)
        return tuple(found)

    # ------------------------------------------------------------------------------------------------------ relations

    @property
    def relations(self) -> Set[Relation]:
        """Relations that hold now (live variants); stays as it is when the graph goes on."""
        return self.recorded.current

    def at(self, stamp: int) -> frozenset[Relation]:
        """Relations that held at `stamp`, nanoseconds (live variants)."""
        return self.recorded.at(stamp)

    def history(self, subject: str, relation: str, reference: str) -> tuple[Interval, ...]:
        """Intervals during which a relation between two named entities held, earliest first."""
        self._require_relation(relation)
        for name in (subject, reference):
            if name not in self.known:
                raise self._unknown(name)
        return self.recorded.intervals(Relation(subject, relation, reference))

    def distance(self, a: str, b: str, measure: Callable[[Entity, Entity], BoxProximity] | None = None) -> BoxProximity:
        """Shortest and longest distance of two entities, with the points where they are attained.

        Exact for their boxes; `measure` puts in another distance, e.g. one of meshes.
        """
        first, second = self.entity(a), self.entity(b)
        return proximity(first.box, second.box) if measure is None else measure(first, second)

    def margin(
        self,
        subject: str,
        relation: str,
        reference: str,
        *,
        strict: bool | None = None,
        projection: bool | None = None,
        viewer: Float64 | None = None,
    ) -> float:
        """Signed distance in metres of a pair from the boundary of a relation, >= 0 where it holds, at current poses.

        See `relations.relation_margin`; for a room as reference, the distance from its outline.
        """
        self._require_relation(relation)
        if reference in self.rooms and self.entity(reference).layer is Layer.ROOM:
            centre = self.entity(subject).T_map[None, :3, 3]
            return float(room_margins(centre, self.rooms[reference])[0]) if relation == "in" else -np.inf
        return relation_margin(
            self.body(subject),
            relation,
            self.body(reference),
            self.relation_config,
            strict=strict,
            projection=projection,
            viewer=viewer,
        )

    # -------------------------------------------------------------------------------------------------------- queries

    def query(
        self,
        relation: str | None = None,
        reference: str | None = None,
        subject: str | None = None,
        *,
        semantic_class: str | None = None,
        strict: bool | None = None,
        projection: bool | None = None,
        viewer: Float64 | None = None,
        at: int | None = None,
    ) -> list[Relation]:
        """Relations that match, sorted by subject, name and reference.

        Args:
            relation: one of `relations.RELATIONS`; None for any.
            reference: name of an entity, of a model (``relay``) or of a semantic class (``tool``: any instance).
            subject: likewise.
            semantic_class: keep subjects of this class or a class below it.
            strict: variant of directions and `in`; None for the live one.
            projection: variant of directions; None for the live one.
            viewer: (4, 4) T_map_camera of who looks: directions are seen from there instead of from the reference.
            at: nanoseconds, to ask the history; live variants only.

        Raises:
            QueryError: unknown relation, entity or class (the message lists the known), or a variant not recorded.
        """
        if relation is not None:
            self._require_relation(relation)
        subjects, references = self._select(subject), self._select(reference)
        if semantic_class is not None:
            of_class = self._of_semantic_class(semantic_class)
            if not of_class and semantic_class not in self._class_names():
                raise self._unknown(semantic_class)
            subjects = of_class if subjects is None else subjects & of_class
        names = set(RELATIONS) if relation is None else {relation}
        derived = {name for name in names if self._is_derived(name, strict, projection, viewer)}
        if derived and at is not None:
            raise QueryError(
                "only the live variants are recorded "
                f"(strict={self.relation_config.strict}, projection={self.relation_config.projection}, no viewer); "
                "leave out 'at' or the variant"
            )
        facts = self.relations if at is None else self.at(at)
        found = {
            fact
            for fact in facts
            if fact.name in names - derived
            and (subjects is None or fact.subject in subjects)
            and (references is None or fact.reference in references)
        }
        if derived:
            found |= self._derive(derived, subjects, references, strict, projection, viewer)
        return sorted(found, key=lambda fact: (fact.subject, fact.name, fact.reference))

    def ask(self, query: str | Query) -> list[Relation]:
        """Answer the text form of a query (see `query.parse_query`)."""
        parsed = parse_query(query) if isinstance(query, str) else query
        return self.query(
            parsed.relation,
            parsed.reference,
            parsed.subject,
            strict=parsed.strict,
            projection=parsed.projection,
            at=parsed.at,
        )

    def sparql(self, text: str) -> "SparqlResult":
        """Answer a SPARQL 1.1 query over current facts, history and background classes (see `sparql`).

        Raises:
            QueryError: the text is no valid SPARQL query.
        """
        if self._store is None:
            self.open_store()
        assert self._store is not None
        self._store.synchronise(self)
        return self._store.query(text)

    def open_store(self, path: str | Path | None = None) -> None:
        """Keep the triples on disk, in a new folder `path`, instead of in memory."""
        from simtrack.perception.scene_graph.sparql import TripleStore

        self._store = TripleStore(path)

    def to_json(self) -> str:
        """The graph in the documented, versioned JSON schema (see `serialization`)."""
        from simtrack.perception.scene_graph.serialization import dump

        return dump(self)

    @staticmethod
    def from_json(text: str, source: str | Path = "graph.json") -> "SceneFacts":
        """Read back what `to_json` wrote; `source` is named in errors.

        Raises:
            FileFormatError: not of the schema.
        """
        from simtrack.perception.scene_graph.serialization import parse

        return parse(text, source)

    # ------------------------------------------------------------------------------------------------------ internals

    def _bodies(self) -> tuple[BodyArrays, dict[str, int]]:
        """All bodies as arrays, and their slots by name."""
        arrays = BodyArrays({name: self._shape(name) for name in self._shapes}, self.relation_config)
        slots = {e.name: arrays.add(e.name, e.T_map) for e in self.entities.values() if e.layer is not Layer.ROOM}
        return arrays, slots

    def _is_derived(self, name: str, strict: bool | None, projection: bool | None, viewer: Float64 | None) -> bool:
        """Whether a variant is not the live one and has to be computed from the poses."""
        other_strict = strict is not None and strict != self.relation_config.strict
        other_projection = projection is not None and projection != self.relation_config.projection
        if name == "in":
            return other_strict
        return name in DIRECTIONS and (other_strict or other_projection or viewer is not None)

    def _derive(
        self,
        names: set[str],
        subjects: set[str] | None,
        references: set[str] | None,
        strict: bool | None,
        projection: bool | None,
        viewer: Float64 | None,
    ) -> set[Relation]:
        arrays, slots = self._bodies()
        left = [name for name in slots if subjects is None or name in subjects]
        right = [name for name in slots if references is None or name in references]
        pairs = [(a, b) for a in left for b in right if a != b]
        found: set[Relation] = set()
        if viewer is not None:
            bodies = {name: self.body(name) for name in {*left, *right}}
            options: dict[str, Any] = {"strict": strict, "projection": projection, "viewer": viewer}
            found |= {
                Relation(a, name, b)
                for name in names & set(DIRECTIONS)
                for a, b in pairs
                if relation_margin(bodies[a], name, bodies[b], self.relation_config, **options) >= 0.0
            }
            names = names - set(DIRECTIONS)
        if pairs and names:
            indices = np.array([(slots[a], slots[b]) for a, b in pairs])
            parameters = self.relation_config.parameters(strict=strict, projection=projection)
            holds = kernels.margin_table(arrays.world, indices, parameters) >= 0.0
            for name in names:
                rows = np.nonzero(holds[:, RELATIONS.index(name)])[0]
                found |= {Relation(pairs[row][0], name, pairs[row][1]) for row in rows}
        if "in" in names:
            found |= {
                fact
                for fact in self.relations
                if fact.name == "in"
                and fact.reference in self.rooms
                and (subjects is None or fact.subject in subjects)
                and (references is None or fact.reference in references)
            }
        return found

    def _select(self, token: str | None) -> set[str] | None:
        """Names that a token stands for: an entity, all of a model, or all of a semantic class; None for anything."""
        if token is None or token == "?":
            return None
        if token in self.known:
            return {token}
        found = {name for name, (model, _, _) in self.known.items() if model == token}
        found = found or self._of_semantic_class(token)
        if not found and token not in self._class_names():
            raise self._unknown(token)
        return found

    def _of_semantic_class(self, semantic_class: str) -> set[str]:
        return {name for name, (_, own, _) in self.known.items() if semantic_class in self.ancestors(own)}

    def _class_names(self) -> set[str]:
        known = {model for model, _, _ in self.known.values()} | {own for _, own, _ in self.known.values()}
        known |= {*self.models, *self.models.values()}
        return known.union(self.parents, *self.parents.values())

    def _require_relation(self, name: str) -> None:
        if name not in RELATIONS:
            raise QueryError(f"unknown relation {name!r}. Relations: {', '.join(RELATIONS)}")

    def _unknown(self, token: str) -> QueryError:
        return QueryError(
            f"unknown entity or class {token!r}. Entities: {', '.join(sorted(self.known)) or '(none)'}. "
            f"Classes: {', '.join(sorted(self._class_names())) or '(none)'}. Relations: {', '.join(RELATIONS)}"
        )


def load_graph(path: str | Path) -> SceneFacts:
    """Read a saved graph, e.g. a run's ``graph.json``.

    Raises:
        FileFormatError: it cannot be read or is not of the schema.
    """
    from simtrack.perception.scene_graph.serialization import load

    return load(path)
