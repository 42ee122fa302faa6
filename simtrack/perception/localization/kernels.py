"""Compiled inner loops of the localizer. All sums run in one fixed order, so results do not depend on threads."""

import numba as nb
import numpy as np

from simtrack.contracts import Float64


@nb.njit(cache=True, nogil=True)
def deskew_shots(
    directions: Float64,
    times: Float64,
    shots: np.ndarray,
    T_base_lidar: Float64,
    knot_times: Float64,
    knots: Float64,
    turns: Float64,
) -> tuple[Float64, Float64]:
    """Origins and directions (M, 3) of the given shots in the base frame at the last knot.

    Between two knots T_end_base(t) moves on a straight line and turns about a fixed axis.

    Args:
        directions: (N, 3), lidar frame.
        times: (N,), seconds.
        shots: (M,) int64, which of the N.
        T_base_lidar: (4, 4).
        knot_times: (K,), seconds.
        knots: (K, 4, 4), T_end_base at the knots.
        turns: (K - 1, 3), rotation vectors from knot to knot, left perturbation.
    """
    count = shots.shape[0]
    origins, turned = np.empty((count, 3)), np.empty((count, 3))
    last = knot_times.shape[0] - 2
    mount, d, R, t = T_base_lidar[:3, 3].copy(), np.empty(3), np.empty((3, 3)), np.empty(3)
    for row in range(count):
        shot = shots[row]
        time = times[shot]
        k = 0
        while k < last and time >= knot_times[k + 1]:
            k += 1
        if last < 0:
            R[:, :] = knots[0, :3, :3]
            t[:] = knots[0, :3, 3]
        else:
            share = (time - knot_times[k]) / (knot_times[k + 1] - knot_times[k])
            for i in range(3):
                t[i] = knots[k, i, 3] + share * (knots[k + 1, i, 3] - knots[k, i, 3])
            _turn(share * turns[k, 0], share * turns[k, 1], share * turns[k, 2], knots[k], R)
        for i in range(3):
            d[i] = 0.0
            for j in range(3):
                d[i] += T_base_lidar[i, j] * directions[shot, j]
        for i in range(3):
            origins[row, i] = t[i] + R[i, 0] * mount[0] + R[i, 1] * mount[1] + R[i, 2] * mount[2]
            turned[row, i] = R[i, 0] * d[0] + R[i, 1] * d[1] + R[i, 2] * d[2]
    return origins, turned


@nb.njit(cache=True, nogil=True)
def _turn(x: float, y: float, z: float, knot: Float64, out: Float64) -> None:
    """Out = Exp((x, y, z)) @ knot[:3, :3], by Rodrigues' formula applied to each column."""
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-16:
        a, b = 1.0, 0.5
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    for j in range(3):
        v0, v1, v2 = knot[0, j], knot[1, j], knot[2, j]
        c0, c1, c2 = y * v2 - z * v1, z * v0 - x * v2, x * v1 - y * v0
        out[0, j] = v0 + a * c0 + b * (y * c2 - z * c1)
        out[1, j] = v1 + a * c1 + b * (z * c0 - x * c2)
        out[2, j] = v2 + a * c2 + b * (x * c1 - y * c0)


