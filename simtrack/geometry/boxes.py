"""Oriented boxes: signed distance, closest and farthest points, containment; exact, compiled, no iteration.

A box is a pose `T_map_box` (origin in the box's centre) and full side lengths. The signed distance of two boxes is
their Euclidean distance when they are apart and minus the penetration depth (the shortest translation that separates
them) when they overlap. The depth follows from the fifteen axes of the separating-axis test (S. Gottschalk, M. C. Lin,
D. Manocha, "OBBTree", SIGGRAPH 1996): the faces of the Minkowski difference of two boxes have no other normals. The
distance is attained between a corner and a box or between two edges, all of which are tried.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from simtrack.contracts import Bool, Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import is_rigid

_PARALLEL = 1e-12
"""Squared sine below which two edges count as parallel: their cross product is no axis of its own."""
_TIGHT = 1e-10
"""Metres: lengths that differ by less are equal."""


@dataclass(frozen=True, slots=True)
class OrientedBox:
    """A box anywhere in the map."""

    T_map_box: Float64
    """(4, 4), origin in the centre of the box."""
    extents: Float64
    """(3,), full side lengths along the box's own axes, metres, positive."""

    def __post_init__(self) -> None:
        extents = np.asarray(self.extents, dtype=float)
        if extents.shape != (3,) or not np.isfinite(extents).all() or not (extents > 0).all():
            raise InvalidValueError("OrientedBox.extents", self.extents, "three positive finite lengths in metres")
        if not is_rigid(np.asarray(self.T_map_box)):
            raise InvalidValueError("OrientedBox.T_map_box", self.T_map_box, "a (4, 4) rigid transform")

    @property
    def corners(self) -> Float64:
        """(8, 3) corners in the map; bit 0, 1, 2 of the row number choose the sign along x, y, z (0 = minus)."""
        signs = np.array([[(i >> k & 1) - 0.5 for k in range(3)] for i in range(8)])
        return (signs * self.extents) @ self.T_map_box[:3, :3].T + self.T_map_box[:3, 3]

    def contains(self, points: Float64) -> Bool:
        """(N,) bool: which of (N, 3) map points lie in the closed box."""
        local = (np.asarray(points) - self.T_map_box[:3, 3]) @ self.T_map_box[:3, :3]
        return np.all(np.abs(local) <= 0.5 * np.asarray(self.extents), axis=-1)


@dataclass(frozen=True, slots=True)
class BoxProximity:
    """How two boxes lie to each other; all distances in metres."""

    distance: float
    """Shortest distance between the closed boxes; 0 where they meet."""
    signed: float
    """`distance` if apart, minus the penetration depth if they overlap."""
    point_a: Float64
    """(3,), map: point of the first box closest to the second (a common point of both where they meet)."""
    point_b: Float64
    """(3,), map: point of the second box closest to the first."""
    maximum: float
    """Longest distance between a point of one box and a point of the other."""
    farthest_a: Float64
    """(3,), map: corner of the first box where `maximum` is attained."""
    farthest_b: Float64
    """(3,), map: corner of the second box where `maximum` is attained."""


def proximity(a: OrientedBox, b: OrientedBox) -> BoxProximity:
    """Distances and closest and farthest points of two boxes."""
    part_a, part_b = _parts(a), _parts(b)
    point_a, point_b = np.empty(3), np.empty(3)
    signed = separation(*part_a, *part_b)
    if signed > 0.0:
        signed = distance_apart(*part_a, *part_b, signed, point_a, point_b)
    else:
        _common_point(*part_a, *part_b, point_a)
        point_b[:] = point_a
    gaps = np.linalg.norm(a.corners[:, None] - b.corners[None], axis=2)
    i, j = np.unravel_index(int(np.argmax(gaps)), gaps.shape)
    return BoxProximity(
        distance=max(0.0, float(signed)),
        signed=float(signed),
        point_a=point_a,
        point_b=point_b,
        maximum=float(gaps[i, j]),
        farthest_a=a.corners[i],
        farthest_b=b.corners[j],
    )


def _parts(box: OrientedBox) -> tuple[Float64, Float64, Float64]:
    T = np.ascontiguousarray(box.T_map_box, dtype=float)
    return T[:3, 3].copy(), np.ascontiguousarray(T[:3, :3]), 0.5 * np.asarray(box.extents, dtype=float)


