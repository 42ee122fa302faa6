"""Another tessellation of the same surfaces: what a surveyor's software makes of planes and solids."""

from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import Mesh, area, concatenate, face_normals, subdivide_to

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

_PLANE_DIGITS = 3
"""Faces belong to one plane if normal and offset agree to so many decimals."""


def retessellated(mesh: Mesh, edge: float, rng: np.random.Generator) -> Mesh:
    """The planes of a mesh with new vertices about `edge` metres apart, at other places than the old ones.

    Meant for the sheets of walls, floors and ceilings: each plane is triangulated anew (Delaunay) between equidistant
    points on its outline and jittered points inside. Outlines are kept; colours are dropped. A wavy sheet, which has
    hardly two faces on a plane, keeps its triangles.
    """
    normals = face_normals(mesh)
    offsets = np.einsum("fk,fk->f", normals, mesh.triangles[:, 0])
    keys = np.round(np.column_stack([normals, offsets]), _PLANE_DIGITS) + 0.0
    _, plane = np.unique(keys, axis=0, return_inverse=True)
    plane = plane.reshape(-1)
    if plane.max() + 1 > 0.6 * len(mesh.faces):
        return subdivide_to(Mesh(mesh.vertices, mesh.faces), int(2.0 * area(mesh) / edge**2))
    pieces = []
    for k in range(plane.max() + 1):
        rows = np.flatnonzero(plane == k)
        pieces.append(_facet(mesh, rows, normals[rows[0]], edge, rng))
    return concatenate(pieces)


def _facet(mesh: Mesh, rows: np.ndarray, normal: Float64, edge: float, rng: np.random.Generator) -> Mesh:
    import shapely

    u = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    u = u / float(np.linalg.norm(u))
    frame = np.array([u, np.cross(normal, u)], dtype=float).T
    used, faces = np.unique(mesh.faces[rows], return_inverse=True)
    old = Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32))
    flat = old.vertices @ frame
    loops = outline(old, flat)
    rings = [shapely.LinearRing(flat[loop]) for loop in loops]
    polygon = shapely.build_area(shapely.union_all(rings))
    for spacing in (edge, edge / 2, edge / 4):
        points, triangles = _triangulated(polygon, [flat[loop] for loop in loops], spacing, rng)
        cross = _doubled_areas(points, triangles)
        if abs(0.5 * cross.sum() - polygon.area) < 1e-6 * max(polygon.area, 1.0):
            offset = normal * float(normal @ old.vertices[0])
            return Mesh(points @ frame.T + offset, triangles[cross > 1e-9].astype(np.int32))
    return subdivide_to(old, int(2.0 * area(old) / edge**2))


def _doubled_areas(points: Float64, triangles: np.ndarray) -> Float64:
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


def outline(mesh: Mesh, flat: Float64) -> list[list[int]]:
    """Boundary loops of a planar mesh as vertex numbers, only the corners. `flat` (V, 2) are its plane coordinates."""
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    count = len(mesh.vertices)
    free = ~np.isin(start.astype(np.int64) * count + end, end.astype(np.int64) * count + start)
    following: dict[int, list[int]] = {}
    for a, b in zip(start[free].tolist(), end[free].tolist(), strict=True):
        following.setdefault(a, []).append(b)
    loops = []
    while following:
        first = next(iter(following))
        loop, here = [], first
        while here in following:
            loop.append(here)
            targets = following[here]
            here = targets.pop()
            if not targets:
                del following[loop[-1]]
        points = flat[loop]
        before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
        turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
        corners = np.abs(turn) > 1e-6 * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        loops.append([loop[k] for k in np.flatnonzero(corners)])
    return loops


def _triangulated(
    polygon: "BaseGeometry", loops: list[Float64], spacing: float, rng: np.random.Generator
) -> tuple[Float64, np.ndarray]:
    """Points (N, 2) and counter-clockwise triangles (M, 3) of a Delaunay triangulation, clipped to the polygon."""
    import shapely
    from scipy.spatial import Delaunay

    border = []
    for loop in loops:
        for a, b in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            steps = max(1, int(np.ceil(np.linalg.norm(b - a) / spacing)))
            border.append(a + (b - a) * (np.arange(steps) / steps)[:, None])
    low, high = np.min([p.min(axis=0) for p in loops], axis=0), np.max([p.max(axis=0) for p in loops], axis=0)
    x, y = (np.arange(a + rng.uniform(0.2, 0.8) * spacing, b, spacing) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    grid += rng.uniform(-0.25, 0.25, grid.shape) * spacing
    inner = grid[shapely.contains_xy(shapely.buffer(polygon, -0.45 * spacing), grid)]
    points = np.concatenate([*border, inner])
    triangles = Delaunay(points).simplices
    triangles = triangles[shapely.contains_xy(polygon, points[triangles].mean(axis=1))]
    cross = _doubled_areas(points, triangles)
    return points, np.where((cross < 0)[:, None], triangles[:, ::-1], triangles)
