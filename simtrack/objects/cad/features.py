"""Features of exact meshes: their planes, and the turns about the vertical that map them onto themselves."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Bool, Float64
from simtrack.geometry.meshes import Mesh, area, concatenate, face_areas, face_normals, sample_surface

if TYPE_CHECKING:
    from scipy.spatial import KDTree

SAMPLES = 1500
TOLERANCE = 0.03
"""Of the larger horizontal side: how far a turned surface may lie from itself, in the 98th percentile."""
FACET = np.cos(np.radians(20.0))
"""Cosine of the angle below which neighbours are facets of one curved surface."""
FLAT = np.cos(np.radians(0.5))
TURNS = 24
"""Steps in which symmetries are sought."""


def mesh_planes(mesh: Mesh, least_area: float) -> list[tuple[Float64, float, float, Float64]]:
    """Planes of an exact mesh: coplanar faces that look the same way are one plane.

    Args:
        mesh: any mesh.
        least_area: square metres below which a plane is left out; the facets of curved surfaces are none.

    Returns:
        (normal (3,), offset d with ``normal @ v + d = 0``, area, area centroid (3,)) each.
    """
    normals, areas = face_normals(mesh), face_areas(mesh)
    areas = np.where(_curved(mesh, normals), 0.0, areas)
    centres = mesh.triangles.mean(axis=1)
    offsets = -np.einsum("ij,ij->i", normals, centres)
    keys = np.round(np.column_stack([normals * 200.0, offsets * 2000.0])).astype(np.int64)
    _, index = np.unique(keys, axis=0, return_inverse=True)
    index = index.reshape(-1)
    total = np.bincount(index, areas)
    planes = []
    for k in np.flatnonzero(total >= least_area):
        own = index == k
        weights = areas[own] / total[k]
        normal = weights @ normals[own]
        normal /= np.linalg.norm(normal)
        centre = weights @ centres[own]
        planes.append((normal, float(-normal @ centre), float(total[k]), centre))
    return planes


def _curved(mesh: Mesh, normals: Float64) -> Bool:
    """(F,), which faces go over into a neighbour at a small angle: facets of a curved surface."""
    start = mesh.faces.astype(np.int64)
    end = np.roll(start, -1, axis=1)
    keys = (np.minimum(start, end) * len(mesh.vertices) + np.maximum(start, end)).ravel()
    order = np.argsort(keys, kind="stable")
    owner = np.repeat(np.arange(len(mesh.faces)), 3)[order]
    same = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    a, b = owner[same], owner[same + 1]
    cosine = np.einsum("ij,ij->i", normals[a], normals[b])
    smooth = (cosine > FACET) & (cosine < FLAT)
    curved = np.zeros(len(mesh.faces), bool)
    curved[a[smooth]] = True
    curved[b[smooth]] = True
    return curved


def _share_near(tree: "KDTree", points: Float64, limit: float) -> float:
    """Share of (N, 3) points that have one of the tree's within `limit` metres."""
    return float(np.isfinite(tree.query(points, distance_upper_bound=limit)[0]).mean())


def yaw_symmetries(meshes: Sequence[Mesh]) -> Float64:
    """(S,) turns about z through the origin, in (-pi, pi], 0 first, that map the meshes together onto themselves."""
    from scipy.spatial import KDTree

    whole = concatenate(meshes)
    rng = np.random.default_rng(0)
    points, _ = sample_surface(whole, SAMPLES, rng)
    dense, _ = sample_surface(whole, 4 * SAMPLES, rng)
    tree = KDTree(dense)
    spacing = np.sqrt(area(whole) / len(dense))
    limit = max(TOLERANCE * float(whole.extents[:2].max()), 1.5 * spacing)
    found = [0.0]
    few = max(len(points) // 8, 1)
    for k in range(1, TURNS):
        angle = 2.0 * np.pi * k / TURNS
        c, s = np.cos(angle), np.sin(angle)
        turned = points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        # most turns fail for an eighth of the points already
        if _share_near(tree, turned[:few], limit) >= 0.9 and _share_near(tree, turned, limit) >= 0.98:
            found.append(angle if angle <= np.pi else angle - 2.0 * np.pi)
    return np.array(found)
