"""Which relations hold between which bodies, kept for pairs that are related at all and renewed where a body moved.

Candidates are found by a scan over the bodies' spheres. It costs a few nanoseconds a body and moved body, far less than
reading the tracks of a frame does, so that an index would not pay before many thousands of bodies.
"""

import numpy as np
from numba import njit

from simtrack.contracts import Float64
from simtrack.perception.scene_graph.kernels import COUNT, Parameters, World, box_distance, pair_margins

_FREE = -1
_SHIFT = 32
"""Bits: a pair's key is its subject shifted by this, and its reference."""
_MIX = -7046029254386353131
"""2^64 over the golden ratio, as a signed number: Fibonacci hashing (D. Knuth, TAOCP vol. 3, section 6.4)."""


class PairTable:
    """Bit masks of the relations of ordered pairs of slots; a pair that is not in it has none.

    A hash table with linear probing in two arrays, so that compiled code reads and writes it. Keys stay when their mask
    becomes zero and leave when the table grows.
    """

    def __init__(self) -> None:
        self._keys = np.full(1024, _FREE, dtype=np.int64)
        self._masks = np.zeros(1024, dtype=np.uint16)
        self._used = 0

    def update(
        self, world: World, slots: np.ndarray, moved: np.ndarray, shift: Float64, parameters: Parameters
    ) -> np.ndarray:
        """Evaluate the pairs of what moved.

        Args:
            world: bodies at their present poses.
            slots: (S,) slots in use.
            moved: (M,) slots of them.
            shift: (M,) metres by which their centres moved since the last evaluation.
            parameters: the thresholds.

        Returns:
            (P, 4) changes: subject, reference, old mask, new mask.
        """
        return self._renew(world, _neighbours(world, slots, moved, shift), parameters)

    def drop(self, world: World, slots: np.ndarray, gone: np.ndarray) -> np.ndarray:
        """Forget all pairs of `gone` (M,) among the `slots` (S,) in use; returns changes as `update` does."""
        pairs = _neighbours(world, slots, gone, np.zeros(len(gone)))
        return _clear(pairs, self._keys, self._masks)

    def _renew(self, world: World, pairs: np.ndarray, parameters: Parameters) -> np.ndarray:
        room = self._used + 2 * len(pairs)
        if 2 * room > len(self._keys):
            self._keys, self._masks = _rehashed(self._keys, self._masks, room)
            self._used = int(np.count_nonzero(self._keys != _FREE))
        changes, added = _evaluate(world, pairs, self._keys, self._masks, parameters)
        self._used += added
        return changes


@njit(cache=True, nogil=True)
def _find(keys, a, b):
    """Where the key of a pair is, or the free place where it belongs."""
    key = (a << _SHIFT) | b
    last = keys.shape[0] - 1
    place = (key * _MIX >> 36) & last
    while keys[place] != key and keys[place] != _FREE:
        place = (place + 1) & last
    return place


def _rehashed(keys: np.ndarray, masks: np.ndarray, room: int) -> tuple[np.ndarray, np.ndarray]:
    """A table with the related pairs of another, and at most half full when it holds `room` pairs more."""
    related = masks != 0
    size = 1 << int(np.ceil(np.log2(2 * (room + 1))))
    larger = np.full(size, _FREE, dtype=np.int64), np.zeros(size, dtype=np.uint16)
    _insert(keys[related], masks[related], *larger)
    return larger


@njit(cache=True, nogil=True)
def _insert(new_keys, new_masks, keys, masks):
    for row in range(new_keys.shape[0]):
        place = _find(keys, new_keys[row] >> _SHIFT, new_keys[row] & ((1 << _SHIFT) - 1))
        keys[place] = new_keys[row]
        masks[place] = new_masks[row]


