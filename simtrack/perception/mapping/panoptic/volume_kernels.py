"""Compiled loops over a sparse volume of voxels in blocks of 8 x 8 x 8, found by hashing.

A block's key packs its integer coordinates; `table` holds numbers of blocks at the hash of their keys (open addressing,
-1 = free). Voxel (i, j, k) of a block has the number (k * 8 + j) * 8 + i, and its centre at (8 * block + (i, j, k)) *
voxel metres in the map.
"""

import numba as nb
import numpy as np

SIDE = 8
VOXELS = SIDE**3
_OFFSET = np.int64(1 << 20)
REACH = 1 << 20
"""Blocks in each direction that a key can name."""
_NONE = np.int64(-1)


@nb.njit(cache=True, nogil=True, inline="always")
def pack(x, y, z):
    """Key of the block at integer coordinates."""
    return ((np.int64(x) + _OFFSET) << 42) | ((np.int64(y) + _OFFSET) << 21) | (np.int64(z) + _OFFSET)


def block_coordinates(keys):
    """(N, 3) int64 coordinates of the blocks with these keys (N,)."""
    mask = np.int64(0x1FFFFF)
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], axis=1) - _OFFSET


@nb.njit(cache=True, nogil=True)
def find(keys, table, key):
    """Number of the block with a key, -1 if there is none."""
    mask = len(table) - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    at = np.int64(mixed >> np.uint64(33)) & mask
    while table[at] >= 0:
        if keys[table[at]] == key:
            return np.int64(table[at])
        at = (at + 1) & mask
    return _NONE


@nb.njit(cache=True, nogil=True)
def put(keys, table, key, number):
    """Enter a block that is not there yet."""
    mask = len(table) - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    at = np.int64(mixed >> np.uint64(33)) & mask
    while table[at] >= 0:
        at = (at + 1) & mask
    table[at] = number
    keys[number] = key


