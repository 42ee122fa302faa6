"""A sensor carried by hand, localized in the mesh of its own first view: no floor, no odometry."""

from dataclasses import replace

import numpy as np
import pytest

from simtrack.contracts import Float64, LidarScan, RgbdFrame, StaticMap, Status
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh, transformed
from simtrack.geometry.transforms import angle_between, exp_so3, inverse, perturb, transform
from simtrack.perception.localization.free import FreeConfig, FreeLocalizer
from simtrack.perception.localization.surface import MapSurface
from simtrack.perception.mapping import mesh_of_depth, mesh_of_scan
from simtrack.recordings.clouds import scan_of_points
from tests.recordings.samples import CAMERA, World, camera_path, lidar_path

PERIOD = 100_000_000
NOISE = 0.005


def surface_of(mesh: Mesh) -> MapSurface:
    return MapSurface(StaticMap(mesh.vertices.astype(np.float32), mesh.faces, noise=0.01))


@pytest.fixture(scope="module")
def scans() -> list[LidarScan]:
    world, rng = World(), np.random.default_rng(0)
    out = []
    for k, T in enumerate(lidar_path(5)):
        points = world.points(T, columns=1808)
        points *= 1.0 + NOISE * rng.normal(size=(len(points), 1)) / np.linalg.norm(points, axis=1, keepdims=True)
        out.append(scan_of_points(points, np.zeros(len(points), np.float32), k * PERIOD, k))
    return out


@pytest.fixture(scope="module")
def lidar_map(scans: list[LidarScan]) -> MapSurface:
    return surface_of(transformed(mesh_of_scan(scans[0]), lidar_path(1)[0]))


@pytest.fixture
def localizer(lidar_map: MapSurface) -> FreeLocalizer:
    return FreeLocalizer(lidar_map, 0, lidar_path(1)[0])


def errors(T: Float64, true: Float64) -> tuple[float, float]:
    return float(np.linalg.norm(T[:3, 3] - true[:3, 3])), angle_between(T[:3, :3], true[:3, :3])


def test_scans_are_localized_in_the_first_one(scans: list[LidarScan], localizer: FreeLocalizer) -> None:
    for scan, true in zip(scans[1:], lidar_path(5)[1:], strict=True):
        found = localizer.update(localizer.measure(scan, NOISE))
        translation, rotation = errors(found.T_map_base, true)
        assert found.status is Status.OK and found.inlier_share > 0.8
        assert translation < 0.01 and rotation < np.deg2rad(0.3)
        assert found.stamp == scan.stamp


def test_a_direction_that_nothing_tells_is_not_feigned() -> None:
    """Level in a small room the lidar sees upright walls alone: its height is unknown, and said to be."""
    world, T = World(), transform(None, (0.2, -0.3, 1.2))
    points = [world.points(perturb(T, np.array([0.0, 0.0, z, 0.0, 0.0, 0.0])), columns=1808) for z in (0.0, 0.05)]
    rng = np.random.default_rng(0)
    first, second = (
        scan_of_points(p * (1.0 + 0.003 * rng.normal(size=(len(p), 1))), np.zeros(len(p), np.float32), k * PERIOD)
        for k, p in enumerate(points)
    )
    localizer = FreeLocalizer(surface_of(transformed(mesh_of_scan(first), T)), 0, T)
    found = localizer.update(localizer.measure(second, NOISE))
    assert np.linalg.norm(found.T_map_base[:2, 3] - T[:2, 3]) < 0.01
    assert abs(found.T_map_base[2, 3] - T[2, 3] - 0.05) < 3.0 * np.sqrt(found.covariance[2, 2])
    assert found.status is Status.DEGRADED and np.sqrt(found.covariance[2, 2]) > 0.05


def test_a_large_first_motion_is_found(scans: list[LidarScan], lidar_map: MapSurface) -> None:
    """Nothing is known of it: 0.5 m and 6 deg off."""
    true = lidar_path(5)[4]
    wrong = perturb(true, np.array([0.4, -0.3, 0.05, 0.02, -0.02, 0.1]))
    localizer = FreeLocalizer(lidar_map, 0, wrong)
    found = localizer.update(localizer.measure(scans[4], NOISE))
    translation, rotation = errors(found.T_map_base, true)
    assert found.status is Status.OK and translation < 0.02 and rotation < np.deg2rad(0.4)


