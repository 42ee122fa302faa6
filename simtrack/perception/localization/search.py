"""Correlative scan matching against the whole floor: the places where a scan could have been taken.

The map is sliced into height layers; each layer becomes a likelihood field of the distance to the nearest surface
(Thrun et al., Probabilistic Robotics, sec. 6.4), and each field a pyramid of maxima over growing neighbourhoods (Olson,
"Real-time correlative scan matching", 2009; Hess et al., "Real-time loop closure in 2D lidar SLAM", 2016). A cell of
poses is bounded from above by looking every scan point up at the level that covers how far the point moves within the
cell; far points move more with yaw and are looked up coarser. Cells are halved, and those whose bound is poor dropped.
"""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Bool, Float64, StaticMap
from simtrack.geometry.transforms import transform_planar
from simtrack.perception.localization.config import SearchConfig
from simtrack.perception.localization.measurement import Measurement

MIN_RANGE = 0.3
"""m from the robot's centre: nearer points are left out."""


@dataclass(frozen=True, slots=True)
class SearchMap:
    """Likelihood fields of a static map, made once."""

    origin: Float64
    """(2,), map x, y of the outer corner of cell (0, 0), metres."""
    resolution: float
    """m."""
    pyramid: np.ndarray
    """All levels, each (L, X, Y) uint8 likelihood, one after the other, flat. Level 0 is the field itself; a cell of
    level k has side ``2^(k-1) * resolution`` and holds the maximum over all cells of level 0 that lie in it or in its
    eight neighbours."""
    shapes: np.ndarray
    """(K, 3) int64: L, X, Y of each level."""
    offsets: np.ndarray
    """(K,) int64: where each level starts in `pyramid`."""
    planes: np.ndarray
    """The levels that the first cells are looked up at, see `search_kernels.combed`."""
    first: int
    """The finest of them."""
    free: np.ndarray
    """(X, Y) bool: a robot's centre may be there."""
    floor: float
    """m."""


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Distinct maxima of the correlation, best first."""

    poses: Float64
    """(K, 4, 4), T_map_base."""
    scores: Float64
    """(K,), 0 to 1."""


def build_search_map(static_map: StaticMap, config: SearchConfig, floor: float = 0.0) -> SearchMap:
    """Slice the map's mesh into likelihood fields."""
    from scipy.ndimage import distance_transform_edt

    from simtrack.perception.localization.search_kernels import combed, level_for, pyramid_level, rasterise

    margin = 1.0
    vertices = np.asarray(static_map.vertices, dtype=np.float64)
    origin = vertices[:, :2].min(axis=0) - margin
    shape = np.ceil((vertices[:, :2].max(axis=0) + margin - origin) / config.resolution).astype(int) + 1
    bounds = np.array(config.heights) + floor
    faces = np.asarray(static_map.faces, np.int64)
    occupied, level = rasterise(vertices, faces, origin, config.resolution, bounds, floor, int(shape[0]), int(shape[1]))
    fine = np.empty(occupied.shape, np.uint8)
    nearest = np.full(occupied.shape[1:], np.inf)
    for k, layer in enumerate(occupied):
        distance = np.asarray(distance_transform_edt(~layer)) * config.resolution
        if not layer.any():
            distance = np.full(layer.shape, np.inf)
        fine[k] = np.round(255.0 * np.exp(-0.5 * np.square(distance / config.sigma)))
        if k < 2:  # what stands on the floor keeps the robot away; what hangs from the ceiling does not
            nearest = np.minimum(nearest, distance)
    fields = [fine, *(pyramid_level(fine, 2**k) for k in range(8))]
    shapes = np.array([field.shape for field in fields], np.int64)
    offsets = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))[:-1]])
    pyramid = np.concatenate([field.ravel() for field in fields])
    free = level & (nearest > config.clearance)
    first, last = (
        level_for(0.5 * (config.coarse_cell + config.coarse_yaw * radius), config.resolution, len(fields) - 1)
        for radius in (MIN_RANGE, config.max_range)
    )
    planes = combed(pyramid, shapes, offsets, first, last, max(1, round(config.coarse_cell / config.resolution)))
    return SearchMap(origin, config.resolution, pyramid, shapes, offsets, planes, first, free, floor)


def search_points(measurement: Measurement, config: SearchConfig) -> tuple[Float64, np.ndarray]:
    """What a search looks up: points (N, 2) in the base frame, evenly spread, and their (N,) int64 height layers.

    The base is taken to stand upright on the floor. Points on the floor and above the last layer take no part.
    """
    points = measurement.points
    layer = np.searchsorted(np.array(config.heights), points[:, 2]) - 1
    radius = np.hypot(points[:, 0], points[:, 1])
    good = (layer >= 0) & (layer < len(config.heights) - 1) & (radius < config.max_range) & (radius > MIN_RANGE)
    points, layer = points[good, :2], layer[good]
    cells = np.floor(points / (1.5 * config.resolution)).astype(np.int64) + (1 << 20)
    keys = (layer << 50) | (cells[:, 0] << 25) | cells[:, 1]
    _, first = np.unique(keys, return_index=True)
    return np.ascontiguousarray(points[first]), layer[first].astype(np.int64)


