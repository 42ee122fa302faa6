"""MICP-L between two casts: correspondences along the rays, and robust Gauss-Newton steps on them, compiled.

Correspondences are kept in single precision relative to the pose of the cast, from which the steps lead away by
centimetres; the pose itself and all sums over many of them are double. Sums run over fixed chunks on the calling
thread, so results do not depend on threads.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from simtrack.perception.localization.kernels import rotation_vector, turn

ROWS = 9
"""Of the array of correspondences: 0-2 the measured point from the base's origin, in the axes of the map, at the pose
of the cast; 3-5 the plane's normal; 6 the signed distance of the point from the plane at the pose of the cast, metres;
7 the information of that distance; 8 that of the plane's own position, which the map's error leaves."""

_CHUNK = 1024
_SAMPLES = 1024
_BINS = 512


class Rules(NamedTuple):
    """Settings of `descend`."""

    iterations: int
    """Gauss-Newton steps at most."""
    tolerance: float
    """m, at `reach`: smaller steps end the iterations."""
    reach: float
    """m, at which rotations are measured."""
    gate: float
    """m, largest scale of the robust kernel."""
    min_kernel: float
    """m, smallest."""
    normal_sigma: float
    """rad, of the map's normals."""
    observability: float
    """See `RegistrationConfig`."""


@njit(cache=True, nogil=True, error_model="numpy")
def pair(T, view, hits, planes, map_instance, gate, pointing_sigma, patch_variance, counts, patches, pairs):
    """Point-to-plane correspondences along the rays, gated, with their whitening weights.

    A ray's plane passes through the hit of the ray cast from the current estimate. The planes of one patch of the map
    share its error (variance `patch_variance`), so n rays on one patch together carry no more than 1 / patch_variance:
    marginalising the shared error of equal Jacobians gives each ray the weight 1 / (sigma^2 + n patch_variance).

    Args:
        T: (4, 4) pose of the cast.
        view: origins, directions, ranges and sigmas of the shots, map frame.
        hits: distances, normals, faces and instances.
        planes: (F, 4) float32, unit normal of each face of the map and the number of its patch.
        map_instance: the map among the instances.
        gate: metres, largest distance from the plane.
        pointing_sigma: rad, of a shot's direction.
        patch_variance: m^2.
        counts: (P,) int32 zeros, one a patch; zeros again afterwards.
        patches: (N,) int32, working space.
        pairs: (`ROWS`, N) float32, is filled.

    Returns:
        How many columns of `pairs` are filled.
    """
    origins, directions, ranges, sigmas = view
    distances, normals, faces, instances = hits
    x, y, z = np.float32(T[0, 3]), np.float32(T[1, 3]), np.float32(T[2, 3])
    limit, slack = np.float32(gate), np.float32(6.0 * gate + 0.1)
    across2, shared2, one = np.float32(pointing_sigma**2), np.float32(patch_variance), np.float32(1.0)
    kept = 0
    for i in range(ranges.shape[0]):
        slip = ranges[i] - distances[i]
        if instances[i] != map_instance or not abs(slip) <= slack:
            continue
        d0, d1, d2 = directions[i, 0], directions[i, 1], directions[i, 2]
        if normals[i, 0] * d0 + normals[i, 1] * d1 + normals[i, 2] * d2 >= 0.0:
            continue  # from inside a body: no surface that the sensor could have seen
        face = faces[i]
        n0, n1, n2 = planes[face, 0], planes[face, 1], planes[face, 2]
        cosine = n0 * d0 + n1 * d1 + n2 * d2
        if abs(cosine * slip) > limit:
            continue
        r = ranges[i]
        pairs[0, kept] = (origins[i, 0] - x) + r * d0
        pairs[1, kept] = (origins[i, 1] - y) + r * d1
        pairs[2, kept] = (origins[i, 2] - z) + r * d2
        pairs[3, kept], pairs[4, kept], pairs[5, kept] = n0, n1, n2
        pairs[6, kept] = cosine * slip
        cosine2 = cosine * cosine
        pairs[7, kept] = sigmas[i] * sigmas[i] * cosine2 + across2 * r * r * (one - cosine2)
        patch = np.int32(planes[face, 3])
        patches[kept] = patch
        counts[patch] += 1
        kept += 1
    for i in range(kept):
        shared = np.float32(counts[patches[i]]) * shared2
        pairs[7, i] = one / (pairs[7, i] + shared + np.float32(1e-8))
        pairs[8, i] = one / max(shared, np.float32(1e-12))
    counts[:] = 0
    return kept


