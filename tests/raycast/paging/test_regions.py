"""What rays can reach: never less than they do reach."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.errors import InvalidValueError
from simtrack.raycast.paging import Regions
from simtrack.raycast.paging.grid import BoxGrid
from tests.raycast.paging.mazes import inside, maze, passed

TWO_ROOMS = {
    "low": [[0, 0, 0], [4, 0, 0]],
    "high": [[4, 4, 3], [8, 4, 3]],
    "sides": [[0, 1]],
    "centres": [[4, 2, 1]],
    "half_axes": [[[0, 0.5, 0], [0, 0, 1]]],
}


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    rays = rng.normal(size=(count, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("radius", [0.0, 1.5])
def test_no_ray_gets_into_a_region_that_was_not_expected(seed: int, radius: float) -> None:
    regions, rng = maze(seed), np.random.default_rng(seed)
    entered = 0
    for _ in range(12):
        sensor, reach = inside(regions, rng), rng.uniform(1.0, 14.0)
        found, ways = regions.reachable(sensor, reach, radius)
        bound = dict(zip(found.tolist(), ways.tolist(), strict=True))
        for ray in directions(rng, 60):
            origin = sensor + radius * rng.random() * directions(rng, 1)[0]
            if not len(regions.containing(origin)):
                continue
            path = passed(regions, origin, ray, reach)
            for region, travelled in path:
                assert region in bound
                assert bound[region] <= travelled + radius + 1e-6
                entered += region != path[0][0]
    assert entered > 30


def test_what_no_ray_can_see_is_not_expected() -> None:
    """Three rooms in a row with doors that are not in line: the third is within reach, but around a corner."""
    regions = Regions(
        [[0, 0, 0], [4, 0, 0], [8, 0, 0]],
        [[4, 9, 3], [8, 9, 3], [12, 9, 3]],
        [[0, 1], [1, 2]],
        [[4, 1, 1], [8, 8, 1]],
        [[[0, 0.4, 0], [0, 0, 1]]] * 2,
    )
    assert regions.reachable([3, 8, 1], 30.0)[0].tolist() == [0, 1]
    assert regions.reachable([3.9, 1, 1], 30.0)[0].tolist() == [0, 1, 2]
    assert regions.reachable([1, 1, 1], 2.5)[0].tolist() == [0]
    assert regions.reachable([1, 1, 1], 2.5, radius=1.0)[0].tolist() == [0, 1]


def test_the_answer_is_in_order_and_the_same_each_time() -> None:
    regions = maze(3)
    first = regions.reachable(inside(regions, np.random.default_rng(0)), 12.0)
    for _ in range(3):
        again = regions.reachable(inside(regions, np.random.default_rng(0)), 12.0)
        np.testing.assert_array_equal(again[0], first[0])
        np.testing.assert_array_equal(again[1], first[1])
    assert (np.diff(first[1]) >= 0).all()
    assert len(set(first[0].tolist())) == len(first[0]) > 5


def test_a_longer_reach_and_an_open_door_never_hide_anything() -> None:
    regions, rng = maze(4, share_open=0.4), np.random.default_rng(4)
    for _ in range(10):
        sensor = inside(regions, rng)
        near = set(regions.reachable(sensor, 5.0)[0].tolist())
        far = set(regions.reachable(sensor, 9.0)[0].tolist())
        wide = set(regions.reachable(sensor, 9.0, 2.0)[0].tolist())
        assert near <= far <= wide
        closed = np.flatnonzero(~regions.is_open)
        regions.set_open(int(rng.choice(closed)), True)
        assert far <= set(regions.reachable(sensor, 9.0)[0].tolist())


def test_closed_doors_end_the_view() -> None:
    regions = Regions(**TWO_ROOMS, is_open=[False])
    assert regions.reachable([2, 2, 1], 10.0)[0].tolist() == [0]
    regions.set_open(0, True)
    assert regions.reachable([2, 2, 1], 10.0)[0].tolist() == [0, 1]


def test_from_outside_everything_near_is_expected() -> None:
    regions = Regions(**TWO_ROOMS, is_open=[False])
    found, ways = regions.reachable([-1, 2, 1], 4.0)
    assert found.tolist() == [0]
    assert ways.tolist() == [1.0]
    assert regions.reachable([-1, 2, 1], 6.0)[0].tolist() == [0, 1]


def test_a_trapdoor_is_seen_through_from_below_it_and_from_aside() -> None:
    regions = Regions(
        [[0, 0, 0], [0, 0, 3]], [[4, 4, 3], [4, 4, 6]], [[0, 1]], [[1, 1, 3]], [[[0.5, 0, 0], [0, 0.5, 0]]]
    )
    for sensor in ([1, 1, 1], [3, 3, 1], [1, 1, 2.999]):
        assert regions.reachable(sensor, 5.0)[0].tolist() == [0, 1]


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3, 4.0, 60.0]))
def test_the_grid_equals_a_search_of_all_boxes(seed: int, distance: float) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(-20, 20, (60, 3))
    high = low + rng.choice([0.0, 0.5, 3.0, 30.0], (60, 1)) * rng.random((60, 3))
    grid = BoxGrid(low, high)
    for point in (*rng.uniform(-22, 22, (8, 3)), low[0], high[1]):
        gap = np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0), axis=1)
        np.testing.assert_array_equal(grid.containing(point), np.flatnonzero(gap == 0))
        np.testing.assert_array_equal(grid.near(point, distance), np.flatnonzero(gap <= distance))


def test_points_are_located() -> None:
    regions = Regions(**TWO_ROOMS)
    assert regions.locate([[1, 1, 1], [5, 1, 1], [4, 1, 1], [9, 1, 1]]).tolist() == [0, 1, 0, -1]
    assert regions.locate(np.empty((0, 3))).tolist() == []


def test_the_rectangle_of_a_portal_is_its_frame() -> None:
    T = Regions(**TWO_ROOMS).rectangle(0)
    np.testing.assert_allclose((T @ [1, -1, 0, 1])[:3], [4, 2.5, 0])
    assert np.linalg.det(T[:3, :3]) > 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sides": [[0, 2]]}, "portal 0"),
        ({"sides": [[1, 1]]}, "portal 0"),
        ({"sides": [[0.0, 1.0]]}, "integers"),
        ({"high": [[4, 4, 3], [8, -4, 3]]}, "region 1"),
        ({"high": [[4, 4, np.nan], [8, 4, 3]]}, "finite"),
        ({"low": np.empty((0, 3)), "high": np.empty((0, 3))}, "R >= 1"),
        ({"centres": [[4, 2, 1], [4, 3, 1]]}, "one for each portal"),
        ({"centres": [[4, np.inf, 1]]}, "finite"),
        ({"half_axes": [[[0, 0.5, 0], [0, 0.5, 1]]]}, "perpendicular"),
        ({"half_axes": [[[0, 0.5, 0], [0, 0, 0]]]}, "not zero"),
        ({"is_open": [True, False]}, "(1,)"),
    ],
)
def test_wrong_regions_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidValueError, match=message.replace("(", r"\(").replace(")", r"\)")):
        Regions(**{**TWO_ROOMS, **change})  # type: ignore[arg-type]


def test_wrong_questions_are_refused() -> None:
    regions = Regions(**TWO_ROOMS)
    for ask in (
        lambda: regions.reachable([0, 0], 1.0),
        lambda: regions.reachable([0, 0, np.nan], 1.0),
        lambda: regions.reachable([0, 0, 0], np.inf),
        lambda: regions.reachable([0, 0, 0], 1.0, -1.0),
        lambda: regions.locate([0, 0, 0]),
        lambda: regions.portals_of(2),
        lambda: regions.set_open(1, True),
        lambda: regions.rectangle(-1),
    ):
        with pytest.raises(InvalidValueError, match="allowed"):
            ask()
