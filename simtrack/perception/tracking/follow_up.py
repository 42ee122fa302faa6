"""A registered candidate, led through the depth images since its own: what it takes to become a track now."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64
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
    T_base_object: Float64
    """(4, 4), in the last image to which it could be registered."""
    seen: int
    """Nanoseconds, of that image."""
    reached: int
    """Nanoseconds, of the last image that was looked at."""
    frames: int = 0
    """Later images to which it could be registered."""

    @classmethod
    def found(cls, model: TrackedModel, fit: RegistrationResult, view: View, config: TrackerConfig) -> "Candidate":
        """Start at the image of the detection."""
        T_base_object = view.T_base_camera @ fit.T_camera_object
        return cls(model, fit, _filter(fit, view, config), T_base_object, view.stamp, view.stamp)

    def follow(self, prober: Prober, views: Iterable[tuple[View, Occluders]], config: TrackerConfig) -> None:
        """Register it to later depth images, each with what is believed to stand around.

        Where it is not to be found where it was in the map, the robot may have learned meanwhile that it stands
        elsewhere: it is looked for where it was before the robot.
        """
        for view, around in views:
            self.reached = view.stamp
            in_map = inverse(view.T_map_camera) @ self.filter.predict(view.stamp).T_map_object
            result = self._registered(in_map, prober, view, around, config)
            if result is not None:
                self.filter.update(measurement(view, result, self.seen, config))
            else:
                before_robot = inverse(view.T_base_camera) @ self.T_base_object
                result = self._registered(before_robot, prober, view, around, config)
                if result is None:
                    self.filter.skip(view.stamp)
                    continue
                self.filter = _filter(result, view, config)
            self.T_base_object = view.T_base_camera @ result.T_camera_object
            self.seen = view.stamp
            self.frames += 1

    def _registered(
        self, T_camera_object: Float64, prober: Prober, view: View, around: Occluders, config: TrackerConfig
    ) -> RegistrationResult | None:
        """Registered to a view from a pose (4, 4), if what comes of it can be believed."""
        result = prober.follow(T_camera_object, self.model, view.depth, view.intrinsics, around)
        return result if result is not None and believable(result, config.fit, view.noise) else None

    @property
    def lost(self) -> bool:
        """Whether it has not been seen in the last images."""
        return self.reached - self.seen > 0.15 * NANOSECONDS


def _filter(result: RegistrationResult, view: View, config: TrackerConfig) -> PoseFilter:
    """That of an object at rest, known from one image."""
    covariance = rotate_covariance(view.T_map_camera[:3, :3], result.covariance)
    return PoseFilter(view.stamp, view.T_map_camera @ result.T_camera_object, covariance, config.filter)


def measurement(view: View, result: RegistrationResult, last_seen: int, config: TrackerConfig) -> Measurement:
    """A registration in the map frame; the camera's own error wanders, correlated over time since `last_seen`."""
    R = view.T_map_camera[:3, :3]
    elapsed = max(view.stamp - last_seen, 0) / NANOSECONDS
    share = 2.0 * (1.0 - np.exp(-elapsed / config.localization_correlation))
    drift = share * camera_error_at(view, view.T_map_camera @ result.T_camera_object)
    return Measurement(
        view.stamp, view.T_map_camera @ result.T_camera_object, rotate_covariance(R, result.covariance), drift
    )
