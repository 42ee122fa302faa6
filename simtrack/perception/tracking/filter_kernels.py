"""The arithmetic of the pose filter, compiled: a late measurement replays a dozen updates of every object.

States are (T (4, 4), velocity (6,), covariance P (12, 12)), map frame; see `simtrack.perception.tracking.filter`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from simtrack.perception.tracking.solver import rotation


class FilterRules(NamedTuple):
    """Settings of the filter, as its kernels take them."""

    acceleration: float
    """m/s^2."""
    angular_acceleration: float
    """rad/s^2."""
    still_noise: float
    """m/sqrt(s)."""
    start_threshold: float
    """Mean squared innovation per direction from which a still object moves."""
    stop_speed: float
    """m/s."""
    stop_angular_speed: float
    """rad/s."""
    stop_consistency: float
    """Times the variance of the velocity."""
    max_speed: float
    """m/s."""
    max_angular_speed: float
    """rad/s."""


@njit(cache=True, nogil=True)
def _turned(R, phi):
    """(3, 3) rotation matrix turned by a rotation vector; a Newton step of the polar decomposition keeps it one."""
    out = rotation(phi) @ R
    return out @ (1.5 * np.eye(3) - 0.5 * (np.ascontiguousarray(out.T) @ out))


@njit(cache=True, nogil=True)
def _moved(T, translation, phi):
    """Pose (4, 4) shifted by a translation and turned by a rotation vector, decoupled."""
    out = T.copy()
    out[:3, :3] = _turned(np.ascontiguousarray(T[:3, :3]), phi)
    out[:3, 3] += translation
    return out


@njit(cache=True, nogil=True)
def predict(T, velocity, P, moving, dt, rules):
    """Pose and covariance after `dt` seconds; a still object's pose only grows less certain."""
    P = P.copy()
    if dt <= 0.0:
        return T, P
    if not moving:
        walk = rules.still_noise**2 * dt
        for i in range(3):
            P[i, i] += walk
            P[i + 3, i + 3] += 25.0 * walk
        return T, P
    for i in range(6):  # F P F^T, F being the identity but for dt from velocity to pose
        for j in range(12):
            P[i, j] += dt * P[i + 6, j]
    for j in range(6):
        for i in range(12):
            P[i, j] += dt * P[i, j + 6]
    for i in range(6):
        density = rules.acceleration if i < 3 else rules.angular_acceleration
        q = density**2 * dt  # acceleration noise correlated over about a frame
        P[i, i] += q * dt**3 / 3.0
        P[i, i + 6] += q * dt**2 / 2.0
        P[i + 6, i] += q * dt**2 / 2.0
        P[i + 6, i + 6] += q * dt
    return _moved(T, dt * velocity[:3], dt * velocity[3:]), P


@njit(cache=True, nogil=True)
def _rotation_vector(R):
    """(3,) rotation vector of a rotation matrix, norm in [0, pi]."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    best, largest = 0, trace
    for i in range(3):
        if R[i, i] > largest:
            best, largest = i + 1, R[i, i]
    wxyz = np.empty(4)
    if best == 0:
        wxyz[0] = 1.0 + trace
        wxyz[1], wxyz[2], wxyz[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i, j, k = best - 1, best % 3, (best + 1) % 3
        wxyz[0] = R[k, j] - R[j, k]
        wxyz[1 + i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        wxyz[1 + j], wxyz[1 + k] = R[j, i] + R[i, j], R[k, i] + R[i, k]
    wxyz /= np.sqrt((wxyz**2).sum())
    if wxyz[0] < 0.0:
        wxyz = -wxyz
    norm = np.sqrt((wxyz[1:] ** 2).sum())
    scale = 2.0 if norm < 1e-12 else 2.0 * np.arctan2(norm, wxyz[0]) / norm
    return scale * wxyz[1:]


@njit(cache=True, nogil=True)
def _innovation(T_measured, T):
    out = np.empty(6)
    out[:3] = T_measured[:3, 3] - T[:3, 3]
    out[3:] = _rotation_vector(np.ascontiguousarray(T_measured[:3, :3]) @ np.ascontiguousarray(T[:3, :3].T))
    return out


@njit(cache=True, nogil=True)
def surprise(T, P, T_measured, covariance):
    """Mean squared innovation per direction that was measured at all: the others have a variance of about 1."""
    measured = np.flatnonzero(np.diag(covariance) < 0.05)
    count = len(measured)
    if count == 0:
        return 0.0
    innovation, S, e = _innovation(T_measured, T), np.empty((count, count)), np.empty(count)
    for a in range(count):
        e[a] = innovation[measured[a]]
        for b in range(count):
            S[a, b] = P[measured[a], measured[b]] + covariance[measured[a], measured[b]]
    return (e * np.linalg.solve(S, e)).sum() / count


@njit(cache=True, nogil=True)
def _limited(v, limit):
    return v * min(1.0, limit / max(np.sqrt((v**2).sum()), 1e-9))


@njit(cache=True, nogil=True)
def _slow(v, P, limit, consistency):
    """Whether a velocity (3,) is below a limit, or not to be told from none by its covariance (3, 3)."""
    if np.sqrt((v**2).sum()) < limit:
        return True
    return (v * np.linalg.solve(np.ascontiguousarray(P), v)).sum() < 3.0 * consistency


@njit(cache=True, nogil=True)
def fuse(T, velocity, P, moving, dt, T_measured, covariance, drift, rules):
    """A state after a measurement `dt` seconds later.

    Returns pose, velocity and covariance; whether the object moves, whether it has just begun to, and whether it is
    slow.
    """
    P_drifted = P.copy()
    P_drifted[:6, :6] += drift
    T_then, P_then = predict(T, velocity, P_drifted, moving, dt, rules)
    begins = not moving and surprise(T_then, P_then, T_measured, covariance) > rules.start_threshold
    if begins:
        moving = True
        T_then, P_then = predict(T, velocity, P_drifted, True, dt, rules)
        span = max(dt, 1e-3)
        for i in range(3):
            P_then[i, i] += (0.2 * span) ** 2
            P_then[i + 3, i + 3] += (0.8 * span) ** 2
            P_then[i + 6, i + 6] += 0.2**2
            P_then[i + 9, i + 9] += 0.8**2
    S = np.ascontiguousarray(P_then[:6, :6]) + covariance
    upper = np.ascontiguousarray(P_then[:6])
    gain = np.ascontiguousarray(np.linalg.solve(S, upper).T)
    xi = gain @ _innovation(T_measured, T_then)
    P_then = P_then - gain @ S @ np.ascontiguousarray(gain.T)
    P_then = 0.5 * (P_then + P_then.T)
    T_then = _moved(T_then, xi[:3], xi[3:6])
    v = velocity + xi[6:]
    v[:3], v[3:] = _limited(v[:3], rules.max_speed), _limited(v[3:], rules.max_angular_speed)
    slow = _slow(v[:3], P_then[6:9, 6:9], rules.stop_speed, rules.stop_consistency)
    slow = slow and _slow(v[3:], P_then[9:, 9:], rules.stop_angular_speed, rules.stop_consistency)
    return T_then, v, P_then, moving, begins, slow
