"""What has happened so far: the state of the world at regular keys, and any moment in between."""

from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError

if TYPE_CHECKING:
    import mujoco

KEY_NS = 4_000_000
"""Nanoseconds between keys. At 2 m/s^2 a straight line between keys errs by 4 micrometres."""
_FIRST_CAPACITY = 2048


class History:
    """Joint positions and mocap poses at every key; states in between are interpolated.

    All that is rendered, scanned or asked of the ground truth goes through `load`, so that all of it agrees exactly.
    A run needs about ``8 (nq + 7 nmocap)`` bytes a key: 15 MB a minute for the workbench.
    """

    def __init__(self, model: "mujoco.MjModel") -> None:
        import mujoco

        self._model = model
        free = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE] + 3
        ball = model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_BALL]
        quaternions = np.concatenate([free, ball]).astype(np.int64)
        mocap = model.nq + 3 * model.nmocap + 4 * np.arange(model.nmocap)
        self._quaternions = np.concatenate([quaternions, mocap])[:, None] + np.arange(4)
        self._rows = np.empty((_FIRST_CAPACITY, model.nq + 7 * model.nmocap))
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def end(self) -> int:
        """Stamp of the last key, nanoseconds."""
        return (self._count - 1) * KEY_NS

    def append(self, data: "mujoco.MjData") -> None:
        """Keep the state that `data` is in as the next key."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
        row, previous = self._rows[self._count], self._rows[self._count - 1]
        nq, nmocap = self._model.nq, self._model.nmocap
        row[:nq] = data.qpos
        row[nq : nq + 3 * nmocap] = data.mocap_pos.ravel()
        row[nq + 3 * nmocap :] = data.mocap_quat.ravel()
        if self._count:
            # Antipodal quaternions are the same rotation, but not to a straight line between them.
            flip = np.einsum("ij,ij->i", row[self._quaternions], previous[self._quaternions]) < 0
            row[self._quaternions[flip]] *= -1.0
        self._count += 1

    def row(self, stamp: float) -> Float64:
        """(nq + 7 nmocap,) joint positions, mocap positions, mocap quaternions at a stamp in nanoseconds.

        Raises:
            InvalidValueError: before the start or after the last key.
        """
        if not 0 <= stamp <= self.end:
            raise InvalidValueError("stamp", stamp, f"0 to {self.end} nanoseconds, what has been simulated so far")
        index = min(int(stamp // KEY_NS), max(self._count - 2, 0))
        fraction = (stamp - index * KEY_NS) / KEY_NS
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
