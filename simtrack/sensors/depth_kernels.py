"""Compiled loops of the depth noise. Inverse depth is linear in pixel coordinates on a plane, hence used throughout."""

from typing import NamedTuple

import numba as nb
import numpy as np

from simtrack.contracts import Float32

_HALF_PI = np.float32(np.pi / 2)
_DEG_60 = np.float32(np.deg2rad(60.0))
_MAX_SHIFT = 4
"""Pixels: lateral shifts are cut here."""
_SHADOW_SLACK = np.float32(1.5)
"""Pixels of disparity by which a surface must lie behind another one to be in its shadow."""


class Parameters(NamedTuple):
    """`DepthNoiseConfig` as kernels take it."""

    axial: Float32
    """offset m, quadratic 1/m, origin m, grazing."""
    max_incidence: float
    lateral: int
    """0 none, 1 at edges, 2 everywhere."""
    lateral_sigma: Float32
    """sigma px, grazing px."""
    disparity_step: float
    """1/m, in units of inverse depth; 0 = none."""
    grazing: Float32
    """centre and width of the loss, rad."""
    albedo_floor: float
    dropout: float
    flying_pixels: float
    simkinect: bool
    limits: Float32
    """m."""


def window(width: int) -> Float32:
    """(width,) Gaussian-like weights (binomial) with unit sum of squares: filtered white noise keeps its variance."""
    weights = np.array([1.0])
    for _ in range(width - 1):
        weights = np.convolve(weights, [0.5, 0.5])
    return (weights / np.sqrt((weights**2).sum())).astype(np.float32)


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def blend_correlated(axial, white, weights, share):
    """Make `axial` sqrt(1 - share) of itself plus sqrt(share) of `white` filtered along rows and columns, in place."""
    height, width = axial.shape
    taps = weights.shape[0]
    own, smooth = np.float32(np.sqrt(1.0 - share)), np.float32(np.sqrt(share))
    rows = np.zeros((height + taps - 1, width), np.float32)
    for v in range(height + taps - 1):
        for k in range(taps):
            weight = smooth * weights[k]
            for u in range(width):
                rows[v, u] += weight * white[v, u + k]
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


@nb.njit(cache=True, nogil=True)
def _shift(normal, sigma):
    pixels = int(np.rint(normal * sigma))
    return min(max(pixels, -_MAX_SHIFT), _MAX_SHIFT)


@nb.njit(cache=True, nogil=True)
def _source(v, u, cosines, edges, lateral, parameters):
    """Row and column of the pixel whose surface pixel (v, u) reads."""
    height, width = cosines.shape
    sigma = parameters.lateral_sigma[0]
    if parameters.lateral_sigma[1] > 0.0 and (edges[v, u] or parameters.lateral == 2):
        theta = min(np.arccos(cosines[v, u]), np.float32(parameters.max_incidence))
        sigma += parameters.lateral_sigma[1] * theta / (_HALF_PI - theta)
    row = min(max(v + _shift(lateral[v, u, 1], sigma), 0), height - 1)
    column = min(max(u + _shift(lateral[v, u, 0], sigma), 0), width - 1)
    if parameters.lateral == 2 or edges[v, u] or edges[row, column]:
        return row, column
    return v, u


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _lost(z, cosine, uniform, albedo, parameters):
    """Whether this reading is lost to incidence, darkness or chance, decided by one uniform number."""
    keep = np.float32(1.0 - parameters.dropout)
    centre, spread = parameters.grazing[0], parameters.grazing[1]
    if centre < _HALF_PI and cosine < np.cos(centre - np.float32(8.0) * spread):
        keep /= np.float32(1.0) + np.exp((np.arccos(cosine) - centre) / spread)
    if albedo >= 0.0 and parameters.albedo_floor > 0.0:
        floor = np.float32(parameters.albedo_floor) * (z / parameters.limits[1]) ** 2
        keep *= albedo * albedo / (albedo * albedo + floor * floor)
    return uniform >= keep


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _axial(z, cosine, parameters):
    """Standard deviation of what is added to z before rounding: that of the whole reading without rounding's share."""
    a = parameters.axial
    sigma = a[0] + a[1] * (z - a[2]) ** 2
    if a[3] > 0.0 and cosine < np.float32(0.5):
        theta = min(np.arccos(cosine), np.float32(parameters.max_incidence))
        ratio = theta / (_HALF_PI - theta)
        sigma += a[3] / np.sqrt(z) * ratio * ratio
    rounding = np.float32(parameters.disparity_step) * z * z
    variance = sigma * sigma - rounding * rounding / np.float32(12.0)
    return np.sqrt(max(variance, np.float32(0.0)))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _round(z, step, simkinect, normal):
    """Depth after the sensor's own rounding."""
    if step > 0.0:
        levels = np.rint(np.float32(1.0 / step) / z)
        z = np.float32(1.0 / step) / levels if levels > 0.0 else np.float32(0.0)
    if simkinect and z > 0.0:
        centimetres = np.rint(np.float32(100.0) * z)
        shift = np.rint(np.float32(35130.0) / centimetres + normal / np.float32(6.0) + np.float32(0.5))
        z = np.float32(351.30) / shift if centimetres > 0.0 and shift > 0.0 else np.float32(0.0)
    return z


@nb.njit(cache=True, nogil=True)
def _mixed(v, u, inverse, share):
    """Inverse depth of a flying pixel: between the nearest and the farthest surface around (v, u)."""
    low = high = inverse[v, u]
    for row in range(max(v - 1, 0), min(v + 2, inverse.shape[0])):
        for column in range(max(u - 1, 0), min(u + 2, inverse.shape[1])):
            w = inverse[row, column]
            if w > 0.0:
                low, high = min(low, w), max(high, w)
    return low + share * (high - low)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def read_depth(depth, inverse, cosines, edges, hidden, albedo, draws, parameters):
    """(H, W) readings of a true depth image, pixel by pixel."""
    axial, lateral, uniform = draws
    height, width = depth.shape
    out = np.zeros((height, width), np.float32)
    for v in range(height):
        for u in range(width):
            row, column = v, u
            if parameters.lateral > 0:
                row, column = _source(v, u, cosines, edges, lateral, parameters)
            w = inverse[row, column]
            if w == 0.0 or hidden[row, column] or inverse[v, u] == 0.0:
                continue
            z = depth[row, column]
            if parameters.flying_pixels > 0.0 and edges[v, u] and uniform[v, u, 1] < parameters.flying_pixels:
                z = np.float32(1.0) / _mixed(v, u, inverse, uniform[v, u, 1] / np.float32(parameters.flying_pixels))
            dark = albedo[row, column] if albedo.shape[0] > 0 else np.float32(-1.0)
            if _lost(z, cosines[row, column], uniform[v, u, 0], dark, parameters):
                continue
            normal = axial[v, u] if axial.shape[0] > 0 else np.float32(0.0)
            if not parameters.simkinect:
                z += normal * _axial(z, cosines[row, column], parameters)
            if z > 0.0:
                z = _round(z, parameters.disparity_step, parameters.simkinect, normal)
                if parameters.limits[0] <= z <= parameters.limits[1]:
                    out[v, u] = z
    return out
