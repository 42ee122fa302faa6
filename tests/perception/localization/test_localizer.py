from dataclasses import replace

import numpy as np
import pytest

from simtrack.contracts import NANOSECONDS, CameraIntrinsics, Localization, Localizer, Odometry, RgbdFrame, Status
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import difference, look_at, perturb, transform_planar
from simtrack.perception.localization import LocalizerConfig, MeshLocalizer
from simtrack.perception.localization.localizer import UNKNOWN

SURE = np.diag(np.square([0.02, 0.02, 0.01, 0.01, 0.01, 0.01]))


@pytest.fixture(scope="session")
def lab_localizer(lab_world) -> MeshLocalizer:
    return MeshLocalizer(lab_world.static_map)


@pytest.fixture(scope="session")
def office_localizer(office_world) -> MeshLocalizer:
    return MeshLocalizer(office_world.static_map)


def follow(world, localizer, drive, rng, seconds: float, first: float = 0.0) -> list[tuple[Localization, np.ndarray]]:
    """Feed a drive in the order of arrival; answers with the truth at their stamps."""
    readings = [o for o in drive.odometry(rng) if first * NANOSECONDS <= o.stamp]
    answers = []
    for k in range(round(seconds * 10)):
        start = first + k / 10
        scan = world.scan(drive.pose, start, rng, sequence=k)
        while readings and readings[0].stamp <= scan.stamp + NANOSECONDS // 10:
            localizer.predict(readings.pop(0))
        answer = localizer.update(scan)
        answers.append((answer, drive.pose(answer.stamp / NANOSECONDS)))
    return answers


def errors(answers) -> np.ndarray:
    return np.array([difference(truth, answer.T_map_base) for answer, truth in answers])


def check_finite(answer: Localization) -> None:
    assert np.isfinite(answer.T_map_base).all()
    assert np.isfinite(answer.covariance).all()
    assert np.isfinite([answer.inlier_share, answer.residual]).all()
    assert (np.linalg.eigvalsh(answer.covariance) > 0).all()


def test_is_a_localizer(lab_localizer) -> None:
    assert isinstance(lab_localizer, Localizer)


def test_tracks_a_curved_drive_within_millimetres(lab_world, lab_localizer, make_drive) -> None:
    rng = np.random.default_rng(1)
    drive = make_drive(transform_planar(3, 2.5, 0.3), lambda t: (0.4 * np.cos(0.5 * t), np.sin(0.7 * t)), duration=4.5)
    lab_localizer.reset()
    lab_localizer.initialise(0, drive.pose(0.0), SURE)
    answers = follow(lab_world, lab_localizer, drive, rng, 4.0)
    xi = errors(answers)
    assert all(answer.status is Status.OK for answer, _ in answers)
    assert np.sqrt((xi[:, :3] ** 2).sum(1).mean()) < 0.006
    assert np.degrees(np.sqrt((xi[:, 3:] ** 2).sum(1).mean())) < 0.15
    planar = [0, 1, 5]
    nees = [
        e[planar] @ np.linalg.solve(a.covariance[np.ix_(planar, planar)], e[planar])
        for e, (a, _) in zip(xi, answers, strict=True)
    ]
    assert 0.05 < np.mean(nees) / 3 < 2.0  # the map's noise here is white: its assumed correlation is the cautious side
    for answer, _ in answers:
        check_finite(answer)
    late = [0.35, 2.0, 3.333, 3.97, 4.08]  # between scans, long ago, ahead of the last scan
    for seconds in late:
        answer = lab_localizer.pose_at(round(seconds * NANOSECONDS))
        xi = difference(drive.pose(seconds), answer.T_map_base)
        assert np.linalg.norm(xi[:3]) < 0.012
        assert np.degrees(np.linalg.norm(xi[3:])) < 0.3


def test_one_drive_gives_the_same_bytes_twice(lab_world, lab_localizer, make_drive) -> None:
    import numba

    drive = make_drive(transform_planar(2, 2, 1.0), lambda t: (0.3, 0.5), duration=1.5)
    runs, threads = [], numba.get_num_threads()
    for count in (1, threads):
        numba.set_num_threads(count)
        lab_localizer.reset()
        answers = follow(lab_world, lab_localizer, drive, np.random.default_rng(4), 0.6)
        runs.append(np.stack([answer.T_map_base for answer, _ in answers]).tobytes())
    numba.set_num_threads(threads)
    assert runs[0] == runs[1]