def test_depth_images_are_localized_in_the_first_one() -> None:
    world, poses = World(), camera_path(5)
    frames = [RgbdFrame(k * PERIOD, world.depth(T), None, CAMERA, np.eye(4), k) for k, T in enumerate(poses)]
    localizer = FreeLocalizer(surface_of(transformed(mesh_of_depth(frames[0]), poses[0])), 0, poses[0])
    for frame, true in zip(frames[1:], poses[1:], strict=True):
        found = localizer.update(localizer.measure(frame, 0.0))
        translation, rotation = errors(found.T_map_base, true)
        assert found.status is Status.OK and translation < 0.01 and rotation < np.deg2rad(0.3)


def test_motion_goes_on_as_it_did(scans: list[LidarScan], localizer: FreeLocalizer) -> None:
    np.testing.assert_array_equal(localizer.predicted(PERIOD), lidar_path(1)[0])
    for scan in scans[1:3]:
        localizer.update(localizer.measure(scan, NOISE))
    translation, rotation = errors(localizer.predicted(3 * PERIOD), lidar_path(4)[3])
    assert translation < 0.02 and rotation < 0.01


def test_shots_of_a_moving_sensor_are_moved_to_the_end(scans: list[LidarScan], localizer: FreeLocalizer) -> None:
    """Each shot is taken from where the sensor was; the localizer knows of the motion from the scans before."""
    for scan in scans[1:3]:
        localizer.update(localizer.measure(scan, NOISE))
    step = inverse(lidar_path(2)[0]) @ lidar_path(2)[1]
    times = np.linspace(0.0, 0.1, len(scans[3].ranges), dtype=np.float32)
    start = localizer.predicted(3 * PERIOD)
    moving = replace(scans[3], times=times, ranges=np.full(len(times), 2.0, np.float32))
    shots = localizer.measure(moving, NOISE)
    assert shots.stamp == pytest.approx(4 * PERIOD, abs=2)
    end = localizer.predicted(4 * PERIOD)
    first = np.argmin(shots.shots)
    expected = inverse(end) @ start
    np.testing.assert_allclose(shots.origins[first], expected[:3, 3], atol=1e-5)
    assert np.linalg.norm(shots.origins[first]) == pytest.approx(np.linalg.norm(step[:3, 3]), rel=0.2)
    assert np.linalg.norm(shots.origins[np.argmax(shots.shots)]) < 1e-5


def test_what_cannot_be_located_is_said_and_changes_nothing(
    scans: list[LidarScan], localizer: FreeLocalizer, lidar_map: MapSurface
) -> None:
    before = localizer.predicted(PERIOD)
    few = replace(scans[1], ranges=np.full(len(scans[1].ranges), np.inf, np.float32))
    assert localizer.update(localizer.measure(few, NOISE)).status is Status.NO_DATA
    rng = np.random.default_rng(1)
    noise = replace(scans[1], ranges=rng.uniform(0.5, 30.0, len(scans[1].ranges)).astype(np.float32))
    lost = localizer.update(localizer.measure(noise, NOISE))
    assert lost.status is Status.LOST
    np.testing.assert_array_equal(lost.T_map_base, before)
    np.testing.assert_array_equal(localizer.predicted(PERIOD), before)
    assert localizer.update(localizer.measure(scans[0], NOISE)).status is Status.STALE
    assert localizer.update(localizer.measure(scans[1], NOISE)).status is Status.OK


def test_it_starts_anew_where_it_is_told(scans: list[LidarScan], localizer: FreeLocalizer) -> None:
    far = lidar_path(1)[0] @ transform(exp_so3(np.array([0.0, 0.0, 2.0])), (1.0, 1.0, 0.0))
    assert not localizer.follows(lidar_path(1)[0], far) and localizer.follows(far, far)
    localizer.restart(2 * PERIOD, lidar_path(3)[2])
    found = localizer.update(localizer.measure(scans[3], NOISE))
    assert found.status is Status.OK and errors(found.T_map_base, lidar_path(4)[3])[0] < 0.01


def test_settings_outside_their_domain_are_named() -> None:
    for name, value in (("sigma", 0.0), ("max_range", float("inf")), ("steady", 1.5)):
        with pytest.raises(InvalidValueError, match=name):
            FreeConfig(**{name: value})  # type: ignore[arg-type]