# Kernels. A box is (centre (3,), rotation (3, 3) with the axes as columns, half side lengths (3,)).


@njit(cache=True, nogil=True)
def separation(ca, Ra, ha, cb, Rb, hb):
    """Largest gap over the fifteen separating axes: minus the penetration depth, or a lower bound of the distance."""
    R = np.empty((3, 3))
    A = np.empty((3, 3))
    t = np.empty(3)
    for i in range(3):
        t[i] = Ra[0, i] * (cb[0] - ca[0]) + Ra[1, i] * (cb[1] - ca[1]) + Ra[2, i] * (cb[2] - ca[2])
        for j in range(3):
            R[i, j] = Ra[0, i] * Rb[0, j] + Ra[1, i] * Rb[1, j] + Ra[2, i] * Rb[2, j]
            A[i, j] = abs(R[i, j])
    best = -np.inf
    for i in range(3):
        gap = abs(t[i]) - ha[i] - (A[i, 0] * hb[0] + A[i, 1] * hb[1] + A[i, 2] * hb[2])
        best = max(best, gap)
    for j in range(3):
        along = abs(t[0] * R[0, j] + t[1] * R[1, j] + t[2] * R[2, j])
        gap = along - hb[j] - (A[0, j] * ha[0] + A[1, j] * ha[1] + A[2, j] * ha[2])
        best = max(best, gap)
    for i in range(3):
        i1 = (i + 1) % 3
        i2 = (i + 2) % 3
        for j in range(3):
            square = 1.0 - R[i, j] * R[i, j]
            if square < _PARALLEL:
                continue
            j1 = (j + 1) % 3
            j2 = (j + 2) % 3
            reach = ha[i1] * A[i2, j] + ha[i2] * A[i1, j] + hb[j1] * A[i, j2] + hb[j2] * A[i, j1]
            gap = (abs(t[i2] * R[i1, j] - t[i1] * R[i2, j]) - reach) / np.sqrt(square)
            best = max(best, gap)
    return best


@njit(cache=True, nogil=True)
def signed_distance(ca, Ra, ha, cb, Rb, hb, limit):
    """Signed distance of two boxes; beyond `limit` only a lower bound of the distance, which then exceeds `limit`."""
    gap = separation(ca, Ra, ha, cb, Rb, hb)
    if gap <= 0.0 or gap > limit:
        return gap
    return distance_apart(ca, Ra, ha, cb, Rb, hb, gap, np.empty(3), np.empty(3))


@njit(cache=True, nogil=True)
def distance_apart(ca, Ra, ha, cb, Rb, hb, bound, point_a, point_b):
    """Distance of two disjoint boxes, of which `bound` is a lower bound; writes the closest points."""
    best = _corners_to_box(ca, Ra, ha, cb, Rb, hb, np.inf, point_a, point_b)
    best = _corners_to_box(cb, Rb, hb, ca, Ra, ha, best, point_b, point_a)
    if best <= bound + _TIGHT:
        return best
    p = np.empty(3)
    q = np.empty(3)
    u = np.empty(3)
    v = np.empty(3)
    for i in range(12):
        _edge(ca, Ra, ha, i, p, u)
        for j in range(12):
            _edge(cb, Rb, hb, j, q, v)
            best = _edges(p, u, q, v, best, point_a, point_b)
    return best


@njit(cache=True, nogil=True)
def corner_distance(ca, Ra, ha, cb, Rb, hb):
    """Distance of two disjoint boxes if a corner of one of them is closest to the other, else an upper bound of it."""
    p = np.empty(3)
    q = np.empty(3)
    return _corners_to_box(cb, Rb, hb, ca, Ra, ha, _corners_to_box(ca, Ra, ha, cb, Rb, hb, np.inf, p, q), p, q)


