import numpy as np
import pytest

from simtrack.geometry.transforms import angle_between, transform_planar
from simtrack.perception.localization.config import MotionConfig, SearchConfig
from simtrack.perception.localization.measurement import Measurement, deskew
from simtrack.perception.localization.motion import OdometryTrack
from simtrack.perception.localization.search import SearchMap, _best, build_search_map, search, search_points
from simtrack.perception.localization.search_kernels import bound_cells, expand_cells, grid_totals


@pytest.fixture(scope="module")
def office_map(office_world) -> SearchMap:
    return build_search_map(office_world.static_map, SearchConfig())


def measure(world, T: np.ndarray) -> Measurement:
    scan = world.scan(lambda t: T, 0.0, np.random.default_rng(0))
    return deskew(scan, OdometryTrack(MotionConfig()), 0.008, 0.3, 100.0)


def likelihood(cells, points, layers, search_map, cell, step, bounded) -> np.ndarray:
    return bound_cells(
        cells,
        points,
        layers,
        search_map.origin,
        search_map.resolution,
        cell,
        step,
        bounded,
        search_map.pyramid,
        search_map.shapes,
        search_map.offsets,
    )


def test_bounds_are_never_below_what_a_cell_holds(office_world, office_map) -> None:
    points, layers = search_points(measure(office_world, transform_planar(3.0, 2.5, 0.4)), SearchConfig())
    rng = np.random.default_rng(3)
    for cell, step in ((0.4, 0.07), (0.2, 0.035), (1.6, 0.3)):
        centres = rng.uniform([0.5, 0.5, -3], [23, 11, 3], (40, 3))
        bounds = likelihood(centres, points, layers, office_map, cell, step, 1)
        for centre, bound in zip(centres, bounds, strict=True):
            inside = centre + rng.uniform(-0.5, 0.5, (60, 3)) * [cell, cell, step]
            assert likelihood(inside, points, layers, office_map, 0.0, 0.0, 0).max() <= bound + 1e-12


def test_whole_rows_are_bounded_as_cell_by_cell(office_world, office_map) -> None:
    """Sums over rows of cells are those of the cells, inside of the map and beyond its rim."""
    config = SearchConfig()
    points, layers = search_points(measure(office_world, transform_planar(3.0, 2.5, 0.4)), config)
    yaws, low, shape = np.array([-0.7, 0.0, 2.1]), np.array([2, 0]), np.array([30, office_map.planes.shape[5]])
    sizes = config.coarse_cell, config.coarse_yaw
    totals = grid_totals(
        office_map.planes, office_map.first, points, layers, yaws, office_map.resolution, *sizes, low, shape
    )
    grid = np.stack(np.meshgrid(yaws, *map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    cells = np.roll(grid, -1, axis=1)
    cells[:, :2] = (cells[:, :2] + low + 0.5) * config.coarse_cell + office_map.origin
    single = likelihood(cells, points, layers, office_map, *sizes, 1)
    np.testing.assert_array_equal(totals.ravel(), np.round(single * 255.0 * len(points)))


def test_the_best_are_those_of_a_sorted_list() -> None:
    rng = np.random.default_rng(0)
    for count in (1, 7, 100, 1000):
        totals = rng.integers(0, 50, 300).astype(np.int32)
        kept = _best(totals, 0.5, count)
        able = np.flatnonzero(totals >= 0.5 * totals.max())
        assert (np.diff(kept) > 0).all() and len(kept) == min(count, len(able))
        assert sorted(totals[kept], reverse=True) == sorted(totals[able], reverse=True)[:count]


def test_halves_of_a_cell_fill_it() -> None:
    halves = expand_cells(np.array([[1.0, 2.0, 0.3]]), 0.4, 0.1)
    assert len(np.unique(halves, axis=0)) == 8
    assert halves.mean(axis=0) == pytest.approx([1.0, 2.0, 0.3])
    assert np.abs(halves - [1.0, 2.0, 0.3]) == pytest.approx(np.tile([0.1, 0.1, 0.025], (8, 1)))


def test_finds_the_place_on_the_whole_floor(office_world, office_map) -> None:
    rng = np.random.default_rng(1)
    found = 0
    for _ in range(6):
        T = transform_planar(*rng.uniform([1.5, 1.5, -3], [22.0, 3.5, 3]))
        result = search(measure(office_world, T), office_map, SearchConfig())
        assert (np.diff(result.scores) <= 0).all()
        best = result.poses[0]
        found += bool(np.hypot(*(best[:2, 3] - T[:2, 3])) < 0.2 and angle_between(best[:3, :3], T[:3, :3]) < 0.06)
    assert found >= 5


def test_a_window_is_not_left(office_world, office_map) -> None:
    T = transform_planar(3.0, 2.5, 0.4)
    around = transform_planar(3.4, 2.2, 0.6)
    result = search(measure(office_world, T), office_map, SearchConfig(), window=(around, 1.0, 0.3))
    assert np.hypot(*(result.poses[0, :2, 3] - T[:2, 3])) < 0.15
    assert np.abs(result.poses[:, :2, 3] - around[:2, 3]).max() < 1.6


def test_modes_are_distinct_and_on_free_floor(office_world, office_map) -> None:
    result = search(measure(office_world, transform_planar(3.0, 2.5, 0.4)), office_map, SearchConfig())
    for i, a in enumerate(result.poses):
        for b in result.poses[:i]:
            assert np.abs(a[:2, 3] - b[:2, 3]).max() > 0.5 or angle_between(a[:3, :3], b[:3, :3]) > 0.2


def test_too_little_to_search_with_finds_nothing(office_world, office_map) -> None:
    shots = measure(office_world, transform_planar(3.0, 2.5, 0.4)).thinned(2000)
    assert len(search(shots, office_map, SearchConfig()).poses) == 0