@njit(cache=True, nogil=True, error_model="numpy")
def kernel_scale(pairs, count, motion, shift, low, high):
    """Three times the median distance from the planes, metres, within bounds: outliers hardly touch it.

    Args:
        pairs: correspondences, of which `count` columns count and some thousand are looked at.
        count: see `pairs`.
        motion: (3, 3), the rotation since the cast, less the identity.
        shift: (3,), the translation since the cast, metres.
        low: bounds of the result, metres ...
        high: ... which is found to a five-hundredth of this.
    """
    histogram = np.zeros(_BINS + 1, np.int32)
    stride = max(1, count // _SAMPLES)
    samples = (count + stride - 1) // stride
    width = high / 3.0 / _BINS
    for i in range(0, count, stride):
        e = pairs[6, i]
        for a in range(3):
            moved = shift[a]
            for b in range(3):
                moved += motion[a, b] * pairs[b, i]
            e += pairs[3 + a, i] * moved
        histogram[min(int(abs(e) / width), _BINS)] += 1
    below, half = 0, samples // 2
    for k in range(_BINS):
        if below + histogram[k] > half:
            median = width * (k + (half - below + 0.5) / histogram[k])
            return min(max(3.0 * median, low), high)
        below += histogram[k]
    return high


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def normal_equations(pairs, weights, count, motion, shift, kernel):
    """Normal equations of point-to-plane registration with a Geman-McClure kernel.

    Residual ``e = e_cast + n . ((D - I) q + s)`` after a rotation D and a translation s since the cast; for the
    decoupled left perturbation ``J = [n, (D q) x n]``.

    Args:
        pairs: (`ROWS`, N) correspondences, of which `count` columns count.
        weights: (N,) float32, row 7 or 8 of them.
        count: see `pairs`.
        motion: (3, 3), D - I.
        shift: (3,), s, metres.
        kernel: metres, scale of the robust kernel.

    Returns:
        information (6, 6), gradient (6,), the information (6, 6) that the same rays would have if their normals
        pointed anywhere (``sum w B B^T``, ``B = [I; [D q]x]``), and statistics (3,): sum of the kernel's weights,
        of these times e^2, and times |q|^2.
    """
    zero = np.float32(0.0)
    m = motion.astype(np.float32)
    m00, m01, m02, m10, m11, m12 = m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2]
    m20, m21, m22 = m[2, 0], m[2, 1], m[2, 2]
    s0, s1, s2 = np.float32(shift[0]), np.float32(shift[1]), np.float32(shift[2])
    scale2 = np.float32(kernel * kernel)
    p0, p1, p2, p3, p4, p5, p6 = pairs[0], pairs[1], pairs[2], pairs[3], pairs[4], pairs[5], pairs[6]
    H, g, B, stats = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6)), np.zeros(3)
    for start in range(0, count, _CHUNK):
        h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = zero
        h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = zero
        g0 = g1 = g2 = g3 = g4 = g5 = zero
        w_ = wx = wy = wz = wxx = wxy = wxz = wyy = wyz = wzz = zero
        r_ = ree = rqq = zero
        for column in range(start, min(start + _CHUNK, count)):
            i = np.uint32(column)
            qx, qy, qz, nx, ny, nz = p0[i], p1[i], p2[i], p3[i], p4[i], p5[i]
            dx = m00 * qx + m01 * qy + m02 * qz
            dy = m10 * qx + m11 * qy + m12 * qz
            dz = m20 * qx + m21 * qy + m22 * qz
            e = p6[i] + nx * (dx + s0) + ny * (dy + s1) + nz * (dz + s2)
            qx, qy, qz = qx + dx, qy + dy, qz + dz
            share = scale2 / (scale2 + e * e)
            robust = share * share
            w = weights[i] * robust
            jx, jy, jz = qy * nz - qz * ny, qz * nx - qx * nz, qx * ny - qy * nx
            a = w * nx
            h00, h01, h02, h03, h04, h05 = (
                h00 + a * nx, h01 + a * ny, h02 + a * nz, h03 + a * jx, h04 + a * jy, h05 + a * jz,
            )  # fmt: skip
            g0 += a * e
            a = w * ny
            h11, h12, h13, h14, h15 = h11 + a * ny, h12 + a * nz, h13 + a * jx, h14 + a * jy, h15 + a * jz
            g1 += a * e
            a = w * nz
            h22, h23, h24, h25 = h22 + a * nz, h23 + a * jx, h24 + a * jy, h25 + a * jz
            g2 += a * e
            a = w * jx
            h33, h34, h35 = h33 + a * jx, h34 + a * jy, h35 + a * jz
            g3 += a * e
            a = w * jy
            h44, h45 = h44 + a * jy, h45 + a * jz
            g4 += a * e
            a = w * jz
            h55 += a * jz
            g5 += a * e
            a = w * qx
            w_, wx, wxx, wxy, wxz = w_ + w, wx + a, wxx + a * qx, wxy + a * qy, wxz + a * qz
            a = w * qy
            wy, wyy, wyz = wy + a, wyy + a * qy, wyz + a * qz
            a = w * qz
            wz, wzz = wz + a, wzz + a * qz
            r_, ree, rqq = r_ + robust, ree + robust * e * e, rqq + robust * (qx * qx + qy * qy + qz * qz)
        upper = (
            h00, h01, h02, h03, h04, h05, h11, h12, h13, h14, h15,
            h22, h23, h24, h25, h33, h34, h35, h44, h45, h55,
        )  # fmt: skip
        gradient = (g0, g1, g2, g3, g4, g5)
        k = 0
        for i in range(6):
            g[i] += gradient[i]
            for j in range(i, 6):
                H[i, j] += upper[k]
                k += 1
        for i in range(3):
            B[i, i] += w_
        B[0, 4] += wz
        B[0, 5] -= wy
        B[1, 5] += wx
        B[3, 3] += wyy + wzz
        B[4, 4] += wxx + wzz
        B[5, 5] += wxx + wyy
        B[3, 4] -= wxy
        B[3, 5] -= wxz
        B[4, 5] -= wyz
        stats[0] += r_
        stats[1] += ree
        stats[2] += rqq
    B[1, 3], B[2, 3], B[2, 4] = -B[0, 4], -B[0, 5], -B[1, 5]
    for i in range(6):
        for j in range(i):
            H[i, j], B[i, j] = H[j, i], B[j, i]
    return H, g, B, stats


