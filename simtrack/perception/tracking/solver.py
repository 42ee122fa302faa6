"""Solvers of the registration on fixed correspondences: robust Gauss-Newton, and the tracking paper's Umeyama fits.

Compiled, all instances in one call; see `simtrack.perception.tracking.correspondences` for the residuals. Rotations are
scaled by the model's radius, so that all six directions are in metres of surface.
"""

import numpy as np
from numba import njit

from simtrack.perception.tracking.correspondences import (
    edge_normal_equations,
    point_normal_equations,
    umeyama_sums,
)

EDGES_NEVER, EDGES_WHERE_OPEN, EDGES_ALWAYS = 0, 1, 2
"""When silhouettes take part."""


@njit(cache=True, nogil=True)
def _symmetric(upper):
    return upper + np.triu(upper, 1).T


@njit(cache=True, nogil=True)
def combine(H, g, H_edge, g_edge, edges, edge_sigma):
    """Information (6, 6) and gradient (6,) of faces and silhouettes, in metres of surface.

    Silhouettes lie on the pixel grid and are blurred by the sensor: with `EDGES_WHERE_OPEN` they speak only in the
    directions that the faces leave open. Where the faces know more than `edge_sigma`, metres, they alone decide.
    """
    if edges == EDGES_ALWAYS:
        return H + H_edge, g + g_edge
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


@njit(cache=True, nogil=True)
def gauss_newton(
    measured, model, normal, weight, owner,
    edge_point, edge_direction, edge_offset, edge_weight, edge_owner,
    camera, centres, rotations, shifts, radii, correlation, kernel, edge_kernel, edges, edge_sigma,
    unconstrained_sigma, max_shift, max_turn, iterations, covariance, constrained, stats,
):  # fmt: skip
    """Move every instance by `iterations` steps (0: only judge), then leave what is known at the last pose.

    The first five arrays come from `point_correspondences`, the next five from `edge_correspondences`; `camera` (4,) is
    fx, fy, cx, cy; `centres` (K, 3) are the objects' origins at the time of the cast. In and out: `rotations` (K, 3, 3)
    and `shifts` (K, 3), the motion since the cast about the centres. `radii` (K,), metres; `correlation` (K, 2):
    readings, and silhouette pixels, that count as one; `kernel`, `edge_kernel`: scales of the robust kernels in
    standard deviations; `edges`: when silhouettes take part; `edge_sigma`, `unconstrained_sigma`: see `combine` and
    `constrained_solution`; `max_shift`, `max_turn`: limits of a step, metres and radians. Out: `covariance` (K, 6, 6),
    `constrained` (K,) number of constrained directions, `stats` (K, 3) of `point_normal_equations`.
    """
    K = centres.shape[0]
    kernels = np.full(K, kernel)
    for step in range(iterations + 1):
        H, H_edge = np.zeros((K, 6, 6)), np.zeros((K, 6, 6))
        g, g_edge = np.zeros((K, 6)), np.zeros((K, 6))
        edge_stats = np.zeros((K, 2))
        stats[:] = 0.0
        point_normal_equations(measured, model, normal, weight, owner, centres, rotations, shifts, kernels, H, g, stats)
        if edges != EDGES_NEVER:
            edge_normal_equations(
                edge_point, edge_direction, edge_offset, edge_weight, edge_owner, camera, centres, rotations, shifts,
                edge_kernel, H_edge, g_edge, edge_stats,
            )  # fmt: skip
        for k in range(K):
            scale = np.ones(6)
            scale[3:] = 1.0 / radii[k]
            outer = scale.reshape(6, 1) * scale
            # A posteriori variance factor: how much better or worse the faces fit than the sensor model says.
            factor = min(max(stats[k, 1] / stats[k, 0], 1e-3), 4.0) if stats[k, 0] > 10.0 else 1.0
            share, edge_share = 1.0 / (correlation[k, 0] * factor), 1.0 / correlation[k, 1]
            A, b = combine(
                _symmetric(H[k]) * outer * share, g[k] * scale * share,
                _symmetric(H_edge[k]) * outer * edge_share, g_edge[k] * scale * edge_share, edges, edge_sigma,
            )  # fmt: skip
            xi, P, known = constrained_solution(A, b, unconstrained_sigma)
            if step == iterations:
                covariance[k], constrained[k] = P * outer, known
                continue
            xi *= scale
            length = np.sqrt(xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2)
            angle = np.sqrt(xi[3] ** 2 + xi[4] ** 2 + xi[5] ** 2)
            xi[:3] *= min(1.0, max_shift / max(length, 1e-12))
            xi[3:] *= min(1.0, max_turn / max(angle, 1e-12))
            rotations[k] = rotation(xi[3:]) @ rotations[k]
            shifts[k] += xi[:3]


@njit(cache=True, nogil=True)
def umeyama(measured, model, normal, owner, centres, rotations, shifts, iterations):
    """Move every instance by `iterations` closed-form rigid fits (Umeyama 1991, eqs. 40-42, without scale)."""
    K = centres.shape[0]
    for _ in range(iterations):
        count, cross = np.zeros(K), np.zeros((K, 3, 3))
        mean_p, mean_q = np.zeros((K, 3)), np.zeros((K, 3))
        umeyama_sums(measured, model, normal, owner, centres, rotations, shifts, count, mean_p, mean_q, cross)
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
