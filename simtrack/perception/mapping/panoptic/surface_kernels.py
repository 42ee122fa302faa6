"""Surface nets on blocks of voxels: one vertex a cell that the surface passes, one quad an edge that it crosses.

S. Gibson, *Constrained elastic surface nets*, MICCAI 1998, without the relaxation: a vertex is the mean of where the
surface crosses the edges of its cell. The cell of a voxel has it and its seven neighbours in +x, +y, +z as corners.
"""

import numba as nb
import numpy as np

from simtrack.perception.mapping.panoptic.volume_kernels import SIDE, find, pack

_OFFSET = np.int64(1 << 20)


@nb.njit(cache=True, nogil=True)
def neighbours(keys, table, count):
    """(count, 27) numbers of the blocks around each, by (dz + 1) * 9 + (dy + 1) * 3 + dx + 1; -1 = none."""
    out = np.full((count, 27), -1, np.int32)
    for block in range(count):
        key = keys[block]
        x, y = (key >> 42) - _OFFSET, ((key >> 21) & np.int64(0x1FFFFF)) - _OFFSET
        z = (key & np.int64(0x1FFFFF)) - _OFFSET
        for dz in range(-1, 2):
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    found = find(keys, table, pack(x + dx, y + dy, z + dz))
                    out[block, (dz + 1) * 9 + (dy + 1) * 3 + dx + 1] = found
    return out


@nb.njit(cache=True, nogil=True)
def _voxel(around, block, i, j, k):
    """Block and number of the voxel at (i, j, k), -1 to 8, of a block; block -1 = none."""
    a, b, c = i >> 3, j >> 3, k >> 3
    return around[block, (c + 1) * 9 + (b + 1) * 3 + a + 1], ((k & 7) * SIDE + (j & 7)) * SIDE + (i & 7)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def vertices(around, keys, distances, weights, colors, voxel, least, cells, points, tints):
    """Vertices of all cells that the surface passes.

    Args:
        around: from `neighbours`.
        keys: (C,) int64 of blocks.
        distances: (C, 512) float32, metres.
        weights: (C, 512) float32.
        colors: (C, 512, 3) uint8.
        voxel: metres.
        least: weight below which a voxel counts as unseen.
        cells: (count, 512) int32, all -1; output: number of the cell's vertex.
        points: (V, 3) float32, output, metres in the map.
        tints: (V, 3) uint8, output.

    Returns:
        Number of vertices, of which the first V are written.
    """
    found = 0
    values = np.empty(8, np.float32)
    for block in range(len(around)):
        key = keys[block]
        bx, by = (key >> 42) - _OFFSET, ((key >> 21) & np.int64(0x1FFFFF)) - _OFFSET
        bz = (key & np.int64(0x1FFFFF)) - _OFFSET
        for k in range(SIDE):
            for j in range(SIDE):
                for i in range(SIDE):
                    below, known = 0, True
                    n = (k * SIDE + j) * SIDE + i
                    if not weights[block, n] >= least:
                        continue
                    nearest_block, nearest, least_off = block, n, np.float32(np.inf)
                    for corner in range(8):
                        b, m = _voxel(around, block, i + (corner & 1), j + ((corner >> 1) & 1), k + (corner >> 2))
                        if b < 0 or not weights[b, m] >= least:
                            known = False
                            break
                        values[corner] = distances[b, m]
                        below += values[corner] < 0.0
                        if abs(values[corner]) < least_off:
                            nearest_block, nearest, least_off = b, m, abs(values[corner])
                    if not known or below == 0 or below == 8:
                        continue
                    if found < len(points):
                        x, y, z, crossed = np.float32(0.0), np.float32(0.0), np.float32(0.0), 0
                        for corner in range(8):
                            for axis in range(3):
                                other = corner | (1 << axis)
                                if other == corner or (values[corner] < 0.0) == (values[other] < 0.0):
                                    continue
                                t = values[corner] / (values[corner] - values[other])
                                x += (corner & 1) + (t if axis == 0 else np.float32(0.0))
                                y += ((corner >> 1) & 1) + (t if axis == 1 else np.float32(0.0))
                                z += (corner >> 2) + (t if axis == 2 else np.float32(0.0))
                                crossed += 1
                        points[found, 0] = (SIDE * bx + i + x / crossed) * voxel
                        points[found, 1] = (SIDE * by + j + y / crossed) * voxel
                        points[found, 2] = (SIDE * bz + k + z / crossed) * voxel
                        for c in range(3):
                            tints[found, c] = colors[nearest_block, nearest, c]
                    cells[block, n] = found
                    found += 1
    return found


@nb.njit(cache=True, nogil=True, error_model="numpy")
def quads(around, distances, labels, support, weights, cells, corners, owners, backing, seen):
    """Quads across all edges between voxels that the surface crosses, counter-clockwise seen from before the surface.

    Args:
        around: from `neighbours`.
        distances: (C, 512) float32, metres.
        labels: (C, 512) int32.
        support: (C, 512) int16, observations for the label less those for others.
        weights: (C, 512) float32, 1/m^2.
        cells: from `vertices`.
        corners: (Q, 4) int32, output.
        owners: (Q,) int32, output: label of the end of the edge that is nearer to the surface.
        backing: (Q,) int16, output: support of that label there.
        seen: (Q,) float32, output: weight there.

    Returns:
        Number of quads, of which the first Q are written.
    """
    found = 0
    quad = np.empty(4, np.int32)
    for block in range(len(around)):
        for k in range(SIDE):
            for j in range(SIDE):
                for i in range(SIDE):
                    n = (k * SIDE + j) * SIDE + i
                    if cells[block, n] < 0:
                        continue
                    here = distances[block, n]
                    for axis in range(3):
                        b, m = _voxel(around, block, i + (axis == 0), j + (axis == 1), k + (axis == 2))
                        if b < 0:
                            continue
                        there = distances[b, m]
                        if (here < 0.0) == (there < 0.0):
                            continue
                        # The four cells around the edge, counter-clockwise seen against the axis.
                        whole = True
                        for turn in range(4):
                            p, q = -(turn == 1 or turn == 2), -(turn == 2 or turn == 3)
                            # The next axis takes p, the one after it q.
                            di = p if axis == 2 else (q if axis == 1 else 0)
                            dj = p if axis == 0 else (q if axis == 2 else 0)
                            dk = p if axis == 1 else (q if axis == 0 else 0)
                            cb, cm = _voxel(around, block, i + di, j + dj, k + dk)
                            if cb < 0 or cells[cb, cm] < 0:
                                whole = False
                                break
                            quad[turn] = cells[cb, cm]
                        if not whole:
                            continue
                        if found < len(corners):
                            for turn in range(4):
                                corners[found, turn] = quad[turn] if here < 0.0 else quad[3 - turn]
                            here_first = abs(here) <= abs(there)
                            here_first = labels[block, n] > 0 if here_first else labels[b, m] <= 0
                            owners[found] = labels[block, n] if here_first else labels[b, m]
                            backing[found] = support[block, n] if here_first else support[b, m]
                            seen[found] = weights[block, n] if here_first else weights[b, m]
                        found += 1
    return found
