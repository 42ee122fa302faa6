"""A localizer that answers from ground truth."""

from typing import Protocol

import numpy as np

from simtrack.contracts import Float64, LidarScan, Localization, Odometry, Status
from simtrack.errors import InvalidValueError

KEPT = 64
"""Poses that are remembered."""
SIGMA = 1e-5
"""Metres and radians: standard deviation that is stated for a pose that is exact, so that nobody divides by zero."""


class RobotTruth(Protocol):
    """What the localizer reads of the world at one stamp."""

    @property
    def T_map_base(self) -> Float64:
        """(4, 4), true."""
        ...


class RobotTruthSource(Protocol):
    """The part of `simtrack.simulation.ground_truth.GroundTruth` that the localizer needs."""

    def at(self, stamp: int) -> RobotTruth:
        """True state at a stamp."""
        ...


class OracleLocalizer:
    """Knows where the robot is; implements `simtrack.contracts.Localizer`.

    A stamp is taken as it comes: where a sensor's clock is off, the pose of the wrong moment is given, as a perfect
    localizer on a robot with such clocks would.
    """

    def __init__(self, truth: RobotTruthSource) -> None:
        self._truth = truth
        self._last = 0
        self._known: dict[int, Float64] = {}

    def predict(self, odometry: Odometry) -> None:
        """Nothing to learn; notes how far time is."""
        self._last = max(self._last, odometry.stamp)

    def update(self, scan: LidarScan) -> Localization:
        """The pose at a scan's stamp."""
        return self.pose_at(scan.stamp)

    def pose_at(self, stamp: int) -> Localization:
        """The true pose at a stamp, or the latest there is where that lies ahead."""
        status = Status.OK
        try:
            T = self._pose(max(stamp, 0))
        except InvalidValueError:
            T, status = self._pose(self._last), Status.STALE
        return Localization(stamp, T, SIGMA**2 * np.eye(6), status, inlier_share=1.0)

    def _pose(self, stamp: int) -> Float64:
        """Kept for a while: a turn of the lidar asks for the same stamps as the images in it."""
        if stamp not in self._known:
            self._known[stamp] = self._truth.at(stamp).T_map_base
            if len(self._known) > KEPT:
                del self._known[next(iter(self._known))]
        return self._known[stamp]
