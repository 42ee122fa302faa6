"""Solvers of the registration on fixed correspondences: robust Gauss-Newton, and the tracking paper's Umeyama fits.

Compiled, all instances in one call. See `simtrack.perception.tracking.normal_equations` for residuals. Rotations are
scaled by the model's radius, so that all six directions are in metres of surface.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from simtrack.perception.tracking.normal_equations import (
    edge_normal_equations,
    point_normal_equations,
    umeyama_sums,
)

EDGES_NEVER, EDGES_WHERE_OPEN, EDGES_ALWAYS = 0, 1, 2
"""When silhouettes take part."""


MAX_LENGTHENING = 1.6
"""Robust steps are lengthened at most this much."""


class SolverSettings(NamedTuple):
    """What `gauss_newton` needs to know."""

    kernel: float
    """Scale of the robust kernel on the faces' residuals, standard deviations."""
    edge_kernel: float
    """... and on the silhouettes'."""
    edges: int
    """When silhouettes take part."""
    edge_sigma: float
    """See `combine`, metres of surface."""
    unconstrained_sigma: float
    """See `constrained_solution`, metres of surface."""
    max_shift: float
    """Longest step, metres."""
    max_turn: float
    """Largest step, radians."""
    last_step: float
    """An instance whose step is shorter than this, metres of surface, takes it and no other."""


@njit(cache=True, nogil=True)
def _symmetric(upper):
    return upper + np.triu(upper, 1).T


@njit(cache=True, nogil=True)
def cholesky(A, shift, L):
    """Lower factor `L` (6, 6) of ``A - shift I``; returns whether that is positive definite."""
    for i in range(6):
        for j in range(i + 1):
            total = A[i, j]
            if i == j:
                total -= shift
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = total / L[j, j]
            elif total > 1e-12 * A[i, i]:
                L[i, i] = np.sqrt(total)
            else:
                return False
    return True


@njit(cache=True, nogil=True)
def _substitute(L, b):
    """Solve ``L L^T x = b`` in place."""
    for i in range(6):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@njit(cache=True, nogil=True)
def combine(H, g, H_edge, g_edge, edges, edge_sigma):
    """Information (6, 6) and gradient (6,) of faces and silhouettes, in metres of surface.

    Silhouettes lie on the pixel grid and are blurred by the sensor: with `EDGES_WHERE_OPEN` they speak only in the
    directions that the faces leave open. Where the faces know more than `edge_sigma`, metres, they alone decide.
    """
    if edges == EDGES_ALWAYS:
        return H + H_edge, g + g_edge
    # Silhouettes would have a say of less than 1/600 in every direction.
    if edges == EDGES_NEVER or cholesky(H, 5.0 / edge_sigma**2, np.empty((6, 6))):
        return H, g
    values, vectors = np.linalg.eigh(H)
    voice = np.empty(6)
    for i in range(6):
        voice[i] = 1.0 / (1.0 + (max(values[i], 0.0) * edge_sigma**2) ** 4)
    blend = (vectors * voice) @ np.ascontiguousarray(vectors.T)
    return H + blend @ H_edge @ blend, g + blend @ g_edge


@njit(cache=True, nogil=True)
def constrained_solution(H, b, unconstrained_sigma):
    """Solve ``H xi = b`` in the directions that the information matrix (6, 6) constrains, all in metres of surface.

    Returns the step (6,), the covariance (6, 6), which is (1 m)^2 in directions known less well than
    `unconstrained_sigma`, and the number of constrained directions.
    """
    L = np.empty((6, 6))
    if cholesky(H, 1.0 / unconstrained_sigma**2, L):  # all of them: no need to look at each
        cholesky(H, 0.0, L)
        step, P = b.copy(), np.eye(6)
        _substitute(L, step)
        for i in range(6):
            _substitute(L, P[i])
        return step, P, 6
    values, vectors = np.linalg.eigh(H)
    step, variance = np.zeros(6), np.ones(6)
    constrained = 0
    for i in range(6):
        if values[i] > 1.0 / unconstrained_sigma**2:
            variance[i] = 1.0 / values[i]
            constrained += 1
            projection = 0.0
            for a in range(6):
                projection += vectors[a, i] * b[a]
            for a in range(6):
                step[a] += vectors[a, i] * projection / values[i]
    return step, (vectors * variance) @ np.ascontiguousarray(vectors.T), constrained


@njit(cache=True, nogil=True)
def rotation(phi):
    """(3, 3) rotation matrix of a rotation vector (3,), by Rodrigues' formula."""
    angle = np.sqrt(phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2)
    K = np.array([[0.0, -phi[2], phi[1]], [phi[2], 0.0, -phi[0]], [-phi[1], phi[0], 0.0]])
    if angle < 1e-8:
        return np.eye(3) + K + 0.5 * K @ K
    return np.eye(3) + (np.sin(angle) / angle) * K + ((1.0 - np.cos(angle)) / angle**2) * K @ K


