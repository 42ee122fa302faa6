"""Compiled loops of the alignment of points with a signed distance field; see `volume_kernels` for how it is kept."""

import numba as nb
import numpy as np

from simtrack.perception.mapping.panoptic.volume_kernels import SIDE, find, pack


@nb.njit(cache=True, nogil=True, error_model="numpy")
def sampled_points(depth, camera, stride, reach, jump):
    """(N, 3) points in the camera frame of every stride-th reading that lies on a smooth surface.

    Args:
        depth: (H, W) float32, metres, 0 = no reading.
        camera: fx, fy, cx, cy.
        stride: pixels.
        reach: pixels on either side ...
        jump: ... in which depth may differ from the middle of its neighbours by this share: the field is wrong where
            surfaces end.
    """
    fx, fy, cx, cy = camera
    out = np.empty((len(range(0, depth.shape[0], stride)) * len(range(0, depth.shape[1], stride)), 3))
    found = 0
    for v in range(reach, depth.shape[0] - reach, stride):
        for u in range(reach, depth.shape[1] - reach, stride):
            z = depth[v, u]
            if not z > 0.0:
                continue
            a, b, c, d = depth[v - reach, u], depth[v + reach, u], depth[v, u - reach], depth[v, u + reach]
            if not min(a, b, c, d) > 0.0:
                continue
            if abs(a + b - 2.0 * z) > jump * z or abs(c + d - 2.0 * z) > jump * z:
                continue
            if abs(a - b) > 8.0 * jump * z or abs(c - d) > 8.0 * jump * z:
                continue
            out[found, 0], out[found, 1], out[found, 2] = (u - cx) / fx * z, (v - cy) / fy * z, z
            found += 1
    return out[:found]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(points, T_map_camera, voxel, reach, robust, keys, table, distances, weights):
    """Gauss-Newton step of sum d(T p)^2 / p_z^2 over points p, with d interpolated between eight voxels.

    Args:
        points: (N, 3), camera frame, metres.
        T_map_camera: (4, 4).
        voxel: metres.
        reach: metres; distances beyond say nothing, they are cut.
        robust: metres from which on residuals count less (Huber).
        keys: (C,) int64 of blocks.
        table: of the hash.
        distances: (C, 512) float32, metres.
        weights: (C, 512) float32.

    Returns:
        H (6, 6), g (6,), for a perturbation (rho, phi) with q' = q + rho + phi x (q - camera); points in known space;
        those of them within `robust` of the surface; the mean of their absolute distances, metres.
    """
    H, g = np.zeros((6, 6)), np.zeros(6)
    R = T_map_camera
    known, near, total = 0, 0, 0.0
    row = np.empty(6)
    values = np.empty(8)
    last_key, last_block = np.int64(-1), np.int64(-1)
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        ax = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
        ay = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
        az = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
        x, y, z = (ax + R[0, 3]) / voxel, (ay + R[1, 3]) / voxel, (az + R[2, 3]) / voxel
        i, j, k = np.int64(np.floor(x)), np.int64(np.floor(y)), np.int64(np.floor(z))
        a, b, c = x - i, y - j, z - k
        whole = True
        for corner in range(8):
            ci, cj, ck = i + (corner & 1), j + ((corner >> 1) & 1), k + (corner >> 2)
            key = pack(ci >> 3, cj >> 3, ck >> 3)
            if key != last_key:
                last_key, last_block = key, find(keys, table, key)
            m = ((ck & 7) * SIDE + (cj & 7)) * SIDE + (ci & 7)
            if last_block < 0 or not weights[last_block, m] > 0.0:
                whole = False
                break
            values[corner] = distances[last_block, m]
        if not whole:
            continue
        v00 = values[0] * (1.0 - a) + values[1] * a
        v10 = values[2] * (1.0 - a) + values[3] * a
        v01 = values[4] * (1.0 - a) + values[5] * a
        v11 = values[6] * (1.0 - a) + values[7] * a
        v0, v1 = v00 * (1.0 - b) + v10 * b, v01 * (1.0 - b) + v11 * b
        d = v0 * (1.0 - c) + v1 * c
        known += 1
        if abs(d) > reach:
            continue
        dz = (v1 - v0) / voxel
        dy = ((v10 - v00) * (1.0 - c) + (v11 - v01) * c) / voxel
        low = (values[1] - values[0]) * (1.0 - b) + (values[3] - values[2]) * b
        high = (values[5] - values[4]) * (1.0 - b) + (values[7] - values[6]) * b
        dx = (low * (1.0 - c) + high * c) / voxel
        if abs(d) <= robust:
            near += 1
            total += abs(d)
        weight = 1.0 / (pz * pz)
        if abs(d) > robust:
            weight *= robust / abs(d)
        row[0], row[1], row[2] = dx, dy, dz
        row[3], row[4], row[5] = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
        for s in range(6):
            g[s] += weight * row[s] * d
            for t in range(s, 6):
                H[s, t] += weight * row[s] * row[t]
    for s in range(6):
        for t in range(s):
            H[s, t] = H[t, s]
    return H, g, known, near, total / max(near, 1)