@nb.njit(cache=True, nogil=True)
def rehash(keys, table, count):
    """Enter the first `count` blocks into an empty table."""
    for number in range(count):
        put(keys, table, keys[number], number)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def touch(depth, camera, T_map_camera, voxel, truncation, stride, keys, table, seen, turn, count, listed):
    """List the blocks within the truncation distance of readings, and enter those that are new.

    Args:
        depth: (H, W) float32, metres, 0 = no reading.
        camera: fx, fy, cx, cy.
        T_map_camera: (4, 4).
        voxel: metres.
        truncation: metres.
        stride: every so many-th column and row is looked at.
        keys: (C,) int64 of blocks.
        table: of the hash.
        seen: (C,) int32, the last turn in which a block was listed.
        turn: number of this turn.
        count: blocks that there are.
        listed: (C,) int32, output.

    Returns:
        Blocks that there are now, and how many are listed; the latter is -1 where there is no more room for new ones.
    """
    fx, fy, cx, cy = camera
    scale = 1.0 / (SIDE * voxel)
    number_listed = 0
    for v in range(0, depth.shape[0], stride):
        for u in range(0, depth.shape[1], stride):
            z = depth[v, u]
            if not z > 0.0:
                continue
            x, y = (u - cx) / fx, (v - cy) / fy
            length = np.sqrt(x * x + y * y + 1.0)
            last = _NONE
            # Steps along the ray of at most half a block.
            steps = max(2, int(np.ceil(2.0 * truncation * 2.0 * scale)))
            for step in range(steps + 1):
                d = z + (2.0 * step / steps - 1.0) * truncation / length
                px, py = x * d, y * d
                a = T_map_camera[0, 0] * px + T_map_camera[0, 1] * py + T_map_camera[0, 2] * d + T_map_camera[0, 3]
                b = T_map_camera[1, 0] * px + T_map_camera[1, 1] * py + T_map_camera[1, 2] * d + T_map_camera[1, 3]
                c = T_map_camera[2, 0] * px + T_map_camera[2, 1] * py + T_map_camera[2, 2] * d + T_map_camera[2, 3]
                # A voxel's cell reaches half a voxel to either side of its centre.
                i = np.int64(np.floor(a * scale + 0.5 / SIDE))
                j = np.int64(np.floor(b * scale + 0.5 / SIDE))
                k = np.int64(np.floor(c * scale + 0.5 / SIDE))
                if max(abs(i), abs(j), abs(k)) >= REACH:
                    continue
                key = pack(i, j, k)
                if key == last:
                    continue
                last = key
                number = find(keys, table, key)
                if number < 0:
                    if count >= len(keys) or 2 * count >= len(table):
                        return count, -1
                    number = count
                    put(keys, table, key, number)
                    seen[number] = -1
                    count += 1
                if seen[number] != turn:
                    seen[number] = turn
                    listed[number_listed] = number
                    number_listed += 1
    return count, number_listed


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def integrate(
    listed, depth, rgb, segments, camera, T_camera_map, voxel, truncation, band, limits, same, votes,
    keys, distances, weights, colors, labels, support,
):  # fmt: skip
    """Fuse one image into the listed blocks: weighted means of distance and colour, majority of labels.

    Args:
        listed: (B,) int32, blocks.
        depth: (H, W) float32, metres, 0 = no reading.
        rgb: (H, W, 3) uint8, or (0, 0, 3).
        segments: (H, W) int32, label of every pixel, 0 = none; a negative one is taken where there is none yet, and
            speaks neither for nor against those that are there.
        camera: fx, fy, cx, cy.
        T_camera_map: (4, 4).
        voxel: metres.
        truncation: metres.
        band: metres from the surface within which voxels take labels.
        limits: largest weight of a voxel, most observations that a label is remembered for.
        same: (L,) int32, labels with the same number support each other.
        votes: (L,) int16, observations that one of a label counts for.
        keys: (C,) int64, of blocks.
        distances: (C, 512) float32, metres, positive before the surface; output, as what follows.
        weights: (C, 512) float32.
        colors: (C, 512, 3) uint8.
        labels: (C, 512) int32.
        support: (C, 512) int16, observations for the label less those for others.
    """
    fx, fy, cx, cy = camera
    height, width = depth.shape
    colored = rgb.shape[0] > 0
    most_weight, most_support = np.float32(limits[0]), np.int16(limits[1])
    R = T_camera_map
    sx, sy, sz = np.float32(R[0, 0] * voxel), np.float32(R[1, 0] * voxel), np.float32(R[2, 0] * voxel)
    for at in range(len(listed)):
        block = listed[at]
        key = keys[block]
        x0 = ((key >> 42) - _OFFSET) * SIDE * voxel
        y0 = (((key >> 21) & np.int64(0x1FFFFF)) - _OFFSET) * SIDE * voxel
        z0 = ((key & np.int64(0x1FFFFF)) - _OFFSET) * SIDE * voxel
        for k in range(SIDE):
            z = z0 + k * voxel
            for j in range(SIDE):
                y = y0 + j * voxel
                px = np.float32(R[0, 0] * x0 + R[0, 1] * y + R[0, 2] * z + R[0, 3])
                py = np.float32(R[1, 0] * x0 + R[1, 1] * y + R[1, 2] * z + R[1, 3])
                pz = np.float32(R[2, 0] * x0 + R[2, 1] * y + R[2, 2] * z + R[2, 3])
                for i in range(SIDE):
                    ax, ay, az = px + i * sx, py + i * sy, pz + i * sz
                    if az < np.float32(0.05):
                        continue
                    inverse = np.float32(1.0) / az
                    u = np.int64(fx * ax * inverse + cx + np.float32(0.5))
                    v = np.int64(fy * ay * inverse + cy + np.float32(0.5))
                    if u < 0 or v < 0 or u >= width or v >= height:
                        continue
                    d = depth[v, u]
                    if not d > np.float32(0.0):
                        continue
                    # Along the ray, not along the optical axis.
                    stretch = np.sqrt(ax * ax + ay * ay + az * az) * inverse
                    off = (d - az) * stretch
                    if off < -truncation:
                        continue
                    n = (k * SIDE + j) * SIDE + i
                    weight = np.float32(1.0) / (d * d)
                    if off < -voxel:  # what is behind the surface is seen less surely
                        weight *= (truncation + off) / (truncation - voxel)
                    near = min(off, truncation)
                    old = weights[block, n]
                    total = old + weight
                    if total <= np.float32(0.0):
                        continue
                    distances[block, n] = (distances[block, n] * old + near * weight) / total
                    weights[block, n] = min(total, most_weight)
                    if abs(off) > band:
                        continue
                    if colored:
                        share = weight / total
                        for c in range(3):
                            was = np.float32(colors[block, n, c])
                            colors[block, n, c] = np.uint8(was + share * (np.float32(rgb[v, u, c]) - was) + 0.5)
                    label = segments[v, u]
                    if label > 0:
                        if same[labels[block, n]] == same[label]:
                            support[block, n] = min(np.int16(support[block, n] + votes[label]), most_support)
                        elif support[block, n] > 0:
                            support[block, n] = max(np.int16(support[block, n] - votes[label]), np.int16(0))
                        else:
                            labels[block, n] = label
                            support[block, n] = votes[label]
                    elif label < 0 and labels[block, n] == 0:
                        labels[block, n] = -label


