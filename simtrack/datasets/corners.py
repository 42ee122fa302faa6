"""Meshes as renderers draw them: corners with a normal and texture coordinates of their own, as few as possible."""

import numpy as np
from numba import njit

from simtrack.contracts import Float32, Int32
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh

CREASE = np.deg2rad(35.0)
"""Radians: faces that meet at less than this are shaded as one curved surface."""


def corners_of(mesh: Mesh, uv: Float32, crease: float = CREASE) -> tuple[Float32, Float32, Float32, Int32]:
    """Split a mesh's vertices where normal or texture coordinates jump.

    Args:
        mesh: V vertices, F faces.
        uv: (F, 3, 2), texture coordinates of each face's corners.
        crease: radians between the normals of faces that are shaded as one surface.

    Returns:
        Positions (N, 3), unit normals (N, 3), texture coordinates (N, 2) and faces (F, 3), indices into these.

    Raises:
        InvalidValueError: `uv` is not that of the mesh's faces.
    """
    if uv.shape != (len(mesh.faces), 3, 2):
        raise InvalidValueError("uv", uv.shape, f"shape ({len(mesh.faces)}, 3, 2)")
    vertices = mesh.vertices.astype(np.float32)
    scaled, unit = _face_normals(vertices, mesh.faces)
    flat = mesh.faces.ravel()
    order = np.argsort(flat, kind="stable").astype(np.int32)
    start = np.searchsorted(flat[order], np.arange(len(vertices) + 1)).astype(np.int32)
    return _split(
        vertices, scaled, unit, np.ascontiguousarray(uv, np.float32).reshape(-1, 2), order, start, np.cos(crease)
    )


@njit(cache=True, nogil=True)
def _face_normals(vertices, faces):
    """(F, 3) normals of twice the faces' areas in length, and of unit length (zero for faces without area)."""
    scaled, unit = np.empty((len(faces), 3), np.float32), np.zeros((len(faces), 3), np.float32)
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        square = 0.0
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            scaled[f, k] = (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i])
            square += scaled[f, k] ** 2
        if square > 0.0:
            for k in range(3):
                unit[f, k] = scaled[f, k] / np.sqrt(square)
    return scaled, unit


@njit(cache=True, nogil=True)
def _split(vertices, scaled, unit, uv, order, start, cosine):
    """Corners of each vertex (order[start[v]:start[v + 1]]), those with equal normals and coordinates as one."""
    corners = len(order)
    positions, normals = np.empty((corners, 3), np.float32), np.empty((corners, 3), np.float32)
    coordinates, indices = np.empty((corners, 2), np.float32), np.empty(corners, np.int32)
    mean = np.zeros(3, np.float32)
    count = 0
    for v in range(len(vertices)):
        first = count
        for here in order[start[v] : start[v + 1]]:
            f = here // 3
            mean[:] = 0.0
            for there in order[start[v] : start[v + 1]]:
                g = there // 3
                along = unit[f, 0] * unit[g, 0] + unit[f, 1] * unit[g, 1] + unit[f, 2] * unit[g, 2]
                if g == f or along >= cosine:
                    for k in range(3):
                        mean[k] += scaled[g, k]
            length = np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
            for k in range(3):
                mean[k] = mean[k] / length if length > 0.0 else np.float32(k == 2)
            at = first
            while at < count:
                apart = abs(normals[at, 0] - mean[0]) + abs(normals[at, 1] - mean[1]) + abs(normals[at, 2] - mean[2])
                if apart < 1e-5 and coordinates[at, 0] == uv[here, 0] and coordinates[at, 1] == uv[here, 1]:
                    break
                at += 1
            if at == count:
                positions[at], normals[at], coordinates[at] = vertices[v], mean, uv[here]
                count += 1
            indices[here] = at
    faces = indices.reshape(-1, 3)
    return positions[:count].copy(), normals[:count].copy(), coordinates[:count].copy(), faces
