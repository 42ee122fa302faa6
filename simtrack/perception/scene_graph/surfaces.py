"""Surfaces of bodies as meshes, made when they are first asked for."""

from collections.abc import Mapping

import numpy as np

from simtrack.contracts import Float64, MapEntity, StaticMap
from simtrack.geometry.meshes import box_mesh
from simtrack.geometry.transforms import apply, inverse
from simtrack.perception.scene_graph.shapes import ModelLike
from simtrack.raycast import TriangleMesh

_SLACK = 1e-3
"""Metres by which the survey's rounding may carry an entity's surface out of its box."""


class Surfaces:
    """Meshes of models, and of static entities: what the survey shows within their boxes.

    What there is no mesh of is taken for its box.
    """

    def __init__(self, static_map: StaticMap | None, models: Mapping[str, ModelLike]) -> None:
        self._map = static_map
        self._models = models
        self._entities = {entity.name: entity for entity in static_map.entities} if static_map else {}
        self._meshes: dict[tuple[str, str], TriangleMesh] = {}

    def of_model(self, name: str) -> TriangleMesh:
        """Mesh of a model, object frame."""
        return self._kept("model", name)

    def of_entity(self, name: str) -> TriangleMesh:
        """Mesh of a static entity, entity frame."""
        return self._kept("entity", name)

    def _kept(self, kind: str, name: str) -> TriangleMesh:
        if (kind, name) not in self._meshes:
            extents, mesh = self._model(name) if kind == "model" else self._entity(self._entities[name])
            if mesh is None:
                box = box_mesh(np.asarray(extents, dtype=float))
                mesh = box.vertices, box.faces
            self._meshes[kind, name] = TriangleMesh(*mesh, source=name)
        return self._meshes[kind, name]

    def _model(self, name: str) -> tuple[Float64, tuple[np.ndarray, np.ndarray] | None]:
        model = self._models[name]
        mesh = getattr(model, "mesh", None)
        return model.extents, None if mesh is None or not len(mesh.faces) else (mesh.vertices, mesh.faces)

    def _entity(self, entity: MapEntity) -> tuple[Float64, tuple[np.ndarray, np.ndarray] | None]:
        assert self._map is not None
        local = apply(inverse(entity.T_map_entity), self._map.vertices.astype(float))
        inside = np.all(np.abs(local) <= 0.5 * np.asarray(entity.extents) + _SLACK, axis=1)
        faces = self._map.faces[inside[self._map.faces].all(axis=1)]
        return entity.extents, (local, faces) if len(faces) else None
