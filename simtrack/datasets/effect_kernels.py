"""Compiled loops of effects on colour images."""

import numpy as np
from numba import njit

_CODES = 1 << 14
_LEVELS = np.arange(256) / 255.0
_DECODED = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""Linear light of each sRGB value (IEC 61966-2-1)."""
_STEPS = (np.arange(_CODES) / (_CODES - 1.0)) ** 2
_ENCODED = np.round(
    255.0 * np.where(_STEPS <= 0.0031308, 12.92 * _STEPS, 1.055 * np.maximum(_STEPS, 1e-9) ** (1 / 2.4) - 0.055)
).astype(np.uint8)
"""sRGB value by square root of the light, which is fine enough in the dark."""
_MOST_SAMPLES = 48
"""Of a blurred pixel."""


@njit(cache=True, nogil=True)
def decode(rgb):
    """(H, W, 3) float32, linear light 0..1 of an sRGB image."""
    out = np.empty(rgb.shape, np.float32)
    source, target = rgb.reshape(-1), out.reshape(-1)
    for k in range(source.shape[0]):
        target[k] = _DECODED[source[k]]
    return out


@njit(cache=True, nogil=True)
def encode(light):
    """(H, W, 3) uint8, sRGB of linear light, cut off at 0 and 1."""
    out = np.empty(light.shape, np.uint8)
    source, target = light.reshape(-1), out.reshape(-1)
    for k in range(source.shape[0]):
        value = min(max(source[k], np.float32(0.0)), np.float32(1.0))
        target[k] = _ENCODED[int(np.sqrt(value) * np.float32(_CODES - 1) + np.float32(0.5))]
    return out


@njit(cache=True, nogil=True)
def darken(light, left, power):
    """Multiply light (H, W, 3) by a power of what is left of it (H, W, 3)."""
    source, target = left.reshape(-1), light.reshape(-1)
    for k in range(source.shape[0]):
        if source[k] != 1.0:
            target[k] *= source[k] ** power


@njit(cache=True, nogil=True, error_model="numpy")
def blur(light, depth, T_end_start, camera, far):
    """Mean of each pixel's light along its way while the camera moves, sampled at least once a pixel."""
    fx, fy, cx, cy = camera
    height, width = depth.shape
    T = T_end_start
    out = np.empty_like(light)
    for v in range(height):
        for u in range(width):
            z = np.float64(depth[v, u]) if depth[v, u] > 0.0 else far
            x, y = (u - cx) / fx * z, (v - cy) / fy * z
            ahead = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            du, dv = 0.0, 0.0
            if ahead > 0.0:
                du = fx * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / ahead + cx - u
                dv = fy * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / ahead + cy - v
            count = min(int(max(abs(du), abs(dv))) + 1, _MOST_SAMPLES)
            red, green, blue = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for k in range(count):
                share = (k + 0.5) / count - 0.5
                column = min(max(int(np.floor(u + share * du + 0.5)), 0), width - 1)
                row = min(max(int(np.floor(v + share * dv + 0.5)), 0), height - 1)
                red += light[row, column, 0]
                green += light[row, column, 1]
                blue += light[row, column, 2]
            scale = np.float32(1.0 / count)
            out[v, u, 0], out[v, u, 1], out[v, u, 2] = red * scale, green * scale, blue * scale
    return out


@njit(cache=True, nogil=True)
def expose(light, normal, balance, full_well, read_noise, top):
    """(H, W) uint16, counts 0..top of a sensor with red at even rows and columns and blue at odd ones."""
    height, width = normal.shape
    out = np.empty((height, width), np.uint16)
    for v in range(height):
        for u in range(width):
            channel = (v & 1) + (u & 1)
            electrons = max(light[v, u, channel], np.float32(0.0)) * balance[channel] * full_well
            noisy = electrons + normal[v, u] * np.sqrt(electrons + read_noise * read_noise)
            counts = noisy / full_well * top + np.float32(0.5)
            out[v, u] = np.uint16(min(max(counts, np.float32(0.0)), np.float32(top)))
    return out
