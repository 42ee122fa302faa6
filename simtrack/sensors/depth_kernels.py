"""Compiled loops of the depth noise. Inverse depth is linear in pixel coordinates on a plane, hence used throughout."""

from functools import cache
from typing import NamedTuple

import numba as nb
import numpy as np

from simtrack.contracts import Float32

_HALF_PI = np.float32(np.pi / 2)
_MAX_SHIFT = 4
"""Pixels: lateral shifts are cut here."""
_SHADOW_SLACK = np.float32(1.5)
"""Pixels of disparity by which a surface must lie behind another one to be in its shadow."""


class Parameters(NamedTuple):
    """`DepthNoiseConfig` as kernels take it: float32 numbers only, since arrays would be reference-counted a pixel."""

    axial_offset: np.float32
    axial_quadratic: np.float32
    axial_origin: np.float32
    axial_grazing: np.float32
    max_incidence: np.float32
    lateral_sigma: np.float32
    lateral_grazing: np.float32
    disparity_step: np.float32
    """1/m, in units of inverse depth; 0 = none."""
    grazing_dropout: np.float32
    grazing_width: np.float32
    grazing_cosine: np.float32
    """Cosine of the incidence above which no reading is lost to it."""
    albedo_floor: np.float32
    """1/m^2: albedo floor over squared range."""
    dropout: np.float32
    flying_pixels: np.float32
    min_range: np.float32
    max_range: np.float32


@cache
def normal_quantiles() -> Float32:
    """(4096,) of the standard normal distribution: lateral shifts are whole pixels, so twelve random bits make one."""
    from statistics import NormalDist

    return np.array([NormalDist().inv_cdf((i + 0.5) / 4096) for i in range(4096)], np.float32)


def window(width: int) -> Float32:
    """(width,) Gaussian-like weights (binomial) with unit sum of squares: filtered white noise keeps its variance."""
    weights = np.array([1.0])
    for _ in range(width - 1):
        weights = np.convolve(weights, [0.5, 0.5])
    return (weights / np.sqrt((weights**2).sum())).astype(np.float32)


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def blend_correlated(axial, white, weights, share):
    """Make `axial` sqrt(1 - share) of itself plus sqrt(share) of filtered `white`, in place.

    `white` is uniform in 0..1, (H + taps - 1, W + taps - 1), and filtered along rows and columns.
    """
    height, width = axial.shape
    taps = weights.shape[0]
    own, smooth = np.float32(np.sqrt(1.0 - share)), np.float32(np.sqrt(12.0 * share))
    rows = np.zeros((height + taps - 1, width), np.float32)
    for v in range(height + taps - 1):
        for k in range(taps):
            weight = smooth * weights[k]
            for u in range(width):
                rows[v, u] += weight * (white[v, u + k] - np.float32(0.5))
    for v in range(height):
        for u in range(width):
            axial[v, u] *= own
        for k in range(taps):
            weight = weights[k]
            for u in range(width):
                axial[v, u] += weight * rows[v + k, u]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def inverse_depth(depth):
    """(H, W) 1/z, 0 where there is no depth."""
    out = np.empty_like(depth)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = depth[v, u]
            out[v, u] = np.float32(1.0) / z if 0.0 < z < np.inf else np.float32(0.0)
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def cosines_from_normals(normals, fx, fy, cx, cy):
    """(H, W) cosine of the incidence from (H, W, 3) unit normals in the camera frame; 1 where the normal is missing."""
    height, width = normals.shape[:2]
    out = np.empty((height, width), np.float32)
    for v in range(height):
        y = np.float32((v - cy) / fy)
        for u in range(width):
            x = np.float32((u - cx) / fx)
            dot = normals[v, u, 0] * x + normals[v, u, 1] * y + normals[v, u, 2]
            cosine = abs(dot) / np.sqrt(np.float32(1.0) + x * x + y * y)
            out[v, u] = min(cosine, np.float32(1.0)) if cosine > 0.0 else np.float32(1.0)
    return out


@nb.njit(cache=True, nogil=True, inline="always")
def _flatter(before, here, after):
    """One-sided difference of smaller size: it does not reach over a depth edge."""
    if before == 0.0:
        return after - here if after != 0.0 else np.float32(0.0)
    if after == 0.0:
        return here - before
    back, ahead = here - before, after - here
    return back if abs(back) < abs(ahead) else ahead