@njit(cache=True, nogil=True)
def _neighbours(world, slots, moved, shift):
    """(P, 2) pairs of slots, each once, one of them moved: all that may be related now or may have been before."""
    spheres = np.empty((moved.shape[0], 5))
    shifts = np.full(world.centres.shape[0], -1.0)
    for row in range(moved.shape[0]):
        i = moved[row]
        for k in range(3):
            spheres[row, k] = world.centres[i, k]
        spheres[row, 3] = world.reach[i] + shift[row]
        spheres[row, 4] = world.radii[i] + shift[row]
        shifts[i] = shift[row]
    pairs = np.empty((256, 2), np.int64)
    count = 0
    for j in slots:
        x, y, z = world.centres[j, 0], world.centres[j, 1], world.centres[j, 2]
        extra = max(shifts[j], 0.0)
        reach, radius = world.reach[j] + extra, world.radii[j] + extra
        for row in range(moved.shape[0]):
            span = max(spheres[row, 3] + radius, spheres[row, 4] + reach)
            square = (spheres[row, 0] - x) ** 2 + (spheres[row, 1] - y) ** 2 + (spheres[row, 2] - z) ** 2
            i = moved[row]
            if square > span * span or i == j or (shifts[j] >= 0.0 and j < i):
                continue
            if count == pairs.shape[0]:
                longer = np.empty((2 * count, 2), np.int64)
                for old in range(count):
                    longer[old, 0], longer[old, 1] = pairs[old, 0], pairs[old, 1]
                pairs = longer
            pairs[count, 0] = i
            pairs[count, 1] = j
            count += 1
    return pairs[:count]


@njit(cache=True, nogil=True)
def _may_face(world, a, b, parameters, limit):
    """Whether the sphere of a, which is not near b, reaches into one of the six regions of b."""
    if world.layout[a] or world.layout[b]:
        return False
    if not parameters.projection:
        return True
    aside = 0
    beyond = 0
    for axis in range(3):
        t = 0.0
        for k in range(3):
            t += world.rotations[b, k, axis] * (world.centres[a, k] - world.centres[b, k])
        half = world.halves[b, axis]
        outside = abs(t) - world.radii[a] - limit
        aside += outside > half
        beyond += outside > half * (1.0 + 2.0 * parameters.projection_factor)
    # A region lies along one axis: beside the box along two axes is beside all regions.
    return aside < 2 and beyond == 0


@njit(cache=True, nogil=True)
def _evaluate(world, pairs, keys, masks, parameters):
    """Renew the masks of both orders of pairs (P, 2); returns the changes (N, 4) and how many keys came in."""
    centres, reach, radii = world.centres, world.reach, world.radii
    changes = np.empty((2 * pairs.shape[0], 4), np.int64)
    count = 0
    added = 0
    margins = np.empty(COUNT)
    t = np.empty(3)
    e = np.empty(3)
    limit = max(parameters.leave_margin, parameters.enter_margin)
    far = parameters.near_range + limit
    for row in range(pairs.shape[0]):
        i = pairs[row, 0]
        j = pairs[row, 1]
        square = 0.0
        for k in range(3):
            square += (centres[i, k] - centres[j, k]) ** 2
        apart = np.sqrt(square)
        near = apart <= max(reach[i] + radii[j], reach[j] + radii[i])
        distance = apart - radii[i] - radii[j]
        if distance <= far:
            distance = box_distance(world, i, j, parameters, limit)
        for turn in range(2):
            a, b = (i, j) if turn == 0 else (j, i)
            place = _find(keys, a, b)
            old = masks[place]
            new = 0
            if near and (distance <= far or _may_face(world, a, b, parameters, limit)):
                pair_margins(world, a, b, distance, parameters, limit, t, e, margins)
                new = _refreshed(old, margins, parameters)
            if new == old:
                continue
            if keys[place] == _FREE:
                keys[place] = (a << _SHIFT) | b
                added += 1
            masks[place] = new
            changes[count, 0] = a
            changes[count, 1] = b
            changes[count, 2] = old
            changes[count, 3] = new
            count += 1
    return changes[:count], added


@njit(cache=True, nogil=True)
def _refreshed(old, margins, parameters):
    """New bit mask of an ordered pair, with hysteresis."""
    new = 0
    for r in range(COUNT):
        if margins[r] >= (-parameters.leave_margin if old >> r & 1 else parameters.enter_margin):
            new |= 1 << r
    return new


@njit(cache=True, nogil=True)
def _clear(pairs, keys, masks):
    """Set the masks of both orders of pairs (P, 2) to zero; returns the changes (N, 4)."""
    changes = np.zeros((2 * pairs.shape[0], 4), np.int64)
    count = 0
    for row in range(pairs.shape[0]):
        for turn in range(2):
            a, b = pairs[row, turn], pairs[row, 1 - turn]
            place = _find(keys, a, b)
            if masks[place] != 0:
                changes[count, 0] = a
                changes[count, 1] = b
                changes[count, 2] = masks[place]
                masks[place] = 0
                count += 1
    return changes[:count]
