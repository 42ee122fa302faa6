"""Correspondences of MICP-L: points of shots with planes of the map, and the sums that Gauss-Newton needs, compiled.

Correspondences are kept in single precision relative to the pose of the cast, from which the steps lead away by
centimetres. Sums run over fixed chunks on the calling thread, so results do not depend on threads.
"""

import numpy as np
from numba import njit

from simtrack.raycast.packets import address
from simtrack.raycast.vector import prefetch

ROWS = 9
"""Of the array of correspondences: 0-2 the measured point from the base's origin, in the axes of the map, at the pose
of the cast; 3-5 the plane's normal; 6 the signed distance of the point from the plane at the pose of the cast, metres;
7 the information of that distance; 8 that of the plane's own position, which the map's error leaves."""

_AHEAD = 24
"""Rays ahead of which planes are fetched: they lie all over the memory."""
_CHUNK = 1024
_SAMPLES = 1024
_BINS = 512


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
    p0, p1, p2, p3, p4, p5, p6, p7, p8 = (
        pairs[0],
        pairs[1],
        pairs[2],
        pairs[3],
        pairs[4],
        pairs[5],
        pairs[6],
        pairs[7],
        pairs[8],
    )
    x, y, z = np.float32(T[0, 3]), np.float32(T[1, 3]), np.float32(T[2, 3])
    limit, slack = np.float32(gate), np.float32(6.0 * gate + 0.1)
    across2, shared2, one = np.float32(pointing_sigma**2), np.float32(patch_variance), np.float32(1.0)
    kept = np.uint32(0)  # unsigned indices need no check for being negative
    p_planes, last = address(planes), ranges.shape[0] - 1
    for ray in range(ranges.shape[0]):
        i = np.uint32(ray)
        prefetch(p_planes + 16 * np.intp(faces[np.uint32(min(ray + _AHEAD, last))]))
        slip = ranges[i] - distances[i]
        if instances[i] != map_instance or not abs(slip) <= slack:
            continue
        d0, d1, d2 = directions[i, 0], directions[i, 1], directions[i, 2]
        if normals[i, 0] * d0 + normals[i, 1] * d1 + normals[i, 2] * d2 >= 0.0:
            continue  # from inside a body: no surface that the sensor could have seen
        face = np.uint32(faces[i])
        n0, n1, n2 = planes[face, 0], planes[face, 1], planes[face, 2]
        cosine = n0 * d0 + n1 * d1 + n2 * d2
        if abs(cosine * slip) > limit:
            continue
        r, cosine2 = ranges[i], cosine * cosine
        p0[kept], p1[kept], p2[kept] = (
            origins[i, 0] - x + r * d0,
            origins[i, 1] - y + r * d1,
            origins[i, 2] - z + r * d2,
        )
        p3[kept], p4[kept], p5[kept], p6[kept] = n0, n1, n2, cosine * slip
        p7[kept] = sigmas[i] * sigmas[i] * cosine2 + across2 * r * r * (one - cosine2)
        patch = np.uint32(planes[face, 3])
        patches[kept] = patch
        counts[patch] += 1
        kept += np.uint32(1)
    for i in range(kept):
        shared = np.float32(counts[np.uint32(patches[i])]) * shared2
        p7[i] = one / (p7[i] + shared + np.float32(1e-8))
        p8[i] = one / max(shared, np.float32(1e-12))
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"}, forceinline=True)
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
        information (6, 6), gradient (6,), and statistics (2,): sum of the kernel's weights, and of these times e^2.
    """
    zero = np.float32(0.0)
    m = motion.astype(np.float32)
    m00, m01, m02, m10, m11, m12 = m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2]
    m20, m21, m22 = m[2, 0], m[2, 1], m[2, 2]
    s0, s1, s2 = np.float32(shift[0]), np.float32(shift[1]), np.float32(shift[2])
    scale2 = np.float32(kernel * kernel)
    p0, p1, p2, p3, p4, p5, p6 = pairs[0], pairs[1], pairs[2], pairs[3], pairs[4], pairs[5], pairs[6]
    H, g, stats = np.zeros((6, 6)), np.zeros(6), np.zeros(2)
    for start in range(0, count, _CHUNK):
        h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = zero
        h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = zero
        g0 = g1 = g2 = g3 = g4 = g5 = zero
        r_ = ree = zero
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
            r_, ree = r_ + robust, ree + robust * e * e
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
        stats[0] += r_
        stats[1] += ree
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
    return H, g, stats


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"}, forceinline=True)
def any_normals(pairs, weights, count, kernel):
    """The information that the same rays would have if their normals pointed anywhere.

    Args:
        pairs: (`ROWS`, N) correspondences, of which `count` columns count.
        weights: (N,) float32, row 7 of them.
        count: see `pairs`.
        kernel: metres, scale of the robust kernel.

    Returns:
        (6, 6) ``sum w B B^T``, ``B = [I; [q]x]``, at the pose of the cast, and metres of RMS distance of the points.
    """
    zero, scale2 = np.float32(0.0), np.float32(kernel * kernel)
    p0, p1, p2, p6 = pairs[0], pairs[1], pairs[2], pairs[6]
    sums = np.zeros(12)
    for start in range(0, count, _CHUNK):
        w_ = wx = wy = wz = wxx = wxy = wxz = wyy = wyz = wzz = r_ = rqq = zero
        for column in range(start, min(start + _CHUNK, count)):
            i = np.uint32(column)
            x, y, z, e = p0[i], p1[i], p2[i], p6[i]
            share = scale2 / (scale2 + e * e)
            robust = share * share
            w = weights[i] * robust
            a, b, c = w * x, w * y, w * z
            w_, wx, wy, wz = w_ + w, wx + a, wy + b, wz + c
            wxx, wxy, wxz = wxx + a * x, wxy + a * y, wxz + a * z
            wyy, wyz, wzz = wyy + b * y, wyz + b * z, wzz + c * z
            r_, rqq = r_ + robust, rqq + robust * (x * x + y * y + z * z)
        chunk = (w_, wx, wy, wz, wxx, wxy, wxz, wyy, wyz, wzz, r_, rqq)
        for k in range(12):
            sums[k] += chunk[k]
    w_, wx, wy, wz, wxx, wxy, wxz, wyy, wyz, wzz, r_, rqq = sums
    B = np.array(
        [
            [w_, 0.0, 0.0, 0.0, wz, -wy],
            [0.0, w_, 0.0, -wz, 0.0, wx],
            [0.0, 0.0, w_, wy, -wx, 0.0],
            [0.0, -wz, wy, wyy + wzz, -wxy, -wxz],
            [wz, 0.0, -wx, -wxy, wxx + wzz, -wyz],
            [-wy, wx, 0.0, -wxz, -wyz, wxx + wyy],
        ]
    )
    return B, np.sqrt(rqq / max(r_, 1e-12))