@nb.njit(cache=True, nogil=True)
def correspond(
    T: Float64,
    origins: Float64,
    directions: Float64,
    ranges: Float64,
    sigmas: Float64,
    distances: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    instances: np.ndarray,
    face_normals: np.ndarray,
    patches: np.ndarray,
    map_instance: int,
    gate: float,
    pointing_sigma: float,
    patch_variance: float,
    counts: np.ndarray,
) -> tuple[Float64, Float64, Float64, Float64, int]:
    """Point-to-plane correspondences along the rays, gated, with their whitening weights.

    A ray's plane passes through the hit of the ray cast from the current estimate. The planes of one patch of the map
    share its error (variance `patch_variance`), so n rays on one patch together carry no more than 1 / patch_variance:
    marginalising the shared error of equal Jacobians gives each ray the weight 1 / (sigma^2 + n patch_variance).

    Returns:
        points (M, 3) in the base frame, planes (M, 4) as normal and offset in the map, weights (M,) = information of
        the residual, map-only weights (M,) = 1 / (n patch_variance), and the number of rays that hit the map at all.
    """
    count = ranges.shape[0]
    points, planes = np.empty((count, 3)), np.empty((count, 4))
    variances, hit_patches = np.empty(count), np.empty(count, np.int64)
    kept, hits = 0, 0
    R, t, d = T[:3, :3].copy(), T[:3, 3].copy(), np.empty(3)
    for i in range(count):
        if instances[i] != map_instance or not np.isfinite(distances[i]):
            continue
        for a in range(3):
            d[a] = R[a, 0] * directions[i, 0] + R[a, 1] * directions[i, 1] + R[a, 2] * directions[i, 2]
        facing = normals[i, 0] * d[0] + normals[i, 1] * d[1] + normals[i, 2] * d[2]
        if facing >= 0.0:
            continue  # from inside a body: no surface that the sensor could have seen
        hits += 1
        face = faces[i]
        n0, n1, n2 = face_normals[face, 0], face_normals[face, 1], face_normals[face, 2]
        cosine = n0 * d[0] + n1 * d[1] + n2 * d[2]
        slip = ranges[i] - distances[i]
        if abs(cosine * slip) > gate or abs(slip) > 6.0 * gate + 0.1:
            continue
        offset = 0.0
        for a in range(3):
            o = R[a, 0] * origins[i, 0] + R[a, 1] * origins[i, 1] + R[a, 2] * origins[i, 2] + t[a]
            offset += face_normals[face, a] * (o + distances[i] * d[a])
            points[kept, a] = origins[i, a] + ranges[i] * directions[i, a]
        planes[kept, 0], planes[kept, 1], planes[kept, 2], planes[kept, 3] = n0, n1, n2, offset
        across = pointing_sigma * ranges[i]
        variances[kept] = sigmas[i] ** 2 * cosine * cosine + across * across * (1.0 - cosine * cosine) + 1e-8
        hit_patches[kept] = patches[face]
        counts[patches[face]] += 1
        kept += 1
    weights, map_weights = np.empty(kept), np.empty(kept)
    for i in range(kept):
        shared = counts[hit_patches[i]] * patch_variance
        weights[i] = 1.0 / (variances[i] + shared)
        map_weights[i] = 1.0 / max(shared, 1e-12)
    for i in range(kept):
        counts[hit_patches[i]] = 0
    return points[:kept], planes[:kept], weights, map_weights, hits


@nb.njit(cache=True, nogil=True)
def plane_distances(T: Float64, points: Float64, planes: Float64) -> Float64:
    """(M,) absolute distances in metres of points (M, 3) in the base frame to planes (M, 4) in the map."""
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        e = -planes[i, 3]
        for a in range(3):
            e += planes[i, a] * (T[a, 0] * points[i, 0] + T[a, 1] * points[i, 1] + T[a, 2] * points[i, 2] + T[a, 3])
        out[i] = abs(e)
    return out


