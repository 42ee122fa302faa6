"""Compiled margins of the spatial relations; their definitions stand in `relations`.

A margin is the signed distance, in metres, of a pair of bodies from the boundary of a relation: >= 0 where it holds.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from simtrack.contracts import Bool, Float64, Int32
from simtrack.geometry.boxes import signed_distance

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
def direction_margin(ca, Ra, ha, cb, Rb, hb, axis, sign, parameters, limit):
    """Margin of body a lying in direction `sign * axis` of body b's box."""
    strict = parameters.strict
    t = np.empty(3)
    e = np.empty(3)
    for i in range(3):
        t[i] = 0.0
        e[i] = 0.0
        for k in range(3):
            t[i] += Rb[k, i] * (ca[k] - cb[k])
            e[i] += abs(Rb[0, i] * Ra[0, k] + Rb[1, i] * Ra[1, k] + Rb[2, i] * Ra[2, k]) * ha[k]
    along = sign * t[axis] - hb[axis]
    if not parameters.projection:
        contained = along - e[axis]
        return contained if strict else max(contained, along + e[axis] - parameters.meet_depth)
    length = 2.0 * parameters.projection_factor * hb[axis]
    i1 = (axis + 1) % 3
    i2 = (axis + 2) % 3
    contained = min(along - e[axis], length - along - e[axis])
    contained = min(contained, hb[i1] - abs(t[i1]) - e[i1], hb[i2] - abs(t[i2]) - e[i2])
    if strict:
        return contained
    half = np.empty(3)
    for k in range(3):
        half[k] = hb[k]
    half[axis] = 0.5 * length
    gap = abs(along - half[axis]) - half[axis] - e[axis]
    gap = max(gap, abs(t[i1]) - hb[i1] - e[i1], abs(t[i2]) - hb[i2] - e[i2])
    if gap > limit:
        return -gap - parameters.meet_depth
    centre = np.empty(3)
    for k in range(3):
        centre[k] = cb[k] + sign * (hb[axis] + half[axis]) * Rb[k, axis]
    return max(contained, -signed_distance(centre, Rb, half, ca, Ra, ha, limit) - parameters.meet_depth)


@njit(cache=True, nogil=True)
def in_margin(world, a, b, strict):
    """Margin of body a being in body b."""
    cb, Rb, hb = world.centres[b], world.rotations[b], world.halves[b]
    ca, Ra, ha = world.centres[a], world.rotations[a], world.halves[a]
    t = np.empty(3)
    e = np.empty(3)
    for i in range(3):
        t[i] = 0.0
        e[i] = 0.0
        for k in range(3):
            t[i] += Rb[k, i] * (ca[k] - cb[k])
            e[i] += abs(Rb[0, i] * Ra[0, k] + Rb[1, i] * Ra[1, k] + Rb[2, i] * Ra[2, k]) * ha[k]
    contained = min(hb[0] - abs(t[0]) - e[0], hb[1] - abs(t[1]) - e[1], hb[2] - abs(t[2]) - e[2])
    half = world.interior_halves[b]
    if half[2] <= 0.0:
        return -np.inf
    for k in range(3):
        t[k] -= world.interior_centres[b, k]
    below_rim = half[2] - (t[2] - e[2]) - min(0.5 * e[2], half[2])
    margin = min(half[0] - abs(t[0]), half[1] - abs(t[1]), below_rim, half[2] + t[2])
    return min(margin, contained) if strict else margin


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
def _contact_gap(world, body, field, other, first, count):
    """Gap between the cells of one field and the nearest of `count` surfaces of another body.

    It is the gap at the cell that completes the contact area (see `CONTACT_SHARE`), inf if fewer cells overlap.
    """
    nu = world.field_shapes[field, 0]
    nv = world.field_shapes[field, 1]
    start = world.field_shapes[field, 2]
    du = world.field_sizes[field, 0] / nu
    dv = world.field_sizes[field, 1] / nv
    gaps = np.empty(nu * nv)
    own = 0.0
    for i in range(nu * nv):
        gaps[i] = np.inf
        if world.heights[start + i] > -np.inf:
            own += 1.0
    area = 0.0
    R = np.empty((3, 3))
    t = np.empty(3)
    for g in range(first, first + count):
        mu = world.field_shapes[g, 0]
        mv = world.field_shapes[g, 1]
        origin = world.field_shapes[g, 2]
        eu = world.field_sizes[g, 0] / mu
        ev = world.field_sizes[g, 1] / mv
        for i in range(mu * mv):
            if world.heights[origin + i] > -np.inf:
                area += eu * ev
        _relative_pose(world, other, g, body, field, R, t)
        for i in range(nu * nv):
            z = world.heights[start + i]
            if z == -np.inf:
                continue
            x = (i // nv + 0.5 - 0.5 * nu) * du
            y = (i % nv + 0.5 - 0.5 * nv) * dv
            p = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / eu + 0.5 * mu
            q = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / ev + 0.5 * mv
            if p < 0.0 or q < 0.0 or p >= mu or q >= mv:
                continue
            surface = world.heights[origin + int(p) * mv + int(q)]
            if surface > -np.inf:
                gaps[i] = min(gaps[i], abs(R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2] - surface))
    needed = int(CONTACT_SHARE * min(own, area / (du * dv)) + 0.999)
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
def on_margin(world, a, b, distance, on_distance, limit):
    """Margin of body a resting on body b; `distance` is the signed distance of their boxes."""
    if distance > on_distance + limit:
        return on_distance - distance
    gap = np.inf
    for turn in range(2):
        other = clearance(world, a if turn == 0 else b, b if turn == 0 else a)
        if turn == 1:
            # Both could be said of two thin bodies side by side: the one with the smaller gap counts.
            return min(on_distance - gap, other - gap)
        gap = other
        if gap == np.inf:
            break
        if gap > on_distance + limit or world.supports[b, 1] > 0:
            return on_distance - gap
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
def pair_margins(world, a, b, distance, parameters, limit, out):
    """Margins of all relations of a to b into `out` (11,); `distance` is the signed distance of their boxes."""
    out[ON] = on_margin(world, a, b, distance, parameters.on_distance, limit)
    out[NEAR] = parameters.near_range - distance
    out[TOUCHING] = parameters.touch_distance - distance
    if world.layout[a] or world.layout[b]:
        for r in range(IN, NEAR):
            out[r] = -np.inf
        out[INTERSECTS] = -np.inf
        return
    out[INTERSECTS] = -distance - parameters.intersection_depth
    out[IN] = in_margin(world, a, b, parameters.strict)
    for d in range(6):
        axis, sign = DIRECTION_AXES[d]
        out[ABOVE + d] = direction_margin(
            world.centres[a],
            world.rotations[a],
            world.halves[a],
            world.centres[b],
            world.rotations[b],
            world.halves[b],
            axis,
            sign,
            parameters,
            limit,
        )


