"""Residuals of correspondences and what solvers make of them: normal equations and moments, summed in a fixed order.

Compiled, all instances in one call. See `simtrack.perception.tracking.correspondences` for the pairs; everything is in
the camera frame.

Kernels whose arithmetic is loosened (`fastmath`) are inlined in those that call them, as are those that do so in turn:
each module that is compiled has its own copy of what it calls, optimised, and so rounded, in its own way, and which of
them a process uses would depend on what it has compiled before. Results have to repeat to the last bit.
"""

import numpy as np
from numba import njit

_RUN = 64
"""Pairs of one instance that are linearised together, in vector instructions."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _linearise(points, first, count, R, centre, shift, scale, terms):
    """Rows of `terms`, a column a pair.

    The six derivatives, the residual, its weight, the robust share of that, squared deviations, the kernel's curvature.
    """
    last = first + count  # slices, because indices that could be negative keep the loop from being vectorised
    measured, model, normal, weight = (
        points[0][first:last],
        points[1][first:last],
        points[2][first:last],
        points[3][first:last],
    )
    for i in range(count):
        ax, ay, az = model[i, 0] - centre[0], model[i, 1] - centre[1], model[i, 2] - centre[2]
        bx = R[0, 0] * ax + R[0, 1] * ay + R[0, 2] * az
        by = R[1, 0] * ax + R[1, 1] * ay + R[1, 2] * az
        bz = R[2, 0] * ax + R[2, 1] * ay + R[2, 2] * az
        nx = R[0, 0] * normal[i, 0] + R[0, 1] * normal[i, 1] + R[0, 2] * normal[i, 2]
        ny = R[1, 0] * normal[i, 0] + R[1, 1] * normal[i, 1] + R[1, 2] * normal[i, 2]
        nz = R[2, 0] * normal[i, 0] + R[2, 1] * normal[i, 1] + R[2, 2] * normal[i, 2]
        r = (
            nx * (measured[i, 0] - centre[0] - shift[0] - bx)
            + ny * (measured[i, 1] - centre[1] - shift[1] - by)
            + nz * (measured[i, 2] - centre[2] - shift[2] - bz)
        )
        squared = r * r * weight[i]
        root = scale / (scale + squared)
        terms[0, i], terms[1, i], terms[2, i] = nx, ny, nz
        terms[3, i], terms[4, i], terms[5, i] = by * nz - bz * ny, bz * nx - bx * nz, bx * ny - by * nx
        terms[6, i], terms[7, i], terms[8, i], terms[9, i] = r, weight[i] * root * root, root * root, squared
        terms[10, i] = root * root * (1.0 - 4.0 * squared / (scale + squared))


@njit(cache=True, nogil=True, fastmath={"contract", "nsz", "reassoc"}, forceinline=True)
def _add_up(terms, count, H, g, stats):
    """Add the sums over the columns of `terms` to `H` (6, 6), `g` (6,) and `stats` (4,) of one instance."""
    weighted = terms[11]
    for a in range(6):
        for i in range(count):
            weighted[i] = terms[7, i] * terms[a, i]
        total = 0.0
        for i in range(count):
            total += weighted[i] * terms[6, i]
        g[a] += total
        for b in range(a, 6):
            total = 0.0
            for i in range(count):
                total += weighted[i] * terms[b, i]
            H[a, b] += total
    share, squared, deviation, curvature = 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        share += terms[8, i]
        curvature += terms[10, i]
        squared += terms[8, i] * terms[9, i]
        deviation += terms[8, i] * terms[6, i] * terms[6, i]
    stats[0] += share
    stats[1] += squared
    stats[2] += deviation
    stats[3] += curvature


@njit(cache=True, nogil=True, forceinline=True)
def point_normal_equations(points, count, wanted, centres, rotations, shifts, kernel, H, g, stats):
    """Accumulate robust point-to-plane normal equations of the `wanted` (K,) instances from the first `count` pairs.

    The models have moved since the cast by ``m' = c + R (m - c) + t`` about their `centres` (K, 3); `rotations` (K, 3,
    3), `shifts` (K, 3). Residual ``r = n . (p - m')``, Geman-McClure weights, scale `kernel` in standard deviations.
    Outputs: `H` (K, 6, 6) and `g` (K, 6) with ``H xi = g``; `stats` (K, 4): weighted pairs, sum of w r^2 in units of
    the variance, sum of squared residuals of inliers in m^2, sum of the kernel's curvatures.
    """
    owner, terms = points[4], np.empty((12, _RUN))
    first = 0
    while first < count:
        k, last = owner[first], first + 1
        while last < min(first + _RUN, count) and owner[last] == k:
            last += 1
        if wanted[k]:
            _linearise(points, first, last - first, rotations[k], centres[k], shifts[k], kernel * kernel, terms)
            _add_up(terms, last - first, H[k], g[k], stats[k])
        first = last


@njit(cache=True, nogil=True)
def edge_normal_equations(edges, count, camera, centres, rotations, shifts, kernel, H, g):
    """Accumulate the normal equations of silhouette offsets, which move the models' edges in the image.

    As `point_normal_equations`; residual in pixels ``r = offset - d . (proj(m') - proj(m))``.
    """
    point, direction, offset, weight, owner = edges
    scale = kernel * kernel
    J = np.empty(6)
    for i in range(count):
        k = owner[i]
        R = rotations[k]
        x, y, z = point[i, 0], point[i, 1], point[i, 2]
        ax, ay, az = x - centres[k, 0], y - centres[k, 1], z - centres[k, 2]
        bx = R[0, 0] * ax + R[0, 1] * ay + R[0, 2] * az
        by = R[1, 0] * ax + R[1, 1] * ay + R[1, 2] * az
        bz = R[2, 0] * ax + R[2, 1] * ay + R[2, 2] * az
        mx, my, mz = (
            bx + shifts[k, 0] + centres[k, 0],
            by + shifts[k, 1] + centres[k, 1],
            bz + shifts[k, 2] + centres[k, 2],
        )
        du, dv = direction[i, 0], direction[i, 1]
        moved = du * camera[0] * (mx / mz - x / z) + dv * camera[1] * (my / mz - y / z)
        r = offset[i] - moved
        # gradient of d . proj(m') with respect to m'
        px, py = du * camera[0] / mz, dv * camera[1] / mz
        pz = -(px * mx + py * my) / mz
        squared = r * r * weight[i]
        robust = (scale / (scale + squared)) ** 2
        w = weight[i] * robust
        J[0], J[1], J[2] = px, py, pz
        J[3], J[4], J[5] = by * pz - bz * py, bz * px - bx * pz, bx * py - by * px
        for a in range(6):
            g[k, a] += w * J[a] * r
            for b in range(a, 6):
                H[k, a, b] += w * J[a] * J[b]


@njit(cache=True, nogil=True)
def umeyama_sums(points, pairs, centres, rotations, shifts, count, mean_p, mean_q, cross):
    """First and second moments of the first `pairs` correspondences for a closed-form rigid fit of every instance.

    The model's partner ``q`` of a measured point ``p`` is its foot on the tangent plane at the ray's hit. Outputs are
    plain sums: `count` (K,), `mean_p`, `mean_q` (K, 3), `cross` (K, 3, 3) of ``p q^T``, about `centres`.
    """
    measured, model, normal, _, owner = points
    for i in range(pairs):
        k = owner[i]
        R = rotations[k]
        b, n, p = np.empty(3), np.empty(3), np.empty(3)
        for a in range(3):
            b[a], n[a] = shifts[k, a], 0.0
            for c in range(3):
                b[a] += R[a, c] * (model[i, c] - centres[k, c])
                n[a] += R[a, c] * normal[i, c]
            p[a] = measured[i, a] - centres[k, a]
        r = n[0] * (p[0] - b[0]) + n[1] * (p[1] - b[1]) + n[2] * (p[2] - b[2])
        count[k] += 1
        for a in range(3):
            q = p[a] - r * n[a]
            mean_p[k, a] += p[a]
            mean_q[k, a] += q
        for a in range(3):
            for c in range(3):
                cross[k, a, c] += p[a] * (p[c] - r * n[c])
