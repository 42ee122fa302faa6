"""Compiled margins of the spatial relations; their definitions stand in `relations`.

A margin is the signed distance, in metres, of a pair of bodies from the boundary of a relation: >= 0 where it holds.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from simtrack.contracts import Bool, Float64, Int32
from simtrack.geometry.boxes import corner_distance, distance_apart, separation, signed_distance

ON, IN, ABOVE, BELOW, LEFT, RIGHT, FRONT, BEHIND, NEAR, TOUCHING, INTERSECTS = range(11)
COUNT = 11
DIRECTION_AXES = ((2, 1.0), (2, -1.0), (1, 1.0), (1, -1.0), (0, 1.0), (0, -1.0))
"""Axis and sign in the reference's frame of above, below, left-of, right-of, in-front-of, behind."""
CONTACT_SHARE = 0.05
"""Share of the smaller footprint that has to be in contact for one body to rest on another."""


class World(NamedTuple):
    """Bodies as arrays, one row a slot; C slots, F height fields, H cells."""

    centres: Float64
    """(C, 3), map."""
    rotations: Float64
    """(C, 3, 3), axes of the box as columns."""
    halves: Float64
    """(C, 3), half side lengths."""
    interior_centres: Float64
    """(C, 3), body frame."""
    interior_halves: Float64
    """(C, 3), zero where the body is no container."""
    layout: Bool
    """(C,), floor, wall, ceiling."""
    reach: Float64
    """(C,), radius about the centre beyond which no relation to this body holds."""
    radii: Float64
    """(C,), half diagonals."""
    fields: Int32
    """(C, 6), height fields seen from +x, -x, +y, -y, +z, -z."""
    supports: Int32
    """(C, 2), first field and number of the declared support faces."""
    field_rotations: Float64
    """(F, 3, 3), body <- field."""
    field_origins: Float64
    """(F, 3), body frame."""
    field_sizes: Float64
    """(F, 2)."""
    field_shapes: Int32
    """(F, 3), cells along x, cells along y, first cell in `heights`."""
    field_ranges: Float64
    """(F, 3), lowest and highest height, number of cells where there is a surface."""
    heights: Float64
    """(H,)."""


class Parameters(NamedTuple):
    """The thresholds of `relations.RelationConfig` in the form that compiled code takes."""

    projection_factor: float
    on_distance: float
    near_range: float
    touch_distance: float
    intersection_depth: float
    meet_depth: float
    enter_margin: float
    leave_margin: float
    strict: bool
    projection: bool


@njit(cache=True, nogil=True)
def relative_box(ca, Ra, ha, cb, Rb, t, e):
    """Body a in the axes of body b: its box's centre into `t` (3,), half sides of the box around that into `e` (3,)."""
    for i in range(3):
        t[i] = 0.0
        e[i] = 0.0
        for k in range(3):
            t[i] += Rb[k, i] * (ca[k] - cb[k])
            e[i] += abs(Rb[0, i] * Ra[0, k] + Rb[1, i] * Ra[1, k] + Rb[2, i] * Ra[2, k]) * ha[k]


@njit(cache=True, nogil=True)
def direction_margin(ca, Ra, ha, cb, Rb, hb, t, e, axis, sign, parameters, limit):
    """Margin of body a lying in direction `sign * axis` of body b's box; `t` and `e` are those of `relative_box`."""
    strict = parameters.strict
    along = sign * t[axis] - hb[axis]
    if not parameters.projection:
        contained = along - e[axis]
        return contained if strict else max(contained, along + e[axis] - parameters.meet_depth)
    length = 2.0 * parameters.projection_factor * hb[axis]
    i1 = (axis + 1) % 3
    i2 = (axis + 2) % 3
    # How deep the body's centre lies in the region along the region's axes, and how far the box reaches from there.
    depth = min(along, length - along)
    depth1 = hb[i1] - abs(t[i1])
    depth2 = hb[i2] - abs(t[i2])
    contained = min(depth - e[axis], depth1 - e[i1], depth2 - e[i2])
    if strict:
        return contained
    # No shift by less than the least depth takes the centre out, none by more than the least overlap is needed.
    least = max(contained, min(depth, depth1, depth2) - parameters.meet_depth)
    most = max(contained, min(depth + e[axis], depth1 + e[i1], depth2 + e[i2]) - parameters.meet_depth)
    if least > limit:
        return least
    if most < -limit:
        return most
    half = np.empty(3)
    centre = np.empty(3)
    for k in range(3):
        half[k] = hb[k]
    half[axis] = 0.5 * length
    for k in range(3):
        centre[k] = cb[k] + sign * (hb[axis] + half[axis]) * Rb[k, axis]
    return max(contained, -signed_distance(centre, Rb, half, ca, Ra, ha, limit) - parameters.meet_depth)


