"""Which faces of a mesh meet where, whether they close it, and on which side of it a point lies."""

from dataclasses import dataclass

import numba as nb
import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float32, Int32
from simtrack.raycast.closest import closest_on_triangle
from simtrack.raycast.triangles import cross, dot, minus, plus


@dataclass(frozen=True, slots=True, eq=False)
class Topology:
    """Neighbourhood of faces; vertices at the same place are one, faces without three different ones do not count."""

    corners: Int32
    """(F, 3), number of the place of each corner."""
    across: Int32
    """(F, 3), the face on the other side of the edge from corner k to corner k + 1; -1 unless there is exactly one,
    which runs along the edge in the opposite direction."""
    ring_start: Int32
    """(P + 1,), where the faces around a place begin in `ring`."""
    ring: Int32
    """Faces around each place, ascending."""
    closed: bool
    """Whether every edge has a face on either side, so that the mesh has an inside: behind its faces."""

    @staticmethod
    def of(vertices: Float32, faces: npt.NDArray[np.uint32]) -> "Topology":
        """Topology of (V, 3) vertices and (F, 3) faces."""
        corners = _places(vertices)[faces]
        a, b, c = corners.T
        counts = (a != b) & (b != c) & (c != a)
        across = _across(corners, counts)
        around = corners[counts]
        owners = np.repeat(np.flatnonzero(counts).astype(np.int32), 3)
        order = np.argsort(around.reshape(-1), kind="stable")
        sizes = np.bincount(around.reshape(-1), minlength=int(corners.max()) + 1)
        start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
        closed = bool(counts.any() and (across[counts] >= 0).all())
        return Topology(corners, across, start, owners[order], closed)


def _places(vertices: Float32) -> Int32:
    """(V,) numbers that are equal for vertices at the same place."""
    x, y, z = vertices.T
    order = np.lexsort((z, y, x))
    ordered = vertices[order]
    new = np.concatenate([[False], (ordered[1:] != ordered[:-1]).any(axis=1)])
    places = np.empty(len(vertices), np.int32)
    places[order] = np.cumsum(new)
    return places


def _across(corners: Int32, counts: npt.NDArray[np.bool_]) -> Int32:
    """(F, 3), see `Topology.across`."""
    here, there = corners.reshape(-1).astype(np.int64), np.roll(corners, -1, axis=1).reshape(-1).astype(np.int64)
    edges = np.minimum(here, there) * (int(corners.max()) + 1) + np.maximum(here, there)
    used = np.flatnonzero(np.repeat(counts, 3))
    order = used[np.argsort(edges[used], kind="stable")]
    starts = np.flatnonzero(np.diff(edges[order], prepend=-1))
    pairs = starts[np.diff(starts, append=len(order)) == 2]
    first, second = order[pairs], order[pairs + 1]
    opposed = (here < there)[first] != (here < there)[second]
    first, second = first[opposed], second[opposed]
    across = np.full(len(edges), -1, np.int32)
    across[first], across[second] = second // 3, first // 3
    return across.reshape(-1, 3)


@nb.njit(cache=True, nogil=True)
def corner_of(vertices, faces, face, k, T):
    """Corner of a face in the frame that T leads to, as a tuple."""
    v = faces[face, k]
    x, y, z = np.float64(vertices[v, 0]), np.float64(vertices[v, 1]), np.float64(vertices[v, 2])
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _unit_normal(vertices, faces, face, T):
    """Unit normal of a face after T, zero for one without area; a mirroring T turns it, the sign of which cancels."""
    a = corner_of(vertices, faces, face, 0, T)
    u, v = minus(corner_of(vertices, faces, face, 1, T), a), minus(corner_of(vertices, faces, face, 2, T), a)
    n = cross(u, v)
    length = np.sqrt(dot(n, n))
    if not length > 0.0:
        return 0.0, 0.0, 0.0
    return n[0] / length, n[1] / length, n[2] / length


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _angle(vertices, faces, face, k, T):
    """Inner angle of a face at corner k, after T."""
    p = corner_of(vertices, faces, face, k, T)
    u = minus(corner_of(vertices, faces, face, (k + 1) % 3, T), p)
    v = minus(corner_of(vertices, faces, face, (k + 2) % 3, T), p)
    scale = np.sqrt(dot(u, u) * dot(v, v))
    if not scale > 0.0:
        return 0.0
    return np.arccos(min(1.0, max(-1.0, dot(u, v) / scale)))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _pseudonormal(vertices, faces, corners, across, ring_start, ring, T, face, s, t):
    """Normal of the feature of a face on which ``a + s (b - a) + t (c - a)`` lies, weighted by angles at a vertex."""
    edge = 0 if t == 0.0 else 2 if s == 0.0 else 1 if s + t > 1.0 - 1e-12 else -1
    at = -1
    if t == 0.0 and s >= 1.0:
        at = 1
    elif s == 0.0 and t >= 1.0:
        at = 2
    elif (t == 0.0 and s == 0.0) or (edge >= 0 and across[face, edge] < 0):  # the latter on faces that do not count
        at = 0
    x, y, z = 0.0, 0.0, 0.0
    if at >= 0:
        place = corners[face, at]
        for k in range(ring_start[place], ring_start[place + 1]):
            other = ring[k]
            which = 0 if corners[other, 0] == place else 1 if corners[other, 1] == place else 2
            weight = _angle(vertices, faces, other, which, T)
            n = _unit_normal(vertices, faces, other, T)
            x, y, z = x + weight * n[0], y + weight * n[1], z + weight * n[2]
        return x, y, z
    n = _unit_normal(vertices, faces, face, T)
    if edge < 0:
        return n
    m = _unit_normal(vertices, faces, across[face, edge], T)
    return n[0] + m[0], n[1] + m[1], n[2] + m[2]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def is_inside(p, vertices, faces, corners, across, ring_start, ring, T, face):
    """Whether a point lies inside a closed mesh whose pose is T, if `face` is the nearest of its faces.

    The sign is that of the pseudonormal at the nearest surface point, which tells inside from outside also where that
    is on an edge or a vertex (Baerentzen and Aanaes, Signed distance computation using the angle weighted pseudonormal,
    2005).

    Args:
        p: tuple of three, frame that T leads to.
        vertices: as the following five, mesh and `Topology`.
        faces: see there.
        corners: see there.
        across: see there.
        ring_start: see there.
        ring: see there.
        T: (4, 4) affine; a mirroring one does not swap the sides.
        face: the nearest face.
    """
    a, b = corner_of(vertices, faces, face, 0, T), corner_of(vertices, faces, face, 1, T)
    c = corner_of(vertices, faces, face, 2, T)
    s, t = closest_on_triangle(p, a, b, c)
    away = minus(p, plus(plus(a, s, minus(b, a)), t, minus(c, a)))
    normal = _pseudonormal(vertices, faces, corners, across, ring_start, ring, T, face, s, t)
    determinant = dot((T[0, 0], T[1, 0], T[2, 0]), cross((T[0, 1], T[1, 1], T[2, 1]), (T[0, 2], T[1, 2], T[2, 2])))
    return dot(away, normal) * determinant < 0.0


@nb.njit(cache=True, nogil=True)
def give_signs(points, vertices, faces, corners, across, ring_start, ring, T, chosen, nearest_faces, distances):
    """Negate the (N,) distances of those of the (N, 3) points, `chosen` (K,), that are inside; see `is_inside`."""
    for i in chosen:
        p = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if is_inside(p, vertices, faces, corners, across, ring_start, ring, T, nearest_faces[i]):
            distances[i] = -distances[i]
