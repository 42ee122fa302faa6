"""Wheel odometry and joint encoders, as the robot reads them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64, JointState, Odometry
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import transform_planar


@dataclass(frozen=True, slots=True)
class OdometryNoiseConfig:
    """The usual four-parameter noise of wheel odometry, plus slip.

    `sample_motion_model_velocity` of Thrun, Burgard and Fox, Probabilistic Robotics, table 5.3, in its continuous form:
    over a time dt with forward speed v and yaw rate w, travel and turn get zero-mean errors with the variances
    ``(a1 |v| + a2 |w|) dt`` and ``(a3 |v| + a4 |w|) dt``, which do not depend on the rate of the readings.
    """

    travel_from_travel: float = 1e-5
    """a1, m^2 a metre: 1e-5 gives 10 mm after 10 m."""
    travel_from_turn: float = 1e-6
    """a2, m^2 a radian."""
    turn_from_travel: float = 1e-5
    """a3, rad^2 a metre: 1e-5 gives 0.57 deg after 10 m."""
    turn_from_turn: float = 2e-5
    """a4, rad^2 a radian."""
    scale_error: float = 0.0
    """Relative error of the wheels' radius: travel is read (1 + scale_error) times."""
    slip_rate: float = 0.0
    """Slip events a metre travelled, on average (Poisson)."""
    slip_travel: float = 0.03
    """Metres by which the wheels turn too far in a slip event, one standard deviation."""
    slip_turn: float = 0.03
    """Radians, likewise."""
    slips: tuple[tuple[int, float, float], ...] = ()
    """Scheduled slip events (stamp in ns, metres, radians) that are added to what the wheels read."""

    def __post_init__(self) -> None:
        for name in ("travel_from_travel", "travel_from_turn", "turn_from_travel", "turn_from_turn"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(name, getattr(self, name), ">= 0 and finite")
        for name in ("slip_rate", "slip_travel", "slip_turn"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(name, getattr(self, name), ">= 0 and finite")
        if not abs(self.scale_error) < 0.5:
            raise InvalidValueError("scale_error", self.scale_error, "-0.5..0.5")


class OdometrySensor:
    """Integrates noisy wheel readings to a drifting pose."""

    def __init__(self, config: OdometryNoiseConfig, rng: np.random.Generator, rate_hz: float = 50.0) -> None:
        if not rate_hz > 0:
            raise InvalidValueError("rate_hz", rate_hz, "> 0")
        self.config = config
        self.period = round(NANOSECONDS / rate_hz)
        """Nanoseconds between readings."""
        self._rng = rng
        self._stamp: int | None = None
        self._T_map_base = np.eye(4)
        self._pose = np.zeros(3)  # x, y, yaw in the odometry frame
        self._due = sorted(config.slips)

    def read(self, stamp: int, T_map_base: Float64) -> Odometry:
        """One reading, from the true planar motion since the last.

        Args:
            stamp: nanoseconds, not before the last reading's.
            T_map_base: (4, 4), the true pose of the base; only its motion is used.

        Raises:
            InvalidValueError: `stamp` runs backwards.
        """
        if self._stamp is None:
            self._stamp, self._T_map_base = stamp, T_map_base.copy()
        if stamp < self._stamp:
            raise InvalidValueError("stamp", stamp, f">= {self._stamp}, the last reading's")
        dt = (stamp - self._stamp) / NANOSECONDS
        travel, sideways, turn = _planar_motion(self._T_map_base, T_map_base)
        measured_travel, measured_turn = self._disturb(stamp, travel, turn)
        heading = self._pose[2] + 0.5 * measured_turn
        self._pose += [
            measured_travel * np.cos(heading) - sideways * np.sin(heading),
            measured_travel * np.sin(heading) + sideways * np.cos(heading),
            measured_turn,
        ]
        self._stamp, self._T_map_base = stamp, T_map_base.copy()
        speed, rate = (measured_travel / dt, measured_turn / dt) if dt > 0 else (0.0, 0.0)
        return Odometry(stamp, transform_planar(*self._pose), float(speed), float(rate))

    def _disturb(self, stamp: int, travel: float, turn: float) -> tuple[float, float]:
        c = self.config
        white = self._rng.standard_normal(4)
        way, angle = abs(travel), abs(turn)
        travel_noise = white[0] * np.sqrt(c.travel_from_travel * way + c.travel_from_turn * angle)
        turn_noise = white[1] * np.sqrt(c.turn_from_travel * way + c.turn_from_turn * angle)
        travel_read, turn_read = travel * (1.0 + c.scale_error) + travel_noise, turn + turn_noise
        if self._rng.random() < -np.expm1(-c.slip_rate * way):
            travel_read += c.slip_travel * white[2]
            turn_read += c.slip_turn * white[3]
        while self._due and self._due[0][0] <= stamp:
            _, metres, radians = self._due.pop(0)
            travel_read += metres
            turn_read += radians
        return travel_read, turn_read


def _planar_motion(T_from: Float64, T_to: Float64) -> tuple[float, float, float]:
    """Forward and sideways way and turn between two poses, in the frame half-way between them."""
    R = T_from[:3, :3].T @ T_to[:3, :3]
    turn = float(np.arctan2(R[1, 0], R[0, 0]))
    dx, dy, _ = T_from[:3, :3].T @ (T_to[:3, 3] - T_from[:3, 3])
    c, s = np.cos(0.5 * turn), np.sin(0.5 * turn)
    return float(c * dx + s * dy), float(-s * dx + c * dy), turn


@dataclass(frozen=True, slots=True)
class EncoderNoiseConfig:
    """How joint encoders err."""

    sigma: float = 2e-4
    """rad (m for a lift), white, a reading."""
    resolution: float = 1e-4
    """rad or m: readings are multiples of it."""
    bias: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """Joint name -> constant error, rad or m: a calibration fault."""

    def __post_init__(self) -> None:
        for name in ("sigma", "resolution"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(name, getattr(self, name), ">= 0 and finite")
        if not all(np.isfinite(v) for v in self.bias.values()):
            raise InvalidValueError("bias", dict(self.bias), "finite numbers")


def read_encoders(
    stamp: int, positions: Mapping[str, float], config: EncoderNoiseConfig, rng: np.random.Generator
) -> JointState:
    """One reading of all joints: true positions (rad or m) plus bias and noise, at the encoder's resolution."""
    names = tuple(positions)
    values = np.array([positions[name] + config.bias.get(name, 0.0) for name in names])
    values = values + config.sigma * rng.standard_normal(len(names))
    if config.resolution > 0:
        values = config.resolution * np.round(values / config.resolution)
    return JointState(stamp, names, values)
