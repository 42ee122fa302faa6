"""A coarse copy of an entity's surface, by which contact is judged: a scan may have half a million faces."""

from collections.abc import Sequence

import numpy as np

from simtrack.contracts import Int32
from simtrack.geometry.meshes import Mesh, area, concatenate
from simtrack.geometry.planes import SurfacePlane

COARSE_FACES = 40_000
"""Faces up to which a surface is taken as it is."""


def coarse_surface(
    mesh: Mesh, planes: Sequence[SurfacePlane], limit: int = COARSE_FACES
) -> tuple[Mesh, tuple[Int32, ...]]:
    """A surface of about `limit` faces, and (K, 3) which of them lie on each plane.

    Vertices in one cell of a grid become their mean (Rossignac and Borrel, 1993), for every plane by itself and for
    what lies on none, so that planes stay flat and keep their faces. A mesh of at most `limit` faces is not changed.
    """
    if len(mesh.faces) <= limit:
        return mesh, tuple(mesh.faces[plane.faces] for plane in planes)
    cell = float(np.sqrt(2.5 * area(mesh) / limit))  # two faces a cell, and a few more where the grid cuts obliquely
    free = np.ones(len(mesh.faces), np.bool_)
    for plane in planes:
        free[plane.faces] = False
    patches = [_clustered(mesh, mesh.faces[faces], cell) for faces in (*(plane.faces for plane in planes), free)]
    starts = np.cumsum([0, *(len(patch.vertices) for patch in patches)]).astype(np.int32)
    on_planes = zip(patches[:-1], starts[: len(planes)], strict=True)
    return concatenate(patches), tuple(patch.faces + start for patch, start in on_planes)


def _clustered(mesh: Mesh, faces: Int32, cell: float) -> Mesh:
    """Some (K, 3) faces of a mesh with the vertices in each cell of a grid made one; what collapses goes."""
    used, local = np.unique(faces, return_inverse=True)
    points = mesh.vertices[used]
    _, cluster = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_inverse=True)
    cluster = cluster.reshape(-1)
    counts = np.maximum(np.bincount(cluster), 1)
    means = np.stack([np.bincount(cluster, points[:, k]) / counts for k in range(3)], axis=1)
    joined = cluster[local.reshape(-1, 3)]
    a, b, c = joined.T
    joined = joined[(a != b) & (b != c) & (c != a)]
    corners = np.sort(joined, axis=1)
    _, first = np.unique(corners @ [len(means) ** 2, len(means), 1], return_index=True)
    return Mesh(means, joined[np.sort(first)].astype(np.int32))
