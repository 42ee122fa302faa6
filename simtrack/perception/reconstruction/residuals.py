"""Residuals of the alignment and their derivatives, compiled. See `alignment` for what the symbols mean.

Unknowns are (log scale, yaw, x, y). R is the turn about z, p the model's centre, a the scale; the centre's height
follows from the scale: dp_z / d(log a) = `rise`.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def plane_residuals(unknowns, height, rise, given, weights, arm, residuals, J):
    """e_p, Eq. 14: first the K differences of offsets, then the K differences of normals times `arm`.

    Args:
        unknowns: (4,).
        height: of the model's centre in the frame of the box.
        rise: its derivative by the logarithm of the scale.
        given: normals (K, 3) and offsets (K,) of the entity, then of the model, turned by its orientation.
        weights: (K,).
        arm: metres that a difference of normals counts for.
        residuals: (2 K,), written.
        J: (2 K, 4), written.
    """
    normals, offsets, model_normals, model_offsets = given
    c, s, scale = np.cos(unknowns[1]), np.sin(unknowns[1]), np.exp(unknowns[0])
    x, y, count = unknowns[2], unknowns[3], len(weights)
    for k in range(count):
        nx = c * model_normals[k, 0] - s * model_normals[k, 1]
        ny = s * model_normals[k, 0] + c * model_normals[k, 1]
        nz = model_normals[k, 2]
        w, v = weights[k], arm * weights[k]
        residuals[k] = w * (scale * model_offsets[k] - nx * x - ny * y - nz * height - offsets[k])
        J[k, 0] = w * (scale * model_offsets[k] - nz * rise)
        J[k, 1] = w * (ny * x - nx * y)
        J[k, 2], J[k, 3] = -w * nx, -w * ny
        residuals[count + k] = v * (1.0 - normals[k, 0] * nx - normals[k, 1] * ny - normals[k, 2] * nz)
        J[count + k, 0] = J[count + k, 2] = J[count + k, 3] = 0.0
        J[count + k, 1] = v * (normals[k, 0] * ny - normals[k, 1] * nx)


@njit(cache=True, nogil=True)
def point_residuals(unknowns, height, rise, points, model_points, model_normals, weights, residuals, J):
    """e_s: (N,) distances of points of the entity from the planes through their counterparts, and (N, 4)."""
    c, s, scale = np.cos(unknowns[1]), np.sin(unknowns[1]), np.exp(unknowns[0])
    for k in range(len(weights)):
        mx, my, nz = model_normals[k, 0], model_normals[k, 1], model_normals[k, 2]
        nx, ny = c * mx - s * my, s * mx + c * my
        ax, ay, az = points[k, 0] - unknowns[2], points[k, 1] - unknowns[3], points[k, 2] - height
        level = scale * (mx * model_points[k, 0] + my * model_points[k, 1] + nz * model_points[k, 2])
        w = weights[k]
        residuals[k] = w * (nx * ax + ny * ay + nz * az - level)
        J[k, 0] = w * (-level - nz * rise)
        J[k, 1] = w * (nx * ay - ny * ax)
        J[k, 2], J[k, 3] = -w * nx, -w * ny


@njit(cache=True, nogil=True)
def footprint_outside(box, half, centre, yaw):
    """A(T y) - A(x and T y) of Eq. 13, square metres, and its derivatives.

    The edges of T y that lie in x sweep the common area when T y moves.

    Args:
        box: (2, 2), lower and upper corner of the rectangle x in its own frame.
        half: (2,), half side lengths of the rectangle T y, scaled.
        centre: (2,), of T y in the frame of x.
        yaw: of T y in the frame of x.

    Returns:
        The area, and (4,) its derivatives by log scale, yaw and the centre's x and y.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    corners = np.empty((4, 2))
    for k in range(4):
        u = half[0] if k in (0, 3) else -half[0]
        v = half[1] if k in (0, 1) else -half[1]
        corners[k, 0] = centre[0] + c * u - s * v
        corners[k, 1] = centre[1] + s * u + c * v
    inside = _clipped_area(corners, box)
    slopes = np.zeros(4)
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        low, high = _part_inside(a, b, box)
        if high <= low:
            continue
        ex, ey = b[0] - a[0], b[1] - a[1]
        middle = 0.5 * (low + high)
        rx, ry = a[0] + middle * ex - centre[0], a[1] + middle * ey - centre[1]
        nx, ny = ey * (high - low), -ex * (high - low)  # outwards, as long as the part that lies inside
        slopes[0] -= nx * rx + ny * ry
        slopes[1] -= ny * rx - nx * ry
        slopes[2] -= nx
        slopes[3] -= ny
    whole = 4.0 * half[0] * half[1]
    slopes[0] += 2.0 * whole
    return whole - inside, slopes


@njit(cache=True, nogil=True)
def _part_inside(a, b, box):
    """Parameters between which the segment lies in an axis-parallel rectangle (Liang and Barsky, 1984)."""
    low, high = 0.0, 1.0
    for axis in range(2):
        along = b[axis] - a[axis]
        if abs(along) < 1e-15:
            if a[axis] < box[0, axis] or a[axis] > box[1, axis]:
                return 1.0, 0.0
            continue
        t0, t1 = (box[0, axis] - a[axis]) / along, (box[1, axis] - a[axis]) / along
        low, high = max(low, min(t0, t1)), min(high, max(t0, t1))
    return low, high


@njit(cache=True, nogil=True)
def _clipped_area(corners, box):
    """Area of a convex polygon within an axis-parallel rectangle (Sutherland and Hodgman, 1974)."""
    polygon = np.empty((16, 2))
    polygon[:4] = corners
    count = 4
    clipped = np.empty((16, 2))
    for side in range(4):
        axis, sign = side // 2, 1.0 if side % 2 else -1.0
        limit = sign * box[side % 2, axis]
        new = 0
        for k in range(count):
            p, q = polygon[k], polygon[(k + 1) % count]
            dp, dq = limit - sign * p[axis], limit - sign * q[axis]
            if dp >= 0.0:
                clipped[new] = p
                new += 1
            if (dp > 0.0 and dq < 0.0) or (dp < 0.0 and dq > 0.0):
                t = dp / (dp - dq)
                clipped[new, 0] = p[0] + t * (q[0] - p[0])
                clipped[new, 1] = p[1] + t * (q[1] - p[1])
                new += 1
        count = new
        polygon[:count] = clipped[:count]
    area = 0.0
    for k in range(count):
        p, q = polygon[k], polygon[(k + 1) % count]
        area += 0.5 * (p[0] * q[1] - q[0] * p[1])
    return max(area, 0.0)
