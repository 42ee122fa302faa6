"""How far apart two triangles are, and whether they cross; compiled, on tuples of three numbers."""

import numba as nb
import numpy as np

from simtrack.raycast.closest import closest_on_triangle


@nb.njit(cache=True, nogil=True, inline="always")
def dot(a, b):
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@nb.njit(cache=True, nogil=True, inline="always")
def minus(a, b):
    """Difference."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@nb.njit(cache=True, nogil=True, inline="always")
def plus(a, s, b):
    """``a + s b``."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


@nb.njit(cache=True, nogil=True, inline="always")
def cross(a, b):
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def between_segments(p, q, r, s):
    """Nearest points of the segments pq and rs (Ericson, Real-Time Collision Detection, 5.1.9)."""
    u, v, w = minus(q, p), minus(s, r), minus(p, r)
    a, e, f = dot(u, u), dot(v, v), dot(v, w)
    along, other = 0.0, 0.0
    if a > 0.0 and e > 0.0:
        b, c = dot(u, v), dot(u, w)
        area = a * e - b * b
        if area > 1e-14 * a * e:
            along = min(max((b * f - c * e) / area, 0.0), 1.0)
        other = (b * along + f) / e
        if other < 0.0:
            other, along = 0.0, min(max(-c / a, 0.0), 1.0)
        elif other > 1.0:
            other, along = 1.0, min(max((b - c) / a, 0.0), 1.0)
    elif a > 0.0:
        along = min(max(-dot(u, w) / a, 0.0), 1.0)
    elif e > 0.0:
        other = min(max(f / e, 0.0), 1.0)
    return plus(p, along, u), plus(r, other, v)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def pierces(p, q, a, b, c):
    """Whether the segment pq passes through the triangle abc, and where."""
    u, v, d = minus(b, a), minus(c, a), minus(q, p)
    h = cross(d, v)
    volume = dot(u, h)
    if volume == 0.0:
        return False, p
    w = minus(p, a)
    s = dot(w, h) / volume
    if not 0.0 <= s <= 1.0:
        return False, p
    k = cross(w, u)
    t = dot(d, k) / volume
    if not (t >= 0.0 and s + t <= 1.0):
        return False, p
    along = dot(v, k) / volume
    if not 0.0 <= along <= 1.0:
        return False, p
    return True, plus(p, along, d)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def between_triangles(first, second):
    """Squared distance and nearest points of two triangles, each a tuple of its corners; 0 where they cross.

    Triangles that do not cross are nearest at a corner of one of them or between two edges.
    """
    for k in range(3):
        through, x = pierces(first[k], first[(k + 1) % 3], second[0], second[1], second[2])
        if through:
            return 0.0, x, x
        through, x = pierces(second[k], second[(k + 1) % 3], first[0], first[1], first[2])
        if through:
            return 0.0, x, x
    best, on_first, on_second = np.inf, first[0], second[0]
    for k in range(3):
        p = first[k]
        s, t = closest_on_triangle(p, second[0], second[1], second[2])
        q = plus(plus(second[0], s, minus(second[1], second[0])), t, minus(second[2], second[0]))
        away = minus(p, q)
        square = dot(away, away)
        if square < best:
            best, on_first, on_second = square, p, q
        q = second[k]
        s, t = closest_on_triangle(q, first[0], first[1], first[2])
        p = plus(plus(first[0], s, minus(first[1], first[0])), t, minus(first[2], first[0]))
        away = minus(p, q)
        square = dot(away, away)
        if square < best:
            best, on_first, on_second = square, p, q
        for j in range(3):
            p, q = between_segments(first[k], first[(k + 1) % 3], second[j], second[(j + 1) % 3])
            away = minus(p, q)
            square = dot(away, away)
            if square < best:
                best, on_first, on_second = square, p, q
    return best, on_first, on_second
