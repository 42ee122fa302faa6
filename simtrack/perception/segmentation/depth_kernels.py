"""Compiled loops of the geometric segmentation. Images are (H, W) float32, metres, 0 = no reading."""

import numba as nb
import numpy as np

_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, -1), (-1, 0), (-1, -1), (-1, 1))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def reduced(depth, stride, tolerance):
    """(H // stride, W // stride): means of blocks of readings, of those within a share `tolerance` of the nearest."""
    rows, columns = depth.shape[0] // stride, depth.shape[1] // stride
    out = np.zeros((rows, columns), np.float32)
    for v in range(rows):
        for u in range(columns):
            nearest = np.float32(np.inf)
            for i in range(stride):
                for j in range(stride):
                    z = depth[v * stride + i, u * stride + j]
                    if z > 0.0 and z < nearest:
                        nearest = z
            if not np.isfinite(nearest):
                continue
            total, count = np.float32(0.0), 0
            for i in range(stride):
                for j in range(stride):
                    z = depth[v * stride + i, u * stride + j]
                    if z > 0.0 and z <= nearest * (np.float32(1.0) + tolerance):
                        total += z
                        count += 1
            out[v, u] = total / np.float32(count)
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def smoothed(depth, reach, tolerance):
    """Mean over a window of 2 `reach` + 1 pixels along rows, then columns, of readings within a share of the middle."""
    height, width = depth.shape
    first, out = np.zeros_like(depth), np.zeros_like(depth)
    for turn in range(2):
        source, target = (depth, first) if turn == 0 else (first, out)
        for v in range(height):
            for u in range(width):
                middle = source[v, u]
                if not middle > 0.0:
                    continue
                total, count, limit = np.float32(0.0), 0, tolerance * middle
                for k in range(-reach, reach + 1):
                    i, j = (v, u + k) if turn == 0 else (v + k, u)
                    if i < 0 or j < 0 or i >= height or j >= width:
                        continue
                    z = source[i, j]
                    if z > 0.0 and abs(z - middle) <= limit:
                        total += z
                        count += 1
                target[v, u] = total / np.float32(count)
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def surface_normals(depth, camera, reach, tolerance):
    """(H, W, 3) float32 unit normals towards the camera, from differences over +- `reach` pixels; zero where unknown.

    A side on which the depth jumps by more than a share `tolerance` is left out.
    """
    height, width = depth.shape
    fx, fy, cx, cy = camera
    normals = np.zeros((height, width, 3), np.float32)
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            if not z > 0.0:
                continue
            limit = tolerance * z
            u0, u1, v0, v1 = u, u, v, v
            for k in range(1, reach + 1):
                if u0 == u - k + 1 and u - k >= 0 and abs(depth[v, u - k] - depth[v, u0]) <= limit:
                    u0 = u - k
                if u1 == u + k - 1 and u + k < width and abs(depth[v, u + k] - depth[v, u1]) <= limit:
                    u1 = u + k
                if v0 == v - k + 1 and v - k >= 0 and abs(depth[v - k, u] - depth[v0, u]) <= limit:
                    v0 = v - k
                if v1 == v + k - 1 and v + k < height and abs(depth[v + k, u] - depth[v1, u]) <= limit:
                    v1 = v + k
            if u1 == u0 or v1 == v0:
                continue
            za, zb, zc, zd = depth[v, u0], depth[v, u1], depth[v0, u], depth[v1, u]
            y, x = (v - cy) / fy, (u - cx) / fx
            ax, ay, az = (u1 - cx) / fx * zb - (u0 - cx) / fx * za, y * (zb - za), zb - za
            bx, by, bz = x * (zd - zc), (v1 - cy) / fy * zd - (v0 - cy) / fy * zc, zd - zc
            nx, ny, nz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
            norm = np.sqrt(nx * nx + ny * ny + nz * nz)
            if norm > 0.0:
                sign = -1.0 if nx * x + ny * y + nz > 0.0 else 1.0
                normals[v, u, 0] = sign * nx / norm
                normals[v, u, 1] = sign * ny / norm
                normals[v, u, 2] = sign * nz / norm
    return normals


