"""The noise floor: how well the same registration does when it starts from the truth, on the same noisy data.

What is left then is due to the sensor, the imperfect model and the share of it that can be seen, not to the tracker. An
error of the tracker is best read as a multiple of this floor.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from simtrack.contracts import Float64, RgbdFrame
from simtrack.evaluation.metrics import Metrics, quantile
from simtrack.evaluation.pose_errors import PoseScorer
from simtrack.evaluation.tracking import ObjectFrame

if TYPE_CHECKING:
    from simtrack.objects import ObjectModel
    from simtrack.perception.tracking.registration import RegistrationConfig

SMALLEST_FLOOR = 1e-5
"""Metres: a floor below is luck (one draw of the noise that hits the truth), and no ratio is taken against less."""


class RegistersFromTruth(Protocol):
    """The tracker's registration, started from given poses."""

    def __call__(self, frame: RgbdFrame, starts: Mapping[str, tuple[str, Float64]]) -> Mapping[str, Float64]:
        """Register objects in one frame.

        `starts`: name -> (class name, (4, 4) T_camera_object to start from), all objects of the scene, so that they
        occlude each other as they do. Returns name -> (4, 4) T_camera_object for those that could be registered.
        """
        ...


class RegistrationFromTruth:
    """The ray-tracing tracker's registration with the tracker's own models and schedule, in a scene of its own."""

    def __init__(self, models: "Mapping[str, ObjectModel]", config: "RegistrationConfig | None" = None) -> None:
        """`models`: class name -> the tracker's model."""
        from simtrack.perception.tracking.registration import Registration
        from simtrack.perception.tracking.target import tracked_model

        self._registration = Registration(config)
        self._models = {name: tracked_model(model) for name, model in models.items()}
        self._instances: dict[str, int] = {}

    def __call__(self, frame: RgbdFrame, starts: Mapping[str, tuple[str, Float64]]) -> Mapping[str, Float64]:
        """See `RegistersFromTruth`."""
        for name, (class_name, _) in starts.items():
            if name not in self._instances:
                self._instances[name] = len(self._instances)
                self._registration.add(self._instances[name], self._models[class_name])
        poses = {self._instances[name]: T for name, (_, T) in starts.items()}
        config = self._registration.config
        schedule = [*config.track_schedule, *([config.finish] if config.finish else [])]
        results = self._registration.register(frame.depth, frame.intrinsics, poses, schedule=schedule)
        return {
            name: results[number].T_camera_object
            for name, number in self._instances.items()
            if number in results and results[number].supported
        }

    def close(self) -> None:
        """Release the scene."""
        self._registration.close()


class FloorEvaluator:
    """Compares the tracker's errors with those of the registration started from the truth."""

    def __init__(self, register: RegistersFromTruth, scorers: Mapping[str, PoseScorer]) -> None:
        self._register = register
        self._scorers = scorers
        self._ratios: list[float] = []
        self.samples: dict[bool, list[float]] = {False: [], True: []}
        """Moving? -> translation errors of the floor, metres."""
        self.rotations: list[float] = []
        """Rotation errors of the floor, radians."""

    def observe(self, frame: RgbdFrame, objects: Sequence[ObjectFrame]) -> None:
        """Take one depth image and its object-frames."""
        starts = {o.name: (o.class_name, o.T_camera_object) for o in objects}
        registered = self._register(frame, starts)
        for thing in objects:
            if not thing.scored or thing.track is None or thing.name not in registered:
                continue
            scorer = self._scorers[thing.class_name]
            translation, rotation = scorer.errors(registered[thing.name], thing.T_camera_object)
            self.samples[thing.moving].append(translation)
            self.rotations.append(rotation)
            self._ratios.append(thing.translation_error / max(translation, SMALLEST_FLOOR))

    def metrics(self) -> Metrics:
        """`tracking.floor_ratio` and the floors themselves."""
        missing = "no object was tracked and registered from the truth in the same frame"
        return {
            "tracking.floor_ratio": quantile(self._ratios, 0.5, "1", missing),
            "tracking.floor.static.translation_error.median": quantile(self.samples[False], 0.5, "m", missing),
            "tracking.floor.moving.translation_error.median": quantile(self.samples[True], 0.5, "m", missing),
            "tracking.floor.static.translation_error.p95": quantile(self.samples[False], 0.95, "m", missing),
            "tracking.floor.moving.translation_error.p95": quantile(self.samples[True], 0.95, "m", missing),
            "tracking.floor.rotation_error.median": quantile(np.array(self.rotations), 0.5, "rad", missing),
        }
