"""A Kalman filter for the pose of one object: what the tracking paper names as its future work.

State: pose in the map and velocity, with a 12x12 covariance of (translation, rotation vector, linear, angular
velocity), perturbing on the left in the map frame. Two motion models take turns: an object that stands still does not
move at all, one that moves has a white-noise acceleration. Which holds is decided by the innovations. Late
measurements are fused at their own stamp: the filter keeps its recent past and replays it.
"""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64
from simtrack.errors import InvalidValueError
from simtrack.perception.tracking import filter_kernels as kernels


@dataclass(frozen=True, slots=True)
class FilterConfig:
    """Settings of `PoseFilter`."""

    acceleration: float = 3.0
    """White-noise acceleration of a moving object, m/s^2 (density over the frame interval)."""
    angular_acceleration: float = 12.0
    """rad/s^2."""
    start_threshold: float = 4.0
    """A still object starts to move when the mean squared innovation per direction exceeds this (1 is expected)."""
    stop_speed: float = 0.006
    """A moving object comes to rest when its speed stays below this, m/s ..."""
    stop_angular_speed: float = 0.04
    """... and its angular speed below this, rad/s ..."""
    stop_consistency: float = 2.0
    """... or within this many times the variance of the velocity's estimate around zero ..."""
    stop_after: float = 0.25
    """... for this long, seconds."""
    max_speed: float = 2.0
    """Velocity estimates are limited to this, m/s."""
    max_angular_speed: float = 6.0
    """rad/s."""
    still_noise: float = 2e-4
    """Random walk of a still object, m/sqrt(s) and, five times as much, rad/sqrt(s): slow errors of the map's frame."""
    memory: float = 0.6
    """How far back late measurements can be fused, seconds."""

    def __post_init__(self) -> None:
        if self.memory < 0.0:
            raise InvalidValueError("FilterConfig.memory", self.memory, ">= 0 s")
        if self.start_threshold <= 1.0:
            raise InvalidValueError("FilterConfig.start_threshold", self.start_threshold, "> 1")


@dataclass(frozen=True, slots=True)
class FilterState:
    """Belief at one stamp."""

    stamp: int
    T_map_object: Float64
    """(4, 4)."""
    velocity: Float64
    """(6,), linear m/s and angular rad/s, map frame."""
    covariance: Float64
    """(12, 12), pose then velocity."""
    moving: bool
    slow_since: int
    """Stamp since which a moving object has been slow; the state's own stamp if it is not."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """A measured pose."""

    stamp: int
    T_map_object: Float64
    covariance: Float64
    """(6, 6), map frame."""
    drift: Float64
    """(6, 6), how far the camera's believed pose may have wandered since the last measurement, at the object. A filter
    that is to be right in the camera's frame must not hold on to a pose in the map while the map wanders."""


class PoseFilter:
    """Filter of one object; see the module's text."""

    def __init__(
        self, stamp: int, T_map_object: Float64, covariance: Float64, config: FilterConfig | None = None
    ) -> None:
        self.config = config or FilterConfig()
        P = np.zeros((12, 12))
        P[:6, :6] = covariance
        P[6:9, 6:9], P[9:, 9:] = 0.05**2 * np.eye(3), 0.3**2 * np.eye(3)
        self.state = FilterState(stamp, T_map_object, np.zeros(6), P, moving=True, slow_since=stamp)
        self._past: deque[tuple[FilterState, Measurement | None]] = deque([(self.state, None)])
        self._rules = kernels.FilterRules(*(getattr(self.config, name) for name in kernels.FilterRules._fields))

    def predict(self, stamp: int) -> FilterState:
        """State at a later stamp, without changing the filter."""
        return self._predicted(self.state, stamp)

    def update(self, measurement: Measurement) -> None:
        """Fuse a measurement; one older than the state is fused at its own stamp and the later ones are replayed."""
        if measurement.stamp >= self.state.stamp:
            self._fuse(measurement)
            return
        later: list[Measurement] = []
        while self._past and self._past[-1][0].stamp > measurement.stamp:
            past = self._past.pop()[1]
            if past is not None:
                later.append(past)
        if not self._past:  # older than the memory: what is known since outweighs it
            for m in reversed(later):
                self._past.append((replace(self.state, stamp=m.stamp), m))
            return
        self.state = self._past[-1][0]
        for m in [measurement, *reversed(later)]:
            self._fuse(m)

    def skip(self, stamp: int) -> None:
        """Move on to a stamp without a measurement; an unobserved object is taken to come to rest."""
        state = self._predicted(self.state, stamp)
        decay = np.exp(-(stamp - self.state.stamp) / NANOSECONDS / 0.15)
        self.state = replace(state, velocity=state.velocity * decay)
        self._remember(None)

    def reset(self, stamp: int, T_map_object: Float64, covariance: Float64) -> None:
        """Begin anew at a pose, forgetting the past."""
        fresh = PoseFilter(stamp, T_map_object, covariance, self.config)
        self.state, self._past = fresh.state, fresh._past

    def pose_at(self, stamp: int) -> Float64:
        """(4, 4) pose at a stamp within the memory, or predicted to a later one."""
        for state, _ in reversed(self._past):
            if state.stamp <= stamp:
                return self._moved(state, stamp)[0]
        return self._past[0][0].T_map_object

    def starts_to_move(self, measurement: Measurement) -> bool:
        """Whether a measurement at the present contradicts that the object stands still as it did so far."""
        if self.state.moving:
            return False
        P = self.state.covariance.copy()
        P[:6, :6] += measurement.drift
        state = self._predicted(replace(self.state, covariance=P), measurement.stamp)
        arguments = state.T_map_object, state.covariance, measurement.T_map_object, measurement.covariance
        return bool(kernels.surprise(*arguments) > self.config.start_threshold)

    def _predicted(self, state: FilterState, stamp: int) -> FilterState:
        if stamp <= state.stamp:
            return state
        T, P = self._moved(state, stamp)
        return FilterState(stamp, T, state.velocity, P, state.moving, state.slow_since)

    def _moved(self, state: FilterState, stamp: int) -> tuple[Float64, Float64]:
        dt = (stamp - state.stamp) / NANOSECONDS
        return kernels.predict(state.T_map_object, state.velocity, state.covariance, state.moving, dt, self._rules)

    def _fuse(self, m: Measurement) -> None:
        before, dt = self.state, (m.stamp - self.state.stamp) / NANOSECONDS
        T, velocity, P, moving, begins, slow = kernels.fuse(
            before.T_map_object, before.velocity, before.covariance, before.moving, dt,
            m.T_map_object, m.covariance, m.drift, self._rules,
        )  # fmt: skip
        since = m.stamp if begins or not slow else before.slow_since
        if moving and slow and m.stamp - since >= self.config.stop_after * NANOSECONDS:
            moving = False  # it has been slow for a while
            P[6:, :], P[:, 6:] = 0.0, 0.0
        if not moving:
            velocity = np.zeros(6)
        self.state = FilterState(m.stamp, T, velocity, P, moving, since)
        self._remember(m)

    def _remember(self, measurement: Measurement | None) -> None:
        self._past.append((self.state, measurement))
        while len(self._past) > 1 and self.state.stamp - self._past[1][0].stamp > self.config.memory * NANOSECONDS:
            self._past.popleft()
