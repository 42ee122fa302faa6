"""Which part of a thing's surface can be seen at all from outside it while it stands where it stands."""

import numpy as np

from simtrack.contracts import Bool, Float64
from simtrack.errors import MeshError
from simtrack.geometry.meshes import Mesh, face_normals
from simtrack.raycast import RayScene, TriangleMesh

DIRECTIONS = 96
"""Directions of view, about 20 degrees apart."""
GRAZING = 0.15
"""Least cosine between a face's normal and a direction from which the face counts as seen: 81 degrees."""
_OFF = 1e-3
"""Metres above a face at which its rays start: what another board covers more closely is hidden."""


def visible_faces(mesh: Mesh) -> Bool:
    """Faces that can be seen from outside the thing at rest.

    A face counts if a ray from its centre into its free hemisphere leaves the box around the thing without meeting its
    mesh, or the level plane through its lowest point, on which it stands. The insides of closed cabinets, faces that
    are glued to others, and undersides near the ground do not count. Directions are fixed: equal meshes, equal faces.

    Args:
        mesh: of the thing, z up; fine enough for a face to be either seen or hidden.

    Returns:
        (F,).

    Raises:
        MeshError: the mesh has no faces.
    """
    if not len(mesh.faces):
        raise MeshError("visible faces", "the mesh has no faces")
    normals = face_normals(mesh)
    origins = mesh.triangles.mean(axis=1) + _OFF * normals
    low, high = mesh.bounds + [[-2.0 * _OFF], [2.0 * _OFF]]
    seen = np.zeros(len(mesh.faces), np.bool_)
    with RayScene() as scene:
        scene.add(TriangleMesh(mesh.vertices, mesh.faces, "visible faces"))
        for direction in _directions():
            asked = np.flatnonzero(~seen & (normals @ direction > GRAZING))
            leaves, lands = _exits(origins[asked], direction, low, high)
            above = leaves < lands
            asked, leaves = asked[above], leaves[above]
            rays = np.broadcast_to(direction, (len(asked), 3))
            seen[asked] = ~scene.occluded(origins[asked], rays, leaves)
    return seen


def _directions() -> Float64:
    """(DIRECTIONS, 3) unit vectors, evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(DIRECTIONS) + 0.5
    z = 1.0 - 2.0 * k / DIRECTIONS
    angle = np.pi * (1.0 + np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _exits(origins: Float64, direction: Float64, low: Float64, high: Float64) -> tuple[Float64, Float64]:
    """(N,) metres along the rays to where they leave a box by its sides or its top, and to where by its bottom."""
    with np.errstate(divide="ignore"):
        ahead = np.where(direction > 0.0, high - origins, low - origins) / direction
    lands = ahead[:, 2] if direction[2] < 0.0 else np.full(len(origins), np.inf)
    sides = ahead if direction[2] > 0.0 else ahead[:, :2]
    return sides.min(axis=1), lands
