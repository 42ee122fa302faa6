"""Numba kernel that draws the part of triangles between two heights into a grid seen from above."""

from typing import Any

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def _clip(polygon: Any, count: int, height: float, sign: float, out: Any) -> int:
    """Sutherland-Hodgman against one horizontal plane: keeps sign * (z - height) >= 0."""
    kept = 0
    for k in range(count):
        a = polygon[k]
        b = polygon[(k + 1) % count]
        da = sign * (a[2] - height)
        db = sign * (b[2] - height)
        if da >= 0.0:
            out[kept] = a
            kept += 1
        if (da > 0.0 and db < 0.0) or (da < 0.0 and db > 0.0):
            out[kept] = a + (b - a) * (da / (da - db))
            kept += 1
    return kept


@numba.njit(cache=True, nogil=True)
def _mark_segment(grid: Any, ax: float, ay: float, bx: float, by: float) -> None:
    """All cells along a segment in grid coordinates, sampled four times a cell."""
    steps = int(np.ceil(4.0 * max(abs(bx - ax), abs(by - ay)))) + 1
    for k in range(steps + 1):
        column = int(np.floor(ax + (bx - ax) * k / steps))
        row = int(np.floor(ay + (by - ay) * k / steps))
        if 0 <= row < grid.shape[0] and 0 <= column < grid.shape[1]:
            grid[row, column] = 1


@numba.njit(cache=True, nogil=True)
def _mark_polygon(grid: Any, polygon: Any, count: int) -> None:
    """Outline and inside of a convex polygon (k, 2) in grid coordinates."""
    low, high = polygon[0, 1], polygon[0, 1]
    for k in range(count):
        j = (k + 1) % count
        _mark_segment(grid, polygon[k, 0], polygon[k, 1], polygon[j, 0], polygon[j, 1])
        low, high = min(low, polygon[k, 1]), max(high, polygon[k, 1])
    for row in range(max(0, int(np.floor(low))), min(grid.shape[0], int(np.ceil(high)))):
        y = row + 0.5
        left, right = np.inf, -np.inf
        for k in range(count):
            j = (k + 1) % count
            ya, yb = polygon[k, 1], polygon[j, 1]
            if (ya <= y) != (yb <= y):
                x = polygon[k, 0] + (y - ya) / (yb - ya) * (polygon[j, 0] - polygon[k, 0])
                left, right = min(left, x), max(right, x)
        if right >= left:
            for column in range(max(0, int(np.floor(left))), min(grid.shape[1], int(np.floor(right)) + 1)):
                grid[row, column] = 1


@numba.njit(cache=True, nogil=True)
def mark_triangles(grid: Any, triangles: Any, origin: Any, cell: float, low: float, high: float) -> None:
    """Set the cells of `grid` (rows, columns) uint8 below the parts of (F, 3, 3) triangles with low <= z <= high.

    `origin` (2,) is the map position of the lower left corner of cell [0, 0]; metres.
    """
    first, second = np.empty((8, 3)), np.empty((8, 3))
    for f in range(triangles.shape[0]):
        count = _clip(triangles[f], 3, low, 1.0, first)
        count = _clip(first, count, high, -1.0, second)
        if count == 0:
            continue
        for k in range(count):
            second[k, 0] = (second[k, 0] - origin[0]) / cell
            second[k, 1] = (second[k, 1] - origin[1]) / cell
        _mark_polygon(grid, second, count)
