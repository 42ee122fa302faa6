"""RGB-D odometry: the alignment's derivatives, a camera that is followed, one that is lost and found."""

import numpy as np
import pytest

from simtrack.contracts import NANOSECONDS, CameraIntrinsics, Float64, RgbdFrame, Status
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import box_mesh
from simtrack.geometry.transforms import difference, inverse, look_at, perturb
from simtrack.perception.mapping.odometry.features import FeatureConfig, FeatureMatcher, FeaturePose
from simtrack.perception.mapping.odometry.field_kernels import normal_equations, sampled_points
from simtrack.perception.mapping.odometry.rgbd_odometry import OdometryConfig, RgbdOdometry
from simtrack.raycast import RayBundle, RayScene, TriangleMesh

CAMERA = CameraIntrinsics(160, 120, 145.0, 145.0, 79.5, 59.5)
K = (145.0, 145.0, 79.5, 59.5)
START = look_at(np.array([1.5, 0.2, 1.2]), np.array([-0.4, 0.0, 0.4]))
CONFIG = OdometryConfig(columns=160, points=3)


@pytest.fixture(scope="module")
def corner():
    """Two walls, a floor and boxes that stand on it, whose colours tell where on them a point is."""
    parts = [((3.0, 3.0, 0.1), (0.0, 0.0, -0.05)), ((0.1, 3.0, 3.0), (-1.5, 0.0, 1.4)),
             ((3.0, 0.1, 3.0), (0.0, -1.5, 1.4)), ((0.5, 0.4, 0.6), (-0.5, -0.3, 0.3)),
             ((0.3, 0.3, 0.4), (-0.2, 0.7, 0.2))]  # fmt: skip
    bundle = RayBundle.from_camera(CAMERA)
    with RayScene() as scene:
        for number, (size, middle) in enumerate(parts):
            mesh = box_mesh(size)
            scene.add(TriangleMesh(mesh.vertices + np.array(middle), mesh.faces), instance=number)

        def seen(number: int, T: Float64) -> RgbdFrame:
            hits = scene.cast(bundle, T)
            depth = np.where(hits.hit, hits.distances, 0.0).astype(np.float32).reshape(120, 160)
            v, u = np.mgrid[:120, :160]
            points = np.stack([(u - 79.5) / 145.0 * depth, (v - 59.5) / 145.0 * depth, depth], axis=2)
            # Cells of 5 cm, each of its own colour: corners that are found again.
            cells = np.floor((points @ T[:3, :3].T + T[:3, 3]) / 0.05 + 1e-3).astype(np.int64)
            mixed = (cells * np.array([73856093, 19349663, 83492791])).sum(axis=2, keepdims=True)
            rgb = (60 + (mixed // np.array([1, 7, 49])) % 140).astype(np.uint8)
            return RgbdFrame(number * NANOSECONDS // 10, depth, rgb, CAMERA, np.eye(4), number)

        yield seen


def walk(count: int) -> list[Float64]:
    """A smooth way past the corner."""
    steps = np.outer(np.arange(count), [0.012, -0.01, 0.003, 0.002, 0.003, -0.012]).astype(np.float64)
    return [perturb(START, np.asarray(step, np.float64)) for step in steps]


def test_the_derivative_of_the_alignment_is_that_of_its_sum(corner) -> None:
    odometry = RgbdOdometry(START, CONFIG)
    frame = corner(0, START)
    odometry.update(frame)
    points = sampled_points(frame.depth, K, 3, 4, 0.02)
    T = perturb(START, np.array([0.006, -0.004, 0.005, 0.003, -0.002, 0.004]))
    field, voxel = odometry.field, CONFIG.voxel

    def step(T: Float64):
        return normal_equations(points, T, voxel, 0.14, 1.0, field.keys, field.table, field.distances, field.weights)

    H, g, known, _, _ = step(T)
    assert known > 0.5 * len(points)
    np.testing.assert_allclose(H, H.T)
    assert np.linalg.eigvalsh(H).min() > 0.0
    better = perturb(T, -np.asarray(np.linalg.solve(H, g), dtype=np.float64))
    assert np.linalg.norm(step(better)[1]) < 0.3 * np.linalg.norm(g)


def test_a_camera_is_followed(corner) -> None:
    poses = walk(12)
    odometry = RgbdOdometry(poses[0], CONFIG)
    for number, T in enumerate(poses):
        result = odometry.update(corner(number, T))
        assert result.status is Status.OK and result.T_map_camera is not None
        off = difference(result.T_map_camera, T)
        assert np.linalg.norm(off[:3]) < 0.01 and np.linalg.norm(off[3:]) < np.radians(0.6), number


def test_what_does_not_fit_has_no_pose_and_the_camera_is_found_again(corner) -> None:
    poses = walk(6)
    odometry = RgbdOdometry(poses[0], CONFIG)
    for number in range(4):
        odometry.update(corner(number, poses[number]))
    before = odometry.field.weights.sum()
    blind = RgbdFrame(0, np.zeros((120, 160), np.float32), None, CAMERA, np.eye(4))
    assert odometry.update(blind).status is Status.NO_DATA
    rng = np.random.default_rng(0)
    noise = corner(4, poses[4])
    noise = RgbdFrame(noise.stamp, rng.uniform(0.5, 4.0, (120, 160)).astype(np.float32), noise.rgb, CAMERA, np.eye(4))
    result = odometry.update(noise)
    assert result.T_map_camera is None and odometry.field.weights.sum() == before
    found = odometry.update(corner(5, poses[5]))
    assert found.T_map_camera is not None
    assert np.linalg.norm(difference(found.T_map_camera, poses[5])[:3]) < 0.02


def test_quick_turns_are_followed_from_the_first_frame_on(corner) -> None:
    steps = np.outer(np.arange(6), [0.02, -0.03, 0.0, 0.0, 0.0, np.radians(9.0)]).astype(np.float64)
    poses = [perturb(START, np.asarray(step, np.float64)) for step in steps]
    odometry = RgbdOdometry(poses[0], CONFIG)
    for number, T in enumerate(poses):
        result = odometry.update(corner(number, T))
        assert result.T_map_camera is not None, number
        off = difference(result.T_map_camera, T)
        assert np.linalg.norm(off[:3]) < 0.03 and np.linalg.norm(off[3:]) < np.radians(1.0), number


def test_a_camera_that_was_covered_is_found_where_it_was_before(corner) -> None:
    turned = perturb(START, np.array([0.05, -0.05, 0.0, 0.0, 0.0, np.radians(30.0)]))
    way = [perturb(START, k / 5 * difference(turned, START)) for k in range(6)]
    odometry = RgbdOdometry(way[0], CONFIG)
    for number, T in enumerate(way):
        assert odometry.update(corner(number, T)).T_map_camera is not None
    covered = RgbdFrame(6 * NANOSECONDS // 10, np.full((120, 160), 0.5, np.float32), None, CAMERA, np.eye(4))
    assert odometry.update(covered).T_map_camera is None
    found = odometry.update(corner(7, way[0]))
    assert found.T_map_camera is not None
    off = difference(found.T_map_camera, way[0])
    assert np.linalg.norm(off[:3]) < 0.02 and np.linalg.norm(off[3:]) < np.radians(0.8)


def test_corners_tell_the_pose_and_how_well_it_is_known(corner) -> None:
    T = perturb(START, np.array([0.02, -0.03, 0.01, 0.01, -0.02, 0.05]))
    matcher = FeatureMatcher(FeatureConfig())
    before, now = matcher.find(corner(0, START)), matcher.find(corner(1, T))
    found = matcher.pose(before, now, CAMERA)
    assert found is not None and len(found.points) > 20
    off = difference(found.T_before_now, inverse(START) @ T)
    assert np.linalg.norm(off[:3]) < 0.03 and np.linalg.norm(off[3:]) < np.radians(1.0)
    again = FeatureMatcher(FeatureConfig()).pose(before, now, CAMERA)
    assert again is not None and np.array_equal(again.T_before_now, found.T_before_now)
    assert found.agreeing(found.T_before_now, 2.0) > 0.9 * len(found.points)
    assert found.agreeing(perturb(found.T_before_now, np.array([0.1, 0, 0, 0, 0, 0.0])), 2.0) < 0.2 * len(found.points)
    # The information is that of the reprojection, by finite differences.
    T_map_now = START @ found.T_before_now
    pixels = _projected(found, np.zeros(6), T_map_now)
    J = np.stack([(_projected(found, 1e-6 * e, T_map_now) - pixels) / 1e-6 for e in np.eye(6)], axis=1)
    np.testing.assert_allclose(found.information(T_map_now, 2.0), J.T @ J / 4.0, rtol=1e-3, atol=1.0)


def test_images_without_colours_have_no_corners(corner) -> None:
    frame = corner(0, START)
    bare = RgbdFrame(0, frame.depth, None, CAMERA, np.eye(4))
    matcher = FeatureMatcher()
    assert len(matcher.find(bare)) == 0
    assert matcher.pose(matcher.find(frame), matcher.find(bare), CAMERA) is None


def _projected(found: FeaturePose, xi: Float64, T_map_now: Float64) -> Float64:
    T = inverse(perturb(T_map_now, xi)) @ START
    x, y, z = (found.points @ T[:3, :3].T + T[:3, 3]).T
    return np.concatenate([145.0 * x / z, 145.0 * y / z])


@pytest.mark.parametrize(
    "wrong", [{"voxel": 0.0}, {"least_near": 1.5}, {"steps": 0}, {"max_rotation": 9.0}, {"agreeing": 0}]
)
def test_settings_outside_their_domain_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(wrong))):
        OdometryConfig(**wrong)  # type: ignore[arg-type]
