"""One contact graph of mapped entities and tracked objects, kept up to date while the objects move.

contacts = TrackedContacts(models, np.random.default_rng(0))
for node in mapped:
    contacts.put(node)  # what was reconstructed of the world
for frame in feed:
    scene_graph.update(frame.stamp, tracks)
    contacts.update(scene_graph)
    graph = contacts.graph()
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.meshes import Mesh, box_mesh
from simtrack.geometry.transforms import angle_between, inverse
from simtrack.perception.scene_graph.contact.builder import ContactGraphBuilder
from simtrack.perception.scene_graph.contact.evidence import ContactConfig
from simtrack.perception.scene_graph.contact.graph import ContactGraph
from simtrack.perception.scene_graph.contact.nodes import (
    EntityNode,
    EntityShape,
    NodeConfig,
    entity_node,
    entity_shape,
)
from simtrack.perception.scene_graph.facts import Entity, Layer, SceneFacts
from simtrack.perception.scene_graph.shapes import ModelLike


@dataclass(frozen=True, slots=True)
class TrackedContactsConfig:
    """Settings of `TrackedContacts`."""

    contact: ContactConfig = field(default_factory=ContactConfig)
    nodes: NodeConfig = field(default_factory=NodeConfig)
    move_translation: float = 0.001
    """Metres: smaller motions of a track since it last entered the graph are the jitter of its estimate."""
    move_rotation: float = float(np.radians(0.3))
    """Radians, likewise."""

    def __post_init__(self) -> None:
        for name in ("move_translation", "move_rotation"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"TrackedContactsConfig.{name}", getattr(self, name), "a finite number >= 0")


class TrackedContacts:
    """A contact graph that follows the objects of a scene graph.

    What stands on an object that moves comes along: other tracked objects until they are seen elsewhere (the scene
    graph carries those), entities that nobody tracks as long as they stay in the graph.

    Args:
        models: object models by name, as `Track.class_name` gives it; those with a `mesh` have their shape from it.
        rng: of the search for planes.
        config: thresholds.
    """

    def __init__(
        self,
        models: Mapping[str, ModelLike],
        rng: np.random.Generator,
        config: TrackedContactsConfig | None = None,
    ) -> None:
        self.config = config or TrackedContactsConfig()
        self._models, self._rng = models, rng
        self._shapes: dict[str, EntityShape] = {}
        self._builder = ContactGraphBuilder(self.config.contact)
        self._tracked: set[str] = set()

    def put(self, node: EntityNode) -> None:
        """Add an entity that nobody tracks, or replace the one of its name.

        Raises:
            InvalidValueError: the name is that of a tracked object, or the node has no mesh.
        """
        if node.name in self._tracked:
            raise InvalidValueError("node.name", node.name, "a name that no tracked object has")
        self._builder.put(node)

    def remove(self, name: str) -> None:
        """Take an entity away; what it supported stays where it is.

        Raises:
            UnknownNameError: no such entity.
        """
        self._builder.remove(name)
        self._tracked.discard(name)

    def graph(self) -> ContactGraph:
        """The graph as of the last update."""
        return self._builder.graph()

    def update(self, facts: SceneFacts) -> frozenset[str]:
        """Follow the objects of a scene graph: new ones enter, gone ones leave, moved ones move with their load.

        Returns:
            Names of the entities that entered or moved.

        Raises:
            UnknownNameError: an object's class is none of the models.
            InvalidValueError: an object has the name of another entity.
        """
        objects = {e.name: e for e in facts.entities.values() if e.layer is Layer.OBJECT}
        for name in self._tracked - objects.keys():
            self._builder.remove(name)
        self._tracked &= objects.keys()
        moved = self._moved(objects)
        graph = self._builder.graph() if moved else None
        for name, T_map_entity in moved.items():
            assert graph is not None
            self._builder.put(graph.nodes[name].moved(T_map_entity))
        new = [entity for name, entity in objects.items() if name not in self._tracked]
        for entity in new:
            if entity.name in self._builder:
                raise InvalidValueError("facts.entities", entity.name, "objects whose names no other entity has")
            self._builder.put(self._node(entity))
            self._tracked.add(entity.name)
        return frozenset(moved) | {entity.name for entity in new}

    def _moved(self, objects: Mapping[str, Entity]) -> dict[str, Float64]:
        """T_map_entity of all that moved since it entered the graph, and of the load of what moved."""
        if not self._tracked:
            return {}
        graph = self._builder.graph()
        poses: dict[str, Float64] = {}
        motions: dict[str, Float64] = {}
        for name in graph.descendants():
            T_old = graph.nodes[name].T_map_entity
            T_new = None
            if name in self._tracked:
                T_new = np.array(objects[name].T_map, dtype=float)
                if not self._farther(T_new, T_old):
                    continue
            elif graph.parent(name) in motions:
                T_new = motions[graph.parent(name)] @ T_old
            if T_new is not None:
                poses[name], motions[name] = T_new, T_new @ inverse(T_old)
        return poses

    def _farther(self, T_new: Float64, T_old: Float64) -> bool:
        shift = float(np.linalg.norm(T_new[:3, 3] - T_old[:3, 3]))
        turn = angle_between(T_new[:3, :3], T_old[:3, :3])
        return shift > self.config.move_translation or turn > self.config.move_rotation

    def _node(self, entity: Entity) -> EntityNode:
        """A node in the frame of the object's model; objects of a model share their shape."""
        if entity.class_name not in self._models:
            raise UnknownNameError("object model", entity.class_name, self._models)
        if entity.class_name not in self._shapes:
            model = self._models[entity.class_name]
            mesh = getattr(model, "visual", None) or getattr(model, "mesh", None)
            mesh = mesh if isinstance(mesh, Mesh) and len(mesh.faces) else box_mesh(model.extents)
            planes = self.config.nodes.planes
            self._shapes[entity.class_name] = entity_shape(mesh, self._rng, planes, source=entity.class_name)
        shape = self._shapes[entity.class_name]
        return entity_node(entity.name, entity.class_name, shape, entity.T_map, self.config.nodes)
