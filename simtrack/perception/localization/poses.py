"""The pose at any stamp: corrections of the last seconds, joined by odometry.

How far odometry may be off is assumed with caution where corrections are gated and weighed (`MotionConfig`): a slip
must not throw the filter off. What is stated about a pose between corrections is measured: corrections show by how much
odometry had led away from one to the next, which scales the assumed covariance (after Mehra, "On the identification of
variances and adaptive Kalman filtering", 1970: innovations should be as large as their covariance says).
"""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64, Localization, Status
from simtrack.geometry.transforms import difference, interpolate, inverse
from simtrack.perception.localization.config import MotionConfig
from simtrack.perception.localization.motion import OdometryTrack, propagate

UNKNOWN = np.diag(np.square([100.0, 100.0, 1.0, 0.1, 0.1, 3.0]))
"""(6, 6) covariance of a pose that is not known."""

_MEMORY = 0.1
"""Share that a correction has in the measured factor."""
_SUDDEN = 9.0
"""Times the factor that a correction must show to be believed at once: a floor that has become slippery."""
_LEAST, _MOST = 0.02, 25.0
"""Bounds of the factor."""
_TRAVEL = 0.01
"""m (a radian counts as half a metre) between corrections below which they show nothing."""


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
        self.odometry_factor = 1.0
        """Measured variance of the odometry over the assumed one."""
        self.latest = Localization(0, np.eye(4), UNKNOWN, Status.LOST)
        """The last correction, or why there is none."""

    def copy(self) -> "PoseTrack":
        """What is known so far; what either one learns does not reach the other."""
        other = PoseTrack(self._config)
        other.odometry, other.anchors, other.latest = self.odometry.copy(), list(self.anchors), self.latest
        other.odometry_factor = self.odometry_factor
        return other

    def adopt(self, other: "PoseTrack") -> None:
        """Take over the corrections of a copy; odometry that came meanwhile stays, and leads on from them."""
        self.anchors, self.latest = list(other.anchors), other.latest
        self.odometry_factor = other.odometry_factor

    def anchor(self, stamp: int, T_map_base: Float64, covariance: Float64) -> None:
        """Add a corrected pose (4, 4) with its (6, 6) covariance, map frame."""
        T_map_odom = T_map_base @ inverse(self.odometry.pose(stamp))
        self._learn(stamp, T_map_base)
        self.anchors.append(Anchor(stamp, T_map_base, covariance, T_map_odom))
        oldest = stamp - self._config.horizon * NANOSECONDS
        while self.anchors[0].stamp < oldest:
            del self.anchors[0]

    def _learn(self, stamp: int, T_map_base: Float64) -> None:
        """Compare where a correction has the robot with where odometry led from the one before."""
        if not self.anchors or stamp <= self.anchors[-1].stamp:
            return
        last = self.anchors[-1]
        before, after = self.odometry.travel(last.stamp), self.odometry.travel(stamp)
        if abs(after[0] - before[0]) + 0.5 * abs(after[1] - before[1]) < _TRAVEL:
            return
        off = difference(T_map_base, last.T_map_base @ self.odometry.relative(last.stamp, stamp))[[0, 1, 5]]
        shown = float(np.mean(off**2 / np.diag(self.odometry.noise(last.stamp, stamp))[[0, 1, 5]]))
        weight = 1.0 if shown > _SUDDEN * self.odometry_factor else _MEMORY
        factor = self.odometry_factor + weight * (shown - self.odometry_factor)
        self.odometry_factor = min(max(factor, _LEAST), _MOST)

    def drift(self, stamp_from: int, stamp_to: int) -> Float64:
        """(6, 6) covariance of the odometry's motion between two stamps as measured, in the base frame of the first."""
        return self.odometry_factor * self.odometry.noise(stamp_from, stamp_to)

    def at(self, stamp: int, cautious: bool = True) -> tuple[Float64, Float64]:
        """(4, 4) T_map_base and (6, 6) covariance at any stamp; `cautious`: with the odometry's assumed errors."""
        if not self.anchors:
            return self.odometry.pose(stamp), UNKNOWN
        k = bisect_right([anchor.stamp for anchor in self.anchors], stamp)
        if 0 < k < len(self.anchors):
            a, b = self.anchors[k - 1], self.anchors[k]
            share = (stamp - a.stamp) / (b.stamp - a.stamp)
            T = interpolate(a.T_map_odom, b.T_map_odom, share) @ self.odometry.pose(stamp)
            return T, (1.0 - share) * a.covariance + share * b.covariance
        anchor = self.anchors[max(k - 1, 0)]
        motion, noise = self.odometry.relative(anchor.stamp, stamp), self.odometry.noise if cautious else self.drift
        return propagate(anchor.T_map_base, anchor.covariance, motion, noise(anchor.stamp, stamp))
