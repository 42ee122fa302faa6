"""Walls of a map told apart: a map has one entity for all that is wall, a contact graph one for each."""

from collections.abc import Sequence

import numpy as np

from simtrack.geometry.meshes import Mesh, face_normals
from simtrack.geometry.planes import PlaneConfig, detect_planes
from simtrack.perception.mapping.panoptic.entities import MapEntityMesh

UPRIGHT, LEAST_AREA, NEAR = 0.25, 0.4, 0.12
"""Largest vertical part of a wall's normal; square metres of a wall; metres within which faces belong to it."""
_PLANES = PlaneConfig(distance=0.05, samples=6000, min_fraction=0.05, min_share=0.02)


def split_walls(entities: Sequence[MapEntityMesh], rng: np.random.Generator) -> tuple[MapEntityMesh, ...]:
    """Entities with each wall replaced by its upright planes; what lies on none of them is left out.

    Args:
        entities: of a map.
        rng: of the search for planes.
    """
    found: list[MapEntityMesh] = []
    for entity in entities:
        if entity.semantic_class != "wall":
            found.append(entity)
            continue
        parts = _upright_parts(entity.mesh, rng)
        names = (f"{entity.name}-{k}" for k in range(1, len(parts) + 1))
        found += [
            MapEntityMesh(name, "wall", entity.instance, entity.score, part)
            for name, part in zip(names, parts, strict=True)
        ]
    return tuple(found)


def _upright_parts(mesh: Mesh, rng: np.random.Generator) -> list[Mesh]:
    planes = [
        plane
        for plane in detect_planes(mesh, rng, _PLANES, source="wall")
        if abs(plane.normal[2]) < UPRIGHT and plane.area > LEAST_AREA
    ]
    if not planes:
        return []
    centres, normals = mesh.triangles.mean(axis=1), face_normals(mesh)
    off = np.stack([np.abs(plane.distance(centres)) for plane in planes])
    # A face on the line where two walls meet is part of the one that it faces away from.
    off += 0.1 * NEAR * (1.0 - np.stack([normals @ plane.normal for plane in planes]))
    nearest = off.argmin(axis=0)
    nearest[off.min(axis=0) > NEAR] = -1
    parts = []
    for k in range(len(planes)):
        chosen = np.flatnonzero(nearest == k)
        if len(chosen):
            used, faces = np.unique(mesh.faces[chosen], return_inverse=True)
            colors = None if mesh.face_colors is None else mesh.face_colors[chosen]
            parts.append(Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), colors))
    return parts