@njit(cache=True, nogil=True)
def in_margin(centre, half, hb, t, e, strict):
    """Margin of a body being in body b, whose interior is given; `t` and `e` are those of `relative_box`."""
    if half[2] <= 0.0:
        return -np.inf
    below_rim = half[2] - (t[2] - centre[2] - e[2]) - min(0.5 * e[2], half[2])
    margin = min(
        half[0] - abs(t[0] - centre[0]), half[1] - abs(t[1] - centre[1]), below_rim, half[2] + t[2] - centre[2]
    )
    if not strict:
        return margin
    return min(margin, hb[0] - abs(t[0]) - e[0], hb[1] - abs(t[1]) - e[1], hb[2] - abs(t[2]) - e[2])


@njit(cache=True, nogil=True)
def _facing(world, body, up):
    """Height field that the body shows to the sky (`up` = 1) or to the ground (-1)."""
    R = world.rotations[body]
    axis = 0
    for k in range(1, 3):
        if abs(R[2, k]) > abs(R[2, axis]):
            axis = k
    return world.fields[body, 2 * axis + (0 if R[2, axis] * up > 0.0 else 1)]


@njit(cache=True, nogil=True)
def _relative_pose(world, other, g, body, f, R, t):
    """Pose of field f of `body` in field g of `other`, written into R (3, 3) and t (3,)."""
    for i in range(3):
        t[i] = 0.0
        for k in range(3):
            axis = 0.0
            for m in range(3):
                axis += world.rotations[other, k, m] * world.field_rotations[g, m, i]
            origin = world.centres[body, k] - world.centres[other, k]
            for m in range(3):
                origin += world.rotations[body, k, m] * world.field_origins[f, m]
                origin -= world.rotations[other, k, m] * world.field_origins[g, m]
            t[i] += axis * origin
    for i in range(3):
        for j in range(3):
            R[i, j] = 0.0
            for k in range(3):
                left = 0.0
                right = 0.0
                for m in range(3):
                    left += world.rotations[other, k, m] * world.field_rotations[g, m, i]
                    right += world.rotations[body, k, m] * world.field_rotations[f, m, j]
                R[i, j] += left * right


@njit(cache=True, nogil=True)
def _smallest(values, rank):
    """The value of a rank (0 = smallest) by quickselect; reorders `values`."""
    low = 0
    high = values.shape[0] - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i = low
        j = high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return values[rank]


@njit(cache=True, nogil=True)
def _span(world, field, R, t):
    """Least and largest height of a field's surface in the field in which its pose is R, t."""
    slack = 0.5 * (abs(R[2, 0]) * world.field_sizes[field, 0] + abs(R[2, 1]) * world.field_sizes[field, 1])
    low = t[2] + R[2, 2] * world.field_ranges[field, 0]
    high = t[2] + R[2, 2] * world.field_ranges[field, 1]
    return min(low, high) - slack, max(low, high) + slack


@njit(cache=True, nogil=True)
def _window(R, t, axis, width, depth, low, high, step, count):
    """First and one past the last of a field's cells along an axis that can lie over a rectangle of another field.

    R and t are the pose of the field in the other one, `low` and `high` the heights of its cells there.
    """
    middle = -R[0, axis] * t[0] - R[1, axis] * t[1] + R[2, axis] * (0.5 * (low + high) - t[2])
    half = 0.5 * (abs(R[0, axis]) * width + abs(R[1, axis]) * depth + abs(R[2, axis]) * (high - low))
    first = np.floor((middle - half) / step + 0.5 * count - 0.5)
    last = np.ceil((middle + half) / step + 0.5 * count + 0.5)
    return int(min(max(first, 0.0), count)), int(min(max(last, 0.0), count))


