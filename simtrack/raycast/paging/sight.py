"""Which regions straight rays can reach through open portals: a conservative search over the portals.

A ray that gets into a region passed a chain of open portals. Three facts bound it from below or prune it, and none ever
rules out what a ray can reach:

- the ray is at least as long as the distance from the sensor to each opening of the chain,
- and at least as long as the way to the previous opening plus the gap between the two,
- and seen from above it keeps one heading, which lies in the interval of headings under which each opening appears.

A sensor that may stand anywhere in a ball of radius ``r`` sees the point ``x`` of an opening under a heading that
differs from the ball centre's by ``asin(r / |x - centre|)`` at most, so intervals widen by that; within the ball every
heading is possible. Chains that lead through a portal in the same direction share one interval, the hull of theirs.
"""

from typing import NamedTuple

import numpy as np
from numba import njit


class Graph(NamedTuple):
    """Portals as the kernels take them; see `simtrack.raycast.paging.regions.Regions`."""

    sides: np.ndarray
    """(P, 2) int32, the regions that a portal joins. Half-edge ``2 p + s`` leads into ``sides[p, s]``."""
    centre: np.ndarray
    """(P, 3) float64, map frame, metres."""
    half_axes: np.ndarray
    """(P, 2, 3) float32, perpendicular half-axes of the rectangle, metres."""
    open: np.ndarray
    """(P,) bool."""
    start: np.ndarray
    """(R + 1,) int64, where a region's portals begin in `portals`."""
    portals: np.ndarray
    """(2 P,) int32, portals of the regions, one region after the other."""


_WAY, _HEADING, _LOW, _HIGH = 0, 1, 2, 3
"""Columns of what is known of a half-edge: lower bound of a ray's way to the opening, metres; heading of the opening's
centre, radians; headings, counted from that, under which rays may pass (a whole turn is -pi..pi)."""
_EDGE, _QUEUED = 0, 1
"""Columns of the marks of a half-edge: its number (-1 - region where rays start), and whether it waits in the queue."""


@njit(cache=True, nogil=True)
def distance_to(graph, p, point):
    """From a point (3,) to the rectangle of portal `p`, metres."""
    squared = 0.0
    along = np.zeros(2)
    for a in range(2):
        length = 0.0
        for axis in range(3):
            half = graph.half_axes[p, a, axis]
            along[a] += (point[axis] - graph.centre[p, axis]) * half
            length += half * half
        along[a] = min(max(along[a] / length, -1.0), 1.0)
    for axis in range(3):
        nearest = graph.centre[p, axis]
        nearest += along[0] * graph.half_axes[p, 0, axis] + along[1] * graph.half_axes[p, 1, axis]
        squared += (point[axis] - nearest) ** 2
    return np.sqrt(squared)


@njit(cache=True, nogil=True)
def _gap(graph, p, q):
    """Lower bound of the distance between two portals, metres: that of their boxes."""
    squared = 0.0
    for axis in range(3):
        reach = abs(graph.half_axes[p, 0, axis]) + abs(graph.half_axes[p, 1, axis])
        reach += abs(graph.half_axes[q, 0, axis]) + abs(graph.half_axes[q, 1, axis])
        squared += max(abs(graph.centre[p, axis] - graph.centre[q, axis]) - reach, 0.0) ** 2
    return np.sqrt(squared)


