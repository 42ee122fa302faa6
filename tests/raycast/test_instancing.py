"""Many instances at a time do what one at a time does."""

import numpy as np
import pytest
import trimesh

from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.raycast import RayBundle, RayHits, RayScene, TriangleMesh

BALL, BOX = trimesh.creation.icosphere(subdivisions=2, radius=0.4), trimesh.creation.box((0.6, 0.4, 0.8))
MESHES = [TriangleMesh(mesh.vertices, mesh.faces) for mesh in (BALL, BOX)]
_RNG = np.random.default_rng(0)
RAYS = RayBundle.from_directions(_RNG.normal(size=(3000, 3)))


def poses(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([transform(exp_so3(rng.normal(size=3)), rng.uniform(-4, 4, 3)) for _ in range(count)])


def cast(scene: RayScene, time: float = 0.0) -> RayHits:
    return scene.cast(RAYS, np.eye(4), time=time)


def assert_equal(a: RayHits, b: RayHits) -> None:
    for name in ("distances", "normals", "faces", "instances"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("use_fallback", [False, True])
def test_many_at_a_time_equal_one_at_a_time(use_fallback: bool) -> None:
    numbers = [7, 0, 3, 90, 4, 41, 12, 5]
    meshes = [MESHES[n % 2] for n in numbers]
    with RayScene(use_fallback) as many, RayScene(use_fallback) as single:
        many.add_many(meshes, poses(8, 1), numbers)
        for mesh, T, number in zip(meshes, poses(8, 1), numbers, strict=True):
            single.add(mesh, T, instance=number)
        assert_equal(cast(many), cast(single))
        many.set_poses(numbers[:5], poses(5, 2))
        for T, number in zip(poses(5, 2), numbers[:5], strict=True):
            single.set_pose(number, T)
        assert_equal(cast(many), cast(single))
        many.remove_many([90, 0, 90])
        single.remove(90)
        single.remove(0)
        assert many.instances == single.instances
        assert_equal(cast(many), cast(single))
        for scene in (many, single):
            scene.add_many([], np.empty((0, 4, 4)), [])
            scene.add_many(MESHES, poses(2, 3), [0, 300])
        assert_equal(cast(many), cast(single))


def test_normals_follow_whatever_changes() -> None:
    """Against a scene that is made anew after every change: added, moved, set in motion, at rest, removed, reused."""
    rng = np.random.default_rng(4)
    state: dict[int, np.ndarray] = {}
    with RayScene() as scene:
        for step in range(60):
            number, T = int(rng.integers(12)), poses(3, step)
            if number not in state:
                scene.add_many([MESHES[number % 2]], T[:1], [number])
                state[number] = T[:1]
            elif step % 4 == 0:
                scene.remove(number)
                del state[number]
            elif step % 4 == 1:
                T[:, :3, 3] = T[0, :3, 3]
                T[1:, :3, :3] = T[0, :3, :3] @ exp_so3(np.array([0.0, 0.1, 0.0]))
                scene.set_motion(number, T)
                state[number] = T
            else:
                scene.set_poses([number], T[:1])
                state[number] = T[:1]
            with RayScene() as anew:
                for n, keys in state.items():
                    anew.add(MESHES[n % 2], keys[0], instance=n)
                    anew.set_motion(n, keys)
                found, expected = cast(scene, 0.4), cast(anew, 0.4)
            same = (found.instances == expected.instances) & (found.faces == expected.faces)
            assert same.mean() > 0.999
            np.testing.assert_array_equal(found.normals[same], expected.normals[same])


def test_what_is_refused_changes_nothing() -> None:
    with RayScene() as scene:
        scene.add_many(MESHES, poses(2, 0), [1, 2])
        for ask in (
            lambda: scene.add_many(MESHES, poses(2, 1), [5, 2]),
            lambda: scene.add_many(MESHES, poses(2, 1), [5, 5]),
            lambda: scene.add_many(MESHES, poses(2, 1), [5, -1]),
            lambda: scene.add_many(MESHES, poses(1, 1), [5, 6]),
            lambda: scene.add_many(MESHES, np.zeros((2, 4, 4)), [5, 6]),
            lambda: scene.remove_many([1, 9]),
            lambda: scene.set_poses([1, 9], poses(2, 1)),
            lambda: scene.set_poses([1], poses(2, 1)),
        ):
            with pytest.raises(InvalidValueError, match="allowed"):
                ask()
        assert scene.instances == (1, 2)
        np.testing.assert_array_equal(scene.pose(1), poses(2, 0)[0])
