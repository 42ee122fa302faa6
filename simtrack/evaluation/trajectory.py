"""Errors of the robot's trajectory: absolute (ATE), relative (RPE), in the map and without any alignment.

Definitions after Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012. There trajectories
are aligned first; here both are poses in the same surveyed map, so that a shift is an error and none is taken away.

A run starts from a pose that is given with an error. Until the first scan is complete and has been matched nobody can
know better, so errors of a run count from `SETTLED` on; when the belief was first trusted is a figure of its own.
"""

from collections.abc import Sequence

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64, Localization, Status
from simtrack.evaluation.metrics import Metrics, measured, quantile, ratio, unmeasured
from simtrack.geometry.transforms import angle_between, inverse

SETTLED = NANOSECONDS // 2
"""Stamp from which errors of a run count, nanoseconds: five turns of the lidar after its start."""


def absolute_errors(estimated: Sequence[Float64], true: Sequence[Float64]) -> tuple[Float64, Float64]:
    """(N,) translation errors in metres and (N,) rotation errors in radians of (4, 4) poses, pair by pair."""
    translation = [np.linalg.norm(e[:3, 3] - t[:3, 3]) for e, t in zip(estimated, true, strict=True)]
    rotation = [angle_between(e[:3, :3], t[:3, :3]) for e, t in zip(estimated, true, strict=True)]
    return np.array(translation, dtype=float), np.array(rotation, dtype=float)


def relative_errors(
    stamps: Sequence[int], estimated: Sequence[Float64], true: Sequence[Float64], delta: float = 1.0
) -> tuple[Float64, Float64]:
    """Errors of the motion over `delta` seconds: metres and radians, one for every pose that has a partner."""
    times = np.asarray(stamps, dtype=np.int64)
    partners = np.searchsorted(times, times + round(delta * NANOSECONDS))
    pairs = [(i, int(j)) for i, j in enumerate(partners) if j < len(times)]
    moves_est = [inverse(estimated[i]) @ estimated[j] for i, j in pairs]
    moves_true = [inverse(true[i]) @ true[j] for i, j in pairs]
    return absolute_errors(moves_est, moves_true)


def rmse(errors: Float64) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(errors))))


class TrajectoryEvaluator:
    """Collects true and believed poses of the robot's base, one pair a camera stamp."""

    def __init__(self, since: int = 0) -> None:
        """Errors count from the stamp `since` on, nanoseconds."""
        self._since = since
        self.stamps: list[int] = []
        self.estimated: list[Float64] = []
        self.true: list[Float64] = []
        self._trusted: list[int] = []

    def observe(self, stamp: int, localization: Localization, T_map_base: Float64) -> None:
        """Take one believed and one true pose."""
        self.stamps.append(stamp)
        self.estimated.append(localization.T_map_base)
        self.true.append(T_map_base)
        if localization.status is Status.OK:
            self._trusted.append(stamp)

    def metrics(self) -> Metrics:
        """The ``localization.*`` metrics."""
        missing = "no frame was processed"
        metrics: Metrics = {"localization.trusted_share": ratio(len(self._trusted), len(self.stamps), missing)}
        waited = [(stamp - self.stamps[0]) / NANOSECONDS for stamp in self._trusted[:1]]
        metrics["localization.first_trusted"] = measured(waited[0], "s") if waited else unmeasured("s", "never trusted")
        first = int(np.searchsorted(self.stamps, self._since))
        stamps, estimated, true = self.stamps[first:], self.estimated[first:], self.true[first:]
        translation, rotation = absolute_errors(estimated, true)
        missing = f"no frame was processed after the first {self._since / NANOSECONDS:g} s"
        for name, unit, errors in (("ate", "m", translation), ("rotation", "rad", rotation)):
            empty = unmeasured(unit, missing)
            metrics[f"localization.{name}_rmse"] = measured(rmse(errors), unit) if errors.size else empty
            metrics[f"localization.{name}_max"] = measured(errors.max(), unit) if errors.size else empty
        translation, rotation = relative_errors(stamps, estimated, true)
        missing = f"the run was shorter than a second after the first {self._since / NANOSECONDS:g} s"
        for name, unit, errors in (("translation", "m", translation), ("rotation", "rad", rotation)):
            found = measured(rmse(errors), unit) if errors.size else unmeasured(unit, missing)
            metrics[f"localization.rpe.{name}.rmse"] = found
        metrics["localization.rpe.translation.median"] = quantile(translation, 0.5, "m", missing)
        metrics["localization.rpe.rotation.median"] = quantile(rotation, 0.5, "rad", missing)
        steps = np.diff([T[:2, 3] for T in self.true], axis=0) if len(self.true) > 1 else np.zeros((0, 2))
        metrics["localization.distance_driven"] = measured(np.linalg.norm(steps, axis=1).sum(), "m")
        return metrics
