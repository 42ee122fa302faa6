"""Compiled loops of masks: run lengths, their code, and the nearest points of two rings."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def run_lengths(part, u0, v0, height, width):
    """COCO's run lengths of a mask that is `part` (h, w) at (u0, v0) and empty elsewhere: down the columns."""
    counts = np.empty(2 * part.size + 2, np.int64)
    count, begin, inside = 0, 0, False
    for u in range(part.shape[1]):
        for v in range(part.shape[0]):
            # Rows above and below the part are outside of the mask.
            if v == 0 and v0 > 0 and inside:
                end = (u0 + u) * height
                counts[count] = end - begin
                count, begin, inside = count + 1, end, False
            if part[v, u] != inside:
                end = (u0 + u) * height + v0 + v
                counts[count] = end - begin
                count, begin, inside = count + 1, end, not inside
        last = v0 + part.shape[0]
        if inside and last < height:
            end = (u0 + u) * height + last
            counts[count] = end - begin
            count, begin, inside = count + 1, end, False
    if inside:
        end = (u0 + part.shape[1]) * height
        counts[count] = end - begin
        count, begin = count + 1, end
    if begin < height * width:
        counts[count] = height * width - begin
        count += 1
    return counts[:count]


@njit(cache=True, nogil=True)
def characters(counts):
    """COCO's code: each count less the one before the last, five bits a character, the lowest first."""
    out = np.empty(7 * counts.size, np.uint8)
    size = 0
    for i in range(counts.size):
        rest = counts[i] - counts[i - 2] if i > 2 else counts[i]
        more = True
        while more:
            bits = rest & 31
            rest >>= 5
            more = rest != -1 if bits & 16 else rest != 0
            out[size] = (bits | 32 if more else bits) + 48
            size += 1
    return out[:size]


@njit(cache=True, nogil=True)
def closest(ring, other):
    """Squared distance of the two nearest points, and their places."""
    best, here, there = np.iinfo(np.int64).max, 0, 0
    for i in range(ring.shape[0]):
        for k in range(other.shape[0]):
            du, dv = np.int64(ring[i, 0] - other[k, 0]), np.int64(ring[i, 1] - other[k, 1])
            if du * du + dv * dv < best:
                best, here, there = du * du + dv * dv, i, k
    return best, here, there
