"""A hash grid over axis-aligned boxes: which of a million hold a point, in microseconds.

Boxes are entered into every cell that they touch; cells are hashed into buckets whose lists lie one after the other in
one array. A bucket may hold boxes of several cells, so every candidate is compared with the box itself.
"""

import numpy as np
from numba import njit

from simtrack.contracts import Float64, Int32

_ENTRIES_PER_BOX = 12
"""Cells grow until boxes touch no more than this many on average."""


class BoxGrid:
    """Answers which boxes hold a point and which come near it."""

    def __init__(self, low: Float64, high: Float64) -> None:
        """Index boxes.

        Args:
            low: (R, 3) lower corners, metres; kept, not copied.
            high: (R, 3) upper corners, not below `low`; kept, not copied.
        """
        self._low, self._high = low, high
        edges = high - low
        self._cell = max(float(np.median(edges.max(axis=1))) if len(edges) else 1.0, 1e-3)
        while len(low) and _entries(low, high, self._cell) > _ENTRIES_PER_BOX * len(low) + 64:
            self._cell *= 2.0
        buckets = 1 << max(4, int(2 * len(low)).bit_length())
        self._start, self._boxes = _fill(low, high, self._cell, buckets)

    @property
    def nbytes(self) -> int:
        """Bytes of the index, without the boxes."""
        return self._start.nbytes + self._boxes.nbytes

    def containing(self, point: Float64) -> Int32:
        """(K,) the boxes that hold a point (3,), border included, ascending."""
        return _near(self._low, self._high, self._cell, self._start, self._boxes, point, 0.0)

    def near(self, point: Float64, distance: float) -> Int32:
        """(K,) the boxes no farther than `distance` from a point (3,), ascending."""
        cells = (2.0 * distance / self._cell + 2.0) ** 3
        if cells < len(self._low):
            return _near(self._low, self._high, self._cell, self._start, self._boxes, point, distance)
        outside = np.maximum(np.maximum(self._low - point, point - self._high), 0.0)
        return np.flatnonzero((outside**2).sum(axis=1) <= distance**2).astype(np.int32)


@njit(cache=True, nogil=True)
def _entries(low, high, cell):
    """Number of (box, cell) pairs, as a float: boxes may be absurdly large."""
    total = 0.0
    for r in range(low.shape[0]):
        touched = 1.0
        for axis in range(3):
            touched *= np.floor(high[r, axis] / cell) - np.floor(low[r, axis] / cell) + 1.0
        total += touched
    return total


@njit(cache=True, nogil=True)
def _bucket(x, y, z, buckets):
    """Bucket of a cell (three large odd factors; `buckets` is a power of two)."""
    mixed = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    return (mixed ^ (mixed >> 15)) & (buckets - 1)


@njit(cache=True, nogil=True)
def _fill(low, high, cell, buckets):
    """Start of every bucket's list (buckets + 1,) and the lists, each ascending and possibly with repetitions."""
    start = np.zeros(buckets + 1, np.int64)
    boxes = np.empty(0, np.int32)
    for step in range(2):
        if step == 1:
            for b in range(buckets):
                start[b + 1] += start[b]
            boxes = np.empty(start[buckets], np.int32)
        for reverse in range(low.shape[0]):
            r = low.shape[0] - 1 - reverse
            for x in range(int(np.floor(low[r, 0] / cell)), int(np.floor(high[r, 0] / cell)) + 1):
                for y in range(int(np.floor(low[r, 1] / cell)), int(np.floor(high[r, 1] / cell)) + 1):
                    for z in range(int(np.floor(low[r, 2] / cell)), int(np.floor(high[r, 2] / cell)) + 1):
                        b = _bucket(x, y, z, buckets)
                        if step == 0:
                            start[b] += 1
                        else:
                            start[b] -= 1
                            boxes[start[b]] = r
    return start, boxes


@njit(cache=True, nogil=True)
def _near(low, high, cell, start, boxes, point, distance):
    found = np.empty(16, np.int32)
    count = 0
    for x in range(int(np.floor((point[0] - distance) / cell)), int(np.floor((point[0] + distance) / cell)) + 1):
        for y in range(int(np.floor((point[1] - distance) / cell)), int(np.floor((point[1] + distance) / cell)) + 1):
            for z in range(
                int(np.floor((point[2] - distance) / cell)), int(np.floor((point[2] + distance) / cell)) + 1
            ):
                b = _bucket(x, y, z, start.shape[0] - 1)
                for entry in range(start[b], start[b + 1]):
                    r = boxes[entry]
                    squared = 0.0
                    for axis in range(3):
                        d = max(low[r, axis] - point[axis], point[axis] - high[r, axis], 0.0)
                        squared += d * d
                    if squared <= distance * distance:
                        if count == found.shape[0]:
                            found = np.concatenate((found, np.empty(count, np.int32)))
                        found[count] = r
                        count += 1
    return np.unique(found[:count])
