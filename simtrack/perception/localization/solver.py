"""Gauss-Newton steps of MICP-L between two casts, and what is known afterwards, compiled."""

from typing import NamedTuple

import numpy as np
from numba import njit

from simtrack.perception.localization.correspondences import any_normals, kernel_scale, normal_equations
from simtrack.perception.localization.kernels import rotation_vector, turn


class Rules(NamedTuple):
    """Settings of `descend`."""

    iterations: int
    """Gauss-Newton steps at most."""
    tolerance: float
    """m, at `reach`: smaller steps end the iterations."""
    reach: float
    """m, at which rotations are measured."""
    gate: float
    """m, largest scale of the robust kernel."""
    min_kernel: float
    """m, smallest."""
    normal_sigma: float
    """rad, of the map's normals."""
    observability: float
    """See `RegistrationConfig`."""


@njit(cache=True, nogil=True)
def observable(info, feigned, lever, normal_sigma, observability):
    """The directions that the data constrain (Zhang et al. 2016, with a threshold from the noise).

    Normals that are off by `normal_sigma` at random give every direction some information, at most
    ``normal_sigma^2 (sum w B B^T - sum w J J^T)``. A direction whose information is not `observability` times that is
    not observed: the pose stays as predicted there. Rotations are scaled by the RMS distance of the points, which makes
    eigenvalues comparable.

    Args:
        info: (6, 6), see `normal_equations`.
        feigned: (6, 6), see `any_normals`.
        lever: metres, RMS distance of the points.
        normal_sigma: rad.
        observability: ratio.

    Returns:
        basis (6, K), steps that stay in the observed directions, metres and radians a unit, and its dual (6, K) with
        ``dual.T @ basis = I``, which reads the coordinates of a step.
    """
    scale = np.ones(6)
    scale[3:] = 1.0 / max(lever, 1e-2)
    outer = scale.reshape(6, 1) * scale
    values, vectors = np.linalg.eigh(outer * info)
    noise = normal_sigma**2 * outer * (feigned - info)
    basis, dual, count = np.empty((6, 6)), np.empty((6, 6)), 0
    for k in range(6):
        least = 0.0
        for i in range(6):
            for j in range(6):
                least += vectors[i, k] * noise[i, j] * vectors[j, k]
        if values[k] > observability * max(least, 1e-9):
            basis[:, count] = scale * vectors[:, k]
            dual[:, count] = vectors[:, k] / scale
            count += 1
    return basis[:, :count].copy(), dual[:, :count].copy()


@njit(cache=True, nogil=True)
def floor_deviation(T, floor):
    """(6,) deviation of a pose (4, 4) from standing upright at height `floor`, metres.

    The tilt is ``e_z x (R e_z)``, whose derivative by a left rotation is the identity about x and y near upright.
    """
    return np.array([0.0, 0.0, T[2, 3] - floor, -T[1, 2], T[0, 2], 0.0])


class Descent(NamedTuple):
    """Where Gauss-Newton steps on fixed correspondences have led."""

    T: np.ndarray
    """(4, 4)."""
    info: np.ndarray
    """(6, 6) information of the data in the observed directions."""
    basis: np.ndarray
    """(6, K), see `observable`."""
    dual: np.ndarray
    """(6, K), likewise."""
    residual: float
    """m, robust RMS distance from the planes."""
    kernel: float
    """m, last scale of the robust kernel."""
    steps: int


@njit(cache=True, nogil=True)
def _since(T_cast, T):
    """Rotation (3, 3) since the cast, less the identity, and translation (3,)."""
    motion, shift = np.zeros((3, 3)), np.empty(3)
    for i in range(3):
        motion[i, i] = -1.0
        shift[i] = T[i, 3] - T_cast[i, 3]
        for j in range(3):
            for k in range(3):
                motion[i, j] += T[i, k] * T_cast[j, k]
    return motion, shift


@njit(cache=True, nogil=True)
def descend(T_cast, pairs, count, T_prior, prior, upright, floor, rules):
    """Gauss-Newton steps on fixed correspondences, with the odometry prediction and the prior of standing upright.

    Args:
        T_cast: (4, 4) pose of the cast, where the steps begin.
        pairs: (`ROWS`, N) correspondences, of which `count` columns count.
        count: see `pairs`.
        T_prior: (4, 4) predicted pose.
        prior: (6, 6) information of the prediction.
        upright: (6, 6) information of standing upright at height `floor`.
        floor: metres.
        rules: settings.

    Returns:
        A `Descent`.
    """
    T, T_next, held, away = T_cast.copy(), T_cast.copy(), prior + upright, np.empty(6)
    info, basis, dual = np.zeros((6, 6)), np.zeros((6, 0)), np.zeros((6, 0))
    feigned, weight, lever = info, 1.0, 1.0
    residual, kernel, steps, size = 0.0, rules.gate, 0, np.inf
    while steps < rules.iterations and size >= rules.tolerance:
        motion, shift = _since(T_cast, T)
        kernel = kernel_scale(pairs, count, motion, shift, rules.min_kernel, rules.gate)
        H, g, stats = normal_equations(pairs, pairs[7], count, motion, shift, kernel)
        if steps == 0:  # where the points lie changes little: later only the sum of the weights is followed
            feigned, lever = any_normals(pairs, pairs[7], count, kernel)
            weight = max(stats[0], 1e-12)
        basis, dual = observable(H, stats[0] / weight * feigned, lever, rules.normal_sigma, rules.observability)
        projector = dual @ np.ascontiguousarray(basis.T)
        info = projector @ H
        info = 0.5 * (info + info.T)
        away[:3], away[3:] = T[:3, 3] - T_prior[:3, 3], rotation_vector(T, T_prior)
        b = projector @ g + prior @ away + upright @ floor_deviation(T, floor)
        step = np.linalg.solve(info + held, b)
        turn(-step[3], -step[4], -step[5], T, T_next)
        size = 0.0
        for a in range(3):
            T_next[a, 3] = T[a, 3] - step[a]
            size = max(size, abs(step[a]), rules.reach * abs(step[3 + a]))
        T[:] = T_next
        steps += 1
        residual = np.sqrt(stats[1] / max(stats[0], 1e-12))
    return Descent(T, info, basis, dual, residual, kernel, steps)


@njit(cache=True, nogil=True)
def map_information(T_cast, T, pairs, count, kernel):
    """(6, 6) information that the map's error alone would leave all rays of a cast, at pose T (4, 4)."""
    motion, shift = _since(T_cast, T)
    return normal_equations(pairs, pairs[8], count, motion, shift, kernel)[0]
