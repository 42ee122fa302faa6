"""Rays of a sensor that moves while it looks: each shot leaves from where the sensor is at its own time."""

import numpy as np
from numba import njit

from simtrack.contracts import Float32, Float64


def sweep(directions: Float32, times: Float32, period: float, poses: Float64) -> tuple[Float32, Float32]:
    """Origins and unit directions (N, 3) of a moving sensor's shots.

    Args:
        directions: (N, 3), sensor frame.
        times: (N,), of the shots, after the first pose.
        period: from one pose to the next, in the unit of `times`.
        poses: (K, 4, 4), K >= 2, of the sensor at multiples of `period`; between them the matrices are interpolated
            linearly, element by element.
    """
    origins, turned = np.empty(directions.shape, np.float32), np.empty(directions.shape, np.float32)
    _sweep(directions, times, float(period), poses, origins, turned)
    return origins, turned


@njit(cache=True, nogil=True)
def _sweep(shots, times, period, poses, origins, directions):
    for i in range(shots.shape[0]):
        position = min(max(float(times[i]) / period, 0.0), poses.shape[0] - 1.000001)
        lower = int(position)
        share = position - lower
        length = 0.0
        for a in range(3):
            ahead = 0.0
            for b in range(3):
                ahead += ((1.0 - share) * poses[lower, a, b] + share * poses[lower + 1, a, b]) * shots[i, b]
            directions[i, a] = ahead
            length += ahead * ahead
            origins[i, a] = (1.0 - share) * poses[lower, a, 3] + share * poses[lower + 1, a, 3]
        for a in range(3):
            directions[i, a] /= np.sqrt(length)
