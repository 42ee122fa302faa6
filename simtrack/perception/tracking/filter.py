"""A Kalman filter for the pose of one object: what the tracking paper names as its future work.

State: pose in the map and velocity, with a 12x12 covariance of (translation, rotation vector, linear, angular
velocity), perturbing on the left in the map frame. Two motion models take turns: an object that stands still does not
move at all, one that moves has a white-noise acceleration. Which holds is decided by the innovations. Late
measurements are fused at their
own stamp: the filter keeps its recent past and replays it.
"""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import difference, exp_so3, orthonormal, perturb


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

    def predict(self, stamp: int) -> FilterState:
        """State at a later stamp, without changing the filter."""
        return _predicted(self.state, stamp, self.config)

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
        state = _predicted(self.state, stamp, self.config)
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
                return _predicted(state, stamp, self.config).T_map_object
        return self._past[0][0].T_map_object

    def starts_to_move(self, measurement: Measurement) -> bool:
        """Whether a measurement at the present contradicts that the object stands still as it did so far."""
        state = _predicted(self.state, measurement.stamp, self.config, measurement.drift)
        return not state.moving and _surprise(state, measurement) > self.config.start_threshold

    def _fuse(self, m: Measurement) -> None:
        state = _predicted(self.state, m.stamp, self.config, m.drift)
        innovation, S = _innovation(state, m)
        if not state.moving and _surprise(state, m) > self.config.start_threshold:
            state = _predicted(replace(self.state, moving=True), m.stamp, self.config, m.drift)
            P = state.covariance.copy()
            dt = max((m.stamp - self.state.stamp) / NANOSECONDS, 1e-3)
            P[6:9, 6:9] += 0.2**2 * np.eye(3)
            P[9:, 9:] += 0.8**2 * np.eye(3)
            P[:3, :3] += (0.2 * dt) ** 2 * np.eye(3)
            P[3:6, 3:6] += (0.8 * dt) ** 2 * np.eye(3)
            state = replace(state, covariance=P, slow_since=m.stamp)
            innovation, S = _innovation(state, m)
        gain = np.linalg.solve(S, state.covariance[:6]).T
        xi = gain @ innovation
        P = state.covariance - gain @ S @ gain.T
        P = 0.5 * (P + P.T)
        velocity = state.velocity + xi[6:]
        velocity[:3] *= min(1.0, self.config.max_speed / max(float(np.linalg.norm(velocity[:3])), 1e-9))
        velocity[3:] *= min(1.0, self.config.max_angular_speed / max(float(np.linalg.norm(velocity[3:])), 1e-9))
        self.state = self._settle(
            FilterState(m.stamp, perturb(state.T_map_object, xi[:6]), velocity, P, state.moving, state.slow_since)
        )
        self._remember(m)

    def _settle(self, state: FilterState) -> FilterState:
        """Let a moving object that has been slow for a while come to rest."""
        if not state.moving:
            return replace(state, velocity=np.zeros(6))
        config = self.config
        limits = ((slice(0, 3), config.stop_speed), (slice(3, 6), config.stop_angular_speed))
        slow = True
        for part, limit in limits:
            v, P = state.velocity[part], state.covariance[6:, 6:][part, part]
            # slower than the limit, or not to be told from standing still
            slow &= bool(np.linalg.norm(v) < limit or float(v @ np.linalg.solve(P, v)) < 3.0 * config.stop_consistency)
        if not slow:
            return replace(state, slow_since=state.stamp)
        if state.stamp - state.slow_since < config.stop_after * NANOSECONDS:
            return state
        P = state.covariance.copy()
        P[6:, :], P[:, 6:] = 0.0, 0.0
        return replace(state, moving=False, velocity=np.zeros(6), covariance=P)

    def _remember(self, measurement: Measurement | None) -> None:
        self._past.append((self.state, measurement))
        while len(self._past) > 1 and self.state.stamp - self._past[1][0].stamp > self.config.memory * NANOSECONDS:
            self._past.popleft()


def _innovation(state: FilterState, m: Measurement) -> tuple[Float64, Float64]:
    S = state.covariance[:6, :6] + m.covariance
    return difference(m.T_map_object, state.T_map_object), S


def _surprise(state: FilterState, m: Measurement) -> float:
    """Mean squared innovation per direction that was measured at all: the others have a variance of about 1."""
    index = np.flatnonzero(np.diag(m.covariance) < 0.05)
    if not len(index):
        return 0.0
    innovation, S = _innovation(state, m)
    e = innovation[index]
    return float(e @ np.linalg.solve(S[np.ix_(index, index)], e)) / len(index)


def _predicted(state: FilterState, stamp: int, config: FilterConfig, drift: Float64 | None = None) -> FilterState:
    dt = (stamp - state.stamp) / NANOSECONDS
    P = state.covariance.copy()
    if drift is not None:
        P[:6, :6] += drift
    if dt <= 0.0:
        return replace(state, covariance=P)
    if not state.moving:
        walk = config.still_noise**2 * dt
        P[range(3), range(3)] += walk
        P[range(3, 6), range(3, 6)] += 25.0 * walk
        return replace(state, stamp=stamp, covariance=P)
    T = np.eye(4)
    T[:3, :3] = orthonormal(exp_so3(dt * state.velocity[3:]) @ state.T_map_object[:3, :3])
    T[:3, 3] = state.T_map_object[:3, 3] + dt * state.velocity[:3]
    F = np.eye(12)
    F[range(6), range(6, 12)] = dt
    P = F @ P @ F.T
    for offset, density in ((0, config.acceleration), (3, config.angular_acceleration)):
        q = density**2 * dt  # acceleration noise correlated over about a frame
        for i in range(offset, offset + 3):
            P[i, i] += q * dt**3 / 3.0
            P[i, i + 6] += q * dt**2 / 2.0
            P[i + 6, i] += q * dt**2 / 2.0
            P[i + 6, i + 6] += q * dt
    return replace(state, stamp=stamp, T_map_object=T, covariance=P)