@njit(cache=True, nogil=True)
def _corners_to_box(ca, Ra, ha, cb, Rb, hb, best, point_a, point_b):
    p = np.empty(3)
    q = np.empty(3)
    for corner in range(8):
        for k in range(3):
            p[k] = ca[k]
            for axis in range(3):
                p[k] += (ha[axis] if corner >> axis & 1 else -ha[axis]) * Ra[k, axis]
        for k in range(3):
            q[k] = cb[k]
        for axis in range(3):
            s = (p[0] - cb[0]) * Rb[0, axis] + (p[1] - cb[1]) * Rb[1, axis] + (p[2] - cb[2]) * Rb[2, axis]
            s = min(max(s, -hb[axis]), hb[axis])
            for k in range(3):
                q[k] += s * Rb[k, axis]
        distance = np.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
        if distance < best:
            best = distance
            for k in range(3):
                point_a[k] = p[k]
                point_b[k] = q[k]
    return best


@njit(cache=True, nogil=True)
def _edge(c, R, h, index, start, along):
    """Start and direction (full length) of one of the twelve edges."""
    axis = index // 4
    b1 = (axis + 1) % 3
    b2 = (axis + 2) % 3
    s1 = h[b1] if index & 1 else -h[b1]
    s2 = h[b2] if index & 2 else -h[b2]
    for k in range(3):
        start[k] = c[k] - h[axis] * R[k, axis] + s1 * R[k, b1] + s2 * R[k, b2]
        along[k] = 2.0 * h[axis] * R[k, axis]


@njit(cache=True, nogil=True)
def _edges(p, u, q, v, best, point_a, point_b):
    """Closest points of two segments (C. Ericson, Real-Time Collision Detection, 2005, section 5.1.9)."""
    uu = uv = vv = uw = vw = 0.0
    for k in range(3):
        w = p[k] - q[k]
        uu += u[k] * u[k]
        uv += u[k] * v[k]
        vv += v[k] * v[k]
        uw += u[k] * w
        vw += v[k] * w
    denominator = uu * vv - uv * uv
    s = 0.0
    if denominator > _PARALLEL * uu * vv:
        s = min(max((uv * vw - uw * vv) / denominator, 0.0), 1.0)
    t = (uv * s + vw) / vv
    if t < 0.0:
        t = 0.0
        s = min(max(-uw / uu, 0.0), 1.0)
    elif t > 1.0:
        t = 1.0
        s = min(max((uv - uw) / uu, 0.0), 1.0)
    square = 0.0
    for k in range(3):
        square += (p[k] + s * u[k] - q[k] - t * v[k]) ** 2
    if square < best * best:
        best = np.sqrt(square)
        for k in range(3):
            point_a[k] = p[k] + s * u[k]
            point_b[k] = q[k] + t * v[k]
    return best


@njit(cache=True, nogil=True)
def _common_point(ca, Ra, ha, cb, Rb, hb, point):
    """Some point of two boxes that meet: inside one there is a corner or a piece of an edge of the other."""
    p = np.empty(3)
    u = np.empty(3)
    fallback = np.inf
    for turn in range(2):
        for index in range(12):
            if turn == 0:
                _edge(ca, Ra, ha, index, p, u)
                outside, middle = _clip(p, u, cb, Rb, hb)
            else:
                _edge(cb, Rb, hb, index, p, u)
                outside, middle = _clip(p, u, ca, Ra, ha)
            if outside < fallback:
                fallback = outside
                for k in range(3):
                    point[k] = p[k] + middle * u[k]
            if outside <= 0.0:
                return


@njit(cache=True, nogil=True)
def _clip(p, u, c, R, h):
    """Middle parameter of the piece of segment p + s u, s in [0, 1], in a box, and by how much the piece is missing."""
    low = 0.0
    high = 1.0
    for axis in range(3):
        start = (p[0] - c[0]) * R[0, axis] + (p[1] - c[1]) * R[1, axis] + (p[2] - c[2]) * R[2, axis]
        rate = u[0] * R[0, axis] + u[1] * R[1, axis] + u[2] * R[2, axis]
        if abs(rate) < 1e-15:
            if abs(start) > h[axis] + _TIGHT:
                return np.inf, 0.5
            continue
        s0 = (-h[axis] - start) / rate
        s1 = (h[axis] - start) / rate
        low = max(low, min(s0, s1))
        high = min(high, max(s0, s1))
    return low - high, min(max(0.5 * (low + high), 0.0), 1.0)
