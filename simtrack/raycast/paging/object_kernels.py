"""Compiled loops of the object index: linked lists by region, poses, how far objects stick out.

Lists are singly linked through rows; those built at once run in ascending order. Region -1 (everywhere) is the last
element of `head`, where a negative index leads.
"""

import numpy as np
from numba import njit

_TOLERANCE = 1e-3
"""Metres by which an object's box may stick out of its region's before it counts: rounding, floors and walls."""


@njit(cache=True, nogil=True)
def link(regions, head, following):
    """Build the lists of all objects."""
    for reverse in range(regions.shape[0]):
        row = regions.shape[0] - 1 - reverse
        following[row] = head[regions[row]]
        head[regions[row]] = row


@njit(cache=True, nogil=True)
def insert(row, region, head, following):
    """Put an object into the list of a region."""
    following[row] = head[region]
    head[region] = row


@njit(cache=True, nogil=True)
def unlink(row, region, head, following):
    """Take an object out of the list of its region."""
    if head[region] == row:
        head[region] = following[row]
        return
    previous = head[region]
    while following[previous] != row:
        previous = following[previous]
    following[previous] = following[row]


@njit(cache=True, nogil=True)
def members(region, head, following):
    """(K,) rows of a region's list, ascending."""
    count = 0
    row = head[region]
    while row >= 0:
        count += 1
        row = following[row]
    out = np.empty(count, np.int64)
    row = head[region]
    for i in range(count):
        out[i] = row
        row = following[row]
    out.sort()
    return out


@njit(cache=True, nogil=True)
def _rotation(q, R):
    """Write the (3, 3) rotation of a quaternion wxyz of any length."""
    w, x, y, z = np.float64(q[0]), np.float64(q[1]), np.float64(q[2]), np.float64(q[3])
    s = 2.0 / (w * w + x * x + y * y + z * z)
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)


@njit(cache=True, nogil=True)
def poses(rows, low, regions, positions, quaternions):
    """(K, 4, 4) float64 T_map_object."""
    out = np.zeros((rows.shape[0], 4, 4))
    for i in range(rows.shape[0]):
        row = rows[i]
        _rotation(quaternions[row], out[i])
        for axis in range(3):
            out[i, axis, 3] = positions[row, axis]
            if regions[row] >= 0:
                out[i, axis, 3] += low[regions[row], axis]
        out[i, 3, 3] = 1.0
    return out


@njit(cache=True, nogil=True)
def overhang(first, last, bounds, low, high, models, regions, positions, quaternions):
    """Largest diameter of the objects first..last whose box sticks out of their region's; 0 if none does, metres."""
    largest = 0.0
    R = np.empty((3, 3))
    for row in range(first, last):
        region = regions[row]
        if region < 0:
            continue
        model = models[row]
        _rotation(quaternions[row], R)
        sticks_out, squared = False, 0.0
        for axis in range(3):
            centre, half = np.float64(positions[row, axis]), 0.0
            for k in range(3):
                centre += R[axis, k] * 0.5 * (bounds[model, 0, k] + bounds[model, 1, k])
                half += abs(R[axis, k]) * 0.5 * (bounds[model, 1, k] - bounds[model, 0, k])
            size = high[region, axis] - low[region, axis]
            sticks_out |= centre - half < -_TOLERANCE or centre + half > size + _TOLERANCE
            squared += (bounds[model, 1, axis] - bounds[model, 0, axis]) ** 2
        if sticks_out:
            largest = max(largest, np.sqrt(squared))
    return largest


@njit(cache=True, nogil=True)
def first_bad_pose(positions, quaternions):
    """First row whose pose is not finite or whose quaternion is not a unit one, -1 if all are good."""
    for row in range(positions.shape[0]):
        finite = True
        for axis in range(3):
            finite &= np.isfinite(positions[row, axis])
        squared = 0.0
        for k in range(4):
            squared += np.float64(quaternions[row, k]) ** 2
        if not finite or not abs(squared - 1.0) < 1e-4:
            return row
    return -1