@pytest.mark.parametrize("seed", range(3))
def test_recovers_from_a_wrong_start(office_world, office_localizer, make_drive, seed: int) -> None:
    rng = np.random.default_rng(seed)
    drive = make_drive(transform_planar(*rng.uniform([2, 1.5, -3], [20, 3.5, 3])), lambda t: (0.1, 0.4), duration=2.5)
    heading = rng.uniform(0, 2 * np.pi)
    wrong = perturb(drive.pose(0.0), np.array([0.5 * np.cos(heading), 0.5 * np.sin(heading), 0, 0, 0, np.radians(10)]))
    office_localizer.reset()
    office_localizer.initialise(0, wrong)
    answers = follow(office_world, office_localizer, drive, rng, 1.0)
    xi = errors(answers)[-5:]
    assert answers[-1][0].status is Status.OK
    assert np.linalg.norm(xi[:, :3], axis=1).max() < 0.05
    assert np.degrees(np.abs(xi[:, 5]).max()) < 1.0


def test_notices_that_it_was_carried_off_and_finds_itself(office_world, office_localizer, make_drive) -> None:
    rng = np.random.default_rng(11)
    still = make_drive(transform_planar(6.5, 6.0, 0.2), lambda t: (0.0, 0.0), duration=5.0)
    office_localizer.reset()
    office_localizer.initialise(0, still.pose(0.0), SURE)
    before = follow(office_world, office_localizer, still, rng, 0.8)
    assert before[-1][0].status is Status.OK
    drive = make_drive(transform_planar(15.0, 2.5, 2.0), lambda t: (0.3, 0.3), duration=5.0)
    after = follow(office_world, office_localizer, drive, rng, 3.0, first=1.0)
    xi = errors(after)
    far = np.linalg.norm(xi[:, :3], axis=1) > 0.25
    ok = np.array([answer.status is Status.OK for answer, _ in after])
    assert not (ok & far)[3:].any()
    assert ok[-1]
    assert not far[-5:].any()
    for answer, _ in after:
        check_finite(answer)


def test_two_equal_rooms_are_reported_as_ambiguous(two_rooms_world, make_drive) -> None:
    localizer = MeshLocalizer(two_rooms_world.static_map)
    drive = make_drive(transform_planar(1.8, 1.5, 0.4), lambda t: (0.05, 0.3), duration=2.5)
    answers = follow(two_rooms_world, localizer, drive, np.random.default_rng(0), 1.2)
    assert all(answer.status is Status.AMBIGUOUS for answer, _ in answers)
    assert all(np.array_equal(answer.covariance, UNKNOWN) for answer, _ in answers)
    assert len(localizer.hypotheses) >= 2


