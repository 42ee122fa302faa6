"""Where bodies are: as last seen, carried along by what they stand on, and as last evaluated.

T_supporter_child = T_map_supporter^-1 T_map_child is kept from when the child was last seen, and
T_map_child = T_map_supporter T_supporter_child holds since then: T_m^c = T_m^t T_t^c of the tracking paper (III.D).
"""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from numba import njit

from simtrack.contracts import Bool, Float64
from simtrack.geometry.transforms import inverse

NONE, HELD = -1, -2
"""Supporter slots: none; gone while it carried the child, which stays where it was carried to."""


class Motion:
    """Poses of slots over time.

    Args:
        capacity: number of slots.
        move: metres and radians: smaller motions since the last evaluation do not count.
        carry: metres and radians of a supporter's motion from which an unseen child is carried along.
    """

    def __init__(self, capacity: int, move: tuple[float, float], carry: tuple[float, float]) -> None:
        self._move = _squares(*move)
        self._carry = _squares(*carry)
        self.T = np.tile(np.eye(4), (capacity, 1, 1))
        """(C, 4, 4), map <- body, now."""
        self._T_evaluated = self.T.copy()
        self._T_seen = self.T.copy()
        self._T_supporter_seen = self.T.copy()
        self._supporter = np.full(capacity, NONE)
        self.carried = np.zeros(capacity, dtype=np.bool_)
        """(C,): the pose follows from the supporter's motion since the body was last seen."""

    def grow(self, capacity: int) -> None:
        """Make room for more slots."""
        more = capacity - len(self.T)
        for name in ("T", "_T_evaluated", "_T_seen", "_T_supporter_seen"):
            setattr(self, name, np.concatenate([getattr(self, name), np.tile(np.eye(4), (more, 1, 1))]))
        self._supporter = np.concatenate([self._supporter, np.full(more, NONE)])
        self.carried = np.concatenate([self.carried, np.zeros(more, dtype=np.bool_)])

    def enter(self, slot: int, T_map: Float64) -> None:
        """Put a new body at a pose (4, 4); it counts as moved until it is evaluated."""
        self.T[slot] = T_map
        self._T_evaluated[slot] = np.inf

    def leave(self, slots: np.ndarray) -> None:
        """Take bodies out; what they carried stays where it is."""
        children = np.nonzero(np.isin(self._supporter, slots))[0]
        self._supporter[children] = np.where(self.carried[children], HELD, NONE)
        self._supporter[slots] = NONE
        self.carried[slots] = False

    def place(self, slots: np.ndarray, T_map: Float64, observed: Bool) -> np.ndarray:
        """Take the poses (S, 4, 4) of slots (S,), and those of supporters that moved for what was not `observed`.

        Returns those of the slots whose pose is now another than the one last evaluated.
        """
        _place(slots, T_map, observed, self._supporter, self.T, self._T_seen, self._T_supporter_seen, self.carried,
               self._carry)  # fmt: skip
        return slots[_moved(slots, self.T, self._T_evaluated, self._move)]

    def evaluated(self, slots: np.ndarray) -> None:
        """The present poses of slots count as evaluated."""
        self._T_evaluated[slots] = self.T[slots]

    def remember(self, slots: np.ndarray, observed: Bool, parents: np.ndarray) -> None:
        """Keep how the observed ones among slots (S,) lie to what carries them: `parents` (C,) by slot."""
        _remember(slots, observed, parents, self.T, self._supporter, self._T_seen, self._T_supporter_seen)

    def carried_pose(self, slot: int) -> Float64 | None:
        """(4, 4) pose of a body that moves with what it stood on or in when last seen; None if on nothing."""
        supporter = int(self._supporter[slot])
        if supporter < 0:
            return None
        return self.T[supporter] @ inverse(self._T_supporter_seen[slot]) @ self._T_seen[slot]


def stacked(poses: Sequence[Float64]) -> Float64:
    """(N, 4, 4) array of N poses.

    To join their bytes takes half the time of numpy's ways; where these are no rows of float64, numpy does it.
    """
    with suppress(TypeError, ValueError):
        joined = np.frombuffer(b"".join(poses))  # pyright: ignore[reportArgumentType]
        if len(joined) == 16 * len(poses) and (joined[15::16] == 1.0).all():
            return joined.reshape(-1, 4, 4)
    return np.array(poses, dtype=float).reshape(-1, 4, 4)


def _squares(shift: float, turn: float) -> tuple[float, float]:
    """Tolerances as `_differs` takes them: |R - S|^2 = 8 sin^2(angle / 2) in the Frobenius norm."""
    return shift**2, 8.0 * np.sin(0.5 * turn) ** 2 if turn < np.pi else np.inf


@njit(cache=True, nogil=True)
def _differs(T, S, tolerance):
    """Whether two poses (4, 4) are farther apart than (metres^2, 8 sin^2(angle / 2))."""
    shift = 0.0
    turn = 0.0
    for i in range(3):
        shift += (T[i, 3] - S[i, 3]) ** 2
        for k in range(3):
            turn += (T[i, k] - S[i, k]) ** 2
    return shift > tolerance[0] or turn > tolerance[1]


@njit(cache=True, nogil=True)
def _moved(slots, T, T_evaluated, tolerance):
    out = np.empty(slots.shape[0], np.bool_)
    for row in range(slots.shape[0]):
        out[row] = _differs(T[slots[row]], T_evaluated[slots[row]], tolerance)
    return out


@njit(cache=True, nogil=True)
def _place(slots, poses, observed, supporter, T, T_seen, T_supporter_seen, carried, tolerance):
    pending = np.zeros(T.shape[0], np.bool_)
    for row in range(slots.shape[0]):
        slot = slots[row]
        carried[slot] = not observed[row] and supporter[slot] == HELD
        if not carried[slot]:
            T[slot] = poses[row]
        pending[slot] = not observed[row] and supporter[slot] >= 0
    chain = np.empty(slots.shape[0], np.int64)
    for slot in slots:
        # A supporter that is a carried child itself goes first.
        length = 0
        while slot >= 0 and pending[slot]:
            pending[slot] = False
            chain[length] = slot
            length += 1
            slot = supporter[slot]
        while length > 0:
            length -= 1
            child = chain[length]
            carrier = supporter[child]
            if _differs(T[carrier], T_supporter_seen[child], tolerance):
                _carry(T[carrier], T_supporter_seen[child], T_seen[child], T[child])
                carried[child] = True


@njit(cache=True, nogil=True)
def _carry(T_now, T_then, T_seen, out):
    """`out` = T_now T_then^-1 T_seen, all (4, 4)."""
    for column in range(4):
        # column of T_then^-1 T_seen
        x = y = z = 0.0
        for k in range(3):
            d = T_seen[k, column] - (T_then[k, 3] if column == 3 else 0.0)
            x += T_then[k, 0] * d
            y += T_then[k, 1] * d
            z += T_then[k, 2] * d
        for i in range(3):
            out[i, column] = T_now[i, 0] * x + T_now[i, 1] * y + T_now[i, 2] * z + (T_now[i, 3] if column == 3 else 0.0)


@njit(cache=True, nogil=True)
def _remember(slots, observed, parents, T, supporter, T_seen, T_supporter_seen):
    for row in range(slots.shape[0]):
        if observed[row]:
            slot = slots[row]
            T_seen[slot] = T[slot]
            supporter[slot] = parents[slot]
            if parents[slot] >= 0:
                T_supporter_seen[slot] = T[parents[slot]]
