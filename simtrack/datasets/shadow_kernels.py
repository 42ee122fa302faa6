"""Compiled loops of soft shadows. Lights are vectors: position, direction, colour, whether directional, reach."""

import numpy as np
from numba import njit

PERIOD = 3
"""Neighbouring sources of rays aim at different points of a light, again and again after this many."""


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
def more_samples(lit, points, normals, light):
    """Sources (N, 2) with a neighbour that saw otherwise, each eight times, with the samples (N,) it has not tried."""
    h, w = lit.shape
    disagree = np.zeros((h, w), np.bool_)
    count = 0
    for i in range(h):
        for j in range(w):
            if not _faces(points, normals, i, j, light):
                continue
            for a in range(max(i - 1, 0), min(i + 2, h)):
                for b in range(max(j - 1, 0), min(j + 2, w)):
                    disagree[i, j] |= lit[a, b] != lit[i, j] and _same_surface(points, normals, i, j, a, b)
            count += disagree[i, j]
    rest = PERIOD * PERIOD - 1
    where, which = np.empty((rest * count, 2), np.int32), np.empty(rest * count, np.int32)
    n = 0
    for i in range(h):
        for j in range(w):
            if disagree[i, j]:
                own = (i % PERIOD) * PERIOD + j % PERIOD
                for sample in range(rest + 1):
                    if sample != own:
                        where[n, 0], where[n, 1], which[n] = i, j, sample
                        n += 1
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
    """Enter what rays met: each source's only one, or eight more beside the first."""
    if first:
        for n in range(len(where)):
            lit[where[n, 0], where[n, 1]] = np.float32(0.0 if blocked[n] else 1.0)
        return
    rest = PERIOD * PERIOD - 1
    for n in range(0, len(where), rest):
        seen = lit[where[n, 0], where[n, 1]]
        for k in range(rest):
            seen += np.float32(0.0 if blocked[n + k] else 1.0)
        lit[where[n, 0], where[n, 1]] = seen / np.float32(rest + 1)


@njit(cache=True, nogil=True, inline="always")
def _same_surface(points, normals, i, j, a, b):
    """Whether two sources lie on one surface, by their normals and distance from each other's plane."""
    p, q, n, m = points[i, j], points[a, b], normals[i, j], normals[a, b]
    x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    apart = abs(n[0] * x + n[1] * y + n[2] * z)
    along = np.sqrt(x * x + y * y + z * z)
    return n[0] * m[0] + n[1] * m[1] + n[2] * m[2] > 0.9 and apart <= 0.3 * along + 0.002


@njit(cache=True, nogil=True)
def smoothed(lit, points, normals):
    """(h, w), means over neighbours on the same surface."""
    h, w = lit.shape
    out = np.empty((h, w), np.float32)
    for i in range(h):
        for j in range(w):
            low = high = lit[i, j]
            for a in range(max(i - 1, 0), min(i + 2, h)):
                for b in range(max(j - 1, 0), min(j + 2, w)):
                    low, high = min(low, lit[a, b]), max(high, lit[a, b])
            out[i, j] = lit[i, j]
            if low == high:
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
def remaining(depth, normals, points, turned, lits, stride, camera, pose, lights, ambient):
    """(H, W, 3), share of the diffuse light of ambient (3,) and lights (L, 11) that is left.

    `lits` (L, h, w) are the shares of the lights that sources `points` with normals `turned` (h, w, 3) see.
    """
    fx, fy, cx, cy = camera
    height, width = depth.shape
    h, w = points.shape[:2]
    T = pose.astype(np.float32)
    out = np.ones((height, width, 3), np.float32)
    total, left = np.empty(3, np.float32), np.empty(3, np.float32)
    weights, corners = np.empty(4, np.float32), np.empty((4, 2), np.int64)
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            if not z > 0.0:
                continue
            i, j = v // stride, u // stride
            below, right = min(i + 1, h - 1), min(j + 1, w - 1)
            x, y = np.float32((u - cx) / fx) * z, np.float32((v - cy) / fy) * z
            px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            a, b, c = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
            nx = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c
            ny = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c
            nz = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c
            for k in range(3):
                total[k] = left[k] = ambient[k]
            weighed = False
            for number in range(lights.shape[0]):
                strength = _incidence(px, py, pz, nx, ny, nz, lights[number])
                if strength <= 0.0:
                    continue
                lit = lits[number]
                seen = lit[i, j]
                if not (seen == lit[i, right] == lit[below, j] == lit[below, right]):
                    if not weighed:
                        _weigh(px, py, pz, nx, ny, nz, points, turned, v, u, stride, corners, weights)
                        weighed = True
                    seen = np.float32(0.0)
                    for corner in range(4):
                        seen += weights[corner] * lit[corners[corner, 0], corners[corner, 1]]
                for k in range(3):
                    total[k] += strength * lights[number, 6 + k]
                    left[k] += strength * lights[number, 6 + k] * seen
            for k in range(3):
                if total[k] > 0.0:
                    out[v, u, k] = left[k] / total[k]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(px, py, pz, nx, ny, nz, points, turned, v, u, stride, corners, weights):
    """Corners (4, 2) and weights (4,) of the sources about a pixel: bilinear among those on its surface.

    Where there are none, the nearest counts alone.
    """
    h, w = points.shape[:2]
    whole, nearest, best = np.float32(0.0), np.float32(np.inf), 0
    for corner in range(4):
        i, j = v // stride + corner // 2, u // stride + corner % 2
        near = max(stride - abs(v - i * stride), 0) * max(stride - abs(u - j * stride), 0)
        i, j = min(i, h - 1), min(j, w - 1)
        corners[corner, 0], corners[corner, 1] = i, j
        q, m = points[i, j], turned[i, j]
        dx, dy, dz = q[0] - px, q[1] - py, q[2] - pz
        apart, square = abs(nx * dx + ny * dy + nz * dz), dx * dx + dy * dy + dz * dz
        same = nx * m[0] + ny * m[1] + nz * m[2] > 0.9 and apart <= 0.3 * np.sqrt(square) + 0.002
        weights[corner] = near if same else 0.0
        whole += weights[corner]
        if square < nearest and m[0] * m[0] + m[1] * m[1] + m[2] * m[2] > 0.0:
            nearest, best = square, corner
    for corner in range(4):
        if whole > 0.0:
            weights[corner] /= whole
        else:
            weights[corner] = np.float32(corner == best)