@nb.njit(cache=True, nogil=True, error_model="numpy")
def overlaps(depth, segments, camera, T_map_camera, voxel, stride, keys, table, labels, canonical, slots, counts):
    """Count for each segment of an image the readings that lie in voxels of each label.

    Args:
        depth: (H, W) float32, metres, 0 = no reading.
        segments: (H, W) int32, number of the segment, 0 = none.
        camera: fx, fy, cx, cy.
        T_map_camera: (4, 4).
        voxel: metres.
        stride: every so many-th column and row is looked at.
        keys: (C,) int64 of blocks.
        table: of the hash.
        labels: (C, 512) int32, 0 = none.
        canonical: (L,) int32, what each label was merged into.
        slots: (L,) int32, all -1; output: column of each label that was met.
        counts: (S, K) int32, zeros; output by segment and column; column 0 counts all readings.

    Returns:
        Columns used, or -1 if there are too few.
    """
    fx, fy, cx, cy = camera
    used = 1
    for v in range(0, depth.shape[0], stride):
        for u in range(0, depth.shape[1], stride):
            z, segment = depth[v, u], segments[v, u]
            if not z > 0.0 or segment == 0:
                continue
            counts[segment, 0] += 1
            px, py = (u - cx) / fx * z, (v - cy) / fy * z
            a = T_map_camera[0, 0] * px + T_map_camera[0, 1] * py + T_map_camera[0, 2] * z + T_map_camera[0, 3]
            b = T_map_camera[1, 0] * px + T_map_camera[1, 1] * py + T_map_camera[1, 2] * z + T_map_camera[1, 3]
            c = T_map_camera[2, 0] * px + T_map_camera[2, 1] * py + T_map_camera[2, 2] * z + T_map_camera[2, 3]
            i, j, k = np.int64(np.rint(a / voxel)), np.int64(np.rint(b / voxel)), np.int64(np.rint(c / voxel))
            if max(abs(i), abs(j), abs(k)) >= REACH * SIDE:
                continue
            block = find(keys, table, pack(i >> 3, j >> 3, k >> 3))
            if block < 0:
                continue
            label = canonical[labels[block, ((k & 7) * SIDE + (j & 7)) * SIDE + (i & 7)]]
            if label == 0:
                continue
            if slots[label] < 0:
                if used >= counts.shape[1]:
                    return -1
                slots[label] = used
                used += 1
            counts[segment, slots[label]] += 1
    return used