@nb.njit(cache=True, nogil=True)
def normal_equations(
    T: Float64, points: Float64, planes: Float64, weights: Float64, map_weights: Float64, kernel: float
) -> tuple[Float64, Float64, Float64, Float64, Float64]:
    """Normal equations of point-to-plane registration with a Geman-McClure kernel.

    Residual ``e = n . (R p + t) - offset``; for the decoupled left perturbation ``J = [n, (R p) x n]``.

    Returns:
        information (6, 6), gradient (6,), map-only information (6, 6), the information (6, 6) that the same rays
        would have if their normals pointed anywhere (``sum w B B^T``, ``B = [I; [R p]x]``), and
        statistics (3,): sum of w_robust, sum of w_robust e^2, sum of |R p|^2 w_robust.
    """
    H, M, S = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    g, stats, J, q = np.zeros(6), np.zeros(3), np.empty(6), np.empty(3)
    R, t = T[:3, :3].copy(), T[:3, 3].copy()
    scale2 = kernel * kernel
    for i in range(points.shape[0]):
        for a in range(3):
            q[a] = R[a, 0] * points[i, 0] + R[a, 1] * points[i, 1] + R[a, 2] * points[i, 2]
        n0, n1, n2 = planes[i, 0], planes[i, 1], planes[i, 2]
        e = n0 * (q[0] + t[0]) + n1 * (q[1] + t[1]) + n2 * (q[2] + t[2]) - planes[i, 3]
        share = scale2 / (scale2 + e * e)
        robust = share * share
        w = weights[i] * robust
        wm = map_weights[i] * robust
        J[0], J[1], J[2] = n0, n1, n2
        J[3] = q[1] * n2 - q[2] * n1
        J[4] = q[2] * n0 - q[0] * n2
        J[5] = q[0] * n1 - q[1] * n0
        for a in range(6):
            g[a] += w * e * J[a]
            for b in range(a, 6):
                H[a, b] += w * J[a] * J[b]
                M[a, b] += wm * J[a] * J[b]
        norm2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
        for a in range(3):
            S[a, a] += w
            S[3 + a, 3 + a] += w * (norm2 - q[a] * q[a])
        S[0, 4] += w * q[2]
        S[0, 5] -= w * q[1]
        S[1, 3] -= w * q[2]
        S[1, 5] += w * q[0]
        S[2, 3] += w * q[1]
        S[2, 4] -= w * q[0]
        S[3, 4] -= w * q[0] * q[1]
        S[3, 5] -= w * q[0] * q[2]
        S[4, 5] -= w * q[1] * q[2]
        stats[0] += robust
        stats[1] += robust * e * e
        stats[2] += robust * norm2
    for a in range(6):
        for b in range(a):
            H[a, b], M[a, b], S[a, b] = H[b, a], M[b, a], S[b, a]
    return H, g, M, S, stats


@nb.njit(cache=True, nogil=True)
def explain(
    ranges: Float64,
    sigmas: Float64,
    distances: np.ndarray,
    normals: np.ndarray,
    cosines: Float64,
    tolerance: float,
) -> np.ndarray:
    """What the map says about each shot.

    Returns:
        (N,) int8: 0 explained by a floor, ceiling or other level surface; 1 explained by structure; 2 the measurement
        ends in front of the map (something that the map does not have); 3 it reaches through the map's surface;
        4 the map has nothing there.
    """
    out = np.empty(ranges.shape[0], np.int8)
    for i in range(ranges.shape[0]):
        if not np.isfinite(distances[i]):
            out[i] = 4
            continue
        slip = ranges[i] - distances[i]
        limit = tolerance + 3.0 * sigmas[i]
        if cosines[i] < 0.0 and abs(slip * cosines[i]) <= limit and abs(slip) <= 8.0 * limit:
            out[i] = 0 if abs(normals[i, 2]) > 0.8 else 1
        elif slip < 0.0:
            out[i] = 2
        else:
            out[i] = 3
    return out


@nb.njit(cache=True, nogil=True)
def average_normals(normals: Float64, areas: Float64, faces: np.ndarray, vertex_count: int, crease: float) -> Float64:
    """One round of bilateral averaging of face normals (F, 3) over the faces that share a vertex."""
    start = np.zeros(vertex_count + 1, np.int64)
    for f in range(faces.shape[0]):
        for k in range(3):
            start[faces[f, k] + 1] += 1
    for v in range(vertex_count):
        start[v + 1] += start[v]
    fill, around = start[:-1].copy(), np.empty(faces.size, np.int64)
    for f in range(faces.shape[0]):
        for k in range(3):
            v = faces[f, k]
            around[fill[v]] = f
            fill[v] += 1
    out = np.empty_like(normals)
    for f in range(faces.shape[0]):
        n0, n1, n2 = normals[f, 0], normals[f, 1], normals[f, 2]
        s0, s1, s2 = areas[f] * n0, areas[f] * n1, areas[f] * n2
        for k in range(3):
            v = faces[f, k]
            for j in range(start[v], start[v + 1]):
                g = around[j]
                alike = n0 * normals[g, 0] + n1 * normals[g, 1] + n2 * normals[g, 2]
                if alike > crease:
                    w = areas[g] * (alike - crease)
                    s0 += w * normals[g, 0]
                    s1 += w * normals[g, 1]
                    s2 += w * normals[g, 2]
        length = np.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
        if length > 1e-15:
            out[f, 0], out[f, 1], out[f, 2] = s0 / length, s1 / length, s2 / length
        else:
            out[f, 0], out[f, 1], out[f, 2] = n0, n1, n2
    return out
