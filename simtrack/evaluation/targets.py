"""What is asked of a run: the numbers that the reference scenes are judged by."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simtrack.evaluation.detector_choice import ORACLE
from simtrack.evaluation.metrics import Metric


@dataclass(frozen=True, slots=True)
class Target:
    """A bound on one metric."""

    limit: float
    at_most: bool = True
    """False: the metric has to be at least the limit."""
    strict: bool = False
    """The limit itself does not suffice."""

    @property
    def sign(self) -> str:
        """``<=``, ``<``, ``>=`` or ``>`` as printed."""
        return ("<" if self.at_most else ">") + ("" if self.strict else "=")

    def met(self, metric: Metric) -> bool | None:
        """Whether a metric keeps the bound; None if it has no value."""
        if metric.value is None:
            return None
        if self.strict and metric.value == self.limit:
            return False
        return metric.value <= self.limit if self.at_most else metric.value >= self.limit


def _least(limit: float, strict: bool = False) -> Target:
    return Target(limit, at_most=False, strict=strict)


WORKBENCH: Mapping[str, Target] = {
    "localization.ate_rmse": Target(0.01),
    "localization.rotation_rmse": Target(float(np.radians(0.2))),
    "tracking.static.translation_error.median": Target(0.0015),
    "tracking.static.translation_error.p95": Target(0.005),
    "tracking.moving.translation_error.median": Target(0.005),
    "tracking.moving.translation_error.p95": Target(0.015),
    "tracking.rotation_error.median": Target(float(np.radians(1.0))),
    "tracking.floor_ratio": Target(1.5),
    "tracking.add_s_auc": _least(0.93),
    "tracking.recall": _least(0.90),
    "tracking.false_tracks": Target(1),
    "tracking.id_switches": Target(0),
    "tracking.first_track_time.max": Target(1.0),
    "tracking.reacquisition_time.p95": Target(1.0),
    "world.known_share": _least(0.85),
    "loop.gaze_gain": _least(0.0, strict=True),
    "presegmentation.camera.known_rejected": _least(0.95),
    "presegmentation.camera.unknown_recall": _least(0.98),
    "presegmentation.lidar.known_rejected": _least(0.95),
    "presegmentation.lidar.unknown_recall": _least(0.98),
    "presegmentation.objects_found": _least(0.95),
    "relations.f1": _least(0.95),
    "speed.frames_per_second": _least(8.0),
    "speed.peak_memory": Target(1.5e9),
}
LAB_FLOOR: Mapping[str, Target] = {
    "localization.ate_rmse": Target(0.02),
    "localization.distance_driven": _least(30.0),
}
FROM_IMAGES: Mapping[str, Target] = {"tracking.add_s_auc": _least(0.90), "speed.frames_per_second": _least(5.0)}
"""What is asked otherwise where objects are detected in images, not by the oracle."""
_BY_SCENE = {"workbench": WORKBENCH, "lab_floor": LAB_FLOOR}


def targets_of(scene: str, detector: str) -> Mapping[str, Target]:
    """Metric -> what is asked of it in a scene with a detector; empty for a scene of the user's own."""
    targets = _BY_SCENE.get(scene, {})
    if detector == ORACLE:
        return targets
    return {name: FROM_IMAGES.get(name, target) for name, target in targets.items()}
