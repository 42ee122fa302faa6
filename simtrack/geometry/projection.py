"""Projections of boxes into pinhole images, compiled to be called from compiled loops."""

from numba import njit

NEAREST = 0.05
"""Metres in front of the camera; what reaches nearer has no rectangle."""


@njit(cache=True, nogil=True)
def bounding_rectangle(corners, T_camera_object, camera):
    """Bounds of a box's projection: whether it has any, then u min, v min, u max, v max, pixels, not clipped.

    `corners` (8, 3), object frame, metres; `T_camera_object` (4, 4); `camera` (4,) fx, fy, cx, cy. A box that reaches
    nearer to the camera than `NEAREST` has none.
    """
    T = T_camera_object
    u_low, v_low, u_high, v_high = 1e300, 1e300, -1e300, -1e300
    for c in range(8):
        p = corners[c]
        z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        if not z >= NEAREST:
            return False, 0.0, 0.0, 0.0, 0.0
        u = camera[0] * (T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]) / z + camera[2]
        v = camera[1] * (T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]) / z + camera[3]
        u_low, v_low, u_high, v_high = min(u_low, u), min(v_low, v), max(u_high, u), max(v_high, v)
    return True, u_low, v_low, u_high, v_high
