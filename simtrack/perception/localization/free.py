"""Localization of a sensor that is carried freely, by hand or by a vehicle: MICP-L without floor and without odometry.

`MeshLocalizer` is for a robot with wheels on a floor. Here nothing is known of the motion but that it goes on as it
did; where that prediction does not explain a measurement, it is registered once more from coarse to fine.
"""

from dataclasses import dataclass, replace

import numpy as np

from simtrack.contracts import Float64, LidarScan, Localization, Odometry, RgbdFrame, Status
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import difference, interpolate, inverse
from simtrack.perception.localization.assessment import Assessment, judge
from simtrack.perception.localization.config import MotionConfig, RegistrationConfig
from simtrack.perception.localization.measurement import Measurement, depth_measurement, deskew, scan_end
from simtrack.perception.localization.motion import OdometryTrack
from simtrack.perception.localization.registration import Registration, register
from simtrack.perception.localization.surface import MapSurface

FREE = RegistrationConfig(
    strides=(5, 5, 3, 3, 3, 2, 2, 2), settled=0.002, floor_sigma=1e3, tilt_sigma=1e3, normal_sigma=0.05
)
"""More casts than on a floor with odometry: along weakly constrained directions each moves the pose by little. Floor
and tilt say nothing. Normals of a mesh that was made of one view err by some degrees: less would feign knowledge of
directions along the walls of a room whose floor is not seen."""
COARSE = replace(FREE, strides=(5,) * 40 + (2,), settled=1e-4, min_gate=0.6, min_kernel=0.1)
"""Wide gates, and as many casts as half a metre takes."""


