import numpy as np
import pytest

from simtrack.contracts import NANOSECONDS, LidarScan, Localization, Odometry, Status
from simtrack.errors import InvalidValueError
from simtrack.evaluation import localization_trials as trials
from simtrack.geometry.transforms import inverse
from simtrack.simulation.building.lab_room import lab_room
from simtrack.simulation.survey import survey


@pytest.fixture(scope="module")
def lab() -> trials.LidarWorld:
    world = lab_room(np.random.default_rng(2))
    return trials.LidarWorld(world, survey(world, None, np.random.default_rng(3)))


class DeadReckoning:
    """A localizer that believes its odometry and says what it is told to say."""

    def __init__(self, status: Status) -> None:
        self.status, self.T_map_odom, self.T_odom_base = status, np.eye(4), np.eye(4)

    def initialise(self, stamp: int, T_map_base: np.ndarray) -> None:
        self.T_map_odom = T_map_base

    def predict(self, odometry: Odometry) -> None:
        self.T_odom_base = odometry.T_odom_base

    def update(self, scan: LidarScan) -> Localization:
        return self.pose_at(scan.stamp + NANOSECONDS // 10)

    def pose_at(self, stamp: int) -> Localization:
        return Localization(stamp, self.T_map_odom @ self.T_odom_base, np.eye(6), self.status)


def test_routes_keep_to_the_free_floor(lab: trials.LidarWorld) -> None:
    rng = np.random.default_rng(0)
    config = trials.TrialConfig()
    for _ in range(3):
        start = lab.plan.place(rng)
        route = lab.plan.route(start, 5.0, rng)
        cells = np.floor((route - lab.plan.origin) / lab.plan.resolution).astype(int)
        assert lab.plan.free[tuple(cells.T)].all()
        path = trials.drive(route, 0.0, 8.0, config)
        cells = np.floor((path[:, :2] - lab.plan.origin) / lab.plan.resolution).astype(int)
        assert lab.plan.clearance[tuple(cells.T)].min() > 0.15
        steps = np.diff(path, axis=0) / 0.01
        assert np.hypot(steps[:, 0], steps[:, 1]).max() <= config.speed + 1e-6
        assert np.abs(steps[:, 2]).max() <= config.turn_rate + 1e-6


def test_scans_are_taken_shot_by_shot(lab: trials.LidarWorld) -> None:
    """A turning robot sees what a robot at each shot's own pose would see."""
    quiet = trials.LidarWorld(lab.world, lab.static_map, lidar_noise=trials.LidarNoiseConfig(0.0, 0.0, dropout=0.0))
    x, y = lab.plan.place(np.random.default_rng(0))
    rng = np.random.default_rng(1)
    turning = quiet.scan(lambda t: np.array([x, y, 0.8 * t]), 0.0, rng)
    for k in (0, 15_000, 28_000):
        held = quiet.scan(lambda t, k=k: np.array([x, y, 0.8 * turning.times[k]]), 0.0, rng)
        if np.isfinite(turning.ranges[k]) and np.isfinite(held.ranges[k]):
            assert turning.ranges[k] == pytest.approx(held.ranges[k], abs=1e-3)


@pytest.mark.parametrize(("status", "wrong"), [(Status.OK, True), (Status.AMBIGUOUS, False)])
def test_a_localizer_that_never_corrects_fails(lab: trials.LidarWorld, status: Status, wrong: bool) -> None:
    blind = DeadReckoning(status)
    config = trials.TrialConfig(start_duration=2.0, start_limit=1.0, kidnap_limit=3.0, settled=0.5, tracked=0.5)
    rng = np.random.default_rng(3)
    outcome = trials.wrong_start(lab, blind, blind.initialise, config, rng)
    assert not outcome.recovered
    assert outcome.seconds == np.inf
    assert (outcome.confident_wrong > 0) == wrong
    assert outcome.translation_error == pytest.approx(0.5, abs=0.1)
    outcome = trials.kidnapped(lab, DeadReckoning(status), lambda t, T: None, config, rng)
    assert not outcome.recovered
    assert (outcome.confident_wrong > 0) == wrong


def test_being_carried_is_not_felt_by_the_wheels(lab: trials.LidarWorld) -> None:
    class Witness(DeadReckoning):
        jumps: list[float] = []  # noqa: RUF012

        def predict(self, odometry: Odometry) -> None:
            step = inverse(self.T_odom_base) @ odometry.T_odom_base
            self.jumps.append(float(np.linalg.norm(step[:3, 3])))
            super().predict(odometry)

    witness = Witness(Status.LOST)
    config = trials.TrialConfig(kidnap_limit=0.5, settled=0.2, tracked=0.5)
    trials.kidnapped(lab, witness, witness.initialise, config, np.random.default_rng(4))
    assert max(witness.jumps) < 0.03


def test_the_mesh_localizer_passes_both_kinds(lab: trials.LidarWorld) -> None:
    config = trials.TrialConfig(start_duration=3.0, start_limit=2.0, kidnap_limit=6.0, settled=0.5, tracked=0.5)
    start = trials.run_trials("wrong-start", 2, lab, seed=1, config=config)
    assert start.recovered == 1.0
    carried = trials.run_trials("kidnapped", 1, lab, seed=1, config=config)
    assert carried.confident_wrong == start.confident_wrong == 0
    assert carried.recovered == 1.0
    assert carried.median_seconds < 6.0


def test_summaries_of_nothing_are_defined() -> None:
    summary = trials.TrialSummary(())
    assert (summary.recovered, summary.confident_wrong, summary.median_seconds) == (0.0, 0, float("inf"))
    with pytest.raises(InvalidValueError):
        trials.TrialConfig(speed=0.0)
