"""Casting at some instances is casting at all of them and choosing."""

import numpy as np
import pytest
import trimesh

from simtrack.contracts import CameraIntrinsics
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import exp_so3, look_at, transform
from simtrack.raycast import RayBundle, RayHits, RayScene, SelectedHits, TriangleMesh

CAMERA = CameraIntrinsics(160, 120, 110.0, 110.0, 79.5, 59.5)
ROOM = trimesh.creation.box((8.0, 6.0, 3.0)).subdivide().subdivide()
BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
T_MAP_SENSOR = look_at(np.array([-1.0, 0.5, 0.2]), np.array([2.0, 0.0, 0.0]))


def furnished(scene: RayScene, room: np.ndarray) -> list[int]:
    rng = np.random.default_rng(0)
    ball = TriangleMesh(BALL.vertices, BALL.faces)
    ids = [scene.add(TriangleMesh(ROOM.vertices, ROOM.faces), room)]
    for k in range(14):
        T = transform(exp_so3(rng.normal(size=3)), rng.uniform((-0.5, -2, -1), (3.5, 2, 1)))
        ids.append(scene.add(ball, T))
        if k == 3:
            keys = np.stack([T, T])
            keys[1, 2, 3] += 0.5
            scene.set_motion(ids[-1], keys)
    return ids


def assert_chosen(found: SelectedHits, all_hits: RayHits, instances: list[int]) -> int:
    chosen = np.flatnonzero(np.isin(all_hits.instances, instances))
    order = np.argsort(found.rays)
    assert len(found) == len(chosen)
    np.testing.assert_array_equal(found.rays[order], chosen)
    for name in ("distances", "normals", "faces", "instances"):
        np.testing.assert_array_equal(getattr(found.hits, name)[order], getattr(all_hits, name)[chosen])
    return len(found)


@pytest.mark.parametrize("use_fallback", [False, True])
@pytest.mark.parametrize("room", [np.eye(4), transform(exp_so3(np.array([0.0, 0.1, 0.4])))], ids=["identity", "posed"])
def test_casting_at_some_is_casting_and_choosing(room: np.ndarray, use_fallback: bool) -> None:
    bundles = [
        RayBundle.from_camera(CAMERA),
        RayBundle.from_windows(CAMERA, [(11, 13, 72, 60), (80, 20, 153, 97)], [1, 3]),
        RayBundle.from_directions(np.random.default_rng(1).normal(size=(2001, 3))),
    ]
    with RayScene(use_fallback) as scene:
        ids, counts = furnished(scene, room), []
        for bundle in bundles:
            for near, far, time in ((0.0, np.inf, 0.0), (0.8, 3.5, 0.7)):
                everything = scene.cast(bundle, T_MAP_SENSOR, far, min_distance=near, time=time, coherent=True)
                for some in (ids[1:], ids[3:7], [ids[0]], ids):
                    found = scene.cast_at(bundle, T_MAP_SENSOR, some, far, min_distance=near, time=time, coherent=True)
                    counts.append(assert_chosen(found, everything, some))
    assert np.count_nonzero(counts) > 0.8 * len(counts)


def test_hidden_ones_occlude_nothing_and_are_not_met() -> None:
    bundle = RayBundle.from_camera(CAMERA)
    with RayScene() as scene:
        ids = furnished(scene, np.eye(4))
        scene.set_enabled(ids[2], False)
        assert not (scene.cast_at(bundle, T_MAP_SENSOR, ids).hits.instances == ids[2]).any()
        assert len(scene.cast_at(bundle, T_MAP_SENSOR, [ids[2]])) == 0
        assert len(scene.cast_at(bundle, T_MAP_SENSOR, [])) == 0
        with pytest.raises(InvalidValueError, match="instance = 99"):
            scene.cast_at(bundle, T_MAP_SENSOR, [ids[1], 99])


@pytest.mark.parametrize("use_fallback", [False, True])
@pytest.mark.parametrize("room", [np.eye(4), transform(exp_so3(np.array([0.0, 0.1, 0.4])))], ids=["identity", "posed"])
def test_casting_anew_where_something_changed_is_casting(room: np.ndarray, use_fallback: bool) -> None:
    """Whether instances were moved, into view or out of it, hidden or shown, and whether one is the ground."""
    rng = np.random.default_rng(3)
    bundles = [RayBundle.from_camera(CAMERA), RayBundle.from_directions(rng.normal(size=(2001, 3)))]
    with RayScene(use_fallback) as scene:
        ids = furnished(scene, room)
        for bundle in bundles:
            hits = scene.cast(bundle, T_MAP_SENSOR, coherent=True)
            for step in range(8):
                changed = rng.choice(ids[1:] if step < 6 else ids, 3, replace=False).tolist()
                for number in changed[:2]:
                    shift = transform(exp_so3(0.3 * rng.normal(size=3)), rng.normal(scale=0.3, size=3))
                    scene.set_pose(number, scene.pose(number) @ shift)
                scene.set_enabled(changed[2], not scene.enabled(changed[2]))
                before = hits.instances.copy()
                scene.cast(bundle, T_MAP_SENSOR, coherent=True, out=hits, changed=changed)
                expected = scene.cast(bundle, T_MAP_SENSOR, coherent=True)
                for name in ("distances", "normals", "faces", "instances"):
                    np.testing.assert_array_equal(getattr(hits, name), getattr(expected, name))
                assert step >= 6 or (before != hits.instances).any()
            for number in ids:
                scene.set_enabled(number, True)


def test_what_changed_needs_the_hits_before() -> None:
    with RayScene() as scene:
        ids = furnished(scene, np.eye(4))
        bundle = RayBundle.from_camera(CAMERA)
        with pytest.raises(InvalidValueError, match="out"):
            scene.cast(bundle, T_MAP_SENSOR, changed=ids[1:])
        with pytest.raises(InvalidValueError, match="instance = 99"):
            scene.cast(bundle, T_MAP_SENSOR, out=scene.cast(bundle, T_MAP_SENSOR), changed=[99])
