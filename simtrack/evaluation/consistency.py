"""Whether stated covariances are honest: the normalised estimation error squared (NEES) of objects and of the robot.

``e^T P^-1 e`` of an unbiased estimate with the covariance that it states is chi-square distributed with as many degrees
of freedom as the error has (Bar-Shalom, Li & Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, 5.4.2). Errors are those of `simtrack.geometry.transforms.perturb`: ``T_true = perturb(T_estimated, e)``.
"""

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np

from simtrack.contracts import Float64, Localization
from simtrack.evaluation.metrics import Metrics, measured, quantile, ratio, unmeasured
from simtrack.evaluation.pose_errors import SymmetriesLike, closest_equivalent
from simtrack.evaluation.tracking import ObjectFrame
from simtrack.geometry.transforms import difference

CONFIDENCE = 0.95
"""Probability of the two-sided bounds."""
FIXED = 1e-12
"""m^2 or rad^2: a direction of less variance is taken for given, as the height of a robot on a floor."""


@cache
def bounds(freedom: int) -> tuple[float, float]:
    """Two-sided `CONFIDENCE` bounds of a chi-square variable with so many degrees of freedom."""
    from scipy.special import gammaincinv  # scipy.stats takes a second to import

    tail = 0.5 * (1.0 - CONFIDENCE)
    return 2.0 * float(gammaincinv(0.5 * freedom, tail)), 2.0 * float(gammaincinv(0.5 * freedom, 1.0 - tail))


def nees(error: Float64, covariance: Float64) -> tuple[float, int]:
    """NEES of a (D,) error under a (D, D) covariance, and its degrees of freedom: the directions that are not given."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    free = values > FIXED
    along = vectors[:, free].T @ error
    return float(np.sum(along**2 / values[free])), int(np.count_nonzero(free))


def pose_nees(
    T_estimated: Float64, covariance: Float64, T_true: Float64, symmetries: SymmetriesLike | None = None
) -> tuple[float, int]:
    """NEES of a (4, 4) pose and its degrees of freedom; turns about an axis of symmetry are no error and no freedom."""
    if symmetries is None:
        return nees(difference(T_true, T_estimated), covariance)
    error = difference(closest_equivalent(T_estimated, T_true, symmetries), T_estimated)
    told = _told(T_estimated, symmetries)
    return nees(told @ error, told @ covariance @ told.T)


def _told(T: Float64, symmetries: SymmetriesLike) -> Float64:
    """(D, 6), orthonormal rows: the directions of an error that the object's looks tell of."""
    if not symmetries.axes:
        return np.eye(6)
    rows = np.zeros((3 if len(symmetries.axes) > 1 else 5, 6))
    rows[:3, :3] = np.eye(3)
    if len(symmetries.axes) == 1:
        axis = T[:3, :3] @ np.asarray(symmetries.axes[0].axis, dtype=float)
        _, _, basis = np.linalg.svd(axis[None])
        rows[3:, 3:] = basis[1:]
    return rows


class Consistency:
    """Collects the NEES of one kind of estimate."""

    def __init__(self, prefix: str, missing: str) -> None:
        """`prefix` of the metrics; `missing`: why there are none, if nothing comes."""
        self._prefix, self._missing = prefix, missing
        self._values: list[tuple[float, int]] = []

    def add(self, value: float, freedom: int) -> None:
        """Take one; without a degree of freedom it tells nothing."""
        if freedom:
            self._values.append((value, freedom))

    def metrics(self) -> Metrics:
        """``<prefix>.nees.*``: per degree of freedom (1 is right), shares inside and outside of the bounds."""
        normalised = np.array([value / freedom for value, freedom in self._values])
        sides = np.array([np.searchsorted(bounds(freedom), value) for value, freedom in self._values])
        name = f"{self._prefix}.nees"
        metrics: Metrics = {f"{name}.per_freedom.median": quantile(normalised, 0.5, "1", self._missing)}
        mean = measured(normalised.mean(), "1") if normalised.size else unmeasured("1", self._missing)
        metrics[f"{name}.per_freedom.mean"] = mean
        for side, what in enumerate(("below_share", "inside_share", "above_share")):
            metrics[f"{name}.{what}"] = ratio(np.count_nonzero(sides == side), len(sides), self._missing)
        freedom = max((freedom for _, freedom in self._values), default=6)
        for what, bound in zip(("lower_bound", "upper_bound"), bounds(freedom), strict=True):
            metrics[f"{name}.{what}"] = measured(bound, "1")
        return metrics


class ConsistencyEvaluator:
    """NEES of the robot's pose and of the objects that are scored and tracked, at every camera stamp."""

    def __init__(self, symmetries: Mapping[str, SymmetriesLike]) -> None:
        """`symmetries` of the models, by class name."""
        self._symmetries = symmetries
        self._robot = Consistency("localization", "no frame was processed")
        self._objects = Consistency("tracking", "no object was scored and tracked")

    def observe_robot(self, localization: Localization, T_map_base: Float64) -> None:
        """Take one believed and one true (4, 4) pose."""
        self._robot.add(*pose_nees(localization.T_map_base, localization.covariance, T_map_base))

    def observe_objects(self, frames: Sequence[ObjectFrame], T_map_object: Mapping[str, Float64]) -> None:
        """Take the object-frames of one stamp and the (4, 4) true poses by the objects' names."""
        for frame in frames:
            if frame.scored and frame.track is not None:
                track, symmetries = frame.track, self._symmetries[frame.class_name]
                T_true = T_map_object[frame.name]
                self._objects.add(*pose_nees(track.T_map_object, track.covariance, T_true, symmetries))

    def metrics(self) -> Metrics:
        """``localization.nees.*`` and ``tracking.nees.*``."""
        return self._robot.metrics() | self._objects.metrics()
