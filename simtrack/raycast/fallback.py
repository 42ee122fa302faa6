"""Casting without instances: `embreex`'s single rays against each mesh in its own frame."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Float32, Float64

if TYPE_CHECKING:
    from simtrack.raycast.hits import ClosestPoints, RayHits
    from simtrack.raycast.mesh import TriangleMesh


@dataclass(frozen=True, slots=True, eq=False)
class Instance:
    """A mesh in a scene."""

    mesh: "TriangleMesh"
    keys: Float64
    """(K, 4, 4), T_map_mesh at equidistant times 0..1; K = 1 at rest."""
    enabled: bool


def cast(
    instances: Mapping[int, Instance],
    origins: Float32,
    directions: Float32,
    times: np.ndarray,
    near: np.float32,
    far: np.float32,
    hits: "RayHits",
) -> None:
    """Fill `hits`: rays go to the frame of every instance that their bounding sphere lets them reach; the nearest wins.

    The direction keeps its scale on the way, so distances along the ray are those of the map frame.
    """
    hits.distances[:], hits.normals[:], hits.faces[:], hits.instances[:] = np.inf, 0.0, -1, -1
    usable = np.isfinite(origins).all(1) & np.isfinite(directions).all(1) & (directions != 0).any(1)
    if len(times):
        usable &= np.isfinite(times)
    for number in sorted(instances):
        entry = instances[number]
        if not entry.enabled:
            continue
        T_map_mesh = _pose_at(entry.keys, times)
        rays = np.flatnonzero(usable)
        T = T_map_mesh if T_map_mesh.ndim == 2 else T_map_mesh[rays]
        linear = np.linalg.inv(T)[..., :3, :3]
        local_directions = _times(linear, directions[rays])
        local_origins = _times(linear, origins[rays] - T[..., :3, 3])
        _keep_nearest(entry, number, rays, local_origins, local_directions, linear, (near, far), hits)


def _keep_nearest(
    entry: Instance,
    number: int,
    rays: np.ndarray,
    origins: Float64,
    directions: Float64,
    linear: np.ndarray,
    limits: tuple[np.float32, np.float32],
    hits: "RayHits",
) -> None:
    centre, radius = entry.mesh.bounding_sphere
    towards = centre - origins
    nearest = np.clip((towards * directions).sum(1) / (directions**2).sum(1), 0.0, None)
    reach = ((towards - nearest[:, None] * directions) ** 2).sum(1) <= (1.001 * radius + 1e-6) ** 2
    if not reach.any():
        return
    origins = origins[reach] + float(limits[0]) * directions[reach]
    output = entry.mesh.embreex_scene.run(origins.astype(np.float32), directions[reach].astype(np.float32), output=True)
    distances = output["tfar"] + limits[0]
    better = (output["primID"] >= 0) & (distances < hits.distances[rays[reach]]) & (distances <= limits[1])
    chosen = rays[reach][better]
    hits.distances[chosen] = distances[better]
    hits.faces[chosen] = output["primID"][better]
    hits.instances[chosen] = number
    transposed = np.swapaxes(linear if linear.ndim == 2 else linear[reach][better], -1, -2)
    normals = _times(transposed, output["Ng"][better])
    hits.normals[chosen] = normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _times(matrix: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """(N, 3) products of one (3, 3) or N matrices (N, 3, 3) with (N, 3) vectors, in float64."""
    return (matrix @ vectors[..., None].astype(np.float64))[..., 0]


def _pose_at(keys: Float64, times: np.ndarray) -> Float64:
    """(4, 4) for an instance at rest, else (N, 4, 4): matrices between keys are interpolated linearly."""
    if len(keys) == 1 or not len(times):
        return keys[0]
    position = np.clip(np.nan_to_num(times.astype(np.float64)), 0.0, 1.0) * (len(keys) - 1)
    segment = np.minimum(position.astype(int), len(keys) - 2)
    fraction = (position - segment)[:, None, None]
    return (1.0 - fraction) * keys[segment] + fraction * keys[segment + 1]


def closest(instances: Mapping[int, Instance], points: Float32, max_distance: float, found: "ClosestPoints") -> None:
    """Fill `found` by exhaustive search of each instance's triangles, moved to the map frame."""
    from simtrack.raycast.closest import search

    found.points[:], found.instances[:], found.faces[:] = points, -1, -1
    found.distances[:] = np.where(np.isfinite(points).all(1), max_distance, -1.0)  # nothing is nearer than -1
    output = (found.points, found.distances, found.instances, found.faces)
    for number in sorted(instances):
        entry = instances[number]
        if entry.enabled:
            T = entry.keys[0]
            vertices = entry.mesh.vertices.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
            search(points.astype(np.float64), vertices[entry.mesh.faces], number, output)
    found.distances[found.instances < 0] = np.inf
