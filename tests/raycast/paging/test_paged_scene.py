"""A paged world gives what the same world gives with everything live."""

import numpy as np
import pytest

from simtrack.benchmarks import rooms
from simtrack.errors import InvalidValueError, RaycastError
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.raycast import RayBundle, TriangleMesh
from simtrack.raycast.paging import EVERYWHERE, ObjectIndex, PagedScene, PagingConfig, Regions
from tests.raycast.paging.worlds import CAMERA, LIDAR, T_BASE_CAMERA, AllLive, shapes, world

REACH = 18.0
DEPTH = REACH / float(np.linalg.norm(CAMERA.directions, axis=1).max())
REACH_OF_LIDAR = REACH / float(np.linalg.norm(LIDAR.directions, axis=1).max())


def paged(made: rooms.Rooms, **settings: int) -> PagedScene:
    return PagedScene(made.index, made.meshes, PagingConfig(reach=REACH, **settings), use_fallback=False)


def random_pose(made: rooms.Rooms, rng: np.random.Generator) -> np.ndarray:
    """Somewhere in a room."""
    regions = made.index.regions
    room = int(rng.integers(made.count))
    position = regions.low[room] + rng.uniform(0.1, 0.9, 3) * (regions.high[room] - regions.low[room])
    return transform(exp_so3(rng.normal(size=3)), position)


@pytest.mark.parametrize("seed", [0, 1])
def test_equals_all_live_on_a_drive_with_jumps_doors_and_moved_objects(seed: int) -> None:
    made, rng = world(seed=seed), np.random.default_rng(seed)
    drive = rooms.drive(made, 60, step=0.7)
    with paged(made, budget=20, linger=5) as scene:
        live = AllLive(scene)
        for frame, T in enumerate(drive):
            if frame % 6 == 5:
                T = random_pose(made, rng)  # without an update: the cast itself has to load
            else:
                T[:2, 3] += rng.uniform(-0.05, 0.05, 2)  # from the very middle, rays run along edges
                scene.update(T[:3, 3] + [0.0, 0.0, 1.0])
            for portal in rng.integers(len(scene.regions.sides), size=4).tolist():
                is_open = not scene.regions.is_open[portal]
                scene.set_open(portal, is_open)
                live.set_open(portal, is_open)
            for number in rng.integers(made.objects, size=10).tolist():
                pose = random_pose(made, rng)
                scene.move(number, pose)
                live.scene.set_pose(number, scene.index.pose(number))
            live.assert_same(scene.cast(CAMERA, T @ T_BASE_CAMERA), live.scene.cast(CAMERA, T @ T_BASE_CAMERA, DEPTH))
            T[2, 3] = 1.1
            live.assert_same(scene.cast(LIDAR, T, REACH), live.scene.cast(LIDAR, T, REACH))
            assert 0 < len(scene.live_regions) < len(scene.regions)


def test_rays_with_their_own_origins_equal_all_live() -> None:
    made, rng = world(), np.random.default_rng(5)
    with paged(made) as scene:
        live = AllLive(scene)
        for _ in range(20):
            T = random_pose(made, rng)
            origins = T[:3, 3] + rng.uniform(-0.3, 0.3, (len(LIDAR), 3))
            hits = scene.cast_rays(origins, LIDAR.directions, packing=LIDAR)
            live.assert_same(hits, live.scene.cast_rays(origins, LIDAR.directions, None, REACH_OF_LIDAR, packing=LIDAR))


def test_from_outside_of_all_regions_equals_all_live() -> None:
    made = world()
    with paged(made) as scene:
        live = AllLive(scene)
        for position in ([-3.0, 10.0, 1.5], [20.0, 20.0, 6.0]):
            T = transform(translation=np.array(position))
            live.assert_same(scene.cast(LIDAR, T, REACH), live.scene.cast(LIDAR, T, REACH))


def test_the_fallback_pages_too() -> None:
    made = world(20)
    bundle = RayBundle.from_directions(LIDAR.directions[::40])
    with PagedScene(made.index, made.meshes, PagingConfig(reach=6.0), use_fallback=True) as scene:
        live = AllLive(scene, use_fallback=True)
        for T in rooms.drive(made, 3, step=2.0):
            T[2, 3] = 1.2
            live.assert_same(scene.cast(bundle, T, 6.0), live.scene.cast(bundle, T, 6.0))


def test_what_is_seen_does_not_depend_on_how_one_came() -> None:
    made = world()
    drive = rooms.drive(made, 40, step=1.0)
    drive[:, 2, 3] = 1.0

    def seen(budget: int, order: slice) -> list[np.ndarray]:
        with paged(world(), budget=budget) as scene:
            out = []
            for T in drive[order]:
                scene.update(T[:3, 3])
                hits = scene.cast(LIDAR, T)
                out.append(np.stack([hits.objects, hits.portals, hits.distances.view(np.int32), hits.faces]))
            return out[:: order.step or 1]

    first = seen(64, slice(None))
    for again in (seen(64, slice(None)), seen(1, slice(None, None, -1))):
        assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))


