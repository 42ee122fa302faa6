"""Compiled inner loops of the correlative search."""

import numba as nb
import numpy as np

from simtrack.contracts import Float64

_CHUNK = 512
"""Pose cells a thread takes at a time."""


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


@nb.njit(cache=True, nogil=True)
def level_for(move: float, resolution: float, top: int) -> int:
    """Finest level, `top` at most, whose neighbourhood covers a movement in metres."""
    level = 0
    while level < top and move > (0.0 if level == 0 else resolution * 2.0 ** (level - 1)):
        level += 1
    return level


@nb.njit(cache=True, nogil=True)
def combed(
    pyramid: np.ndarray, shapes: np.ndarray, offsets: np.ndarray, first: int, last: int, comb: int
) -> np.ndarray:
    """(K, L, comb, comb, X / comb, Y / comb) uint8: levels `first` to `last` of a pyramid in the cells of level 0.

    Every `comb`-th cell of a row lies side by side: what a point meets as the pose moves by that many cells.
    """
    layers, last_shift = shapes[0, 0], max(last - 1, 0)
    w = ((shapes[last, 1] << last_shift) + comb - 1) // comb
    h = ((shapes[last, 2] << last_shift) + comb - 1) // comb
    out = np.zeros((last - first + 1, layers, comb, comb, w, h), np.uint8)
    for level in range(first, last + 1):
        shift, wide, high = max(level - 1, 0), shapes[level, 1], shapes[level, 2]
        for k in range(layers):
            for x in range(wide << shift):
                row = offsets[level] + (k * wide + (x >> shift)) * high
                for y in range(high << shift):
                    out[level - first, k, x % comb, y % comb, x // comb, y // comb] = pyramid[row + (y >> shift)]
    return out


@nb.njit(cache=True, nogil=True, parallel=True)
def grid_totals(
    planes: np.ndarray,
    first: int,
    points: Float64,
    layers: np.ndarray,
    yaws: Float64,
    resolution: float,
    cell: float,
    step: float,
    low: np.ndarray,
    shape: np.ndarray,
) -> np.ndarray:
    """(A, W, H) int32, sums of the points' likelihoods in 255ths, for all pose cells of a grid: upper bounds.

    As `bound_cells`, for cells of side ``comb * resolution`` that fill a rectangle of the map: whole rows at once.

    Args:
        planes: from `combed`, of levels from `first` on.
        first: see there.
        points: (N, 2), base frame, metres.
        layers: (N,).
        yaws: (A,), radians.
        resolution: metres.
        cell: side of the cells for the bound, metres, and `step` in yaw, radians.
        step: see there.
        low: (2,) cell of the rectangle's corner.
        shape: (2,) cells of the rectangle, W and H.

    """
    comb, top, count = planes.shape[2], first + planes.shape[0] - 1, points.shape[0]
    out = np.zeros((yaws.shape[0], shape[0], shape[1]), np.int32)
    for a in nb.prange(yaws.shape[0]):
        cosine, sine = np.cos(yaws[a]), np.sin(yaws[a])
        at = np.empty((count, 5), np.int64)
        for i in range(count):
            radius = np.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2)
            at[i, 0] = level_for(0.5 * cell + 0.5 * step * radius, resolution, top) - first
            x = int(np.floor(0.5 * comb + (cosine * points[i, 0] - sine * points[i, 1]) / resolution))
            y = int(np.floor(0.5 * comb + (sine * points[i, 0] + cosine * points[i, 1]) / resolution))
            at[i, 1], at[i, 2], at[i, 3], at[i, 4] = x % comb, y % comb, x // comb + low[0], y // comb + low[1]
        for column in range(shape[0]):
            target = out[a, column]
            for i in range(count):
                x, start = at[i, 3] + column, at[i, 4]
                under, over = max(0, -start), min(shape[1], planes.shape[5] - start)
                if 0 <= x < planes.shape[4] and under < over:
                    source = planes[at[i, 0], layers[i], at[i, 1], at[i, 2], x, under + start : over + start]
                    within = target[under:over]
                    for k in range(over - under):
                        within[k] += source[k]
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
        level = level_for(move, resolution, top)
        scale[i] = 1.0 / (resolution * (1.0 if level == 0 else 2.0 ** (level - 1)))
        width[i], height[i] = shapes[level, 1], shapes[level, 2]
        offset[i] = offsets[level] + layers[i] * width[i] * height[i]
    for chunk in nb.prange((cells.shape[0] + _CHUNK - 1) // _CHUNK):
        turned, yaw = np.empty((count, 2)), np.nan
        for c in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, cells.shape[0])):
            if cells[c, 2] != yaw:  # halves of a cell come with the same yaw in a row
                yaw = cells[c, 2]
                cosine, sine = np.cos(yaw), np.sin(yaw)
                for i in range(count):
                    turned[i, 0] = (cosine * points[i, 0] - sine * points[i, 1]) * scale[i]
                    turned[i, 1] = (sine * points[i, 0] + cosine * points[i, 1]) * scale[i]
            x0, y0 = cells[c, 0] - origin[0], cells[c, 1] - origin[1]
            total = 0
            for i in range(count):
                x, y = x0 * scale[i] + turned[i, 0], y0 * scale[i] + turned[i, 1]
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
