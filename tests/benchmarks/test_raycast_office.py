"""The benchmark's scene is what it says: exact counts, the same every time, all objects in sight of both sensors."""

import numpy as np
import pytest

from simtrack.benchmarks import office as scenes
from simtrack.benchmarks.office import OBJECT_FACES, STATIC_FACES, Office
from simtrack.benchmarks.yardstick import REFERENCE, scaled


@pytest.fixture(scope="module")
def world() -> Office:
    return scenes.office()


def test_counts_are_exact_and_faces_have_area(world: Office) -> None:
    assert len(world.static.faces) == STATIC_FACES
    assert {name: len(mesh.faces) for name, mesh in world.objects.items()} == OBJECT_FACES
    for mesh in (world.static, *world.objects.values()):
        a, b, c = np.moveaxis(mesh.triangles, 1, 0)
        assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 0
        assert set(np.unique(mesh.faces)) == set(range(len(mesh.vertices)))


def test_floor_has_the_papers_area(world: Office) -> None:
    (x, y, _), wall = world.static.extents, 0.12
    assert (x - wall) * (y - wall) == pytest.approx(2986.6, rel=0.005)  # outer walls are rough


def test_the_scene_repeats_and_the_seed_matters(world: Office) -> None:
    again, other = scenes.office(), scenes.office(seed=8)
    assert again.static.vertices.tobytes() == world.static.vertices.tobytes()
    assert again.objects["relay"].faces.tobytes() == world.objects["relay"].faces.tobytes()
    assert other.static.vertices.tobytes() != world.static.vertices.tobytes()
    assert len(other.static.faces) == STATIC_FACES


def test_both_sensors_see_all_objects_and_no_ray_leaves(world: Office) -> None:
    pinhole, vlp16 = scenes.pinhole(), scenes.vlp16()
    assert (len(pinhole), len(vlp16)) == (640 * 480, 1824 * 16)
    with world.scene() as scene:
        for bundle, T, at_least in ((pinhole, world.T_map_camera, 1000), (vlp16, world.T_map_lidar, 10)):
            instances = scene.cast(bundle, T).instances
            assert (instances >= 0).all()
            assert np.bincount(instances, minlength=6)[1:].min() >= at_least


def test_absolute_figures_scale_with_the_yardstick() -> None:
    assert scaled(0.1, REFERENCE) == pytest.approx(0.1)
    assert scaled(0.1, 2 * REFERENCE) == pytest.approx(0.2)