def test_the_same_drive_makes_the_same_live() -> None:
    lives = []
    for _ in range(2):
        made = world()
        with paged(made, budget=12, linger=4) as scene:
            lives.append([])
            for T in rooms.drive(made, 60, step=0.5):
                report = scene.update(T[:3, 3])
                lives[-1].append((report, scene.live_regions.tolist(), scene.live_instances))
    assert lives[0] == lives[1]
    assert any(report.unloaded for report, _, _ in lives[0])


def test_updates_load_ahead_within_the_budget_so_that_casts_need_not() -> None:
    made = world(400)
    drive = rooms.drive(made, 300, step=0.1)
    drive[:, 2, 3] = 1.0
    room = rooms.OBJECTS_PER_ROOM + 6  # with its structure and panels
    with paged(made, budget=24) as scene:
        while scene.update(drive[0, :3, 3]).waiting:
            assert scene.live_instances > 0
        for T in drive:
            report = scene.update(T[:3, 3])
            assert report.loaded < 24 + room
            assert report.unloaded < 24 + room
            assert scene.require(T[:3, 3], REACH) == 0
        regions, _ = scene.regions.reachable(drive[-1, :3, 3], REACH)
        assert set(regions.tolist()) <= set(scene.live_regions.tolist())


def test_what_was_left_behind_is_retired_after_a_while() -> None:
    made, here = world(400), np.array([3.0, 2.5, 1.0])
    with paged(made, linger=3, budget=30) as scene:
        scene.require([3.0, 60.0, 1.0], REACH)
        behind = set(scene.live_regions.tolist())
        scene.require(here, REACH)
        for _ in range(3):
            scene.update(here)
            assert behind <= set(scene.live_regions.tolist())
        while scene.update(here).unloaded:
            pass
        wanted, _ = scene.regions.reachable(here, REACH, scene.config.ahead)
        assert set(scene.live_regions.tolist()) == set(wanted.tolist())
        members = sum(len(scene.index.members(region)) for region in wanted.tolist())
        assert members <= scene.live_instances <= members + len(scene.regions.sides)


def test_ids_are_those_of_the_index_and_results_outlive_changes() -> None:
    made = world(20_000)
    with paged(made) as scene:
        T = rooms.drive(made, 1)[0]
        T[2, 3] = 1.1
        hits = scene.cast(LIDAR, T)
        first = hits.objects.copy()
        assert first.max() > 1 << 16
        assert set(first.tolist()) <= {-1, *(n for r in scene.live_regions for n in scene.index.members(int(r)))}
        scene.require(scene.regions.low[0] + 1.0, REACH)
        for _ in range(200):
            scene.update(scene.regions.low[0] + 1.0)
        np.testing.assert_array_equal(hits.objects, first)


def test_kilometres_from_the_origin_results_are_as_exact_as_near_it() -> None:
    shift = np.array([5120.0, -7680.0, 0.0])
    near = world()
    regions = near.index.regions
    T = rooms.drive(near, 1)[0]
    T[2, 3] = 1.0
    moved = Regions(
        regions.low + shift, regions.high + shift, regions.sides, regions.centres + shift, regions.half_axes,
        regions.is_open,
    )  # fmt: skip
    poses = near.index.poses(np.arange(len(near.index)))
    poses[:, :3, 3] += shift
    far = ObjectIndex.from_poses(moved, near.index.bounds, near.index.models(np.arange(len(near.index))), poses)
    with paged(near) as a, PagedScene(far, near.meshes, a.config, use_fallback=False) as b:
        expected, T_far = a.cast(LIDAR, T), T.copy()
        T_far[:3, 3] += shift
        found = b.cast(LIDAR, T_far)
        same = expected.objects == found.objects
        assert same.mean() > 0.999  # rays may graze a silhouette
        np.testing.assert_allclose(found.distances[same], expected.distances[same], atol=2e-5)


def two_rooms(is_open: bool) -> Regions:
    """Two rooms side by side, without walls of their own but for the portal, the whole boundary."""
    sides, centres, axes = [[0, 1]], [[4, 2, 1.5]], [[[0, 2, 0], [0, 0, 1.5]]]
    return Regions([[0, 0, 0], [4, 0, 0]], [[4, 4, 3], [8, 4, 3]], sides, centres, axes, [is_open])


def one_ray(scene: PagedScene, origin: tuple[float, float, float], direction: tuple[float, float, float]) -> int:
    hits = scene.cast(RayBundle.from_directions([direction]), transform(translation=origin), 3.0)
    return int(hits.objects[0]) if hits.objects[0] >= 0 else -2 - int(hits.portals[0]) if hits.portals[0] >= 0 else -1


