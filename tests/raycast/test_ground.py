"""The ground is traced by itself, and rays that meet no other instance's sphere skip the others: nobody can tell."""

from typing import Any

import numpy as np
import pytest
import trimesh

from simtrack.contracts import CameraIntrinsics
from simtrack.geometry.transforms import exp_so3, look_at, transform
from simtrack.raycast import RayBundle, RayHits, RayScene, TriangleMesh, hierarchy, kernels

CAMERA = CameraIntrinsics(160, 120, 110.0, 110.0, 79.5, 59.5)
ROOM = trimesh.creation.box((8.0, 6.0, 3.0)).subdivide().subdivide()
BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.2)
TURN = exp_so3(np.array([0.3, -0.5, 0.9]))


def shape(mesh: trimesh.Trimesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces)


def placed(count: int, seed: int = 0) -> list[np.ndarray]:
    """Poses in the room, with sizes from 1 to 3 and mirrored ones."""
    rng = np.random.default_rng(seed)
    poses = []
    for k in range(count):
        scale = np.diag(rng.uniform(1.0, 3.0, 3) * [1, 1, -1 if k % 3 == 0 else 1])
        poses.append(transform(exp_so3(rng.normal(size=3)) @ scale, rng.uniform((-3.5, -2.5, -1), (3.5, 2.5, 1))))
    return poses


def baked(poses: list[np.ndarray], room: np.ndarray) -> TriangleMesh:
    """Room and balls in one mesh, map frame."""
    parts = [ROOM.copy().apply_transform(room)] + [BALL.copy().apply_transform(T) for T in poses]
    vertices = np.concatenate([part.vertices for part in parts])
    first = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return TriangleMesh(vertices, np.concatenate([part.faces + k for part, k in zip(parts, first, strict=True)]))


def world_of(scene: RayScene) -> kernels.World:
    assert scene._hierarchy is not None
    fields: Any = scene._hierarchy.world
    return kernels.World(*fields)


def assert_same(hits: RayHits, expected: RayHits) -> None:
    np.testing.assert_allclose(hits.distances, expected.distances, atol=2e-5)
    hit = expected.hit
    same = np.einsum("ij,ij->i", hits.normals[hit], expected.normals[hit]) > 0.999
    assert same.mean() > 0.995  # a ray through an edge may be given to either face


@pytest.mark.parametrize("count", [0, 1, 12])
@pytest.mark.parametrize("room", [np.eye(4), transform(TURN, (0.1, -0.2, 0.05))], ids=["at identity", "posed"])
def test_queries_equal_those_of_one_baked_mesh(count: int, room: np.ndarray) -> None:
    poses = placed(count)
    origins = np.random.default_rng(1).uniform(-1, 1, (3000, 3))
    directions = np.random.default_rng(2).normal(size=(3000, 3))
    bundles = RayBundle.from_camera(CAMERA), RayBundle.from_directions(directions)
    with RayScene() as scene, RayScene() as oracle:
        scene.add(shape(ROOM), room)
        for T in poses:
            scene.add(shape(BALL), T)
        oracle.add(baked(poses, room))
        for eye in ((0.0, 0.0, 0.0), (3.0, -2.0, 1.0), (-30.0, 4.0, 2.0)):
            T_map_sensor = look_at(np.array(eye), np.array([0.3, 0.4, -0.2]))
            for bundle in bundles:
                assert_same(scene.cast(bundle, T_map_sensor), oracle.cast(bundle, T_map_sensor))
        assert_same(scene.cast_rays(origins, directions), oracle.cast_rays(origins, directions))
        limits = np.random.default_rng(3).uniform(0.3, 4.0, 3000)
        blocked = scene.occluded(origins, directions, limits)
        assert (blocked == oracle.occluded(origins, directions, limits)).mean() > 0.999
        found, expected = scene.closest_points(origins[:500]), oracle.closest_points(origins[:500])
        np.testing.assert_allclose(found.distances, expected.distances, atol=2e-6)


def test_coherence_is_a_matter_of_speed() -> None:
    bundle, T = RayBundle.from_camera(CAMERA), look_at(np.array([1.0, 2.0, 1.0]), np.zeros(3))
    with RayScene() as scene:
        scene.add(shape(ROOM))
        for pose in placed(12):
            scene.add(shape(BALL), pose)
        for coherent in (True, False):
            assert_same(scene.cast(bundle, T, coherent=coherent), scene.cast(bundle, T))


