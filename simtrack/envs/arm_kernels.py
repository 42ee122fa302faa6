"""Inverse kinematics of a serial arm by damped least squares, compiled."""

import numpy as np
from numba import njit

from simtrack.contracts import Float64, Int32

FIXED, REVOLUTE, PRISMATIC = 0, 1, 2
DOWNWARDS, TURNED, POINTING, LEVELLED = 0, 1, 2, 3
"""What is wanted of the cup besides its place: that it points down, down with a heading, in a direction, or in a
horizontal direction with its z axis up."""


@njit(cache=True, nogil=True)
def linearised(
    frames: Float64, kinds: Int32, axes: Float64, numbers: Int32, tip: Float64, values: Float64, count: int
) -> tuple[Float64, Float64]:
    """Pose of the tip of a chain and its Jacobian.

    Args:
        frames: (L, 4, 4), pose of each joint in the link before it.
        kinds: (L,), `FIXED`, `REVOLUTE` or `PRISMATIC`.
        axes: (L, 3), unit vectors in the joints' frames.
        numbers: (L,), which of the values moves it, -1 for none.
        tip: (4, 4), in the last link.
        values: (V,), rad or m.
        count: the first so many values are what the Jacobian is of; they must be revolute.

    Returns:
        (4, 4) T_base_tip, and (6, count): translation, then rotation, base frame.
    """
    T = np.eye(4)
    places, turns = np.zeros((count, 3)), np.zeros((count, 3))
    for k in range(len(kinds)):
        T = T @ frames[k]
        value = values[numbers[k]] if numbers[k] >= 0 else 0.0
        if kinds[k] == PRISMATIC:
            T[:3, 3] += value * (np.ascontiguousarray(T[:3, :3]) @ axes[k])
        elif kinds[k] == REVOLUTE:
            x, y, z = axes[k]
            c, s = np.cos(value), np.sin(value)
            K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            T[:3, :3] = np.ascontiguousarray(T[:3, :3]) @ (np.eye(3) + s * K + (1.0 - c) * (K @ K))
            if 0 <= numbers[k] < count:
                places[numbers[k]] = T[:3, 3]
                turns[numbers[k]] = np.ascontiguousarray(T[:3, :3]) @ axes[k]
    T = T @ tip
    J = np.empty((6, count))
    for k in range(count):
        J[:3, k] = np.cross(turns[k], T[:3, 3] - places[k])
        J[3:, k] = turns[k]
    return T, J


@njit(cache=True, nogil=True)
def missing(
    T: Float64, position: Float64, direction: Float64, yaw: float, mode: int, near: float, upright: float
) -> tuple[Float64, bool]:
    """What is missing, metres and radians, (5,) for `DOWNWARDS`, else (6,); and whether it is little."""
    error = np.zeros(6)
    error[:3] = position - T[:3, 3]
    close = np.linalg.norm(error[:3]) < near
    axis = np.ascontiguousarray(T[:3, 0])
    ahead = axis @ direction
    if mode == LEVELLED:
        wanted = np.zeros((3, 3))
        wanted[:, 0] = direction
        wanted[0, 1], wanted[1, 1], wanted[2, 2] = -direction[1], direction[0], 1.0
        turn = np.zeros(3)
        for k in range(3):
            turn += 0.5 * np.cross(T[:3, k], wanted[:, k])
        far = (T[:3, :3] * wanted).sum() < 1.0  # more than a right angle: any way round
    else:
        turn = np.cross(axis, direction)
        far = ahead < 0.0
    if far:
        turn = turn / max(np.linalg.norm(turn), 1e-6)
    close = close and ahead > 0.0 and np.linalg.norm(turn) < upright
    if mode == TURNED:
        gap = yaw - np.arctan2(T[1, 1], T[0, 1])
        turn[2] = np.arctan2(np.sin(gap), np.cos(gap))
        close = close and abs(turn[2]) < 2.0 * upright
    error[3:] = turn
    return (error[:5].copy() if mode == DOWNWARDS else error), bool(close)


@njit(cache=True, nogil=True)
def solve(
    frames: Float64, kinds: Int32, axes: Float64, numbers: Int32, tip: Float64, start: Float64, torso: float,
    limits: Float64, position: Float64, direction: Float64, yaw: float, mode: int, iterations: int, settings: Float64,
) -> tuple[bool, Float64]:  # fmt: skip
    """Joint angles near `start` (N,) that bring the tip where it is wanted; whether they were found, and (N,) radians.

    The chain is that of `linearised`, its last value the torso's; `limits` are (2, N), `settings` damping, nearness in
    metres, in radians, largest step and the posture's weight, as in `simtrack.envs.arm.IkConfig`.
    """
    damping, near, upright, step, posture = settings
    q = start.copy()
    values = np.empty(len(q) + 1)
    values[-1] = torso
    for _ in range(iterations):
        values[:-1] = q
        T, J = linearised(frames, kinds, axes, numbers, tip, values, len(q))
        error, close = missing(T, position, direction, yaw, mode, near, upright)
        if close:
            return True, q
        if mode == POINTING:  # turning about the cup's axis is free
            J[3:] -= np.outer(direction, direction @ np.ascontiguousarray(J[3:]))
        J = np.ascontiguousarray(J[: len(error)])
        back = np.ascontiguousarray(J.T)
        JJ = J @ back + damping**2 * np.eye(len(J))
        pull = start - q
        change = back @ np.linalg.solve(JJ, error)
        change += posture * (pull - back @ np.linalg.solve(JJ, J @ pull))
        change *= min(1.0, step / max(np.abs(change).max(), 1e-9))
        q = np.minimum(np.maximum(q + change, limits[0]), limits[1])
    return False, q
