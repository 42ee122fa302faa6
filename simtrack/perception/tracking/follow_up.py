"""A registered candidate, led through the depth images since its own: what it takes to become a track now."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import NANOSECONDS
from simtrack.geometry.transforms import inverse, rotate_covariance
from simtrack.perception.tracking.birth import Occluders, Prober, believable
from simtrack.perception.tracking.filter import Measurement, PoseFilter
from simtrack.perception.tracking.registration import RegistrationResult, TrackedModel
from simtrack.perception.tracking.target import TrackerConfig, View, camera_error_at


@dataclass(slots=True)
class Candidate:
    """A pose that fits the depth image of a detection, and where it has gone since."""

    model: TrackedModel
    fit: RegistrationResult
    """To the detection's own image."""
    filter: PoseFilter
    seen: int
    """Nanoseconds, of the last image to which it could be registered."""
    reached: int
    """Nanoseconds, of the last image that was looked at."""

    @classmethod
    def found(cls, model: TrackedModel, fit: RegistrationResult, view: View, config: TrackerConfig) -> "Candidate":
        """Start at the image of the detection."""
        covariance = rotate_covariance(view.T_map_camera[:3, :3], fit.covariance)
        state = PoseFilter(view.stamp, view.T_map_camera @ fit.T_camera_object, covariance, config.filter)
        return cls(model, fit, state, view.stamp, view.stamp)

    def follow(self, prober: Prober, views: Iterable[tuple[View, Occluders]], config: TrackerConfig) -> None:
        """Register it to later depth images, each with what is believed to stand around."""
        for view, around in views:
            T = inverse(view.T_map_camera) @ self.filter.predict(view.stamp).T_map_object
            followed = prober.follow(T, self.model, view.depth, view.intrinsics, around)
            if followed is not None and believable(followed, config.fit):
                self.filter.update(measurement(view, followed, self.seen, config))
                self.seen = view.stamp
            else:
                self.filter.skip(view.stamp)
            self.reached = view.stamp

    @property
    def lost(self) -> bool:
        """Whether it has not been seen in the last images."""
        return self.reached - self.seen > 0.15 * NANOSECONDS


def measurement(view: View, result: RegistrationResult, last_seen: int, config: TrackerConfig) -> Measurement:
    """A registration in the map frame; the camera's own error wanders, correlated over time since `last_seen`."""
    R = view.T_map_camera[:3, :3]
    elapsed = max(view.stamp - last_seen, 0) / NANOSECONDS
    share = 2.0 * (1.0 - np.exp(-elapsed / config.localization_correlation))
    drift = share * camera_error_at(view, view.T_map_camera @ result.T_camera_object)
    return Measurement(
        view.stamp, view.T_map_camera @ result.T_camera_object, rotate_covariance(R, result.covariance), drift
    )
