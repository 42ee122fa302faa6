"""The index of objects: everything is in one place, where it was put, in few bytes."""

import numpy as np
import pytest

from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.raycast.paging import EVERYWHERE, ObjectIndex, Regions
from tests.raycast.paging.mazes import inside, maze

BOUNDS = [[[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]], [[-0.2, -0.1, 0.0], [0.2, 0.1, 0.5]]]
"""The second model's origin is below its middle."""


def pose(regions: Regions, rng: np.random.Generator) -> np.ndarray:
    return transform(exp_so3(rng.normal(size=3)), inside(regions, rng))


def fill(regions: Regions, count: int, seed: int = 0, spare: int = 0) -> ObjectIndex:
    rng = np.random.default_rng(seed)
    poses = [pose(regions, rng) for _ in range(count)]
    return ObjectIndex.from_poses(regions, BOUNDS, rng.integers(2, size=count), poses, spare)


def middle(index: ObjectIndex, number: int) -> np.ndarray:
    return (index.pose(number) @ np.append(index.bounds[index.models([number])[0]].mean(axis=0), 1.0))[:3]


def test_objects_are_moved_added_and_removed_without_getting_lost() -> None:
    regions, rng = maze(0), np.random.default_rng(1)
    index = fill(regions, 80, spare=40)
    expected = {n: index.pose(n) for n in range(80)}
    for step in range(400):
        action = rng.random()
        if action < 0.1 and len(index) < 120:
            T = pose(regions, rng)
            number = index.add(int(rng.integers(2)), T)
            assert number == len(index) - 1
            expected[number] = T
        elif action < 0.15:
            number = int(rng.choice(list(expected)))
            index.remove(number)
            del expected[number]
        else:
            number = int(rng.choice(list(expected)))
            T = pose(regions, rng) if step % 9 else transform(translation=(0, 0, 500.0))
            assert index.move(number, T) == index.region(number)
            expected[number] = T
    lists = [index.members(region).tolist() for region in (EVERYWHERE, *range(len(regions)))]
    assert sorted(n for members in lists for n in members) == sorted(expected)
    assert all(members == sorted(members) for members in lists)
    for number, T in expected.items():
        np.testing.assert_allclose(index.pose(number), T, atol=2e-6)
        region = index.region(number)
        assert number in index.members(region)
        assert region in regions.containing(middle(index, number)) or region == EVERYWHERE
    assert len(index.members(EVERYWHERE)) > 0


def test_an_object_stays_in_its_region_while_that_holds_it() -> None:
    regions = Regions([[0, 0, 0], [1, 0, 0]], [[2, 2, 2], [3, 2, 2]])
    index = ObjectIndex.from_poses(regions, BOUNDS, [0], [transform(translation=(2.5, 1, 1))])
    assert index.region(0) == 1
    assert index.move(0, transform(translation=(1.5, 1, 1))) == 1
    assert index.move(0, transform(translation=(0.5, 1, 1))) == 0
    assert index.move(0, transform(translation=(9, 1, 1))) == EVERYWHERE


def test_positions_are_exact_far_from_the_origin() -> None:
    far = np.array([6000.0, -4000.0, 0.0])
    regions = Regions([far], [far + 5.0])
    T = transform(exp_so3(np.array([0.1, -2.0, 0.7])), far + np.array([1.23456789, 2.3456789, 3.456789]))
    index = ObjectIndex.from_poses(regions, BOUNDS, [0], [T])
    np.testing.assert_allclose(index.pose(0), T, atol=3e-7)


def test_memory_is_bounded_by_the_arrays() -> None:
    regions = maze(0)
    small, large = fill(regions, 100), fill(regions, 1100)
    assert (large.nbytes - small.nbytes) / 1000 <= 40
    lone = Regions([[0, 0, 0]], [[1, 1, 1]])
    assert (regions.nbytes - lone.nbytes) / (len(regions) + len(regions.sides)) <= 250


def test_arrays_are_taken_over() -> None:
    regions = Regions([[0, 0, 0]], [[4, 4, 4]])
    columns = (
        np.zeros(3, np.uint16),
        np.zeros(3, np.int32),
        np.ones((3, 3), np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1)),
    )
    index = ObjectIndex(regions, BOUNDS, *columns)
    index.move(1, transform(translation=(2, 2, 2)))
    assert columns[2][1].tolist() == [2, 2, 2]


def test_overhang_is_the_size_of_what_sticks_out() -> None:
    regions = Regions([[0, 0, 0]], [[4, 4, 4]])
    index = ObjectIndex.from_poses(regions, BOUNDS, [0, 1], [transform(translation=(2, 2, 2))] * 2)
    assert index.overhang == 0.0
    index.move(0, transform(translation=(0.1, 2, 2)))
    assert index.overhang == 0.0
    index.move(1, transform(translation=(2, 2, 3.6)))
    assert index.overhang == pytest.approx(np.linalg.norm([0.4, 0.2, 0.5]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"models": np.array([2])}, "models"),
        ({"models": np.array([-1])}, "models"),
        ({"models": np.array([0.0])}, "integers"),
        ({"region_of": np.array([1])}, "region_of"),
        ({"region_of": np.array([-3])}, "region_of"),
        ({"region_of": np.array([0, 0])}, "region_of"),
        ({"positions": np.zeros((1, 4))}, "positions"),
        ({"positions": np.full((1, 3), np.nan)}, "object 0"),
        ({"quaternions": np.zeros((1, 4))}, "object 0"),
        ({"bounds": np.zeros((1, 3))}, "bounds"),
    ],
)
def test_wrong_objects_are_refused(change: dict[str, np.ndarray], message: str) -> None:
    columns = {
        "bounds": BOUNDS,
        "models": np.zeros(1, np.uint16),
        "region_of": np.zeros(1, np.int32),
        "positions": np.zeros((1, 3), np.float32),
        "quaternions": np.array([[1, 0, 0, 0]], np.float32),
    }
    with pytest.raises(InvalidValueError, match=message):
        ObjectIndex(Regions([[0, 0, 0]], [[4, 4, 4]]), **{**columns, **change})  # type: ignore[arg-type]


def test_wrong_questions_are_refused() -> None:
    index = fill(maze(0), 3)
    index.remove(1)
    stretched = np.diag([1.0, 2.0, 1.0, 1.0])
    for ask in (
        lambda: index.pose(3),
        lambda: index.pose(-1),
        lambda: index.pose(1),
        lambda: index.poses([0, 1]),
        lambda: index.remove(1),
        lambda: index.move(1, np.eye(4)),
        lambda: index.move(0, stretched),
        lambda: index.move(0, np.eye(3)),
        lambda: index.members(10_000),
        lambda: index.members(-2),
        lambda: index.add(2, np.eye(4)),
        lambda: index.add(0, np.eye(4)),
        lambda: ObjectIndex.from_poses(index.regions, BOUNDS, [5], [np.eye(4)]),
        lambda: ObjectIndex.from_poses(index.regions, BOUNDS, [0], [stretched]),
    ):
        with pytest.raises(InvalidValueError, match="allowed"):
            ask()