@dataclass(frozen=True, slots=True)
class FreeConfig:
    """Settings of `FreeLocalizer`."""

    fine: RegistrationConfig = FREE
    """The registration that decides."""
    coarse: RegistrationConfig = COARSE
    """What comes before it where the prediction does not hold."""
    sigma: float = 0.5
    """Metres, standard deviation of a prediction of the motion between two measurements."""
    sigma_angle: float = 0.1
    """Radians, likewise."""
    steady: float = 0.01
    """A prediction holds if, of the shots that meet the map, the registration from it explains no smaller a share than
    the last one did, less this. Otherwise others are tried."""
    max_through: float = 0.05
    """No pose is believed that lets more of the shots pass through surfaces of the map ..."""
    min_share: float = 0.3
    """... or explains a smaller share of them."""
    min_range: float = 0.3
    """Metres: nearer lidar returns are not used."""
    max_range: float = 100.0
    """Metres: farther ones neither."""
    depth_columns: int = 160
    """About so many columns of a depth image are used, and rows as far apart."""
    depth_max_range: float = 5.0
    """Metres."""

    def __post_init__(self) -> None:
        for name in ("sigma", "sigma_angle", "max_range", "depth_columns", "depth_max_range"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InvalidValueError(f"FreeConfig.{name}", getattr(self, name), "a finite number > 0")
        for name in ("steady", "max_through", "min_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidValueError(f"FreeConfig.{name}", getattr(self, name), "0 to 1")


class FreeLocalizer:
    """Poses of the base of one sensor in a mesh map, from one measurement to the next."""

    def __init__(self, surface: MapSurface, stamp: int, T_map_base: Float64, config: FreeConfig | None = None) -> None:
        """Start at a known pose.

        Args:
            surface: the map.
            stamp: nanoseconds.
            T_map_base: (4, 4), where the base is at `stamp`.
            config: settings, the defaults if None.
        """
        self.surface = surface
        """May be replaced by a larger one in the same frame."""
        self.config = config or FreeConfig()
        self.restart(stamp, T_map_base)

    def restart(self, stamp: int, T_map_base: Float64, before: tuple[int, Float64] | None = None) -> None:
        """Forget what was measured; start anew at a known pose, moving since an earlier one (stamp, pose), if given."""
        known = [(stamp, np.array(T_map_base, dtype=float))]
        self._poses: list[tuple[int, Float64]] = known if before is None else [before, *known]
        self._level = 1.0

    def follows(self, T_before: Float64, T_after: Float64) -> bool:
        """Whether a motion lies within the three standard deviations beyond which none is believed."""
        motion = difference(T_after, T_before)
        far, turned = float(np.linalg.norm(motion[:3])), float(np.linalg.norm(motion[3:]))
        return far <= 3.0 * self.config.sigma and turned <= 3.0 * self.config.sigma_angle

    def measure(self, frame: LidarScan | RgbdFrame, sigma: float) -> Measurement:
        """The readings of a frame in the frame of the base, those of a lidar moved to the scan's end as predicted.

        `sigma`: metres, standard deviation of a lidar range.
        """
        c = self.config
        if isinstance(frame, RgbdFrame):
            stride = max(1, round(frame.intrinsics.width / c.depth_columns))
            return depth_measurement(frame, stride, c.depth_max_range)
        track = OdometryTrack(MotionConfig())
        for stamp in dict.fromkeys((frame.stamp, scan_end(frame))):
            track.add(Odometry(stamp, self.predicted(stamp), 0.0, 0.0))
        return deskew(frame, track, sigma, c.min_range, c.max_range)

    def predicted(self, stamp: int) -> Float64:
        """(4, 4) T_map_base at `stamp` if the motion between the last two measurements goes on."""
        last, T_last = self._poses[-1]
        if len(self._poses) < 2 or last <= self._poses[0][0]:
            return T_last
        first, T_first = self._poses[0]
        share = min((stamp - last) / (last - first), 2.0)
        return T_last @ interpolate(np.eye(4), inverse(T_first) @ T_last, share)

    def update(self, shots: Measurement) -> Localization:
        """Correct with one measurement; LOST and NO_DATA come with the predicted pose."""
        c, stamp = self.config, shots.stamp
        T = self.predicted(stamp)
        P = np.diag(np.square([c.sigma] * 3 + [c.sigma_angle] * 3))
        if stamp <= self._poses[-1][0]:
            return Localization(stamp, T, P, Status.STALE)
        if len(shots) < c.fine.min_correspondences:
            return Localization(stamp, T, P, Status.NO_DATA)
        best = self._fitted(shots, T, P, T)
        if not best.registration.converged or best.agreement < self._level - c.steady:
            coarse = (register(shots, self.surface, T, P, c.coarse, T_start=S) for S in (T, self._poses[-1][1]))
            best = max((best, *(self._fitted(shots, T, P, start.T_map_base) for start in coarse)), key=_score)
        found, judged = best.registration, best.assessment
        fits = judged.explained >= c.min_share and judged.through <= c.max_through
        if not (fits and found.converged and self.follows(T, found.T_map_base)):
            return Localization(stamp, T, P, Status.LOST, judged.explained, found.residual)
        self._level = best.agreement
        self._poses = [self._poses[-1], (stamp, found.T_map_base)]
        status = Status.OK if found.observed == 6 else Status.DEGRADED
        return Localization(stamp, found.T_map_base, found.covariance, status, judged.explained, found.residual)

    def _fitted(self, shots: Measurement, T_prior: Float64, covariance: Float64, T_start: Float64) -> "_Fit":
        found = register(shots, self.surface, T_prior, covariance, self.config.fine, T_start=T_start)
        view = self.surface.cast(found.T_map_base, shots, stride=2)
        covered = float(np.mean(np.isfinite(view.hits.distances)))
        return _Fit(found, judge(view), covered)


@dataclass(frozen=True, slots=True)
class _Fit:
    """A registration, judged by the shots that meet the map: it may end where a sensor looks now."""

    registration: Registration
    assessment: Assessment
    covered: float
    """Share of the shots that meet the map."""

    @property
    def agreement(self) -> float:
        """Share explained of the shots that meet the map."""
        return self.assessment.explained / self.covered if self.covered else 0.0


def _score(fit: _Fit) -> float:
    """What is explained, less what is contradicted; a pose that merely looks at more of the map gains little."""
    contradicted = fit.covered - fit.assessment.explained
    return fit.assessment.explained - 3.0 * contradicted if fit.registration.converged else -np.inf
