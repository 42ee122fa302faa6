"""In which room something is: margins of points from the outlines of rooms."""

from collections.abc import Sequence

import numpy as np
from numba import njit

from simtrack.contracts import Float64, Room

_SILL = 0.5
"""Metres below its floor that still belong to a room: steps, pits, errors of the survey."""


def room_margins(points: Float64, room: Room) -> Float64:
    """(N,) metres from the outline of a room, >= 0 inside, of map points (N, 2) or (N, 3)."""
    polygon = np.ascontiguousarray(room.polygon, dtype=float)
    return np.array([_outline_margin(x, y, polygon) for x, y in np.asarray(points, dtype=float)[:, :2]])


class RoomIndex:
    """Outlines of rooms as arrays."""

    def __init__(self, rooms: Sequence[Room]) -> None:
        outlines = [np.asarray(room.polygon, dtype=float).reshape(-1, 2) for room in rooms]
        self._starts = np.cumsum([0, *(len(outline) for outline in outlines)])
        self._corners = np.concatenate([*outlines, np.zeros((0, 2))])
        low = [[*o.min(axis=0), room.floor - _SILL] for o, room in zip(outlines, rooms, strict=True)]
        high = [[*o.max(axis=0), room.floor + room.height] for o, room in zip(outlines, rooms, strict=True)]
        self._bounds = np.array([low, high]).reshape(2, -1, 3)

    def assign(self, points: Float64, current: np.ndarray, leave_margin: float) -> np.ndarray:
        """(N,) numbers of the rooms in which map points (N, 3) lie, -1 for none.

        A point stays in its `current` room (N,) until it is `leave_margin` metres outside; among several the one in
        which it lies deepest counts.
        """
        return _assign(np.ascontiguousarray(points), current, self._corners, self._starts, self._bounds, leave_margin)


@njit(cache=True, nogil=True)
def _outline_margin(x, y, polygon):
    """Distance of a point from a closed outline (K, 2), negative outside."""
    square = np.inf
    inside = False
    n = polygon.shape[0]
    for i in range(n):
        ax, ay = polygon[i, 0], polygon[i, 1]
        bx, by = polygon[(i + 1) % n, 0], polygon[(i + 1) % n, 1]
        ux, uy = bx - ax, by - ay
        share = ((x - ax) * ux + (y - ay) * uy) / max(ux * ux + uy * uy, 1e-18)
        share = min(max(share, 0.0), 1.0)
        square = min(square, (x - ax - share * ux) ** 2 + (y - ay - share * uy) ** 2)
        if (ay > y) != (by > y) and x < ax + (y - ay) / uy * ux:
            inside = not inside
    return np.sqrt(square) if inside else -np.sqrt(square)


@njit(cache=True, nogil=True)
def _assign(points, current, corners, starts, bounds, leave_margin):
    out = np.empty(points.shape[0], np.int64)
    for row in range(points.shape[0]):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        out[row] = -1
        best = 0.0
        # The present room first: a point that stays needs no other one looked at.
        for turn in range(-1, bounds.shape[1]):
            room = current[row] if turn < 0 else turn
            if room < 0 or z < bounds[0, room, 2] or z > bounds[1, room, 2]:
                continue
            outside = max(
                bounds[0, room, 0] - x, x - bounds[1, room, 0], bounds[0, room, 1] - y, y - bounds[1, room, 1]
            )
            if outside > (leave_margin if turn < 0 else 0.0):
                continue
            margin = _outline_margin(x, y, corners[starts[room] : starts[room + 1]])
            if turn < 0 and margin >= -leave_margin:
                out[row] = room
                break
            if turn >= 0 and margin >= 0.0 and (out[row] < 0 or margin > best):
                out[row] = room
                best = margin
    return out
