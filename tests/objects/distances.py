"""Exact point-to-surface distances for tests, by brute force."""

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import Mesh


def surface_distances(points: Float64, mesh: Mesh, chunk: int = 100) -> Float64:
    """(N,) distance of (N, 3) points to the nearest point of the mesh, metres."""
    return np.concatenate([_nearest(points[i : i + chunk], mesh.triangles) for i in range(0, len(points), chunk)])


def _nearest(points: Float64, triangles: Float64) -> Float64:
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    height = points @ normal.T - np.einsum("ij,ij->i", a, normal)
    inside = np.ones(height.shape, bool)
    best = np.full(height.shape, np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        edge = q - p
        inward = np.cross(normal, edge)
        inside &= points @ inward.T >= np.einsum("ij,ij->i", p, inward)
        along = (points @ edge.T - np.einsum("ij,ij->i", p, edge)) / np.maximum(
            np.einsum("ij,ij->i", edge, edge), 1e-30
        )
        foot = p + np.clip(along, 0.0, 1.0)[..., None] * edge
        best = np.minimum(best, np.linalg.norm(points[:, None, :] - foot, axis=2))
    return np.where(inside, np.abs(height), best).min(axis=1)