@njit(cache=True, nogil=True)
def observable(info, feigned, stats, normal_sigma, observability):
    """The directions that the data constrain (Zhang et al. 2016, with a threshold from the noise).

    Normals that are off by `normal_sigma` at random give every direction some information, at most
    ``normal_sigma^2 (sum w B B^T - sum w J J^T)``. A direction whose information is not `observability` times that is
    not observed: the pose stays as predicted there. Rotations are scaled by the RMS distance of the points, which makes
    eigenvalues comparable.

    Args:
        info: (6, 6), see `normal_equations` ...
        feigned: (6, 6), likewise ...
        stats: (3,), likewise.
        normal_sigma: rad.
        observability: ratio.

    Returns:
        basis (6, K), steps that stay in the observed directions, metres and radians a unit, and its dual (6, K) with
        ``dual.T @ basis = I``, which reads the coordinates of a step.
    """
    scale = np.ones(6)
    scale[3:] = 1.0 / np.sqrt(max(stats[2] / max(stats[0], 1e-12), 1e-4))
    outer = scale.reshape(6, 1) * scale
    values, vectors = np.linalg.eigh(outer * info)
    noise = normal_sigma**2 * outer * (feigned - info)
    basis, dual, count = np.empty((6, 6)), np.empty((6, 6)), 0
    for k in range(6):
        least = 0.0
        for i in range(6):
            for j in range(6):
                least += vectors[i, k] * noise[i, j] * vectors[j, k]
        if values[k] > observability * max(least, 1e-9):
            basis[:, count] = scale * vectors[:, k]
            dual[:, count] = vectors[:, k] / scale
            count += 1
    return basis[:, :count].copy(), dual[:, :count].copy()


