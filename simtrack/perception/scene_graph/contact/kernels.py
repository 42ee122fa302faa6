"""Compiled geometry of contact: how much of a surface lies under a footprint, and how far it encloses an axis."""

import numpy as np
from numba import njit

_CORNERS = 12
"""A triangle cut by six half-spaces has nine corners at most."""


@njit(cache=True, nogil=True)
def _cut(polygon, count, axis, sign, limit, out):
    """Sutherland and Hodgman (1974): the part of a polygon with ``sign * p[axis] <= limit``; returns its corners."""
    kept = 0
    for i in range(count):
        j = (i + 1) % count
        a = sign * polygon[i, axis] - limit
        b = sign * polygon[j, axis] - limit
        if a <= 0.0:
            out[kept] = polygon[i]
            kept += 1
        if (a < 0.0 < b) or (b < 0.0 < a):
            s = a / (a - b)
            for k in range(3):
                out[kept, k] = polygon[i, k] + s * (polygon[j, k] - polygon[i, k])
            kept += 1
    return kept


@njit(cache=True, nogil=True)
def _into(vertices, face, origin, cosine, sine, polygon):
    """A triangle in an upright frame: origin (3,), x axis at the yaw of (cosine, sine)."""
    for k in range(3):
        x = vertices[face[k], 0] - origin[0]
        y = vertices[face[k], 1] - origin[1]
        polygon[k, 0] = cosine * x + sine * y
        polygon[k, 1] = cosine * y - sine * x
        polygon[k, 2] = vertices[face[k], 2] - origin[2]


@njit(cache=True, nogil=True)
def covered(vertices, faces, origin, cosine, sine, half, margin, low, high):
    """What of a surface lies under an upright box's footprint, between two heights.

    Args:
        vertices: (V, 3), map.
        faces: (K, 3).
        origin: (3,), centre of the footprint.
        cosine: of the footprint's yaw.
        sine: likewise.
        half: (2,), half its side lengths.
        margin: metres around the footprint in which surface is looked for, too.
        low: lowest height relative to the origin's.
        high: highest, likewise.

    Returns:
        (4,) x0, x1, y0, y1 of the rectangle around what was found, in the footprint's frame and cut to the footprint
        (x0 >= x1 if there is none), and the horizontal area of what lies in the footprint itself.
    """
    a = np.empty((_CORNERS, 3))
    b = np.empty((_CORNERS, 3))
    reach_x = half[0] + margin
    reach_y = half[1] + margin
    around = np.sqrt(reach_x * reach_x + reach_y * reach_y)
    x0 = y0 = np.inf
    x1 = y1 = -np.inf
    area = 0.0
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        # most faces lie elsewhere: seen before they are turned
        p, q, r = vertices[i, 0] - origin[0], vertices[j, 0] - origin[0], vertices[k, 0] - origin[0]
        if min(p, q, r) > around or max(p, q, r) < -around:
            continue
        p, q, r = vertices[i, 1] - origin[1], vertices[j, 1] - origin[1], vertices[k, 1] - origin[1]
        if min(p, q, r) > around or max(p, q, r) < -around:
            continue
        _into(vertices, faces[f], origin, cosine, sine, a)
        if min(a[0, 2], a[1, 2], a[2, 2]) > high or max(a[0, 2], a[1, 2], a[2, 2]) < low:
            continue
        if min(a[0, 0], a[1, 0], a[2, 0]) > reach_x or max(a[0, 0], a[1, 0], a[2, 0]) < -reach_x:
            continue
        if min(a[0, 1], a[1, 1], a[2, 1]) > reach_y or max(a[0, 1], a[1, 1], a[2, 1]) < -reach_y:
            continue
        n = _cut(a, 3, 2, 1.0, high, b)
        n = _cut(b, n, 2, -1.0, -low, a)
        n = _cut(a, n, 0, 1.0, reach_x, b)
        n = _cut(b, n, 0, -1.0, reach_x, a)
        n = _cut(a, n, 1, 1.0, reach_y, b)
        n = _cut(b, n, 1, -1.0, reach_y, a)
        for i in range(n):
            x0 = min(x0, a[i, 0])
            x1 = max(x1, a[i, 0])
            y0 = min(y0, a[i, 1])
            y1 = max(y1, a[i, 1])
        n = _cut(a, n, 0, 1.0, half[0], b)
        n = _cut(b, n, 0, -1.0, half[0], a)
        n = _cut(a, n, 1, 1.0, half[1], b)
        n = _cut(b, n, 1, -1.0, half[1], a)
        twice = 0.0
        for i in range(n):
            j = (i + 1) % n
            twice += a[i, 0] * a[j, 1] - a[j, 0] * a[i, 1]
        area += 0.5 * abs(twice)
    rectangle = np.array([max(x0, -half[0]), min(x1, half[0]), max(y0, -half[1]), min(y1, half[1])])
    return rectangle, area


@njit(cache=True, nogil=True)
def enclosure(vertices, faces, origin, low, high, bins):
    """Share of the horizontal directions, seen from an axis, in which a surface stands between two heights.

    `origin` (3,) lies on the axis; heights are relative to its. 1 = enclosed all around.
    """
    a = np.empty((_CORNERS, 3))
    b = np.empty((_CORNERS, 3))
    hit = np.zeros(bins, dtype=np.bool_)
    turn = 2.0 * np.pi
    for f in range(len(faces)):
        _into(vertices, faces[f], origin, 1.0, 0.0, a)
        if min(a[0, 2], a[1, 2], a[2, 2]) > high or max(a[0, 2], a[1, 2], a[2, 2]) < low:
            continue
        n = _cut(a, 3, 2, 1.0, high, b)
        n = _cut(b, n, 2, -1.0, -low, a)
        if n == 0:
            continue
        start = np.arctan2(a[0, 1], a[0, 0])
        least = most = 0.0
        for i in range(1, n):
            off = (np.arctan2(a[i, 1], a[i, 0]) - start + np.pi) % turn - np.pi
            least = min(least, off)
            most = max(most, off)
        if most - least >= np.pi:  # the axis runs through it
            continue
        # a direction counts if its ray passes through: bin centres inside the interval
        first = int(np.ceil((start + least) / turn * bins - 0.5))
        last = int(np.floor((start + most) / turn * bins - 0.5))
        for k in range(first, last + 1):
            hit[k % bins] = True
    return hit.mean()
