"""Odometry as the localizer uses it: a short track of dead-reckoned poses, and how its uncertainty grows."""

from bisect import bisect_right

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64, Odometry
from simtrack.geometry.transforms import (
    angle_between,
    interpolate,
    inverse,
    is_rigid,
    skew,
    transform_planar,
)
from simtrack.perception.localization.config import MotionConfig


class OdometryTrack:
    """The last seconds of odometry; answers with the pose in the odometry frame at any stamp."""

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._stamps: list[int] = []
        self._poses: list[Float64] = []
        self._travel: list[tuple[float, float]] = []
        self._twist = (0.0, 0.0)

    def __len__(self) -> int:
        return len(self._stamps)

    def copy(self) -> "OdometryTrack":
        """The readings so far; those that are added to either one do not reach the other."""
        other = OdometryTrack(self._config)
        other._stamps, other._poses, other._travel = list(self._stamps), list(self._poses), list(self._travel)
        other._twist = self._twist
        return other

    @property
    def last_stamp(self) -> int | None:
        """Nanoseconds of the newest reading, None before the first."""
        return self._stamps[-1] if self._stamps else None

    def add(self, odometry: Odometry) -> bool:
        """Take a reading; one that is malformed, or not newer than the last, is left out and answered with False."""
        twist = (float(odometry.linear), float(odometry.angular))
        if not (is_rigid(odometry.T_odom_base) and np.isfinite(twist).all()):
            return False
        if self._stamps and odometry.stamp <= self._stamps[-1]:
            return False
        distance, rotation = self._travel[-1] if self._travel else (0.0, 0.0)
        if self._poses:
            previous = self._poses[-1]
            distance += float(np.linalg.norm(odometry.T_odom_base[:3, 3] - previous[:3, 3]))
            rotation += angle_between(odometry.T_odom_base[:3, :3], previous[:3, :3])
        self._stamps.append(odometry.stamp)
        self._poses.append(np.array(odometry.T_odom_base, dtype=float))
        self._travel.append((distance, rotation))
        self._twist = twist
        oldest = odometry.stamp - int(self._config.horizon * NANOSECONDS)
        drop = max(0, min(bisect_right(self._stamps, oldest) - 1, len(self._stamps) - 2))
        if drop > 32:  # seldom and in bulk: deleting from the front of a list moves the rest
            del self._stamps[:drop], self._poses[:drop], self._travel[:drop]
        return True

    def pose(self, stamp: int) -> Float64:
        """(4, 4) T_odom_base at `stamp`: interpolated, before the first reading held, after the last one carried on."""
        if not self._stamps:
            return np.eye(4)
        k = bisect_right(self._stamps, stamp)
        if k == 0:
            return self._poses[0]
        if k == len(self._stamps):
            seconds = min((stamp - self._stamps[-1]) / NANOSECONDS, self._config.max_extrapolation)
            return self._poses[-1] @ _arc(*self._twist, seconds)
        a, b = self._stamps[k - 1], self._stamps[k]
        return interpolate(self._poses[k - 1], self._poses[k], (stamp - a) / (b - a))

    def relative(self, stamp_from: int, stamp_to: int) -> Float64:
        """(4, 4) pose of the base at `stamp_to` in the base at `stamp_from`."""
        return inverse(self.pose(stamp_from)) @ self.pose(stamp_to)

    def knots(self, first: int, last: int) -> tuple[list[int], list[Float64]]:
        """Stamps and T_odom_base that bracket [first, last]: the readings between, and both ends themselves."""
        a, b = bisect_right(self._stamps, first), bisect_right(self._stamps, last)
        inside = [k for k in range(a, b) if first < self._stamps[k] < last]
        stamps = [first, *(self._stamps[k] for k in inside)]
        poses = [self.pose(first), *(self._poses[k] for k in inside)]
        if last > first:
            stamps.append(last)
            poses.append(self.pose(last))
        return stamps, poses

    def travel(self, stamp: int) -> tuple[float, float]:
        """Metres driven and radians turned up to `stamp`, counted from some start."""
        if not self._stamps:
            return 0.0, 0.0
        k = bisect_right(self._stamps, stamp)
        if k == 0:
            return self._travel[0]
        distance, rotation = self._travel[k - 1]
        if k == len(self._stamps):
            seconds = min((stamp - self._stamps[-1]) / NANOSECONDS, self._config.max_extrapolation)
            return distance + abs(self._twist[0]) * seconds, rotation + abs(self._twist[1]) * seconds
        share = (stamp - self._stamps[k - 1]) / (self._stamps[k] - self._stamps[k - 1])
        later = self._travel[k]
        return distance + share * (later[0] - distance), rotation + share * (later[1] - rotation)

    def noise(self, stamp_from: int, stamp_to: int) -> Float64:
        """(6, 6) covariance of `relative(stamp_from, stamp_to)`, in the base frame.

        Readings that are missing (none at all, or older than the interval's end) make it grow as fast as the robot
        may have moved meanwhile.
        """
        c = self._config
        seconds = abs(stamp_to - stamp_from) / NANOSECONDS
        a, b = self.travel(stamp_from), self.travel(stamp_to)
        distance, rotation = abs(b[0] - a[0]), abs(b[1] - a[1])
        sigma_t = c.translation_per_metre * distance + c.translation_per_radian * rotation
        sigma_r = c.rotation_per_metre * distance + c.rotation_per_radian * rotation
        covered = self._stamps[-1] if self._stamps else min(stamp_from, stamp_to)
        blind = max(0.0, (max(stamp_from, stamp_to) - max(covered, min(stamp_from, stamp_to))) / NANOSECONDS)
        blind = max(0.0, blind - 0.05)  # the newest reading is always a little old
        sigma_t += c.drift_translation * np.sqrt(seconds) + c.blind_speed * blind
        sigma_r += c.drift_rotation * np.sqrt(seconds) + c.blind_turn_rate * blind
        flat = 0.1  # height and tilt change little on a floor
        return np.diag(np.square([sigma_t, sigma_t, flat * sigma_t, flat * sigma_r, flat * sigma_r, sigma_r]))


def _arc(linear: float, angular: float, seconds: float) -> Float64:
    """(4, 4) motion of a differential drive with constant speeds."""
    angle, length = angular * seconds, linear * seconds
    if abs(angle) < 1e-9:
        return transform_planar(length, 0.0, 0.0)
    radius = length / angle
    return transform_planar(radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle)


def propagate(T_map_base: Float64, covariance: Float64, motion: Float64, noise: Float64) -> tuple[Float64, Float64]:
    """Compound a pose with a motion.

    Args:
        T_map_base: (4, 4) pose before.
        covariance: (6, 6) of its left perturbation, map frame.
        motion: (4, 4) T_before_after.
        noise: (6, 6) covariance of `motion`, frame of `before`.

    Returns:
        (4, 4) pose after and its (6, 6) covariance: ``rho' = rho - [R t]x phi``, ``phi' = phi``.
    """
    R = T_map_base[:3, :3]
    F = np.eye(6)
    F[:3, 3:] = -skew(R @ motion[:3, 3])
    G = np.zeros((6, 6))
    G[:3, :3] = G[3:, 3:] = R
    return T_map_base @ motion, F @ covariance @ F.T + G @ noise @ G.T