def test_culling_loses_no_hit_of_many_instances_near_or_far(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    ball, far_away = shape(BALL), np.array([3000.0, -2000.0, 40.0])
    for offset in (np.zeros(3), far_away):
        with RayScene() as scene, RayScene() as asks_all:
            for world in (scene, asks_all):
                world.add(shape(ROOM), transform(translation=offset))
                for T in placed(100, seed=6):
                    T[:3, 3] += offset
                    world.add(ball, T)
            monkeypatch.setattr(hierarchy, "_MAX_LISTED", 1000)
            scene.commit()
            monkeypatch.setattr(hierarchy, "_MAX_LISTED", 0)
            asks_all.commit()
            for _ in range(5):
                T = transform(exp_so3(rng.normal(size=3)), offset + rng.uniform(-1, 1, 3))
                a, b = (world.cast(RayBundle.from_camera(CAMERA), T, coherent=True) for world in (scene, asks_all))
                np.testing.assert_array_equal(a.instances, b.instances)
                np.testing.assert_array_equal(a.distances, b.distances)


def test_the_ground_changes_with_poses_and_visibility() -> None:
    """Whatever is large, rigid, hidden, removed or moves, a ray from above meets what is there."""
    towards, eye = np.array([[0.0, 0.0, -1.0]]), np.array([[0.03, 0.05, 9.0]])  # past the poles
    ball, globe = (shape(trimesh.creation.icosphere(radius=radius)) for radius in (1.0, 3.0))
    grounds = set()
    with RayScene() as scene:

        def seen() -> tuple[int, float]:
            hits = scene.cast_rays(eye, towards)
            bundle = scene.cast(RayBundle.from_directions(towards), transform(translation=eye[0]))
            assert bundle.instances[0] == hits.instances[0]
            assert scene.occluded(eye, towards, [9.0])[0] == hits.hit[0]
            assert scene.closest_points(eye).instances[0] in (hits.instances[0], *scene.instances)
            if scene._hierarchy:
                grounds.add(scene._hierarchy.world[2])
            return int(hits.instances[0]), round(float(hits.distances[0]), 1)

        small, big = scene.add(ball), scene.add(globe, transform(TURN))
        assert seen() == (big, 6.0)
        scene.set_pose(big, transform(TURN, (0.0, 0.0, -1.0)))
        assert seen() == (big, 7.0)
        scene.set_pose(big, transform(translation=(9.0, 0.0, 0.0)))
        assert seen() == (small, 8.0)
        scene.set_enabled(small, False)
        assert not scene.enabled(small)
        assert seen() == (-1, np.inf)
        scene.set_poses((small, big), np.stack([np.eye(4), np.diag([1.0, 1.0, 2.0, 1.0])]))
        assert seen() == (big, 3.0)
        scene.set_pose(big, transform(translation=(0.0, 0.0, 1.0)))
        assert seen() == (big, 5.0)
        scene.set_enabled(small, True)
        scene.set_motion(small, np.stack([np.eye(4), transform(translation=(0.0, 0.0, 6.0))]))
        assert scene.cast_rays(eye, towards, [1.0]).distances[0] == pytest.approx(2.0, abs=0.02)
        scene.set_pose(big, np.diag([1.0, 1.0, -1.0, 1.0]))
        assert seen() == (big, 6.0)
        scene.set_pose(small, transform(translation=(0.0, 0.0, 3.0)))
        assert seen() == (small, 5.0)
        scene.remove(big)
        assert scene.add(ball, np.diag([3.0, 3.0, 0.5, 1.0]), instance=big) == big
        assert seen() == (small, 5.0)
        scene.set_pose(small, np.eye(4))
        assert seen() == (small, 8.0)
        scene.remove_many([small])
        assert seen() == (big, 8.5)
        scene.set_pose(big, np.eye(4))
        scene.remove(big)
        assert seen() == (-1, np.inf)
        assert scene.add(globe) == small
        assert seen() == (small, 6.0)
    assert grounds in ({small, big, -1}, set())


def test_what_rays_meet_lies_in_the_disc_that_the_sensor_sees_of_it() -> None:
    rng = np.random.default_rng(4)
    plate = trimesh.creation.box((1.0, 0.6, 0.02))
    bundle = RayBundle.from_directions(rng.normal(size=(4000, 3)))
    rays = bundle.directions / np.linalg.norm(bundle.directions, axis=1, keepdims=True)
    beside = 0
    for _ in range(40):
        T_map_plate = transform(exp_so3(rng.normal(size=3)) @ np.diag(rng.uniform(0.5, 2.0, 3)), rng.normal(size=3))
        place = rng.uniform(-0.6, 0.6, 3) + [0.0, 0.0, rng.choice([-0.03, 0.03, 0.3])]  # often within its sphere
        T_map_sensor = transform(exp_so3(rng.normal(size=3)), T_map_plate[:3, :3] @ place + T_map_plate[:3, 3])
        with RayScene(use_fallback=False) as scene:
            scene.add(shape(plate), T_map_plate)
            scene.add(shape(BALL), transform(translation=(9.0, 9.0, 9.0)))  # of that size: there is no ground
            hits = scene.cast(bundle, T_map_sensor)
            world = world_of(scene)
        disc = kernels.discs_of(world, T_map_sensor[:3].astype(np.float32))[0]
        beside += disc[3] > -1.0
        assert (rays[hits.instances == 0] @ disc[:3] >= disc[3] - 2e-6).all()
    assert beside > 20


def test_a_plate_behind_the_sensor_is_not_looked_at_though_its_sphere_holds_the_sensor() -> None:
    plate = trimesh.creation.box((0.2, 0.2, 0.04))
    with RayScene(use_fallback=False) as scene:
        scene.add(shape(plate), transform(translation=(0.0, 0.0, -0.03)))
        scene.commit()
        world = world_of(scene)
        discs = kernels.discs_of(world, np.eye(4, dtype=np.float32)[:3])
        cones = RayBundle.from_camera(CAMERA).cones
        met = np.empty(len(discs), np.int64)
        flags = [kernels.to_trace(world, cones, k, discs, 128, met)[0] for k in range(len(cones))]
        assert not any(flags)
        scene.set_motion(0, np.stack([np.eye(4), transform(translation=(0.0, 0.0, 0.1))]))  # its box tells no more
        scene.commit()
        discs = kernels.discs_of(world_of(scene), np.eye(4, dtype=np.float32)[:3])
        assert discs[0, 3] == -1.0