@njit(cache=True, nogil=True)
def _contact_gap(world, body, field, other, first, count):
    """Gap between the cells of one field and the nearest of `count` surfaces of another body.

    It is the gap at the cell that completes the contact area (see `CONTACT_SHARE`), inf if fewer cells overlap.
    """
    nu, nv, start = world.field_shapes[field, 0], world.field_shapes[field, 1], world.field_shapes[field, 2]
    du = world.field_sizes[field, 0] / nu
    dv = world.field_sizes[field, 1] / nv
    heights = world.heights
    gaps = np.full(nu * nv, np.inf)
    area = 0.0
    R = np.empty((3, 3))
    t = np.empty(3)
    for g in range(first, first + count):
        mu, mv, origin = world.field_shapes[g, 0], world.field_shapes[g, 1], world.field_shapes[g, 2]
        eu = world.field_sizes[g, 0] / mu
        ev = world.field_sizes[g, 1] / mv
        area += world.field_ranges[g, 2] * eu * ev
        _relative_pose(world, other, g, body, field, R, t)
        low, high = _span(world, field, R, t)
        i0, i1 = _window(R, t, 0, mu * eu, mv * ev, low, high, du, nu)
        j0, j1 = _window(R, t, 1, mu * eu, mv * ev, low, high, dv, nv)
        for i in range(i0, i1):
            x = (i + 0.5 - 0.5 * nu) * du
            for j in range(j0, j1):
                cell = i * nv + j
                z = heights[start + cell]
                if z == -np.inf:
                    continue
                y = (j + 0.5 - 0.5 * nv) * dv
                p = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / eu + 0.5 * mu
                q = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / ev + 0.5 * mv
                if p < 0.0 or q < 0.0 or p >= mu or q >= mv:
                    continue
                surface = heights[origin + int(p) * mv + int(q)]
                if surface > -np.inf:
                    gaps[cell] = min(gaps[cell], abs(R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2] - surface))
    needed = int(CONTACT_SHARE * min(world.field_ranges[field, 2], area / (du * dv)) + 0.999)
    needed = min(max(needed, 1), nu * nv)
    return _smallest(gaps, needed - 1)


@njit(cache=True, nogil=True)
def clearance(world, a, b):
    """Vertical gap, without sign, between what a shows to the ground and what b shows to the sky; inf: not above."""
    lower = _facing(world, a, -1.0)
    count = world.supports[b, 1]
    first = world.supports[b, 0] if count > 0 else _facing(world, b, 1.0)
    gap = np.inf
    for turn in range(1 if count > 0 else 2):
        if turn == 0:
            body, field, other, surface = a, lower, b, first
        else:
            body, field, other, surface = b, first, a, lower
        gap = min(gap, _contact_gap(world, body, field, other, surface, max(count, 1)))
    return gap


@njit(cache=True, nogil=True)
def _clearance_bound(world, a, b):
    """Lower bound of `clearance`: how far the heights of the surfaces keep apart, wherever these overlap."""
    lower = _facing(world, a, -1.0)
    count = world.supports[b, 1]
    first = world.supports[b, 0] if count > 0 else _facing(world, b, 1.0)
    R = np.empty((3, 3))
    t = np.empty(3)
    bound = np.inf
    for turn in range(1 if count > 0 else 2):
        for g in range(first, first + max(count, 1)):
            if turn == 0:
                body, field, other, surface = a, lower, b, g
            else:
                body, field, other, surface = b, g, a, lower
            _relative_pose(world, other, surface, body, field, R, t)
            low, high = _span(world, field, R, t)
            bound = min(bound, max(low - world.field_ranges[surface, 1], world.field_ranges[surface, 0] - high))
    return bound


@njit(cache=True, nogil=True)
def _level_margin(world, a, b, distance, on_distance):
    """Margin of body a resting on body b, which is not below it: how far their levels and boxes are apart."""
    bottom = world.centres[a, 2]
    top = world.centres[b, 2]
    for k in range(3):
        bottom -= abs(world.rotations[a, 2, k]) * world.halves[a, k]
        top += abs(world.rotations[b, 2, k]) * world.halves[b, k]
    miss = abs(bottom - top)
    for s in range(world.supports[b, 1]):
        height = world.centres[b, 2]
        for k in range(3):
            height += world.rotations[b, 2, k] * world.field_origins[world.supports[b, 0] + s, k]
        miss = abs(bottom - height) if s == 0 else min(miss, abs(bottom - height))
    return -max(miss - on_distance, distance, 1e-9)


