"""Which piece of the surveyed map's mesh belongs to which labelled entity."""

from collections.abc import Mapping

import numpy as np

from simtrack.contracts import Float64, Int32, MapEntity, StaticMap
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import apply, inverse

SLACK = 1e-3
"""Metres by which rounding may carry an entity's surface out of its box."""
NOBODY = -1


def face_owners(static_map: StaticMap) -> Int32:
    """(F,) index of the entity that each face of the map belongs to, `NOBODY` for none.

    A connected piece of the surface belongs to the smallest box that holds all of it: a floor that reaches under the
    furniture is not cut, and a carton on a cupboard is its own.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    vertices, faces = static_map.vertices.astype(float), static_map.faces
    if not len(faces):
        return np.empty(0, np.int32)
    start, end = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_matrix((np.ones(len(start), np.int8), (start, end)), (len(vertices),) * 2)
    count, piece = connected_components(links, directed=False)
    owner = np.full(count, NOBODY, np.int32)
    by_size = sorted(
        enumerate(static_map.entities), key=lambda item: -float(np.prod(np.maximum(item[1].extents, 0.01)))
    )
    for number, entity in by_size:
        held = np.ones(count, bool)
        held[piece[~_inside(vertices, entity)]] = False
        owner[held] = number
    return owner[piece[faces[:, 0]]]


def _inside(vertices: Float64, entity: MapEntity) -> np.ndarray:
    local = apply(inverse(entity.T_map_entity), vertices)
    return np.all(np.abs(local) <= 0.5 * np.asarray(entity.extents) + SLACK, axis=1)


def entity_meshes(static_map: StaticMap, owners: Int32 | None = None) -> Mapping[str, Mesh]:
    """Name -> what the map shows of the entity, entity frame; entities of which it shows nothing are missing.

    Args:
        static_map: mesh and entities.
        owners: (F,) from `face_owners`; found anew if None.
    """
    owners = face_owners(static_map) if owners is None else owners
    found = {}
    for number, entity in enumerate(static_map.entities):
        own = static_map.faces[owners == number]
        if len(own):
            used, faces = np.unique(own, return_inverse=True)
            local = apply(inverse(entity.T_map_entity), static_map.vertices[used].astype(float))
            found[entity.name] = Mesh(local, faces.reshape(-1, 3).astype(np.int32))
    return found