@nb.njit(cache=True, nogil=True, error_model="numpy")
def cosines_from_depth(inverse, fx, fy, cx, cy):
    """(H, W) cosine of the incidence from differences of the inverse depth w; exact on planes.

    A plane n X = d has w = n (x, y, 1) / d, so n / d = (fx w_u, fy w_v, w - x fx w_u - y fy w_v), and the cosine
    between n and the ray (x, y, 1) is w / (|n / d| |ray|).
    """
    height, width = inverse.shape
    out = np.empty((height, width), np.float32)
    fx, fy = np.float32(fx), np.float32(fy)
    for v in range(height):
        y = np.float32(v - cy) / fy
        above, below = max(v - 1, 0), min(v + 1, height - 1)
        for u in range(width):
            w = inverse[v, u]
            if w == 0.0:
                out[v, u] = 1.0
                continue
            x = np.float32(u - cx) / fx
            left = inverse[v, u - 1] if u > 0 else np.float32(0.0)
            right = inverse[v, u + 1] if u + 1 < width else np.float32(0.0)
            a = fx * _flatter(left, w, right)
            b = fy * _flatter(
                inverse[above, u] if above < v else np.float32(0.0),
                w,
                inverse[below, u] if below > v else np.float32(0.0),
            )
            c = w - x * a - y * b
            norm = (a * a + b * b + c * c) * (np.float32(1.0) + x * x + y * y)
            out[v, u] = min(w / np.sqrt(norm), np.float32(1.0))
    return out


@nb.njit(cache=True, nogil=True)
def depth_edges(inverse, threshold):
    """(H, W), whether a second difference of the inverse depth (zero on planes) exceeds `threshold`."""
    height, width = inverse.shape
    out = np.zeros((height, width), np.bool_)
    for v in range(height):
        above, below = max(v - 1, 0), min(v + 1, height - 1)
        for u in range(1, width - 1):
            twice = np.float32(2.0) * inverse[v, u]
            row = abs(inverse[v, u - 1] - twice + inverse[v, u + 1]) > threshold
            column = abs(inverse[above, u] - twice + inverse[below, u]) > threshold and above < v < below
            out[v, u] = row or column
    return out


@nb.njit(cache=True, nogil=True)
def projector_shadow(inverse, focal_baseline):
    """(H, W), whether a projector at +x does not light the point seen by a pixel.

    Each row is mapped to the projector's columns u - f b / z, neighbours on one surface as a connected line, the
    nearest surface is kept in every column (a shadow map), and a pixel that is farther than it is in the shadow.
    """
    height, width = inverse.shape
    hidden = np.zeros((height, width), np.bool_)
    largest = np.float32(0.0)
    for v in range(height):
        for u in range(width):
            largest = max(largest, inverse[v, u])
    offset = min(int(largest * focal_baseline) + 2, 4 * width)
    nearest = np.empty(width + offset + 2, np.float32)
    for v in range(height):
        nearest[:] = 0.0
        for u in range(width):
            disparity = focal_baseline * inverse[v, u]
            if disparity == 0.0:
                continue
            column = np.float32(u + offset) - disparity
            first = last = int(column + np.float32(0.5))
            if u + 1 < width:
                following = focal_baseline * inverse[v, u + 1]
                if abs(following - disparity) < _SHADOW_SLACK:
                    last = int(np.float32(u + 1 + offset) - following + np.float32(0.5))
            for c in range(max(min(first, last), 0), max(first, last) + 1):
                nearest[c] = max(nearest[c], disparity)
        for u in range(width):
            disparity = focal_baseline * inverse[v, u]
            column = int(np.float32(u + offset) - disparity + np.float32(0.5))
            hidden[v, u] = disparity > 0.0 and column >= 0 and nearest[column] > disparity + _SHADOW_SLACK
    return hidden


