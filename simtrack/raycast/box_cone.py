"""How large a box looks from outside: the cone around it, often tighter than its sphere's, and there even within."""

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True, error_model="numpy")
def nearest_in_box(offset, axes, out):
    """Distance to the nearest point of a box whose half axes are at right angles; `out` (3,) leads there.

    `offset` (3,) leads from the sensor to the centre, `axes` (9,) are the half axes in a row; float32, metres.
    """
    square = 0.0
    for i in range(3):
        out[i] = offset[i]
    for k in range(3):
        along, length = 0.0, 0.0
        for i in range(3):
            along += offset[i] * axes[3 * k + i]
            length += axes[3 * k + i] * axes[3 * k + i]
        share = min(max(-along / length, -1.0), 1.0) if length > 0.0 else 0.0
        for i in range(3):
            out[i] += np.float32(share * axes[3 * k + i])
    for i in range(3):
        square += out[i] * out[i]
    return np.float32(np.sqrt(square))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def box_cosine(offset, axes, ahead, distance, margin):
    """Cosine of the angle that a box takes around a direction; -1 where that is not below a right angle.

    `offset` (3,) leads from the sensor to the centre, `axes` (9,) are the half axes, `ahead` (3,) is the direction, of
    length `distance`; corners may be off by `margin`, metres.
    """
    least = 1.0
    for corner in range(8):
        along, square = 0.0, 0.0
        for i in range(3):
            value = offset[i] + (axes[i] if corner & 1 else -axes[i])
            value += axes[3 + i] if corner & 2 else -axes[3 + i]
            value += axes[6 + i] if corner & 4 else -axes[6 + i]
            along += value * ahead[i]
            square += value * value
        along = along / distance - margin
        if not along > 0.0:
            return np.float32(-1.0)
        least = min(least, along / (np.sqrt(square) + margin))
    return np.float32(least)
