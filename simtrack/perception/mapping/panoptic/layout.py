"""Layout of a map made of planes: a map has one entity for all that is wall, a contact graph one for each."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from simtrack.contracts import Bool, Int32
from simtrack.geometry.meshes import Mesh, face_normals
from simtrack.geometry.planes import PlaneConfig, SurfacePlane, detect_planes
from simtrack.perception.mapping.panoptic.entities import MapEntityMesh

UPRIGHT, LEVEL, LEAST_AREA, NEAR = 0.25, 0.9, 0.4, 0.12
"""Largest vertical part of a wall's normal, smallest of a floor's; square metres of a plane; metres within which faces
belong to it."""
RECESS = 0.2
"""Metres between a wall and what is sunk in it: a window's pane is no wall of its own."""
_PLANES = PlaneConfig(distance=0.05, samples=6000, min_fraction=0.05, min_share=0.02)


def split_layout(entities: Sequence[MapEntityMesh], rng: np.random.Generator) -> tuple[MapEntityMesh, ...]:
    """Entities with each wall replaced by its upright planes, and floors and ceilings by their level ones.

    What lies on none of them is left out: where masks leak, feet of things are floor.

    Args:
        entities: of a map.
        rng: of the search for planes.
    """
    found: list[MapEntityMesh] = []
    for entity in entities:
        if entity.semantic_class in ("floor", "ceiling"):
            found.append(replace(entity, mesh=_level_part(entity.mesh, rng)))
        elif entity.semantic_class != "wall":
            found.append(entity)
        else:
            parts = _upright_parts(entity.mesh, rng)
            named = [(f"{entity.name}-{k}", part) for k, part in enumerate(parts, start=1)]
            found += [replace(entity, name=name, mesh=part) for name, part in named]
    return tuple(found)


def _level_part(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """What lies on level planes; all of it if there is none."""
    planes = [
        plane
        for plane in detect_planes(mesh, rng, _PLANES, source="floor")
        if abs(plane.normal[2]) > LEVEL and plane.area > LEAST_AREA
    ]
    on = _nearest_plane(mesh, planes) >= 0
    return _part(mesh, on) if on.any() else mesh


def _upright_parts(mesh: Mesh, rng: np.random.Generator) -> list[Mesh]:
    planes = [
        plane
        for plane in detect_planes(mesh, rng, _PLANES, source="wall")
        if abs(plane.normal[2]) < UPRIGHT and plane.area > LEAST_AREA
    ]
    planes.sort(key=lambda plane: -plane.area)
    nearest, wall = _nearest_plane(mesh, planes), _walls(mesh, planes)
    parts = [(nearest >= 0) & (wall[nearest] == k) for k in range(len(planes))]
    return [_part(mesh, chosen) for chosen in parts if chosen.any()]


def _walls(mesh: Mesh, planes: Sequence[SurfacePlane]) -> Int32:
    """(K,) number of the wall that each plane is part of; largest first."""
    wall = np.arange(len(planes), dtype=np.int32)
    middles = [mesh.triangles[plane.faces].mean(axis=(0, 1)) for plane in planes]
    for k, plane in enumerate(planes):
        for other in range(k):
            beside = abs(float(planes[other].distance(middles[k][None])[0])) <= RECESS
            if wall[other] == other and beside and plane.normal @ planes[other].normal > LEVEL:
                wall[k] = other
                break
    return wall


def _nearest_plane(mesh: Mesh, planes: Sequence[SurfacePlane]) -> Int32:
    """(F,) number of the plane that each face lies on, -1 = none."""
    if not planes:
        return np.full(len(mesh.faces), -1, np.int32)
    centres, normals = mesh.triangles.mean(axis=1), face_normals(mesh)
    off = np.stack([np.abs(plane.distance(centres)) for plane in planes])
    # A face on the line where two walls meet is part of the one that it faces away from.
    off += 0.1 * NEAR * (1.0 - np.stack([normals @ plane.normal for plane in planes]))
    nearest = off.argmin(axis=0)
    nearest[off.min(axis=0) > NEAR] = -1
    return nearest.astype(np.int32)


def _part(mesh: Mesh, chosen: Bool) -> Mesh:
    used, faces = np.unique(mesh.faces[chosen], return_inverse=True)
    colors = None if mesh.face_colors is None else mesh.face_colors[chosen]
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), colors)
