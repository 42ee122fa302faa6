"""Compiled loops of soft shadows. Lights are vectors: position, direction, colour, whether directional, reach."""

import numpy as np
from numba import njit

PERIOD = 3
"""Neighbouring sources of rays aim at different points of a light, again and again after this many."""
SAMPLES = PERIOD * PERIOD
MORE = 4
"""Further samples of a source whose neighbours saw otherwise."""


@njit(cache=True, nogil=True, error_model="numpy")
def sources(depth, normals, stride, camera, pose):
    """Points (h, w, 3) and unit normals (h, w, 3), map frame, at every `stride`-th pixel; normals 0 = nothing."""
    fx, fy, cx, cy = camera
    h, w = (depth.shape[0] + stride - 1) // stride, (depth.shape[1] + stride - 1) // stride
    points, turned = np.zeros((h, w, 3), np.float32), np.zeros((h, w, 3), np.float32)
    for i in range(h):
        for j in range(w):
            v, u = i * stride, j * stride
            z = depth[v, u]
            if z > 0.0:
                x, y = (u - cx) / fx * z, (v - cy) / fy * z
                for k in range(3):
                    points[i, j, k] = pose[k, 0] * x + pose[k, 1] * y + pose[k, 2] * z + pose[k, 3]
                    a, b, c = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
                    turned[i, j, k] = pose[k, 0] * a + pose[k, 1] * b + pose[k, 2] * c
    return points, turned


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _incidence(px, py, pz, nx, ny, nz, light):
    """Cosine of a light's incidence on a surface times its strength there; 0 from behind."""
    if light[9] > 0.0:
        return max(-(nx * light[3] + ny * light[4] + nz * light[5]), np.float32(0.0))
    x, y, z = light[0] - px, light[1] - py, light[2] - pz
    square = max(x * x + y * y + z * z, np.float32(1e-6))
    return max((nx * x + ny * y + nz * z) / np.sqrt(square), np.float32(0.0)) * light[10] * light[10] / square


@njit(cache=True, nogil=True)
def _faces(points, normals, i, j, light):
    p, n = points[i, j], normals[i, j]
    return _incidence(p[0], p[1], p[2], n[0], n[1], n[2], light) > 0.0


@njit(cache=True, nogil=True)
def first_samples(points, normals, light):
    """Sources (N, 2) that face a light, in tiles of 4x4, and the sample (N,) of the light that each aims at."""
    h, w = points.shape[:2]
    where, which = np.empty((h * w, 2), np.int32), np.empty(h * w, np.int32)
    n = 0
    for top in range(0, h, 4):
        for left in range(0, w, 4):
            for i in range(top, min(top + 4, h)):
                for j in range(left, min(left + 4, w)):
                    if _faces(points, normals, i, j, light):
                        where[n, 0], where[n, 1] = i, j
                        which[n] = (i % PERIOD) * PERIOD + j % PERIOD
                        n += 1
    return where[:n], which[:n]


@njit(cache=True, nogil=True)
def _edges(lit):
    """(h, w), whether one of the eight neighbours differs."""
    h, w = lit.shape
    out = np.zeros((h, w), np.bool_)
    for i in range(h):
        for j in range(w):
            for a, b in ((i, j + 1), (i + 1, j - 1), (i + 1, j), (i + 1, j + 1)):
                if a < h and 0 <= b < w and lit[a, b] != lit[i, j]:
                    out[i, j] = out[a, b] = True
    return out


@njit(cache=True, nogil=True)
def more_samples(lit, points, normals, light):
    """Sources (N, 2) with a neighbour that saw otherwise, `MORE` times each, with samples (N,) it has not tried yet."""
    h, w = lit.shape
    chosen = np.empty((h * w, 2), np.int32)
    count, edges = 0, _edges(lit)
    for i in range(h):
        for j in range(w):
            if not (edges[i, j] and _faces(points, normals, i, j, light)):
                continue
            differs = False
            for a in range(max(i - 1, 0), min(i + 2, h)):
                for b in range(max(j - 1, 0), min(j + 2, w)):
                    if lit[a, b] != lit[i, j] and not differs:
                        differs = _same_surface(points, normals, i, j, a, b)
            if differs:
                chosen[count, 0], chosen[count, 1] = i, j
                count += 1
    where, which = np.empty((MORE * count, 2), np.int32), np.empty(MORE * count, np.int32)
    for n in range(count):
        i, j = chosen[n]
        for k in range(MORE):
            where[MORE * n + k] = chosen[n]
            which[MORE * n + k] = ((i % PERIOD) * PERIOD + j % PERIOD + 2 * (k + 1)) % SAMPLES
    return where, which


@njit(cache=True, nogil=True)
def shadow_rays(points, normals, where, which, light, across, skin):
    """Origins and directions (N, 3), map frame, from sources to samples of a light, which they reach at distance 1."""
    origins, directions = np.empty((len(where), 3), np.float32), np.empty((len(where), 3), np.float32)
    for n in range(len(where)):
        i, j = where[n]
        for k in range(3):
            origins[n, k] = points[i, j, k] + skin * normals[i, j, k]
            if light[9] > 0.0:
                directions[n, k] = across[which[n], k] - light[10] * light[3 + k]
            else:
                directions[n, k] = light[k] + across[which[n], k] - origins[n, k]
    return origins, directions


