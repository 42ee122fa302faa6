"""What truly stands where relative to what: the scene graph's relations at true poses, with `on` from physics."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64, MapEntity, Relation
from simtrack.datasets.content import Placed
from simtrack.geometry.meshes import Mesh
from simtrack.perception.scene_graph import RELATIONS, RelationConfig, Shape, map_entity_shape, model_shape
from simtrack.perception.scene_graph.bodies import BodyArrays
from simtrack.perception.scene_graph.pairs import PairTable

_KEPT = 100
"""Shapes up to which those out of use are kept too: scenes share models, but not random shapes."""


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """What `model_shape` asks of a model."""

    semantic_class: str
    extents: Float64
    mesh: Mesh


class Relations:
    """True relations of scenes; shapes are made once for each mesh and scale, and kept while they are in use."""

    def __init__(self, config: RelationConfig | None = None) -> None:
        """`config`: the scene graph's thresholds, its defaults if None."""
        self._config = config or RelationConfig()
        self._shapes: dict[tuple[int, bytes], tuple[object, Shape]] = {}

    def of(
        self, things: Sequence[Placed], statics: Sequence[MapEntity], support: Sequence[tuple[str, str]]
    ) -> tuple[Relation, ...]:
        """All relations of the things to one another and to the static entities.

        `on` is what `support` says; the others hold where the scene graph's definition at the true shapes and poses
        does, without hysteresis.

        Args:
            things: targets and distractors where they stand.
            statics: furniture, walls and floors; nothing is said of these alone.
            support: (carried, carrier), direct contacts from above.

        Returns:
            Relations ordered by subject, name and reference.
        """
        arrays = BodyArrays({}, self._config, capacity=max(1, len(things) + len(statics)))
        names: dict[int, str] = {}
        used: set[tuple[int, bytes]] = set()
        shapes = [self._shape(thing) for thing in things] + [self._static(entity) for entity in statics]
        for key, shape in shapes:
            if key not in used:
                arrays.declare(str(key), shape)
                used.add(key)
        for (key, _), body in zip(shapes, (*things, *statics), strict=True):
            T_map = body.T_map_object if isinstance(body, Placed) else body.T_map_entity
            names[arrays.add(str(key), np.asarray(T_map, float))] = body.name
        if len(self._shapes) > _KEPT:
            self._shapes = {key: kept for key, kept in self._shapes.items() if key in used}
        slots = np.array(list(names), np.int64)
        apart = PairTable().update(
            arrays.world, slots, slots[: len(things)], np.zeros(len(things)), self._config.parameters()
        )
        found = {Relation(carried, "on", carrier) for carried, carrier in support}
        for subject, reference, _, held in apart.tolist():
            for bit, relation in enumerate(RELATIONS):
                if relation != "on" and held >> bit & 1:
                    found.add(Relation(names[subject], relation, names[reference]))
        return tuple(sorted(found, key=lambda relation: (relation.subject, relation.name, relation.reference)))

    def _shape(self, thing: Placed) -> tuple[tuple[int, bytes], Shape]:
        key = id(thing.mesh), np.asarray(thing.scale, float).tobytes()
        if key not in self._shapes:
            mesh = Mesh(thing.mesh.vertices * thing.scale, thing.mesh.faces.astype(np.int32))
            self._shapes[key] = thing.mesh, model_shape(_Model(thing.semantic_class, thing.extents, mesh))
        return key, self._shapes[key][1]

    def _static(self, entity: MapEntity) -> tuple[tuple[int, bytes], Shape]:
        key = id(entity), b""
        if key not in self._shapes:
            shape = map_entity_shape(entity, self._config.container_classes, self._config.layout_classes)
            self._shapes[key] = entity, shape
        return key, self._shapes[key][1]
