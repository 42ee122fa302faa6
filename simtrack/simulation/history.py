"""What has happened so far: the state of the world at regular keys, and any moment in between."""

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError

if TYPE_CHECKING:
    import mujoco

KEY_NS = 4_000_000
"""Nanoseconds between keys. At 2 m/s^2 a straight line between keys errs by 4 micrometres."""
_FIRST_CAPACITY = 2048


@njit(cache=True, nogil=True)
def _turn_alike(row, previous, quaternions):
    """Give the quaternions of a row, at indices (Q, 4), the signs with which they are nearest to those before."""
    for q in quaternions:
        product = 0.0
        for i in q:
            product += row[i] * previous[i]
        if product < 0.0:
            for i in q:
                row[i] *= -1.0


class History:
    """Joint positions and mocap poses at every key; states in between are interpolated.

    All that is rendered, scanned or asked of the ground truth goes through `load`, so that all of it agrees exactly.
    A run needs about ``8 (nq + 7 nmocap)`` bytes a key: 15 MB a minute for the workbench. With `memory`, the last so
    many nanoseconds are kept at least, and older keys are forgotten.
    """

    def __init__(self, model: "mujoco.MjModel", memory: int | None = None, key: int = KEY_NS) -> None:
        """`memory`: nanoseconds of the past that are kept, all of it if None; `key`: nanoseconds between keys."""
        import mujoco

        self._model, self.key = model, key
        self._keep = None if memory is None else -(-memory // key) + 2
        free = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE] + 3
        ball = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_BALL]
        quaternions = np.concatenate([free, ball]).astype(np.int64)
        mocap = model.nq + 3 * model.nmocap + 4 * np.arange(model.nmocap)
        self._quaternions = np.concatenate([quaternions, mocap])[:, None] + np.arange(4)
        capacity = _FIRST_CAPACITY if self._keep is None else 2 * self._keep
        self._rows = np.empty((capacity, model.nq + 7 * model.nmocap))
        self._count = 0
        self._forgotten = 0

    def __len__(self) -> int:
        return self._count

    @property
    def start(self) -> int:
        """Stamp of the first key that is still known, nanoseconds."""
        return self._forgotten * self.key

    @property
    def end(self) -> int:
        """Stamp of the last key, nanoseconds."""
        return (self._forgotten + self._count - 1) * self.key

    def clear(self) -> None:
        """Forget everything: the next key is that of stamp 0."""
        self._count = self._forgotten = 0

    def append(self, data: "mujoco.MjData") -> None:
        """Keep the state that `data` is in as the next key."""
        if self._count == len(self._rows):
            self._make_room()
        row, previous = self._rows[self._count], self._rows[self._count - 1]
        nq, nmocap = self._model.nq, self._model.nmocap
        row[:nq] = data.qpos
        row[nq : nq + 3 * nmocap] = data.mocap_pos.ravel()
        row[nq + 3 * nmocap :] = data.mocap_quat.ravel()
        if self._count:
            # Antipodal quaternions are the same rotation, but not to a straight line between them.
            _turn_alike(row, previous, self._quaternions)
        self._count += 1

    def _make_room(self) -> None:
        if self._keep is None:
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
            return
        self._rows[: self._keep] = self._rows[self._count - self._keep : self._count]
        self._forgotten += self._count - self._keep
        self._count = self._keep

    def row(self, stamp: float) -> Float64:
        """(nq + 7 nmocap,) joint positions, mocap positions, mocap quaternions at a stamp in nanoseconds.

        Raises:
            InvalidValueError: before the first key that is known, or after the last.
        """
        if not self.start <= stamp <= self.end:
            raise InvalidValueError("stamp", stamp, f"{self.start} to {self.end} ns, what was simulated so far")
        index = min(int(stamp // self.key) - self._forgotten, max(self._count - 2, 0))
        fraction = (stamp - self.start - index * self.key) / self.key
        if fraction == 0.0:
            return self._rows[index].copy()
        row = (1.0 - fraction) * self._rows[index] + fraction * self._rows[index + 1]
        quaternions = row[self._quaternions]
        row[self._quaternions] = quaternions / np.sqrt(np.einsum("ij,ij->i", quaternions, quaternions))[:, None]
        return row

    def qpos(self, stamp: float) -> Float64:
        """(nq,) joint positions at a stamp."""
        return self.row(stamp)[: self._model.nq]

    def load(self, stamp: float, data: "mujoco.MjData") -> None:
        """Put `data` (a scratch copy, never the one that is stepped) into the state at a stamp: all body poses."""
        import mujoco

        row, nq, nmocap = self.row(stamp), self._model.nq, self._model.nmocap
        data.qpos[:] = row[:nq]
        data.mocap_pos[:] = row[nq : nq + 3 * nmocap].reshape(-1, 3)
        data.mocap_quat[:] = row[nq + 3 * nmocap :].reshape(-1, 4)
        mujoco.mj_kinematics(self._model, data)
