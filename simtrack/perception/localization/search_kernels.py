"""Compiled inner loops of the correlative search."""

import numba as nb
import numpy as np

from simtrack.contracts import Float64


@nb.njit(cache=True, nogil=True)
def rasterise(
    vertices: Float64,
    faces: np.ndarray,
    origin: Float64,
    resolution: float,
    bounds: Float64,
    floor: float,
    width: int,
    height: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Cells that a mesh touches: (L, X, Y) bool in each height layer, and (X, Y) bool where there is floor."""
    layers = bounds.shape[0] - 1
    occupied = np.zeros((layers, width, height), np.bool_)
    level = np.zeros((width, height), np.bool_)
    spacing = 0.6 * resolution
    for f in range(faces.shape[0]):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        u, v = b - a, c - a
        low, high = min(a[2], b[2], c[2]), max(a[2], b[2], c[2])
        ground = high < floor + 0.08 and low > floor - 0.08
        if not ground and (high < bounds[0] or low > bounds[layers]):
            continue
        nu = int(np.sqrt(u @ u) / spacing) + 1
        nv = int(np.sqrt(v @ v) / spacing) + 1
        for i in range(nu + 1):
            s = i / nu
            mv = int(np.ceil(nv * (1.0 - s)))
            for j in range(mv + 1):
                t = min(j / nv, 1.0 - s)
                x = int((a[0] + s * u[0] + t * v[0] - origin[0]) / resolution)
                y = int((a[1] + s * u[1] + t * v[1] - origin[1]) / resolution)
                if ground:
                    level[x, y] = True
                    continue
                z = a[2] + s * u[2] + t * v[2]
                for k in range(layers):
                    if bounds[k] <= z < bounds[k + 1]:
                        occupied[k, x, y] = True
    return occupied, level


@nb.njit(cache=True, nogil=True)
def pyramid_level(fine: np.ndarray, block: int) -> np.ndarray:
    """Maxima over blocks of `block` cells and their eight neighbours."""
    layers, width, height = fine.shape
    w, h = (width + block - 1) // block, (height + block - 1) // block
    coarse = np.zeros((layers, w, h), np.uint8)
    for k in range(layers):
        for x in range(width):
            for y in range(height):
                coarse[k, x // block, y // block] = max(coarse[k, x // block, y // block], fine[k, x, y])
    out = np.zeros_like(coarse)
    for k in range(layers):
        for x in range(w):
            for y in range(h):
                best = 0
                for i in range(max(0, x - 1), min(w, x + 2)):
                    for j in range(max(0, y - 1), min(h, y + 2)):
                        best = max(best, coarse[k, i, j])
                out[k, x, y] = best
    return out


@nb.njit(cache=True, nogil=True, parallel=True)
def bound_cells(
    cells: Float64,
    points: Float64,
    layers: np.ndarray,
    origin: Float64,
    resolution: float,
    cell: float,
    step: float,
    bounded: int,
    field: np.ndarray,
    shapes: np.ndarray,
    offsets: np.ndarray,
) -> Float64:
    """(C,) mean likelihood of the points, 0 to 1, for pose cells (C, 3): an upper bound, or exact if not `bounded`.

    Each point is looked up at the level whose neighbourhood covers its movement within the cell.
    """
    count = points.shape[0]
    out = np.empty(cells.shape[0])
    scale, offset = np.empty(count), np.empty(count, np.int64)
    width, height = np.empty(count, np.int64), np.empty(count, np.int64)
    top = shapes.shape[0] - 1
    for i in range(count):
        radius = np.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2)
        move = 0.5 * cell + 0.5 * step * radius if bounded else 0.0
        level = 0
        while level < top and move > (0.0 if level == 0 else resolution * 2.0 ** (level - 1)):
            level += 1
        scale[i] = 1.0 / (resolution * (1.0 if level == 0 else 2.0 ** (level - 1)))
        width[i], height[i] = shapes[level, 1], shapes[level, 2]
        offset[i] = offsets[level] + layers[i] * width[i] * height[i]
    for c in nb.prange(cells.shape[0]):
        cosine, sine = np.cos(cells[c, 2]), np.sin(cells[c, 2])
        x0, y0 = cells[c, 0] - origin[0], cells[c, 1] - origin[1]
        total = 0
        for i in range(count):
            x = (x0 + cosine * points[i, 0] - sine * points[i, 1]) * scale[i]
            y = (y0 + sine * points[i, 0] + cosine * points[i, 1]) * scale[i]
            if 0.0 <= x < width[i] and 0.0 <= y < height[i]:
                total += field[offset[i] + int(x) * height[i] + int(y)]
        out[c] = total / (255.0 * count)
    return out


@nb.njit(cache=True, nogil=True)
def expand_cells(cells: Float64, cell: float, step: float) -> Float64:
    """(8 C, 3) the halves of pose cells (C, 3) in x, y and yaw."""
    out = np.empty((8 * cells.shape[0], 3))
    for c in range(cells.shape[0]):
        for k in range(8):
            out[8 * c + k, 0] = cells[c, 0] + (0.25 if k & 1 else -0.25) * cell
            out[8 * c + k, 1] = cells[c, 1] + (0.25 if k & 2 else -0.25) * cell
            out[8 * c + k, 2] = cells[c, 2] + (0.25 if k & 4 else -0.25) * step
    return out


@nb.njit(cache=True, nogil=True)
def distinct(cells: Float64, order: np.ndarray, count: int, distance: float, turn: float) -> np.ndarray:
    """Up to `count` of the pose cells (C, 3), in `order` (C,), each apart from those before by one of the limits.

    `distance` in metres along x or y, `turn` in radians.
    """
    chosen = np.empty(count, np.int64)
    found = 0
    for c in order:
        alike = False
        for k in range(found):
            other = chosen[k]
            yaw = abs((cells[c, 2] - cells[other, 2] + np.pi) % (2 * np.pi) - np.pi)
            away = max(abs(cells[c, 0] - cells[other, 0]), abs(cells[c, 1] - cells[other, 1]))
            if away <= distance and yaw <= turn:
                alike = True
                break
        if not alike:
            chosen[found] = c
            found += 1
            if found == count:
                break
    return chosen[:found]