@nb.njit(cache=True, nogil=True, error_model="numpy")
def smooth_inside(depth, normals, camera, reach, convexity, mask, mask_noise, discontinuity):
    """(H, W) uint8: 1 where no edge is, neither concave nor a jump (Furrer et al., IROS 2018, after Tateno et al.).

    A neighbour q of a point p with normals n_q, n_p is on the far side of a concave edge where q lies above the plane
    of p and n_q . n_p < convexity; on the far side of a jump where its distance to that plane exceeds a share of its
    depth. What is less than `mask` + `mask_noise` z^2 above the plane counts as on it.
    """
    height, width = depth.shape
    fx, fy, cx, cy = camera
    inside = np.zeros((height, width), np.uint8)
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            if not z > 0.0 or normals[v, u, 2] == 0.0:
                continue
            x, y = (u - cx) / fx * z, (v - cy) / fy * z
            n0, n1, n2 = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
            above = mask + mask_noise * z * z
            # Seen at a grazing angle, a reading's error along the ray is small across the surface.
            jump = max(discontinuity * z, above)
            smooth = True
            for k in range(8):
                for step in (1, reach):
                    i, j = v + step * _NEIGHBOURS[k][0], u + step * _NEIGHBOURS[k][1]
                    if i < 0 or j < 0 or i >= height or j >= width:
                        continue
                    zq = depth[i, j]
                    if not zq > 0.0:
                        continue
                    off = n0 * ((j - cx) / fx * zq - x) + n1 * ((i - cy) / fy * zq - y) + n2 * (zq - z)
                    if step == 1 and abs(off) > jump:
                        smooth = False
                        break
                    if off > above and normals[i, j, 2] != 0.0:
                        turn = n0 * normals[i, j, 0] + n1 * normals[i, j, 1] + n2 * normals[i, j, 2]
                        if turn < convexity:
                            smooth = False
                            break
                if not smooth:
                    break
            if smooth:
                inside[v, u] = 1
    return inside


@nb.njit(cache=True, nogil=True, error_model="numpy")
def grown(labels, depth, rounds, tolerance):
    """Give readings without label that of a neighbour at about their depth, nearest first, for so many pixels."""
    height, width = labels.shape
    front = np.empty(labels.size, np.int64)
    filled = 0
    for v in range(height):
        for u in range(width):
            if labels[v, u] > 0:
                front[filled] = v * width + u
                filled += 1
    start = 0
    for _ in range(rounds):
        end = filled
        for at in range(start, end):
            v, u = front[at] // width, front[at] % width
            for k in range(8):
                if _NEIGHBOURS[k][0] * _NEIGHBOURS[k][1] != 0:
                    continue
                i, j = v + _NEIGHBOURS[k][0], u + _NEIGHBOURS[k][1]
                if i < 0 or j < 0 or i >= height or j >= width or labels[i, j] != 0 or not depth[i, j] > 0.0:
                    continue
                if abs(depth[i, j] - depth[v, u]) <= tolerance * depth[v, u]:
                    labels[i, j] = labels[v, u]
                    front[filled] = i * width + j
                    filled += 1
        start = end
    return labels


@nb.njit(cache=True, nogil=True, error_model="numpy")
def enlarged(labels, depth, coarse, stride, tolerance):
    """(H, W) labels of readings: of their block, where they are at about its depth."""
    out = np.zeros(depth.shape, np.int32)
    for v in range(labels.shape[0] * stride):
        for u in range(labels.shape[1] * stride):
            z = coarse[v // stride, u // stride]
            if depth[v, u] > 0.0 and z > 0.0 and abs(depth[v, u] - z) <= tolerance * z:
                out[v, u] = labels[v // stride, u // stride]
    return out