@njit(cache=True, nogil=True, forceinline=True)
def gauss_newton(
    points, pairs, edges, edge_pairs, camera, centres, rotations, shifts, radii, correlation, active, settings,
    iterations, covariance, constrained, stats,
):  # fmt: skip
    """Move every active instance by up to `iterations` steps (0: only judge), and leave what is known in the end.

    The first `pairs` of `points` and `edge_pairs` of `edges` count; `camera` (4,) is fx, fy, cx, cy; `centres` (K, 3)
    are the objects' origins at the time of the cast. In and out: `rotations` (K, 3, 3) and `shifts` (K, 3), the motion
    since the cast about the centres. `radii` (K,), metres; `correlation` (K, 2): readings, and silhouette pixels, that
    count as one; `active` (K,). Out, of active instances: `covariance` (K, 6, 6), `constrained` (K,) number of
    constrained directions, `stats` (K, 3), the first of `point_normal_equations`.
    """
    K = centres.shape[0]
    H, H_edge = np.empty((K, 6, 6)), np.empty((K, 6, 6))
    g, g_edge = np.empty((K, 6)), np.empty((K, 6))
    sums = np.empty((K, 4))
    scale = np.ones(6)
    unsettled = active.copy()
    for step in range(iterations + 1):
        if not unsettled.any():
            break
        H[:], H_edge[:], g[:], g_edge[:], sums[:] = 0.0, 0.0, 0.0, 0.0, 0.0
        point_normal_equations(points, pairs, unsettled, centres, rotations, shifts, settings.kernel, H, g, sums)
        if settings.edges != EDGES_NEVER:
            edge_normal_equations(
                edges, edge_pairs, camera, centres, rotations, shifts, settings.edge_kernel, H_edge, g_edge
            )
        for k in range(K):
            if not unsettled[k]:
                continue
            scale[3:] = 1.0 / radii[k]
            outer = scale.reshape(6, 1) * scale
            # A posteriori variance factor: how much better or worse the faces fit than the sensor model says.
            factor = min(max(sums[k, 1] / sums[k, 0], 1e-3), 4.0) if sums[k, 0] > 10.0 else 1.0
            share, edge_share = 1.0 / (correlation[k, 0] * factor), 1.0 / correlation[k, 1]
            A, b = combine(
                _symmetric(H[k]) * outer * share, g[k] * scale * share, _symmetric(H_edge[k]) * outer * edge_share,
                g_edge[k] * scale * edge_share, settings.edges, settings.edge_sigma,
            )  # fmt: skip
            xi, P, known = constrained_solution(A, b, settings.unconstrained_sigma)
            # Weights that stand still during a step make it too short, by the kernel's curvature to them.
            xi *= min(max(sums[k, 0] / max(sums[k, 3], 1e-9), 1.0), MAX_LENGTHENING)
            surface = np.sqrt((xi[:3] ** 2).sum()) + np.sqrt((xi[3:] ** 2).sum())
            if step == iterations or surface < settings.last_step:
                covariance[k], constrained[k], stats[k] = P * outer, known, sums[k, :3]
                unsettled[k] = False
            if step == iterations:
                continue
            xi *= scale
            length = np.sqrt(xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2)
            angle = np.sqrt(xi[3] ** 2 + xi[4] ** 2 + xi[5] ** 2)
            xi[:3] *= min(1.0, settings.max_shift / max(length, 1e-12))
            xi[3:] *= min(1.0, settings.max_turn / max(angle, 1e-12))
            rotations[k] = rotation(xi[3:]) @ rotations[k]
            shifts[k] += xi[:3]


@njit(cache=True, nogil=True)
def umeyama(points, pairs, centres, rotations, shifts, iterations):
    """Move every instance by `iterations` closed-form rigid fits (Umeyama 1991, eqs. 40-42, without scale)."""
    K = centres.shape[0]
    for _ in range(iterations):
        count, cross = np.zeros(K), np.zeros((K, 3, 3))
        mean_p, mean_q = np.zeros((K, 3)), np.zeros((K, 3))
        umeyama_sums(points, pairs, centres, rotations, shifts, count, mean_p, mean_q, cross)
        for k in range(K):
            if count[k] < 6:
                continue
            p, q = mean_p[k] / count[k], mean_q[k] / count[k]
            U, _, Vt = np.linalg.svd(cross[k] / count[k] - p.reshape(3, 1) * q)
            signs = np.ones(3)
            signs[2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
            R = (U * signs) @ Vt
            rotations[k] = R @ rotations[k]
            shifts[k] = R @ shifts[k] + p - R @ q


@njit(cache=True, nogil=True)
def advance(poses, rotations, shifts, radii, covariance, active, moved, deviations):
    """Apply motions to the active of the poses (K, 4, 4), in place.

    Out: `moved` (K,), how far, metres of surface; `deviations` (K,), how far in standard deviations of the estimate,
    whose `covariance` is (K, 6, 6).
    """
    L, xi = np.empty((6, 6)), np.empty(6)
    for k in range(poses.shape[0]):
        moved[k], deviations[k] = 0.0, 0.0
        if not active[k]:
            continue
        turn = rotations[k]
        R = turn @ np.ascontiguousarray(poses[k, :3, :3])
        # A Newton step of the polar decomposition keeps the product orthonormal.
        poses[k, :3, :3] = R @ (1.5 * np.eye(3) - 0.5 * (R.T @ R))
        poses[k, :3, 3] += shifts[k]
        angle = np.sqrt(max(3.0 - (turn[0, 0] + turn[1, 1] + turn[2, 2]), 0.0))
        moved[k] = np.sqrt(shifts[k, 0] ** 2 + shifts[k, 1] ** 2 + shifts[k, 2] ** 2) + angle * radii[k]
        xi[:3] = shifts[k]
        xi[3], xi[4], xi[5] = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
        xi[3:] *= 0.5
        deviations[k] = np.inf
        if cholesky(covariance[k], 0.0, L):
            weighted = xi.copy()
            _substitute(L, weighted)
            deviations[k] = np.sqrt(max(xi @ weighted, 0.0))
