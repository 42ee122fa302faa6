"""Worlds of rooms are what they say: closed, furnished, passable where doors are open, the same in the middle."""

import numpy as np
import pytest

from simtrack.benchmarks import room_models, rooms
from simtrack.benchmarks.rooms import OBJECTS_PER_ROOM, Rooms
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import transform
from simtrack.raycast import RayBundle
from simtrack.raycast.paging import PagedScene, PagingConfig
from tests.raycast.paging.worlds import LIDAR, shapes, world


def contents(made: Rooms, room: int) -> np.ndarray:
    """Models and poses of the objects in a room, in its own frame."""
    numbers = made.index.members(room)
    assert numbers[:-1].tolist() == list(range(OBJECTS_PER_ROOM * room, OBJECTS_PER_ROOM * (room + 1)))
    poses = made.index.poses(numbers)
    poses[:, :3, 3] -= made.index.regions.low[room]
    return np.column_stack([made.index.models(numbers), poses.reshape(-1, 16)])


@pytest.mark.parametrize("count", [2, 20, 100, 202, 1000])
def test_every_region_has_its_objects_and_its_structure(count: int) -> None:
    made = world(count)
    regions = made.index.regions
    assert made.objects == OBJECTS_PER_ROOM * count
    assert len(regions) == count + count // 2
    assert len(made.index) == made.objects + len(regions)
    for region in (0, count - 1, count, len(regions) - 1):
        members = made.index.members(region)
        assert len(members) == (OBJECTS_PER_ROOM + 1 if region < count else 1)
        assert members[-1] == made.objects + region
    assert made.index.overhang == 0.0
    assert made.index.nbytes <= 48 * made.objects + 5000


def test_worlds_repeat_and_the_seed_matters() -> None:
    same = [contents(world(100, seed), 17) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(same[0], same[1])
    assert (same[0] != same[2]).any()
    assert (world(100, 0).index.regions.is_open != world(100, 1).index.regions.is_open[:1]).any()


def test_the_middle_is_the_same_in_worlds_of_every_size() -> None:
    small, large = world(100), world(3000)
    shift = large.index.regions.low[large.middle] - small.index.regions.low[small.middle]
    a, b = rooms.drive(small, 200), rooms.drive(large, 200)
    np.testing.assert_allclose(b[:, :3, 3], a[:, :3, 3] + shift, atol=1e-9)
    for room in range(100):
        there = int(large.index.regions.containing(small.index.regions.low[room] + shift + 0.1)[0])
        np.testing.assert_allclose(contents(large, there)[:-1], contents(small, room)[:-1], atol=1e-5)


def test_no_ray_leaves_and_doors_are_holes_that_panels_close() -> None:
    made = world()
    regions = made.index.regions
    with PagedScene(made.index, made.meshes, PagingConfig(reach=120.0), use_fallback=False) as scene:
        for region in np.random.default_rng(0).integers(len(regions), size=12):
            middle = 0.5 * (regions.low[region] + regions.high[region])
            assert scene.cast(LIDAR, transform(translation=middle)).hit.all()
        for portal in range(0, len(regions.sides), 7):
            normal = np.cross(*regions.half_axes[portal].astype(float))
            ray = RayBundle.from_directions([normal / np.linalg.norm(normal)])
            start = regions.centres[portal] - 0.1 * ray.directions[0]
            hits = scene.cast(ray, transform(translation=start), 0.2)
            assert hits.hit[0] != regions.is_open[portal]
            assert hits.portals[0] == (-1 if regions.is_open[portal] else portal)


def test_objects_stand_on_something_and_apart() -> None:
    made = world()
    numbers = np.arange(300)
    poses, models = made.index.poses(numbers), made.index.models(numbers)
    low = made.index.bounds[models][:, 0, 2]
    down = RayBundle.from_directions([[0.0, 0.0, -1.0]])
    with PagedScene(made.index, made.meshes, PagingConfig(reach=5.0), use_fallback=False) as scene:
        for T, bottom in zip(poses[::7], low[::7], strict=True):
            below = transform(translation=T[:3, 3] + [0.0, 0.0, bottom - 1e-4])
            hits = scene.cast(down, below, 0.01)
            assert hits.objects[0] >= made.objects
    for room in range(30):
        position = poses[OBJECTS_PER_ROOM * room : OBJECTS_PER_ROOM * (room + 1), :3, 3]
        gaps = np.linalg.norm(position[:, None] - position[None], axis=2) + 9 * np.eye(OBJECTS_PER_ROOM)
        assert gaps.min() > 0.3
        assert (position > made.index.regions.low[room]).all()
        assert (position < made.index.regions.high[room]).all()


def test_furniture_differs_and_has_places_enough() -> None:
    assert len({room_models.room(3, layout).vertices.tobytes() for layout in range(room_models.LAYOUTS)}) == 4
    for layout in range(room_models.LAYOUTS):
        spots = room_models.spots(layout)
        assert len(spots) >= 2 * OBJECTS_PER_ROOM
        assert (spots > 0).all()
        assert (spots < [room_models.WIDTH, room_models.DEPTH, room_models.HEIGHT - 0.4]).all()


def test_a_drive_goes_from_room_to_room_through_open_doors() -> None:
    made = world()
    poses = rooms.drive(made, 400, step=0.2)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() <= 0.2 + 1e-9
    assert np.median(steps) == pytest.approx(0.2)
    visited = made.index.regions.locate(poses[:, :3, 3])
    assert len({int(region) for region in visited if region < made.count}) >= 4
    sides = {tuple(sorted(pair)) for pair in made.index.regions.sides[made.index.regions.is_open].tolist()}
    for a, b in zip(visited[:-1].tolist(), visited[1:].tolist(), strict=True):
        assert a == b or tuple(sorted((a, b))) in sides


def test_a_drive_along_the_corridor_stays_in_it_and_ends_with_it() -> None:
    made = world(200)
    positions = rooms.along_corridor(made, 10_000, step=0.25)
    assert len(positions) < 10_000
    np.testing.assert_allclose(np.diff(positions, axis=0), [[0.25, 0.0, 0.0]] * (len(positions) - 1), atol=1e-9)
    visited = made.index.regions.locate(positions)
    assert visited[0] == made.middle
    assert (visited >= made.count).all()
    assert visited[-1] == visited.max()
    np.testing.assert_array_equal(rooms.along_corridor(made, 5, step=0.25), positions[:5])


def test_wrong_worlds_are_refused() -> None:
    for count in (0, 1, 7, -2):
        with pytest.raises(InvalidValueError, match="even"):
            rooms.build(count, shapes())
    with pytest.raises(InvalidValueError, match="objects"):
        rooms.build(10, [])