@njit(cache=True, nogil=True)
def gather(where, blocked, first, lit):
    """Enter what rays met: each source's first one, or `MORE` beside it."""
    if first:
        for n in range(len(where)):
            lit[where[n, 0], where[n, 1]] = np.float32(0.0 if blocked[n] else 1.0)
        return
    for n in range(0, len(where), MORE):
        seen = lit[where[n, 0], where[n, 1]]
        for k in range(MORE):
            seen += np.float32(0.0 if blocked[n + k] else 1.0)
        lit[where[n, 0], where[n, 1]] = seen / np.float32(MORE + 1)


@njit(cache=True, nogil=True, inline="always")
def _alike(cosine, apart, square):
    """Whether two points with normals at that cosine lie on one surface, `apart` off the plane of one of them."""
    return cosine > 0.9 and apart * apart <= np.float32(0.09) * square + np.float32(4e-6)


@njit(cache=True, nogil=True, inline="always")
def _same_surface(points, normals, i, j, a, b):
    """Whether two sources lie on one surface, by their normals and distance from each other's plane."""
    p, q, n, m = points[i, j], points[a, b], normals[i, j], normals[a, b]
    x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    turn, apart = n[0] * m[0] + n[1] * m[1] + n[2] * m[2], n[0] * x + n[1] * y + n[2] * z
    return _alike(turn, apart, x * x + y * y + z * z)


@njit(cache=True, nogil=True)
def smoothed(lit, points, normals):
    """(h, w), means over neighbours on the same surface."""
    h, w = lit.shape
    out, edges = np.empty((h, w), np.float32), _edges(lit)
    for i in range(h):
        for j in range(w):
            out[i, j] = lit[i, j]
            if not edges[i, j]:
                continue
            total, count = np.float32(0.0), 0
            for a in range(max(i - 1, 0), min(i + 2, h)):
                for b in range(max(j - 1, 0), min(j + 2, w)):
                    if (a == i and b == j) or _same_surface(points, normals, i, j, a, b):
                        total += lit[a, b]
                        count += 1
            out[i, j] = total / np.float32(count)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def remaining(points, normals, lits, lights, ambient):
    """(h, w, 3), share of the diffuse light of ambient (3,) and lights (L, 11) that sources keep.

    `lits` (L, h, w) are the shares of each light that they see.
    """
    h, w = points.shape[:2]
    out = np.ones((h, w, 3), np.float32)
    total, left = np.empty(3, np.float32), np.empty(3, np.float32)
    for i in range(h):
        for j in range(w):
            shaded = False
            for number in range(lights.shape[0]):
                shaded |= lits[number, i, j] < 1.0
            if not shaded:
                continue
            p, n = points[i, j], normals[i, j]
            for k in range(3):
                total[k] = left[k] = ambient[k]
            for number in range(lights.shape[0]):
                strength = _incidence(p[0], p[1], p[2], n[0], n[1], n[2], lights[number])
                for k in range(3):
                    total[k] += strength * lights[number, 6 + k]
                    left[k] += strength * lights[number, 6 + k] * lits[number, i, j]
            for k in range(3):
                if total[k] > 0.0:
                    out[i, j, k] = left[k] / total[k]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def spread(shares, depth, normals, points, turned, stride, camera, pose):
    """(H, W, 3), shares (h, w, 3) of sources `points` with normals `turned`, brought to all pixels."""
    fx, fy, cx, cy = camera
    height, width = depth.shape
    h, w = points.shape[:2]
    T = pose.astype(np.float32)
    plain = np.empty((h, w), np.bool_)
    for i in range(h):
        for j in range(w):
            plain[i, j] = True
            for a in range(i, min(i + 2, h)):
                for b in range(j, min(j + 2, w)):
                    for k in range(3):
                        plain[i, j] &= shares[a, b, k] == 1.0
    out = np.ones((height, width, 3), np.float32)
    for v in range(height):
        y = np.float32((v - cy) / fy)
        for u in range(width):
            z = depth[v, u]
            if plain[v // stride, u // stride] or not z > 0.0:
                continue
            x = np.float32((u - cx) / fx)
            px = (T[0, 0] * x + T[0, 1] * y + T[0, 2]) * z + T[0, 3]
            py = (T[1, 0] * x + T[1, 1] * y + T[1, 2]) * z + T[1, 3]
            pz = (T[2, 0] * x + T[2, 1] * y + T[2, 2]) * z + T[2, 3]
            a, b, c = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
            nx = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c
            ny = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c
            nz = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c
            red, green, blue, whole = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            nearest, best_i, best_j = np.float32(np.inf), v // stride, u // stride
            for i in range(v // stride, min(v // stride + 2, h)):
                for j in range(u // stride, min(u // stride + 2, w)):
                    near = np.float32(max(stride - abs(v - i * stride), 0) * max(stride - abs(u - j * stride), 0))
                    if near == 0.0:
                        continue
                    dx, dy, dz = points[i, j, 0] - px, points[i, j, 1] - py, points[i, j, 2] - pz
                    mx, my, mz = turned[i, j, 0], turned[i, j, 1], turned[i, j, 2]
                    square = dx * dx + dy * dy + dz * dz
                    if _alike(nx * mx + ny * my + nz * mz, nx * dx + ny * dy + nz * dz, square):
                        red += near * shares[i, j, 0]
                        green += near * shares[i, j, 1]
                        blue += near * shares[i, j, 2]
                        whole += near
                    elif square < nearest and mx * mx + my * my + mz * mz > 0.0:
                        nearest, best_i, best_j = square, i, j
            if whole > 0.0:
                out[v, u, 0], out[v, u, 1], out[v, u, 2] = red / whole, green / whole, blue / whole
            else:
                for k in range(3):
                    out[v, u, k] = shares[best_i, best_j, k]
    return out