@nb.njit(cache=True, nogil=True, inline="always")
def _shift(normal, sigma):
    return min(max(int(np.rint(normal * sigma)), -_MAX_SHIFT), _MAX_SHIFT)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def sources(cosines, edges, bits, quantiles, everywhere, p):
    """(H, W) flat index of the pixel whose surface each pixel reads: itself, or at depth edges a neighbour."""
    height, width = cosines.shape
    out = np.empty((height, width), np.int32)
    for v in range(height):
        for u in range(width):
            word = bits[v, u]
            sigma = p.lateral_sigma
            if p.lateral_grazing > 0.0 and (everywhere or edges[v, u]):
                theta = min(np.arccos(cosines[v, u]), p.max_incidence)
                sigma += p.lateral_grazing * theta / (_HALF_PI - theta)
            row = min(max(v + _shift(quantiles[word & 4095], sigma), 0), height - 1)
            column = min(max(u + _shift(quantiles[(word >> 12) & 4095], sigma), 0), width - 1)
            moved = everywhere or edges[v, u] or edges[row, column]
            out[v, u] = row * width + column if moved else v * width + u
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _kept(z, cosine, albedo, p):
    """Probability that a reading is not lost to incidence, darkness or chance; no albedo is a negative one."""
    keep = np.float32(1.0) - p.dropout
    if cosine < p.grazing_cosine:
        keep /= np.float32(1.0) + np.exp((np.arccos(cosine) - p.grazing_dropout) / p.grazing_width)
    if albedo >= 0.0 and p.albedo_floor > 0.0:
        ratio = p.albedo_floor * z * z / max(albedo, np.float32(1e-6))
        keep /= np.float32(1.0) + ratio * ratio
    return keep


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _axial(z, cosine, p):
    """Standard deviation of what is added to z before rounding: that of the whole reading without rounding's share."""
    sigma = p.axial_offset + p.axial_quadratic * (z - p.axial_origin) * (z - p.axial_origin)
    if p.axial_grazing > 0.0 and cosine < np.float32(0.5):  # beyond 60 deg
        theta = min(np.arccos(cosine), p.max_incidence)
        ratio = theta / (_HALF_PI - theta)
        sigma += p.axial_grazing / np.sqrt(z) * ratio * ratio
    rounding = p.disparity_step * z * z
    return np.sqrt(max(sigma * sigma - rounding * rounding / np.float32(12.0), np.float32(0.0)))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _handa(z, normal):
    """Depth by the last step of Handa et al. (see `DepthNoiseConfig.simkinect`)."""
    centimetres = np.rint(np.float32(100.0) * z)
    levels = np.rint(np.float32(35130.0) / centimetres + normal / np.float32(6.0) + np.float32(0.5))
    return np.float32(351.30) / levels if centimetres > 0.0 and levels > 0.0 else np.float32(0.0)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def fly(inverse, edges, uniform, share):
    """(H, W) inverse depth in which a share of the pixels at edges lies between the surfaces around them."""
    height, width = inverse.shape
    out = inverse.copy()
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            if not edges[v, u] or uniform[v, u] >= share or inverse[v, u] == 0.0:
                continue
            low = high = inverse[v, u]
            for row in range(v - 1, v + 2):
                for column in range(u - 1, u + 2):
                    w = inverse[row, column]
                    if w > 0.0:
                        low, high = min(low, w), max(high, w)
            out[v, u] = low + uniform[v, u] / np.float32(share) * (high - low)
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def read_depth(inverse, cosines, hidden, source, albedo, axial, uniform, simkinect, p):
    """Readings of N pixels, all arguments flat; `albedo`, `axial` and `source` may be empty."""
    out = np.zeros(inverse.shape[0], np.float32)
    scale = np.float32(1.0) / p.disparity_step
    for i in range(inverse.shape[0]):
        j = np.int64(source[i]) if source.shape[0] > 0 else i
        if inverse[j] == 0.0 or inverse[i] == 0.0 or hidden[j]:
            continue
        z = np.float32(1.0) / inverse[j]
        cosine = cosines[j]
        if uniform[i] >= _kept(z, cosine, albedo[j] if albedo.shape[0] > 0 else np.float32(-1.0), p):
            continue
        normal = axial[i] if axial.shape[0] > 0 else np.float32(0.0)
        if not simkinect:
            z += normal * _axial(z, cosine, p)
        if p.disparity_step > 0.0 and z > 0.0:
            z = scale / max(np.rint(scale / z), np.float32(1.0))
        if simkinect:
            z = _handa(z, normal)
        if p.min_range <= z <= p.max_range:
            out[i] = z
    return out
