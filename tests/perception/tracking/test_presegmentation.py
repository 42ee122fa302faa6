import importlib.util
from pathlib import Path

import numpy as np
import pytest

from simtrack.contracts import LidarScan, Status
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import transform
from simtrack.objects import load_object
from simtrack.perception.tracking.presegmentation import (
    PresegmentationConfig,
    presegment_camera,
    presegment_lidar,
)
from simtrack.raycast import RayBundle
from simtrack.sensors.depth_noise import PRESETS, apply_depth_noise
from simtrack.sensors.lidar import VLP16

spec = importlib.util.spec_from_file_location("bench_scenes", Path(__file__).with_name("scenes.py"))
assert spec is not None and spec.loader is not None
scenes = importlib.util.module_from_spec(spec)
spec.loader.exec_module(scenes)


@pytest.fixture(scope="module")
def worlds():
    """The true world holds a mug and a drill; the believed one knows of the drill only."""
    true, believed = scenes.BenchWorld(), scenes.BenchWorld()
    drill = load_object("powerdrill")
    mug = true.add(load_object("mug"), scenes.on_bench(load_object("mug"), 0.2, 0.0, 0.5))
    for world in (true, believed):
        world.add(drill, scenes.on_bench(drill, -0.2, 0.0, 1.0))
    return true, believed, mug


def test_the_unknown_is_found_and_the_known_removed(worlds) -> None:
    true, believed, mug = worlds
    rng = np.random.default_rng(0)
    depth = apply_depth_noise(true.depth(), None, scenes.INTRINSICS, PRESETS["xtion"], rng)
    bundle = RayBundle.from_camera(scenes.INTRINSICS)
    owners = true.scene.cast(bundle, scenes.T_MAP_CAMERA).instances.reshape(bundle.shape)
    result = presegment_camera(true.frame(7, depth), scenes.T_MAP_CAMERA, believed.scene)
    valid, on_mug = depth > 0.0, owners == mug
    assert result.stamp == 7
    assert np.mean(result.unknown[valid & ~on_mug]) < 0.02
    assert np.mean(result.unknown[valid & on_mug]) > 0.6  # its foot lies within the bench's own uncertainty
    assert result.reduction > 0.95
    overlaps = [
        np.count_nonzero((result.labels == k + 1) & on_mug) / np.count_nonzero((result.labels == k + 1) | on_mug)
        for k in range(len(result.regions))
    ]
    best = result.regions[int(np.argmax(overlaps))]
    assert max(overlaps) > 0.6
    assert np.linalg.norm(best.centre[:2] - [0.2, 0.0]) < 0.05
    u0, v0, u1, v1 = best.box
    assert 0 <= u0 < u1 <= 320
    assert 0 <= v0 < v1 <= 240


def test_the_robots_own_body_is_no_discovery(worlds) -> None:
    true, believed, _ = worlds
    frame = true.frame(1)
    own = np.ones(frame.depth.shape, bool)
    assert not presegment_camera(frame, scenes.T_MAP_CAMERA, believed.scene, own).unknown.any()


def test_empty_and_broken_images_are_statuses(worlds) -> None:
    _, believed, _ = worlds
    for value in (0.0, np.nan, np.inf, -1.0):
        frame = believed.frame(1, np.full((240, 320), value, np.float32))
        result = presegment_camera(frame, scenes.T_MAP_CAMERA, believed.scene)
        assert result.status is Status.NO_DATA
        assert not result.unknown.any()
        assert result.reduction == 0.0
    with pytest.raises(InvalidValueError, match="stride"):
        PresegmentationConfig(stride=0)


def test_a_scan_is_reduced_to_what_is_unknown(worlds) -> None:
    true, believed, mug = worlds
    shots = VLP16.shots()
    T_map_lidar = transform(translation=(0.0, -0.6, 1.0))
    hits = true.scene.cast(RayBundle.from_directions(shots.directions, shots.rings), T_map_lidar)
    scan = LidarScan(
        5, shots.directions, hits.distances, shots.times, shots.rings, np.zeros(len(shots.times), np.float32),
        T_map_lidar,
    )  # fmt: skip
    result = presegment_lidar(scan, lambda stamp: np.eye(4), believed.scene)
    on_mug = hits.instances == mug
    assert on_mug.sum() > 20
    assert np.mean(result.unknown[on_mug]) > 0.5
    assert not result.unknown[np.isfinite(hits.distances) & ~on_mug].any()
    assert result.valid == np.count_nonzero(np.isfinite(hits.distances))
    assert any(np.linalg.norm(r.centre[:2] - [0.2, 0.0]) < 0.08 for r in result.regions)
    silent = LidarScan(
        6, shots.directions, np.full_like(hits.distances, np.inf), shots.times, shots.rings, scan.intensities,
        T_map_lidar,
    )  # fmt: skip
    assert presegment_lidar(silent, lambda stamp: np.eye(4), believed.scene).status is Status.NO_DATA