@njit(cache=True, nogil=True)
def _headings(graph, p, sensor, radius):
    """Heading of the centre of portal `p` from the sensor, and from it the headings (low, high) of rays into it."""
    cx, cy = graph.centre[p, 0] - sensor[0], graph.centre[p, 1] - sensor[1]
    ux, uy = graph.half_axes[p, 0, 0], graph.half_axes[p, 0, 1]
    vx, vy = graph.half_axes[p, 1, 0], graph.half_axes[p, 1, 1]
    low, high, nearest = 0.0, 0.0, np.inf
    for corner in range(4):
        a = 1.0 if corner in (0, 3) else -1.0
        b = 1.0 if corner < 2 else -1.0
        x, y = cx + a * ux + b * vx, cy + a * uy + b * vy
        turn = np.arctan2(cx * y - cy * x, cx * x + cy * y)
        low, high = min(low, turn), max(high, turn)
        # From this corner to the next one, along the half-axis whose sign changes.
        ex, ey = (-2.0 * a * ux, -2.0 * a * uy) if corner in (0, 2) else (-2.0 * b * vx, -2.0 * b * vy)
        squared = ex * ex + ey * ey
        t = min(max(-(x * ex + y * ey) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
        nearest = min(nearest, np.hypot(x + t * ex, y + t * ey))
    determinant = ux * vy - uy * vx
    above = False
    if determinant != 0.0:  # not upright: the sensor may stand under or over it
        above = abs(cx * vy - cy * vx) <= abs(determinant) and abs(cx * uy - cy * ux) <= abs(determinant)
    if above or nearest <= radius:
        return 0.0, -np.pi, np.pi
    slack = np.arcsin(radius / nearest)
    if high - low + 2.0 * slack >= 2.0 * np.pi:
        return 0.0, -np.pi, np.pi
    return np.arctan2(cy, cx), low - slack, high + slack


@njit(cache=True, nogil=True)
def _narrowed(heading, low, high, from_heading, from_low, from_high):
    """Part of `low`..`high` (about `heading`) that lies in another interval; empty if low > high."""
    if from_high - from_low >= 2.0 * np.pi:
        return low, high
    shift = (from_heading - heading + np.pi) % (2.0 * np.pi) - np.pi
    if high - low >= 2.0 * np.pi:
        return from_low + shift, from_high + shift
    out_low, out_high = np.inf, -np.inf
    for turn in range(-1, 2):
        a = max(low, from_low + shift + 2.0 * np.pi * turn)
        b = min(high, from_high + shift + 2.0 * np.pi * turn)
        if a <= b:
            out_low, out_high = min(out_low, a), max(out_high, b)
    return out_low, out_high


@njit(cache=True, nogil=True)
def _with_room(rows, count):
    """The array itself, or one with twice the rows if `count` fill it."""
    return rows if count < rows.shape[0] else np.concatenate((rows, np.empty_like(rows)))


@njit(cache=True, nogil=True)
def reachable(graph, sources, sensor, radius, reach, row_of):
    """Half-edges that rays no longer than `reach` may pass, from anywhere within `radius` of the sensor.

    Args:
        graph: the portals.
        sources: (S,) regions where rays start.
        sensor: (3,) map frame.
        radius: metres, above 0.
        reach: metres.
        row_of: (2 P,) int32 scratch, all -1, which it is again afterwards.

    Returns:
        (K,) half-edges in the order of discovery, and (K,) lower bounds of a ray's way to them, metres.
    """
    count = sources.shape[0]
    known, marks = np.empty((2 * count + 64, 4)), np.empty((2 * count + 64, 2), np.int64)
    queue = np.empty((2 * count + 64, 1), np.int64)
    for row in range(count):
        known[row, _WAY], known[row, _HEADING], known[row, _LOW], known[row, _HIGH] = 0.0, 0.0, -np.pi, np.pi
        marks[row, _EDGE], marks[row, _QUEUED], queue[row, 0] = -1 - sources[row], 1, row
    head, tail = 0, count
    while head < tail:
        here = queue[head, 0]
        head += 1
        marks[here, _QUEUED] = 0
        came = marks[here, _EDGE] // 2
        region = graph.sides[came, marks[here, _EDGE] % 2] if came >= 0 else -1 - marks[here, _EDGE]
        for entry in range(graph.start[region], graph.start[region + 1]):
            p = graph.portals[entry]
            if p == came or not graph.open[p]:
                continue
            way, heading, low, high = _onwards(graph, came, known[here], p, sensor, radius)
            if way > reach + radius or low > high:
                continue
            edge = 2 * p + (1 if graph.sides[p, 0] == region else 0)
            row = row_of[edge]
            if row < 0:
                row = row_of[edge] = count
                known, marks = _with_room(known, count), _with_room(marks, count)
                count += 1
                known[row, _WAY], known[row, _HEADING], known[row, _LOW], known[row, _HIGH] = way, heading, low, high
                marks[row, _EDGE] = edge
            elif _merge(known[row], way, low, high):
                if marks[row, _QUEUED]:
                    continue
            else:
                continue
            queue = _with_room(queue, tail)
            queue[tail, 0] = row
            tail += 1
            marks[row, _QUEUED] = 1
    edges = marks[sources.shape[0] : count, _EDGE].copy()
    for edge in edges:
        row_of[edge] = -1
    return edges, known[sources.shape[0] : count, _WAY].copy()


@njit(cache=True, nogil=True)
def _onwards(graph, came, chain, p, sensor, radius):
    """Way, heading and range of headings of rays that pass portal `p` after `came` (-1: rays start before `p`)."""
    way = distance_to(graph, p, sensor)
    heading, low, high = _headings(graph, p, sensor, radius)
    if came >= 0:
        way = max(way, chain[_WAY] + _gap(graph, came, p))
        low, high = _narrowed(heading, low, high, chain[_HEADING], chain[_LOW], chain[_HIGH])
    return way, heading, low, high


@njit(cache=True, nogil=True)
def _merge(chain, way, low, high):
    """Add another way through the same half-edge to what is known of it; whether that told anything new."""
    turns = np.round((0.5 * (chain[_LOW] + chain[_HIGH]) - 0.5 * (low + high)) / (2.0 * np.pi))
    low, high = min(chain[_LOW], low + 2.0 * np.pi * turns), max(chain[_HIGH], high + 2.0 * np.pi * turns)
    wider = high - low > chain[_HIGH] - chain[_LOW] + 1e-9
    if wider:
        whole = high - low >= 2.0 * np.pi
        chain[_LOW], chain[_HIGH] = (-np.pi, np.pi) if whole else (low, high)
    nearer = way < chain[_WAY]
    chain[_WAY] = min(way, chain[_WAY])
    return wider or nearer