def test_empty_and_hopeless_scans_are_statuses(lab_world, lab_localizer, make_drive) -> None:
    drive = make_drive(transform_planar(3, 2, 1.0), lambda t: (0.0, 0.0), duration=1.0)
    scan = lab_world.scan(drive.pose, 0.0, np.random.default_rng(0))
    none = np.full_like(scan.ranges, np.inf)
    lab_localizer.reset()
    assert lab_localizer.pose_at(0).status is Status.LOST
    assert lab_localizer.update(replace(scan, ranges=none)).status is Status.NO_DATA
    lab_localizer.initialise(0, drive.pose(0.0), SURE)
    assert lab_localizer.update(scan).status is Status.OK
    later = replace(scan, stamp=NANOSECONDS // 10)
    for ranges in (none, np.full_like(none, np.nan), np.zeros_like(none), -scan.ranges):
        answer = lab_localizer.update(replace(later, ranges=ranges))
        assert answer.status is Status.NO_DATA
        check_finite(answer)
    empty = replace(
        later,
        directions=scan.directions[:0],
        ranges=none[:0],
        times=scan.times[:0],
        rings=scan.rings[:0],
        intensities=scan.intensities[:0],
    )
    assert lab_localizer.update(empty).status in (Status.NO_DATA, Status.STALE)
    assert lab_localizer.update(scan).status is Status.STALE
    assert lab_localizer.update(replace(scan, stamp=-5 * NANOSECONDS)).status is Status.STALE
    broken = replace(later, times=np.full_like(scan.times, np.nan))
    check_finite(lab_localizer.update(broken))
    assert lab_localizer.update(replace(later, stamp=NANOSECONDS // 5)).status is Status.OK
    nonsense = replace(later, ranges=np.random.default_rng(1).uniform(1, 9, len(none)).astype(np.float32))
    statuses = [lab_localizer.update(replace(nonsense, stamp=(3 + k) * NANOSECONDS // 10)).status for k in range(5)]
    assert Status.OK not in statuses
    assert statuses[-1] in (Status.LOST, Status.AMBIGUOUS)


def test_depth_images_carry_on_where_the_lidar_falls_silent(lab_world, make_drive) -> None:
    drive = make_drive(transform_planar(3, 2.5, 0.5), lambda t: (0.2, 0.3), duration=4.0)
    localizer = MeshLocalizer(lab_world.static_map)
    localizer.initialise(0, drive.pose(0.0), SURE)
    rng = np.random.default_rng(0)
    localizer.update(lab_world.scan(drive.pose, 0.0, rng))
    assert localizer.update_depth(depth_image(lab_world, drive, 0.05)).stamp == NANOSECONDS // 20  # not newer: no harm
    readings = list(drive.odometry(rng))
    answer = localizer.pose_at(0)
    biased = [replace(o, T_odom_base=scaled(o, 1.2)) for o in readings]
    for k in range(1, 30):
        while biased and biased[0].stamp <= k * NANOSECONDS // 10:
            localizer.predict(biased.pop(0))
        answer = localizer.update_depth(depth_image(lab_world, drive, k / 10))
        check_finite(answer)
    xi = difference(drive.pose(2.9), answer.T_map_base)
    assert np.linalg.norm(xi[:2]) < 0.02  # odometry alone is off by 12 cm
    dark = replace(depth_image(lab_world, drive, 3.0), depth=np.zeros((120, 160), np.float32))
    assert localizer.update_depth(dark).status is Status.NO_DATA


def scaled(reading: Odometry, factor: float) -> np.ndarray:
    T = reading.T_odom_base.copy()
    T[:3, 3] *= factor
    return T


def depth_image(world, drive, seconds: float) -> RgbdFrame:
    from simtrack.raycast import RayBundle

    intrinsics = CameraIntrinsics(160, 120, 144.0, 144.0, 79.5, 59.5)
    T_base_camera = look_at(np.array([0.1, 0.0, 1.2]), np.array([1.1, 0.0, 1.0]))
    bundle = RayBundle.from_camera(intrinsics)
    hits = world.scene.cast(bundle, drive.pose(seconds) @ T_base_camera)
    depth = np.where(np.isfinite(hits.distances), hits.distances, 0.0).reshape(120, 160).astype(np.float32)
    return RgbdFrame(round(seconds * NANOSECONDS), depth, None, intrinsics, T_base_camera)


def test_masks_keep_the_own_body_out(lab_world, make_drive) -> None:
    """A plate that follows the robot would hold a localizer back that takes it for a wall."""
    drive = make_drive(transform_planar(2, 2.5, 0.0), lambda t: (0.3, 0.0), duration=2.0)
    localizer = MeshLocalizer(lab_world.static_map, LocalizerConfig(), lidar_mask=lambda scan: scan.ranges < 0.7)
    localizer.initialise(0, drive.pose(0.0), SURE)
    answer = localizer.pose_at(0)
    rng = np.random.default_rng(0)
    for k in range(5):
        scan = lab_world.scan(drive.pose, k / 10, rng)
        plate = scan.directions[:, 1] > 0.3
        answer = localizer.update(replace(scan, ranges=np.where(plate, np.float32(0.6), scan.ranges)))
        assert answer.inlier_share > 0.8
    assert np.linalg.norm(difference(drive.pose(0.5), answer.T_map_base)[:2]) < 0.02


def test_refuses_a_start_that_is_no_pose(lab_localizer) -> None:
    with pytest.raises(InvalidValueError, match="rigid"):
        lab_localizer.initialise(0, np.full((4, 4), np.nan))