@njit(cache=True, nogil=True)
def descend(T_cast, pairs, count, T_prior, prior, upright, floor, rules):
    """Gauss-Newton steps on fixed correspondences, with the odometry prediction and the prior of standing upright.

    Args:
        T_cast: (4, 4) pose of the cast, where the steps begin.
        pairs: (`ROWS`, N) correspondences, of which `count` columns count.
        count: see `pairs`.
        T_prior: (4, 4) predicted pose.
        prior: (6, 6) information of the prediction.
        upright: (6, 6) information of standing upright at height `floor`.
        floor: metres.
        rules: settings.

    Returns:
        (4, 4) pose, (6, 6) information of the data in the observed directions, basis and dual of these (see
        `observable`), metres of robust RMS distance from the planes, metres of kernel scale, and steps taken.
    """
    T, R_cast = T_cast.copy(), T_cast[:3, :3].copy()
    R, b, turned = R_cast.copy(), np.empty(6), np.empty((3, 3))
    info, basis, dual = np.zeros((6, 6)), np.zeros((6, 0)), np.zeros((6, 0))
    residual, kernel, steps = 0.0, rules.gate, 0
    while steps < rules.iterations:
        motion, shift = R @ R_cast.T - np.eye(3), T[:3, 3] - T_cast[:3, 3]
        kernel = kernel_scale(pairs, count, motion, shift, rules.min_kernel, rules.gate)
        H, g, feigned, stats = normal_equations(pairs, pairs[7], count, motion, shift, kernel)
        basis, dual = observable(H, feigned, stats, rules.normal_sigma, rules.observability)
        projector = dual @ np.ascontiguousarray(basis.T)
        half = projector @ H
        info = 0.5 * (half + half.T)
        away = np.empty(6)
        away[:3] = T[:3, 3] - T_prior[:3, 3]
        away[3:] = rotation_vector(R, T_prior)
        tilt = np.array([0.0, 0.0, T[2, 3] - floor, -R[1, 2], R[0, 2], 0.0])
        b = projector @ g + prior @ away + upright @ tilt
        step = -np.linalg.solve(info + prior + upright, b)
        turn(step[3], step[4], step[5], R, turned)
        R[:] = turned
        T[:3, 3] += step[:3]
        T[:3, :3] = R
        steps += 1
        residual = np.sqrt(stats[1] / max(stats[0], 1e-12))
        size = 0.0
        for a in range(3):
            size = max(size, abs(step[a]), rules.reach * abs(step[3 + a]))
        if size < rules.tolerance:
            break
    return T, info, basis, dual, residual, kernel, steps


@njit(cache=True, nogil=True)
def map_information(pairs, count, T_cast, T, kernel):
    """(6, 6) information that the map's error alone would leave, all rays together, at pose T (4, 4)."""
    motion = T[:3, :3].copy() @ T_cast[:3, :3].copy().T - np.eye(3)
    H, _, _, _ = normal_equations(pairs, pairs[8], count, motion, T[:3, 3] - T_cast[:3, 3], kernel)
    return H
