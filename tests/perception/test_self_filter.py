from dataclasses import replace

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, LidarScan, RgbdFrame
from simtrack.errors import InvalidValueError
from simtrack.geometry.kinematics import Joint, KinematicTree, Link
from simtrack.geometry.meshes import box_mesh
from simtrack.geometry.transforms import look_at, transform
from simtrack.perception.self_filter import SelfFilter, SelfFilterConfig
from simtrack.sensors.camera import unproject


def link(name: str, parent: str, joint: Joint | None, at: tuple[float, float, float], size: float) -> Link:
    mesh = box_mesh(np.full(3, size))
    return Link(name, parent, joint, transform(translation=at), mesh.vertices.astype(np.float32), mesh.faces, 1.0)


@pytest.fixture(scope="module")
def robot() -> KinematicTree:
    """A base of 0.4 m with a block of 0.2 m on an arm that lifts it in front of the sensors."""
    lift = Joint("lift", "prismatic", np.array([0.0, 0.0, 1.0]), 0.0, 1.0, 1.0)
    return KinematicTree((link("base", "", None, (0, 0, 0), 0.4), link("hand", "base", lift, (0.6, 0, 0), 0.2)))


@pytest.fixture(scope="module")
def body(robot: KinematicTree) -> SelfFilter:
    return SelfFilter(robot)


def scan(ranges: np.ndarray) -> LidarScan:
    azimuth = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    directions = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], 1).astype(np.float32)
    zeros = np.zeros(720, np.float32)
    return LidarScan(0, directions, ranges, zeros, np.zeros(720, np.uint8), zeros, transform(translation=(0, 0, 0.7)))


def test_shots_at_and_behind_the_body_are_its_own_and_those_in_front_are_not(body: SelfFilter) -> None:
    ahead = 360  # azimuth 0; the hand's near side is at 0.5 m while it is lifted to the lidar's height
    for distance, own in ((0.5, True), (0.52, True), (0.9, True), (0.4, False), (np.inf, False)):
        mask = body.lidar_mask(scan(np.full(720, distance, np.float32)), {"lift": 0.7})
        assert mask[ahead] == own
        assert not mask[200]
    assert not body.lidar_mask(scan(np.full(720, 0.5, np.float32)), {"lift": 0.0}).any()


def test_the_silhouette_in_a_scan_is_the_body_with_a_small_margin(body: SelfFilter) -> None:
    mask = body.lidar_mask(scan(np.full(720, 2.0, np.float32)), {"lift": 0.7})
    half = np.degrees(np.arctan2(0.1, 0.5)) * 2
    assert half * 2 - 1 <= mask.sum() <= half * 2 + 2 * SelfFilterConfig().edge + 1


def test_pixels_of_the_body_are_found_with_their_depth(body: SelfFilter) -> None:
    intrinsics = CameraIntrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)
    T = look_at(np.array([0.0, 0.0, 1.2]), np.array([0.6, 0.0, 0.7]))
    empty = RgbdFrame(0, np.zeros((60, 80), np.float32), None, intrinsics, T)
    depth = body.camera_depth(empty, {"lift": 0.7})
    seen = np.isfinite(depth)
    assert 0.03 < seen.mean() < 0.5
    points = unproject(np.where(seen, depth, 0.0).astype(np.float32), intrinsics)[seen]
    centre = np.median(points @ T[:3, :3].T + T[:3, 3], axis=0)
    assert np.linalg.norm(centre - [0.6, 0.0, 0.75]) < 0.12
    assert not body.camera_mask(empty, {"lift": 0.7}).any()
    full = RgbdFrame(0, np.where(seen, depth, np.float32(3.0)).astype(np.float32), None, intrinsics, T)
    assert np.array_equal(body.camera_mask(full, {"lift": 0.7}), seen)
    front = RgbdFrame(0, np.full((60, 80), 0.3, np.float32), None, intrinsics, T)
    assert not body.camera_mask(front, {"lift": 0.7}).any()


def test_a_body_that_has_moved_is_seen_where_it_is(robot: KinematicTree) -> None:
    """What is kept between scans is never older than the tolerance allows."""
    kept, measured = SelfFilter(robot), scan(np.full(720, 2.0, np.float32))
    for lift in (0.7, 0.7004, 0.699, 0.3, 0.0, 0.64, 0.7):
        fresh = SelfFilter(robot)
        assert np.array_equal(kept.lidar_mask(measured, {"lift": lift}), fresh.lidar_mask(measured, {"lift": lift}))
    other = replace(measured, T_base_lidar=transform(translation=(0, 0, 0.1)))
    assert np.array_equal(kept.lidar_mask(other, {"lift": 0.7}), SelfFilter(robot).lidar_mask(other, {"lift": 0.7}))
    shorter = replace(
        other,
        directions=other.directions[::2],
        ranges=other.ranges[::2],
        times=other.times[::2],
        rings=other.rings[::2],
        intensities=other.intensities[::2],
    )
    mask = kept.lidar_mask(shorter, {"lift": 0.0})
    assert mask.any()
    assert np.array_equal(mask, SelfFilter(robot).lidar_mask(shorter, {"lift": 0.0}))


def test_bad_settings_are_refused() -> None:
    with pytest.raises(InvalidValueError):
        SelfFilterConfig(margin=-1.0)
    with pytest.raises(InvalidValueError):
        SelfFilterConfig(stride=0)
    with pytest.raises(InvalidValueError):
        SelfFilterConfig(tolerance=-1e-3)
