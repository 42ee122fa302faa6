"""The spinning lidar: firing order and timing of a Velodyne VLP-16, and its noise."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float32, Float64, Uint8
from simtrack.errors import InvalidValueError

VLP16_ELEVATIONS = (-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15)
"""Degrees above the horizon, by laser id, which is the firing order (VLP-16 User Manual 63-9243, table 9-1)."""


@dataclass(frozen=True, slots=True, eq=False)
class LidarShots:
    """The shots of one turn, in the order in which they are fired."""

    directions: Float32
    """(N, 3), unit vectors in the lidar frame (x forward, y left, z up)."""
    times: Float32
    """(N,), seconds after the first shot, ascending."""
    rings: Uint8
    """(N,), rank of the laser by elevation, 0 = lowest."""
    azimuths: Float32
    """(N,), radians clockwise from x forward seen from above, not wrapped: ascending with time."""

    def __len__(self) -> int:
        return len(self.times)


@dataclass(frozen=True, slots=True)
class LidarModel:
    """A lidar that fires its lasers one after the other while it turns clockwise, seen from above."""

    elevations: tuple[float, ...] = VLP16_ELEVATIONS
    """Degrees, by laser in firing order."""
    rate_hz: float = 10.0
    """Turns a second; the VLP-16 turns at 5 to 20 Hz."""
    firing_period: float = 55.296e-6
    """Seconds from one firing of all lasers to the next, recharge included."""
    laser_period: float = 2.304e-6
    """Seconds between two lasers of a firing."""
    min_range: float = 0.4
    """Metres."""
    max_range: float = 100.0
    """Metres."""

    def __post_init__(self) -> None:
        if not self.elevations:
            raise InvalidValueError("elevations", self.elevations, "at least one laser")
        if not self.rate_hz > 0 or not self.firing_period * self.rate_hz <= 1:
            raise InvalidValueError("rate_hz", self.rate_hz, "> 0, at least one firing a turn")
        if not 0 < self.laser_period * len(self.elevations) <= self.firing_period:
            raise InvalidValueError("laser_period", self.laser_period, "> 0, all lasers within firing_period")
        if not 0 <= self.min_range < self.max_range:
            raise InvalidValueError("min_range, max_range", (self.min_range, self.max_range), "0 <= min < max")

    @property
    def period(self) -> int:
        """Nanoseconds a turn, rounded."""
        return round(1e9 / self.rate_hz)

    @property
    def columns(self) -> int:
        """Firings that begin within one turn of 360 deg: 1809 for a VLP-16 at 10 Hz (1808.4 firing periods)."""
        return int(np.ceil(1.0 / (self.rate_hz * self.firing_period)))

    @property
    def driver_columns(self) -> int:
        """Firings of a scan as drivers pack it, whole packets of 24: 1824 at 10 Hz, 363 deg, 3 deg of them twice.

        This is the scan of 1824 x 16 rays of the tracking paper; use it for benchmarks only.
        """
        return 24 * int(np.ceil(self.columns / 24))

    def shots(self, start_azimuth: float = 0.0, columns: int | None = None) -> LidarShots:
        """The shots of one turn, each with its own time ``t(k, n) = firing_period k + laser_period n`` and azimuth.

        Args:
            start_azimuth: of the first shot, radians clockwise from x forward seen from above.
            columns: firings; None takes the shots within one turn by true time (28,939 of a VLP-16 at 10 Hz),
                `driver_columns` the overlapping form.
        """
        lasers = np.arange(len(self.elevations))
        firings = np.arange(self.columns if columns is None else columns)
        times = (self.firing_period * firings[:, None] + self.laser_period * lasers).ravel()
        rings, elevations = self._by_laser(len(firings))
        if columns is None:
            inside = times < 1.0 / self.rate_hz
            times, rings, elevations = times[inside], rings[inside], elevations[inside]
        azimuths = start_azimuth + 2.0 * np.pi * self.rate_hz * times
        directions = np.stack(
            [np.cos(elevations) * np.cos(azimuths), -np.cos(elevations) * np.sin(azimuths), np.sin(elevations)], axis=1
        )
        return LidarShots(directions.astype(np.float32), times.astype(np.float32), rings, azimuths.astype(np.float32))

    def _by_laser(self, firings: int) -> tuple[Uint8, Float64]:
        """(N,) rings and elevations in radians of `firings` firings."""
        degrees = np.asarray(self.elevations, dtype=np.float64)
        ranks = np.argsort(np.argsort(degrees, kind="stable"), kind="stable").astype(np.uint8)
        return np.tile(ranks, firings), np.tile(np.deg2rad(degrees), firings)


VLP16 = LidarModel()
"""Velodyne VLP-16 (Puck) at 10 Hz: 16 lasers, +-15 deg, 0.4 to 100 m."""


@dataclass(frozen=True, slots=True)
class LidarNoiseConfig:
    """How a lidar errs; every part can be switched off by its zero."""

    sigma: float = 0.008
    """Metres, of the range; common simulators use 8 mm, the data sheet states +-3 cm."""
    resolution: float = 0.002
    """Metres: ranges are multiples of it."""
    min_range: float = 0.4
    """Metres."""
    max_range: float = 100.0
    """Metres."""
    grazing_angle: float = 1.48
    """Incidence, radians, at which half of the shots are lost; pi/2: no such loss. A choice of this project."""
    grazing_width: float = 0.03
    """Radians over which the loss sets in (logistic). A choice of this project."""
    dropout: float = 0.002
    """Share of shots lost for no reason. A choice of this project."""
    reflectivity_floor: float = 2.0
    """Calibrated reflectivity below which returns from `max_range` are lost; the limit falls with the square of the
    range (inverse-square law of the received power). A choice of this project."""

    def __post_init__(self) -> None:
        for name in ("sigma", "resolution", "min_range", "reflectivity_floor"):
            if not getattr(self, name) >= 0:
                raise InvalidValueError(name, getattr(self, name), ">= 0")
        if not self.max_range > self.min_range:
            raise InvalidValueError("max_range", self.max_range, "> min_range")
        if not 0 <= self.dropout <= 1:
            raise InvalidValueError("dropout", self.dropout, "0..1")
        if not 0 < self.grazing_angle <= np.pi / 2 or not self.grazing_width > 0:
            raise InvalidValueError("grazing_angle", self.grazing_angle, "0..pi/2, with grazing_width > 0")


IDEAL_LIDAR_NOISE = LidarNoiseConfig(0.0, 0.0, 0.0, np.inf, np.pi / 2, 0.03, 0.0, 0.0)
"""No noise at all."""


def apply_lidar_noise(
    ranges: npt.ArrayLike,
    intensities: npt.ArrayLike | None,
    config: LidarNoiseConfig,
    rng: np.random.Generator,
    incidence: npt.ArrayLike | None = None,
) -> Float32:
    """(N,) measured ranges of true ones: noise, resolution, dropouts, limits.

    Args:
        ranges: (N,), metres along the ray, inf = nothing there; anything not finite or <= 0 stays without return.
        intensities: (N,) calibrated reflectivity 0-255 of what was hit, or None.
        config: the noise.
        rng: three numbers a shot are drawn whatever the input, so that one shot's fate does not change the others'.
        incidence: (N,) radians between the ray and the surface's normal, 0..pi/2, or None for no grazing dropout.

    Returns:
        (N,) float32, metres, inf = no return, never NaN.
    """
    true = np.asarray(ranges, dtype=np.float64)
    noise = rng.standard_normal(true.shape)
    loss, graze = rng.random((2, *true.shape))
    valid = np.isfinite(true) & (true > 0) & (loss >= config.dropout)
    measured = np.where(valid, true, 1.0) + config.sigma * noise
    if config.resolution > 0:
        measured = config.resolution * np.round(measured / config.resolution)
    if incidence is not None and config.grazing_angle < np.pi / 2:
        lost = 1.0 / (1.0 + np.exp(-(np.asarray(incidence) - config.grazing_angle) / config.grazing_width))
        valid &= graze >= lost
    if intensities is not None and config.reflectivity_floor > 0:
        reach = np.where(valid, true, 0.0) / config.max_range
        valid &= np.asarray(intensities) >= config.reflectivity_floor * reach**2
    valid &= (measured >= config.min_range) & (measured <= config.max_range)
    return np.where(valid, measured, np.inf).astype(np.float32)


def reflected_intensity(reflectivity: npt.ArrayLike, incidence: npt.ArrayLike) -> Float32:
    """(N,) calibrated reflectivity 0-100 of diffuse surfaces.

    The sensor's calibration removes the range but not the angle: Lambert's cosine law remains.

    Args:
        reflectivity: (N,) or scalar, diffuse albedo 0..1 in the near infrared.
        incidence: (N,) radians between ray and normal.
    """
    value = 100.0 * np.clip(reflectivity, 0.0, 1.0) * np.abs(np.cos(np.asarray(incidence, dtype=np.float64)))
    return np.round(value).astype(np.float32)