def search(
    measurement: Measurement,
    search_map: SearchMap,
    config: SearchConfig,
    window: tuple[Float64, float, float] | None = None,
) -> SearchResult:
    """Find the poses that the measurement fits, over the whole map or in a window.

    Args:
        measurement: shots in the base frame.
        search_map: the sliced map.
        config: settings.
        window: (T_map_base (4, 4), half side in metres, half range of yaw in radians), or None for everywhere.
    """
    from simtrack.perception.localization.search_kernels import bound_cells, expand_cells

    points, layers = search_points(measurement, config)
    empty = SearchResult(np.zeros((0, 4, 4)), np.zeros(0))
    if len(points) < 30:
        return empty
    order = np.argsort(np.arange(len(points)) * 0.6180339887498949 % 1.0)  # any first part is evenly spread
    points, layers = points[order], layers[order]
    cells = _coarse_cells(points, layers, search_map, config, window)
    if not len(cells):
        return empty
    cell, step = config.coarse_cell, config.coarse_yaw
    score, stacked = np.zeros(len(cells)), (search_map.pyramid, search_map.shapes, search_map.offsets)
    for level in range(1, config.levels):
        cells = expand_cells(cells, cell, step)
        cell, step = cell / 2, step / 2
        count = min(config.points[level], len(points))
        last = level == config.levels - 1
        arguments = points[:count], layers[:count], search_map.origin, search_map.resolution
        score = bound_cells(cells, *arguments, cell, step, 0 if last else 1, *stacked)
        if last:
            break
        keep = np.flatnonzero(score >= config.keep * score.max())
        if len(keep) > config.beam[level]:
            keep = keep[np.argpartition(-score[keep], config.beam[level])[: config.beam[level]]]
        cells = cells[np.sort(keep)]
    return _distinct(cells, score, search_map, config)


def _coarse_cells(
    points: Float64,
    layers: np.ndarray,
    search_map: SearchMap,
    config: SearchConfig,
    window: tuple[Float64, float, float] | None,
) -> Float64:
    """(C, 3) x, y, yaw of the centres of the first cells that are gone on with."""
    from simtrack.perception.localization.search_kernels import grid_totals

    resolution, cell, step = search_map.resolution, config.coarse_cell, config.coarse_yaw
    comb = search_map.planes.shape[2]
    free = search_map.free
    padded = np.zeros([-(-n // comb) * comb for n in free.shape], bool)
    padded[: free.shape[0], : free.shape[1]] = free
    wanted: Bool = np.asarray(padded.reshape(padded.shape[0] // comb, comb, -1, comb).any(axis=(1, 3)))
    x, y = (
        (np.arange(n) + 0.5) * comb * resolution + low for n, low in zip(wanted.shape, search_map.origin, strict=True)
    )
    yaws: Float64 = np.arange(int(np.ceil(2 * np.pi / step))) * np.float64(step)
    if window is not None:
        T, half, half_yaw = window
        wanted &= (np.abs(x - T[0, 3]) <= half + cell / 2)[:, None] & (np.abs(y - T[1, 3]) <= half + cell / 2)
        turns = int(np.ceil(half_yaw / step))
        yaws = np.arctan2(T[1, 0], T[0, 0]) + np.arange(-turns, turns + 1) * step
    if not wanted.any():
        return np.zeros((0, 3))
    places = np.argwhere(wanted)
    low = places.min(axis=0)
    shape = places.max(axis=0) + 1 - low
    points, layers = points[: config.points[0]], layers[: config.points[0]]
    totals = grid_totals(search_map.planes, search_map.first, points, layers, yaws, resolution, cell, step, low, shape)
    columns, rows = (places - low).T
    kept = _best(totals[:, columns, rows].ravel(), config.keep, config.beam[0])
    turn, place = kept // len(places), kept % len(places)
    return np.stack([x[places[place, 0]], y[places[place, 1]], yaws[turn]], axis=1).astype(np.float64)


def _best(totals: np.ndarray, share: float, count: int) -> np.ndarray:
    """Ascending indices of the whole numbers (N,) that are no less than a `share` of the largest, `count` at most."""
    least = int(np.ceil(share * int(totals.max())))
    above = np.cumsum(np.bincount(totals)[::-1])[::-1]  # how many are no less than each number
    enough = int(np.searchsorted(-above, -count))  # the least number that no more than `count` reach
    if enough <= least:
        return np.flatnonzero(totals >= least)
    equal = np.flatnonzero(totals == enough - 1)[: count - int(above[enough]) if enough < len(above) else count]
    return np.sort(np.concatenate([np.flatnonzero(totals >= enough), equal]))


def _distinct(cells: Float64, score: Float64, search_map: SearchMap, config: SearchConfig) -> SearchResult:
    """The maxima that differ by more than half a metre or 15 degrees."""
    from simtrack.perception.localization.search_kernels import distinct

    chosen = distinct(cells, np.argsort(-score, kind="stable"), config.modes, 0.5, 0.26)
    poses = np.stack([transform_planar(*cells[k]) for k in chosen])
    poses[:, 2, 3] = search_map.floor
    return SearchResult(poses, score[chosen])
