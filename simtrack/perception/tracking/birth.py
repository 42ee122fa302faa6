"""From a detection's pose hypotheses to a registered candidate: depth alignment, registration, comparison of fits."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Float64, PoseHypothesis
from simtrack.geometry.transforms import angle_between, exp_so3
from simtrack.perception.tracking.registration import (
    Registration,
    RegistrationConfig,
    RegistrationResult,
    Step,
    TrackedModel,
)

PROBE = 0
"""Instance id of the candidate in its own scene."""


@dataclass(frozen=True, slots=True)
class FitConfig:
    """When a registered candidate is believed to be there."""

    support: float = 0.8
    """Least share of its unoccluded rays that must confirm it."""
    pixels: int = 150
    """Fewest pixels that must confirm it."""
    occluded: float = 0.45
    """Largest share of its rays on which something may stand in front of it."""
    turn: float = np.deg2rad(35.0)
    """Registration may turn a hypothesis by at most this, radians: else it has slid into another minimum."""
    residual: float = 0.0045
    """Largest RMS residual along the normal, metres, at 1 m distance; grows with its square."""
    constrained: int = 4
    """Fewest directions that the data must constrain."""
    rotation_sigma: float = np.deg2rad(2.5)
    """Largest standard deviation of a constrained orientation, radians: a small thing far away fits in many ways."""
    good_support: float = 0.95
    """A fit with less support than this is tried again from turned starts ..."""
    good_misfit: float = 1.3
    """... and so is one with a larger misfit than this."""
    promising: float = 0.4
    """... unless it has even less support than this: nothing like the model is there."""
    retry_angle: float = np.deg2rad(14.0)
    """How far those starts are turned, radians."""
    align_reach: float = 0.3
    """Depth differences up to this are considered when a hypothesis is slid along its viewing ray, metres."""


def cost(result: RegistrationResult, gate: float = 0.012) -> float:
    """Mean squared residual of a registered pose, seen-through rays counting as `gate` metres; lower is better, m^2."""
    seen = result.supported + result.missing
    if seen == 0:
        return np.inf
    return (result.residual**2 * result.supported + gate**2 * result.missing) / seen


def believable(result: RegistrationResult, config: FitConfig) -> bool:
    """Whether a registered pose is well supported by the measurements."""
    z = float(result.T_camera_object[2, 3])
    variances = np.linalg.eigvalsh(result.covariance[3:, 3:])
    known = variances[variances < 1.0]  # unconstrained directions have far larger ones
    return (
        result.support >= config.support
        and result.supported * result.stride**2 >= config.pixels
        and result.residual <= config.residual * max(1.0, z) ** 2
        and result.constrained >= config.constrained
        and result.occluded <= config.occluded * result.rays
        and bool(np.all(known <= config.rotation_sigma**2))
    )


class Prober:
    """Registers one candidate at a time in a scene of its own."""

    def __init__(self, registration: RegistrationConfig, fit: FitConfig) -> None:
        wide = Step(gate=0.06, kernel=16.0, edge_reach=18, silhouettes="always", coarsen=2)
        schedule = (wide, wide, *registration.schedule)
        probe = replace(registration, schedule=schedule)
        self._fit = fit
        self._coarse = [replace(step, repeats=1, coarsen=2) for step in schedule[:5]]
        self._refine = schedule[3:]
        self._follow = registration.track_schedule
        self._registration = Registration(probe)
        self._model: TrackedModel | None = None

    def close(self) -> None:
        """Release the scene's memory."""
        self._registration.close()

    def best(
        self,
        hypotheses: Sequence[PoseHypothesis],
        model: TrackedModel,
        depth: Float32,
        intrinsics: CameraIntrinsics,
    ) -> RegistrationResult | None:
        """Register each alternative and return the one that fits best, or None if none can be believed."""
        self._show(model)
        starts = [self._align_depth(h.T_camera_object, depth, intrinsics) for h in hypotheses]
        result = self._best_of(starts, depth, intrinsics)
        if result is not None and self._fit.promising < result.support and not self._good(result):
            turned = [_turned(starts[0], axis, sign * self._fit.retry_angle) for axis in range(3) for sign in (1, -1)]
            result = min((r for r in (result, self._best_of(turned, depth, intrinsics)) if r), key=cost, default=None)
        if result is None or not believable(result, self._fit):
            return None
        turned = min(angle_between(result.T_camera_object[:3, :3], h.T_camera_object[:3, :3]) for h in hypotheses)
        return result if turned <= self._fit.turn else None

    def _good(self, result: RegistrationResult) -> bool:
        return result.support >= self._fit.good_support and result.misfit <= self._fit.good_misfit

    def _best_of(
        self, starts: Sequence[Float64], depth: Float32, intrinsics: CameraIntrinsics
    ) -> RegistrationResult | None:
        """Register roughly from each start, and the best of them to the end."""
        rough = [self._register(T, depth, intrinsics, self._coarse) for T in starts]
        found = min((r for r in rough if r is not None), key=cost, default=None)
        if found is None:
            return None
        return self._register(found.T_camera_object, depth, intrinsics, self._refine)

    def _register(
        self, T_camera_object: Float64, depth: Float32, intrinsics: CameraIntrinsics, schedule: Sequence[Step]
    ) -> RegistrationResult | None:
        return self._registration.register(depth, intrinsics, {PROBE: T_camera_object}, schedule=schedule).get(PROBE)

    def follow(
        self, T_camera_object: Float64, model: TrackedModel, depth: Float32, intrinsics: CameraIntrinsics
    ) -> RegistrationResult | None:
        """Register a candidate from a near pose, as the next frame of a track."""
        self._show(model)
        return self._register(T_camera_object, depth, intrinsics, self._follow)

    def judge(
        self, T_camera_object: Float64, model: TrackedModel, depth: Float32, intrinsics: CameraIntrinsics
    ) -> RegistrationResult | None:
        """How well a pose fits as it stands."""
        self._show(model)
        return self._registration.assess(depth, intrinsics, {PROBE: T_camera_object}).get(PROBE)

    def shared(
        self,
        T_camera_object: Float64,
        model: TrackedModel,
        T_camera_other: Float64,
        other: TrackedModel,
        depth: Float32,
        intrinsics: CameraIntrinsics,
    ) -> float:
        """Share of the measurements on a candidate that another object, where it stands, explains as well, 0 to 1.

        A thing in a container shares its place with it, but not its surface.
        """
        self._show(model)
        mine = self._registration.explained(depth, intrinsics, PROBE, T_camera_object)
        self._show(other)
        theirs = self._registration.explained(depth, intrinsics, PROBE, T_camera_other)
        return float(np.count_nonzero(mine & theirs)) / max(int(np.count_nonzero(mine)), 1)

    def _show(self, model: TrackedModel) -> None:
        if self._model is not model:
            if self._model is not None:
                self._registration.remove(PROBE)
            self._registration.add(PROBE, model)
            self._model = model

    def _align_depth(self, T_camera_object: Float64, depth: Float32, intrinsics: CameraIntrinsics) -> Float64:
        """Slide the model along the viewing ray of its centre until its rendered depth matches the measured one.

        The most frequent difference counts, not the mean: the window holds background and occluders too.
        """
        T = T_camera_object.copy()
        for reach, width in ((self._fit.align_reach, 0.03), (0.08, 0.015)):
            differences = self._registration.depth_differences(depth, intrinsics, PROBE, T, reach)
            if len(differences) < 20:
                return T
            shift = _mode(differences, width)
            T[:3, 3] *= (T[2, 3] + shift) / T[2, 3]
        return T


def _turned(T: Float64, axis: int, angle: float) -> Float64:
    """A pose turned about its own centre and one of its own axes, radians."""
    turn = np.eye(4)
    turn[:3, :3] = exp_so3(angle * np.eye(3)[axis])
    return T @ turn


def _mode(values: Float64, width: float) -> float:
    """Mean of the values in the fullest window of the given width, metres."""
    ordered = np.sort(values)
    ends = np.searchsorted(ordered, ordered + width, side="right")
    start = int(np.argmax(ends - np.arange(len(ordered))))
    return float(np.mean(ordered[start : ends[start]]))