def test_objects_that_stick_out_of_their_region_are_seen_from_the_next() -> None:
    rod = TriangleMesh(np.array([[-1.5, -0.1, 0], [1.5, -0.1, 0], [0, 0.1, 0]]), [[0, 1, 2]])
    bounds = [[rod.vertices.min(axis=0), rod.vertices.max(axis=0)]]
    index = ObjectIndex.from_poses(two_rooms(True), bounds, [0], [transform(translation=(4.2, 2, 1))])
    assert index.region(0) == 1
    with PagedScene(index, [rod], PagingConfig(reach=3.0)) as scene:
        assert one_ray(scene, (3.2, 1.95, 1.5), (0, 0, -1)) == 0


def test_doors_close_and_open_again() -> None:
    index = ObjectIndex.from_poses(
        two_rooms(False), [[[-0.12] * 3, [0.12] * 3]], [0], [transform(translation=(5, 2, 1))]
    )
    with PagedScene(index, shapes()[:1], PagingConfig(reach=3.0)) as scene:
        for _ in range(2):
            assert one_ray(scene, (3, 2, 1), (1, 0, 0)) == -2
            assert scene.live_regions.tolist() == [0] or scene.live_instances == 2
            scene.set_open(0, True)
            scene.set_open(0, True)
            assert one_ray(scene, (3, 2, 1), (1, 0, 0)) == 0
            scene.set_open(0, False)
            scene.set_open(0, False)


def test_objects_come_go_and_may_be_everywhere() -> None:
    bounds = [[[-0.12] * 3, [0.12] * 3]]
    index = ObjectIndex.from_poses(two_rooms(True), bounds, [0], [transform(translation=(50, 2, 1))], spare=2)
    with PagedScene(index, shapes()[:1], PagingConfig(reach=2.0, ahead=0.1)) as scene:
        assert one_ray(scene, (49, 2, 1), (1, 0, 0)) == 0
        scene.move(0, transform(translation=(7.5, 2, 1)))
        assert scene.live_instances == 0
        number = scene.add(0, transform(translation=(1, 2, 1)))
        assert one_ray(scene, (2, 2, 1), (-1, 0, 0)) == number
        scene.move(number, transform(translation=(1, 3, 1)))
        assert one_ray(scene, (2, 3, 1), (-1, 0, 0)) == number
        assert one_ray(scene, (6.5, 2, 1), (1, 0, 0)) == 0
        scene.move(0, transform(translation=(1, 1, 1)))
        assert one_ray(scene, (2, 1, 1), (-1, 0, 0)) == 0
        scene.remove(number)
        assert one_ray(scene, (2, 3, 1), (-1, 0, 0)) == -1
        floating = scene.add(0, transform(translation=(0, 0, 90)))
        assert scene.index.region(floating) == EVERYWHERE
        assert one_ray(scene, (0, 0, 91), (0, 0, -1)) == floating


def test_too_many_instances_are_refused_and_nothing_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    made = world()
    T = rooms.drive(made, 1)[0]
    T[2, 3] = 1.0
    with paged(made) as scene:
        monkeypatch.setattr("simtrack.raycast.paging.live.MAX_INSTANCE", 100)
        with pytest.raises(RaycastError, match="more than 100 instances"):
            scene.cast(LIDAR, T)
        assert 0 < scene.live_instances <= 100
        monkeypatch.undo()
        AllLive(scene).assert_same(scene.cast(LIDAR, T), AllLive(scene).scene.cast(LIDAR, T, REACH_OF_LIDAR))


def test_misuse_is_refused() -> None:
    made = world(20)
    with pytest.raises(InvalidValueError, match="one for each model"):
        PagedScene(made.index, made.meshes[1:])
    for settings in ({"reach": 0.0}, {"reach": np.inf}, {"ahead": -1.0}, {"budget": 0}, {"linger": 0}):
        with pytest.raises(InvalidValueError, match="allowed"):
            PagingConfig(**settings)  # pyright: ignore[reportArgumentType]
    scene = paged(made)
    for ask in (
        lambda: scene.cast(LIDAR, np.eye(4), np.inf),
        lambda: scene.cast(LIDAR, np.eye(4), -1.0),
        lambda: scene.cast(LIDAR, np.eye(3)),
        lambda: scene.cast(LIDAR, np.full((4, 4), np.nan)),
        lambda: scene.cast_rays(np.zeros((2, 3)), np.zeros((3, 3))),
        lambda: scene.update([0.0, 0.0, np.nan]),
        lambda: scene.update([0.0, 0.0]),
        lambda: scene.set_open(-1, True),
        lambda: scene.move(10**9, np.eye(4)),
        lambda: scene.require([0, 0, 0], np.inf),
    ):
        with pytest.raises(InvalidValueError, match="allowed"):
            ask()
    scene.close()
    with pytest.raises(RaycastError, match="closed"):
        scene.cast(LIDAR, transform(translation=(1, 1, 1)))