@njit(cache=True, nogil=True)
def box_distance(world, a, b, limit):
    """Signed distance of the boxes of two slots, the same in either order."""
    i, j = min(a, b), max(a, b)
    return signed_distance(
        world.centres[i],
        world.rotations[i],
        world.halves[i],
        world.centres[j],
        world.rotations[j],
        world.halves[j],
        limit,
    )


@njit(cache=True, nogil=True)
def margin_table(world, pairs, parameters):
    """(P, 11) exact margins of ordered pairs of slots (P, 2), subject and reference; -inf for a slot with itself."""
    out = np.full((pairs.shape[0], COUNT), -np.inf)
    for row in range(pairs.shape[0]):
        a = pairs[row, 0]
        b = pairs[row, 1]
        if a != b:
            pair_margins(world, a, b, box_distance(world, a, b, np.inf), parameters, np.inf, out[row])
    return out


@njit(cache=True, nogil=True)
def _refresh(bits, a, b, margins, parameters):
    """New bit mask of an ordered pair, with hysteresis."""
    old = bits[a, b]
    new = 0
    for r in range(COUNT):
        held = old >> r & 1
        if margins[r] >= (-parameters.leave_margin if held else parameters.enter_margin):
            new |= 1 << r
    return new


@njit(cache=True, nogil=True)
def update_pairs(world, slots, moved, bits, parameters):
    """Bring `bits` (C, C) up to date for the pairs in which a slot `moved` (C,) bool takes part.

    `slots` (S,) are the slots in use. Returns rows (P, 4): subject, reference, old mask, new mask of changed pairs.
    """
    changes = np.empty((64, 4), np.int64)
    count = 0
    margins = np.empty(COUNT)
    limit = max(parameters.leave_margin, 0.0)
    for i in slots:
        if not moved[i]:
            continue
        for j in slots:
            if i == j or (moved[j] and j < i):
                continue
            square = 0.0
            for k in range(3):
                square += (world.centres[i, k] - world.centres[j, k]) ** 2
            span = max(world.reach[i] + world.radii[j], world.reach[j] + world.radii[i])
            near = square <= span * span
            if not near and bits[i, j] == 0 and bits[j, i] == 0:
                continue
            distance = box_distance(world, i, j, parameters.near_range + limit) if near else np.inf
            for turn in range(2):
                a, b = (i, j) if turn == 0 else (j, i)
                new = 0
                if near:
                    pair_margins(world, a, b, distance, parameters, limit, margins)
                    new = _refresh(bits, a, b, margins, parameters)
                if new != bits[a, b]:
                    if count == changes.shape[0]:
                        longer = np.empty((2 * count, 4), np.int64)
                        for row in range(count):
                            for k in range(4):
                                longer[row, k] = changes[row, k]
                        changes = longer
                    changes[count, 0] = a
                    changes[count, 1] = b
                    changes[count, 2] = bits[a, b]
                    changes[count, 3] = new
                    count += 1
                    bits[a, b] = new
    return changes[:count]
