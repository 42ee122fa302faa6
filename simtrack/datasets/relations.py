"""What truly stands where relative to what: the scene graph's relations at true poses, with `on` from physics."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64, MapEntity, Relation
from simtrack.datasets.content import Placed
from simtrack.geometry.meshes import Mesh
from simtrack.perception.scene_graph import (
    RELATIONS,
    Body,
    RelationConfig,
    Shape,
    map_entity_shape,
    model_shape,
    relation_margins,
)


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """What `model_shape` asks of a model."""

    semantic_class: str
    extents: Float64
    mesh: Mesh


class Relations:
    """True relations of settled scenes; shapes are made once for each mesh and scale."""

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
        bodies = [Body(self._shape(thing), np.asarray(thing.T_map_object, float)) for thing in things]
        bodies += [Body(self._static(entity), np.asarray(entity.T_map_entity, float)) for entity in statics]
        names = [thing.name for thing in things] + [entity.name for entity in statics]
        found = {Relation(carried, "on", carrier) for carried, carrier in support}
        if len(bodies) > 1:
            margins = relation_margins(bodies, self._config)
            for i, j, k in np.argwhere(margins >= 0.0).tolist():
                if RELATIONS[k] != "on" and min(i, j) < len(things):
                    found.add(Relation(names[i], RELATIONS[k], names[j]))
        return tuple(sorted(found, key=lambda relation: (relation.subject, relation.name, relation.reference)))

    def _shape(self, thing: Placed) -> Shape:
        key = id(thing.mesh), np.asarray(thing.scale, float).tobytes()
        if key not in self._shapes:
            mesh = Mesh(thing.mesh.vertices * thing.scale, thing.mesh.faces.astype(np.int32))
            self._shapes[key] = thing.mesh, model_shape(_Model(thing.semantic_class, thing.extents, mesh))
        return self._shapes[key][1]

    def _static(self, entity: MapEntity) -> Shape:
        if (id(entity), b"") not in self._shapes:
            shape = map_entity_shape(entity, self._config.container_classes, self._config.layout_classes)
            self._shapes[id(entity), b""] = entity, shape
        return self._shapes[id(entity), b""][1]
