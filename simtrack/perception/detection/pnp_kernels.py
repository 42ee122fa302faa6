"""The arithmetic of perspective-n-point, compiled: an image asks for dozens of refinements of nine points each.

Poses are T_camera_object (4, 4), points (N, 3) in the object frame, metres, pixels (N, 2); `camera` (4,) is fx, fy, cx,
cy. Steps are left perturbations, decoupled: translation, then rotation vector about the object's origin.
"""

import numpy as np
from numba import njit

from simtrack.perception.tracking.solver import rotation

ITERATIONS = 30
"""Levenberg-Marquardt steps at most, those included that are taken back."""
SETTLED = 1e-9
"""Relative drop of the squared error from which on a step is the last."""


@njit(cache=True, nogil=True)
def squared_error(T, points, pixels, camera):
    """Sum of squared reprojection errors, pixels^2; inf if a point lies behind the camera."""
    total = 0.0
    for k in range(points.shape[0]):
        x, y, z = T[0, 3], T[1, 3], T[2, 3]
        for j in range(3):
            x += T[0, j] * points[k, j]
            y += T[1, j] * points[k, j]
            z += T[2, j] * points[k, j]
        if not z > 1e-6:
            return np.inf
        du = camera[0] * x / z + camera[2] - pixels[k, 0]
        dv = camera[1] * y / z + camera[3] - pixels[k, 1]
        total += du * du + dv * dv
    return total


@njit(cache=True, nogil=True)
def _jacobian_row(along, slope, scale, z, arm, row):
    """Derivative (6,) of one pixel coordinate: `along` is its axis, `slope` x / z or y / z, `arm` from the origin."""
    for j in range(3):
        row[j] = 0.0
    row[along] = scale / z
    row[2] = -scale * slope / z
    # d(R p) = phi x arm, so the derivative by phi is arm x gradient.
    row[3] = arm[1] * row[2] - arm[2] * row[1]
    row[4] = arm[2] * row[0] - arm[0] * row[2]
    row[5] = arm[0] * row[1] - arm[1] * row[0]


@njit(cache=True, nogil=True)
def normal_equations(T, points, pixels, weights, camera, H, g):
    """Information (6, 6) and gradient (6,) of the reprojection errors, each point weighted by one of `weights` (N,)."""
    H[:], g[:] = 0.0, 0.0
    arm, row = np.empty(3), np.empty(6)
    for k in range(points.shape[0]):
        for i in range(3):
            arm[i] = T[i, 0] * points[k, 0] + T[i, 1] * points[k, 1] + T[i, 2] * points[k, 2]
        z = arm[2] + T[2, 3]
        for axis in range(2):
            slope = (arm[axis] + T[axis, 3]) / z
            residual = camera[axis] * slope + camera[2 + axis] - pixels[k, axis]
            _jacobian_row(axis, slope, camera[axis], z, arm, row)
            for i in range(6):
                g[i] += weights[k] * row[i] * residual
                for j in range(6):
                    H[i, j] += weights[k] * row[i] * row[j]


@njit(cache=True, nogil=True)
def refine(T, points, pixels, camera):
    """Pose that minimises the reprojection error, by Levenberg-Marquardt from a pose, and its squared error, pixels^2.

    A pose that has points behind the camera is given back as it is.
    """
    T = T.copy()
    error = squared_error(T, points, pixels, camera)
    H, g, weights = np.empty((6, 6)), np.empty(6), np.ones(points.shape[0])
    damping, fresh = 1e-3, True
    for _ in range(ITERATIONS):
        if not error < np.inf:
            break
        if fresh:
            normal_equations(T, points, pixels, weights, camera, H, g)
        A = H.copy()
        for i in range(6):
            A[i, i] += damping * H[i, i] + 1e-12
        step = np.linalg.solve(A, -g)
        moved = T.copy()
        moved[:3, :3] = rotation(step[3:]) @ np.ascontiguousarray(T[:3, :3])
        moved[:3, 3] += step[:3]
        left = squared_error(moved, points, pixels, camera)
        fresh = left < error
        if fresh:
            done = error - left <= SETTLED * error
            T, error, damping = moved, left, 0.1 * damping
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    R = np.ascontiguousarray(T[:3, :3])
    T[:3, :3] = R @ (1.5 * np.eye(3) - 0.5 * (np.ascontiguousarray(R.T) @ R))  # nearest rotation, one Newton step
    return T, error


@njit(cache=True, nogil=True)
def tilted_back(T, points, pixels, camera):
    """Refined poses (H, 4, 4), H <= 3, and their squared errors (H,), from the reversed tilts of a pose.

    Seen from afar, a box tilted towards the camera looks like one tilted away.
    """
    poses, errors, found = np.empty((3, 4, 4)), np.empty(3), 0
    view = T[:3, 3] / np.sqrt((T[:3, 3] ** 2).sum())
    start, tilt = T.copy(), np.empty(3)
    for axis in range(3):
        tilt[0] = T[1, axis] * view[2] - T[2, axis] * view[1]
        tilt[1] = T[2, axis] * view[0] - T[0, axis] * view[2]
        tilt[2] = T[0, axis] * view[1] - T[1, axis] * view[0]
        norm = np.sqrt((tilt**2).sum())
        if norm <= 1e-3:
            continue
        along = T[0, axis] * view[0] + T[1, axis] * view[1] + T[2, axis] * view[2]
        angle = 2.0 * np.arctan2(norm, abs(along)) * (1.0 if along > 0.0 else -1.0)
        start[:3, :3] = rotation(angle / norm * tilt) @ np.ascontiguousarray(T[:3, :3])
        poses[found], errors[found] = refine(start, points, pixels, camera)
        found += 1
    return poses[:found], errors[:found]


@njit(cache=True, nogil=True)
def nearest_corners(T, points, symmetry, pixels, camera, mixed):
    """Give each keypoint the point, or its equivalent by a (4, 4) symmetry, that is projected nearest to it: `mixed`.

    Returns how many of them are different, 0 if a point lies behind the camera.
    """
    other = np.empty(3)
    for k in range(points.shape[0]):
        for i in range(3):
            other[i] = symmetry[i, 3]
            for j in range(3):
                other[i] += symmetry[i, j] * points[k, j]
        own, alternative = 0.0, 0.0
        for choice in range(2):
            p = points[k] if choice == 0 else other
            z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
            if not z > 1e-6:
                return 0
            x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
            y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
            square = (camera[0] * x / z + camera[2] - pixels[k, 0]) ** 2
            square += (camera[1] * y / z + camera[3] - pixels[k, 1]) ** 2
            own, alternative = (square, 0.0) if choice == 0 else (own, square)
        mixed[k] = points[k] if own <= alternative else other
    different = 0
    for k in range(mixed.shape[0]):
        alike = False
        for other_k in range(k):
            alike |= (np.abs(mixed[k] - mixed[other_k]) < 1e-6).all()
        different += not alike
    return different


@njit(cache=True, nogil=True)
def covariance(T, points, sigmas, camera):
    """(6, 6) inverse Fisher information of keypoints with standard deviations `sigmas` (N,), pixels; camera frame."""
    H, g = np.empty((6, 6)), np.empty(6)
    normal_equations(T, points, np.zeros((points.shape[0], 2)), 1.0 / sigmas**2, camera, H, g)
    for i in range(6):
        H[i, i] += 1e-3
    return np.linalg.inv(H)
