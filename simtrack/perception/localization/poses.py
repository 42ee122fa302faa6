"""The pose at any stamp: corrections of the last seconds, joined by odometry."""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64, Localization, Status
from simtrack.geometry.transforms import interpolate, inverse
from simtrack.perception.localization.config import MotionConfig
from simtrack.perception.localization.motion import OdometryTrack, propagate

UNKNOWN = np.diag(np.square([100.0, 100.0, 1.0, 0.1, 0.1, 3.0]))
"""(6, 6) covariance of a pose that is not known."""


@dataclass(frozen=True, slots=True)
class Anchor:
    """A corrected pose."""

    stamp: int
    T_map_base: Float64
    covariance: Float64
    T_map_odom: Float64


class PoseTrack:
    """Odometry and corrections. One that is worked at and one that is asked meanwhile are two: see `copy`, `adopt`."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self.odometry = OdometryTrack(config)
        self.anchors: list[Anchor] = []
        self.latest = Localization(0, np.eye(4), UNKNOWN, Status.LOST)
        """The last correction, or why there is none."""

    def copy(self) -> "PoseTrack":
        """What is known so far; what either one learns does not reach the other."""
        other = PoseTrack(self._config)
        other.odometry, other.anchors, other.latest = self.odometry.copy(), list(self.anchors), self.latest
        return other

    def adopt(self, other: "PoseTrack") -> None:
        """Take over the corrections of a copy; odometry that came meanwhile stays, and leads on from them."""
        self.anchors, self.latest = list(other.anchors), other.latest

    def anchor(self, stamp: int, T_map_base: Float64, covariance: Float64) -> None:
        """Add a corrected pose (4, 4) with its (6, 6) covariance, map frame."""
        T_map_odom = T_map_base @ inverse(self.odometry.pose(stamp))
        self.anchors.append(Anchor(stamp, T_map_base, covariance, T_map_odom))
        oldest = stamp - self._config.horizon * NANOSECONDS
        while self.anchors[0].stamp < oldest:
            del self.anchors[0]

    def at(self, stamp: int) -> tuple[Float64, Float64]:
        """(4, 4) T_map_base and (6, 6) covariance at any stamp."""
        if not self.anchors:
            return self.odometry.pose(stamp), UNKNOWN
        k = bisect_right([anchor.stamp for anchor in self.anchors], stamp)
        if 0 < k < len(self.anchors):
            a, b = self.anchors[k - 1], self.anchors[k]
            share = (stamp - a.stamp) / (b.stamp - a.stamp)
            T = interpolate(a.T_map_odom, b.T_map_odom, share) @ self.odometry.pose(stamp)
            return T, (1.0 - share) * a.covariance + share * b.covariance
        anchor = self.anchors[max(k - 1, 0)]
        motion = self.odometry.relative(anchor.stamp, stamp)
        return propagate(anchor.T_map_base, anchor.covariance, motion, self.odometry.noise(anchor.stamp, stamp))
