"""Compiled loops that give readings of a mask to the segments of its thing. Images are (H, W)."""

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _spread(image, masks, depth, tolerance, front, filled):
    """Give the numbers of the first `filled` pixels of `front` to connected readings of the same mask that have none.

    The pixels that are reached are appended to `front`; returns how many it holds.
    """
    height, width = image.shape
    at = 0
    while at < filled:
        v, u = front[at] // width, front[at] % width
        at += 1
        for side in range(4):
            i = v + (1 if side == 0 else -1 if side == 1 else 0)
            j = u + (1 if side == 2 else -1 if side == 3 else 0)
            if i < 0 or j < 0 or i >= height or j >= width or image[i, j] != 0 or masks[i, j] != masks[v, u]:
                continue
            if depth[i, j] > 0.0 and abs(depth[i, j] - depth[v, u]) <= tolerance * depth[v, u]:
                image[i, j] = image[v, u]
                front[filled] = i * width + j
                filled += 1
    return filled


@nb.njit(cache=True, nogil=True, error_model="numpy")
def grow_inside(image, instances, masks, depth, tolerance):
    """Let segments take the readings beside them that none has and that lie in the mask of their thing, in place.

    Args:
        image: int32, numbers of segments, 0 = none.
        instances: (N + 1,) int32, mask that each segment belongs to, 0 = none.
        masks: int32, numbers of masks, 0 = none.
        depth: float32, metres, 0 = no reading.
        tolerance: share of the depth by which neighbours on one surface differ at most.
    """
    height, width = image.shape
    front = np.empty(image.size, np.int64)
    filled = 0
    for v in range(height):
        for u in range(width):
            if image[v, u] > 0 and masks[v, u] > 0 and instances[image[v, u]] == masks[v, u]:
                front[filled] = v * width + u
                filled += 1
    _spread(image, masks, depth, tolerance, front, filled)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def pieces_inside(image, masks, depth, tolerance, least, first):
    """Make segments, from number `first`, of connected readings of one mask that no segment has, in place.

    Args:
        image: int32, numbers of segments, 0 = none.
        masks: int32, numbers of masks, 0 = none.
        depth: float32, metres, 0 = no reading.
        tolerance: share of the depth by which neighbours on one surface differ at most.
        least: readings of a segment; smaller ones stay without.
        first: number of the first one.

    Returns:
        (K,) int32, the masks of the new segments.
    """
    width = image.shape[1]
    front = np.empty(image.size, np.int64)
    owners = np.empty(image.size // max(least, 1) + 1, np.int32)
    found = 0
    for start in range(image.size):
        v0, u0 = start // width, start % width
        if image[v0, u0] != 0 or masks[v0, u0] <= 0 or not depth[v0, u0] > 0.0:
            continue
        front[0] = start
        image[v0, u0] = -1
        filled = _spread(image, masks, depth, tolerance, front, 1)
        number = -2
        if filled >= least:
            number = first + found
            owners[found] = masks[v0, u0]
            found += 1
        for k in range(filled):
            image[front[k] // width, front[k] % width] = number
    for k in range(image.size):
        if image[k // width, k % width] < 0:
            image[k // width, k % width] = 0
    return owners[:found]