@njit(cache=True, nogil=True)
def on_margin(world, a, b, distance, on_distance, limit):
    """Margin of body a resting on body b; `distance` is the signed distance of their boxes."""
    beside = _level_margin(world, a, b, distance, on_distance)
    if beside < -limit:
        bound = _clearance_bound(world, a, b)
        if bound > on_distance + limit:
            return max(beside, on_distance - bound)
    gap = clearance(world, a, b)
    if gap == np.inf:
        return beside
    if gap > on_distance + limit or world.supports[b, 1] > 0:
        return on_distance - gap
    # Both could be said of two thin bodies side by side: the one with the smaller gap counts.
    return min(on_distance - gap, clearance(world, b, a) - gap)


@njit(cache=True, nogil=True)
def pair_margins(world, a, b, distance, parameters, limit, t, e, out):
    """Margins of all relations of a to b into `out` (11,).

    `distance` is the signed distance of their boxes, `limit` the distance from a boundary beyond which a margin may be
    a bound; `t` and `e` (3,) are scratch.
    """
    if distance > parameters.on_distance + limit:
        out[ON] = parameters.on_distance - distance
    else:
        out[ON] = on_margin(world, a, b, distance, parameters.on_distance, limit)
    out[NEAR] = parameters.near_range - distance
    out[TOUCHING] = parameters.touch_distance - distance
    if world.layout[a] or world.layout[b]:
        for r in range(IN, NEAR):
            out[r] = -np.inf
        out[INTERSECTS] = -np.inf
        return
    out[INTERSECTS] = -distance - parameters.intersection_depth
    ca, Ra, ha = world.centres[a], world.rotations[a], world.halves[a]
    cb, Rb, hb = world.centres[b], world.rotations[b], world.halves[b]
    relative_box(ca, Ra, ha, cb, Rb, t, e)
    out[IN] = in_margin(world.interior_centres[b], world.interior_halves[b], hb, t, e, parameters.strict)
    _direction_margins(ca, Ra, ha, cb, Rb, hb, t, e, parameters, limit, out)


@njit(cache=True, nogil=True)
def _direction_margins(ca, Ra, ha, cb, Rb, hb, t, e, parameters, limit, out):
    for d in range(6):
        axis, sign = DIRECTION_AXES[d]
        i1 = (axis + 1) % 3
        i2 = (axis + 2) % 3
        aside = max(abs(t[i1]) - hb[i1] - e[i1], abs(t[i2]) - hb[i2] - e[i2])
        if parameters.projection and aside > limit:
            # Most pairs lie beside four of the six regions, or all of them.
            out[ABOVE + d] = -aside
        else:
            out[ABOVE + d] = direction_margin(ca, Ra, ha, cb, Rb, hb, t, e, axis, sign, parameters, limit)


@njit(cache=True, nogil=True)
def box_distance(world, a, b, parameters, limit):
    """Signed distance of the boxes of two slots, the same in either order.

    With a finite `limit` it may be a bound that lies on the same side of every threshold, by `limit` at least.
    """
    i, j = min(a, b), max(a, b)
    ci, Ri, hi = world.centres[i], world.rotations[i], world.halves[i]
    cj, Rj, hj = world.centres[j], world.rotations[j], world.halves[j]
    if limit == np.inf:
        return signed_distance(ci, Ri, hi, cj, Rj, hj, np.inf)
    gap = separation(ci, Ri, hi, cj, Rj, hj)
    if gap <= 0.0 or gap > parameters.near_range + limit:
        return gap
    upper = corner_distance(ci, Ri, hi, cj, Rj, hj)
    for threshold in (0.0, parameters.touch_distance, parameters.on_distance, parameters.near_range):
        if gap < threshold + limit and upper > threshold - limit:
            return distance_apart(ci, Ri, hi, cj, Rj, hj, gap, np.empty(3), np.empty(3))
    return upper


@njit(cache=True, nogil=True)
def margin_table(world, pairs, parameters):
    """(P, 11) exact margins of ordered pairs of slots (P, 2), subject and reference; -inf for a slot with itself."""
    out = np.full((pairs.shape[0], COUNT), -np.inf)
    t = np.empty(3)
    e = np.empty(3)
    for row in range(pairs.shape[0]):
        a = pairs[row, 0]
        b = pairs[row, 1]
        if a != b:
            pair_margins(world, a, b, box_distance(world, a, b, parameters, np.inf), parameters, np.inf, t, e, out[row])
    return out
