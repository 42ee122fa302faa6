"""From a detection's pose hypotheses to a registered candidate: depth alignment, registration, comparison of fits."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

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

    support: float = 0.88
    """Least share of its unoccluded rays that must confirm it; right poses have 0.9 to 1, near and far."""
    pixels: int = 200
    """Fewest pixels that must confirm it."""
    occluded: float = 0.45
    """Largest share of its rays on which something may stand in front of it."""
    turn: float = np.deg2rad(35.0)
    """Registration may turn a hypothesis by at most this, radians: else it has slid into another minimum."""
    residual: float = 0.0045
    """Largest RMS residual along the normal, metres, at 1 m distance; grows with its square."""
    edges: int = 8
    """Fewest silhouette pixels that must have a depth step behind them: a flat side fits any wall."""
    constrained: int = 4
    """Fewest directions that the data must constrain."""
    rotation_sigma: float = np.deg2rad(6.0)
    """Largest standard deviation of a constrained orientation, radians: a small thing far away fits in many ways."""
    good_support: float = 0.95
    """A fit with less support than this is tried again from turned starts ..."""
    good_misfit: float = 1.2
    """... and so is one with a larger misfit than this many times that of right poses."""
    misfit: float = 1.3
    """A fit with a larger misfit than this many times that of right poses (`NoiseLevel`) is not believed: another
    thing's surface, or fingers before it, fit worse."""
    near_support: float = 0.8
    """Hypotheses with more support than this are registered as they are, and no others are ..."""
    near_margin: float = 0.8
    """... of which a further one is taken if it fits so much better."""
    modes: int = 3
    """Up to so many frequent depth differences are tried: the most frequent one may be that of an occluder."""
    survivors: int = 4
    """So many of the starts are gone on with after the first casts."""
    promising: float = 0.4
    """... unless it has even less support than this: nothing like the model is there."""
    hopeless: float = 0.02
    """Starts of which none has more support than this after the first casts, with their wide gates, are given up."""
    retry_angle: float = np.deg2rad(14.0)
    """How far those starts are turned, radians."""
    align_reach: float = 0.3
    """Depth differences up to this are considered when a hypothesis is slid along its viewing ray, metres."""


def cost(result: RegistrationResult, gate: float = 0.012) -> float:
    """Mean squared residual of a registered pose, seen-through rays counting as a large one; lower is better, m^2.

    Args:
        result: of the registration.
        gate: that residual, metres, at 1 m distance; it grows with its square, as the errors of depth do.
    """
    seen = result.supported + result.missing
    if seen == 0:
        return np.inf
    large = gate * max(1.0, float(result.T_camera_object[2, 3])) ** 2
    return (result.residual**2 * result.supported + large**2 * result.missing) / seen


def believable(result: RegistrationResult, config: FitConfig, noise: float) -> bool:
    """Whether a registered pose is well supported by the measurements; `noise` is the misfit of right poses."""
    z = float(result.T_camera_object[2, 3])
    variances = np.linalg.eigvalsh(result.covariance[3:, 3:])
    known = variances[variances < 1.0]  # unconstrained directions have far larger ones
    return (
        result.support >= config.support
        and result.supported * result.stride**2 >= config.pixels
        and result.residual <= config.residual * max(1.0, z) ** 2
        and fits_noise(result, config, noise)
        and result.edges >= config.edges
        and result.constrained >= config.constrained
        and result.occluded <= config.occluded * result.rays
        and bool(np.all(known <= config.rotation_sigma**2))
    )


def fits_noise(result: RegistrationResult, config: FitConfig, noise: float) -> bool:
    """Whether a registered pose's residuals are those of the sensor."""
    return result.misfit <= config.misfit * noise


class NoiseLevel:
    """The misfit of right poses, learned from tracks: what the sensor's noise is of what the registration takes it for.

    A sensor as good as the model of it gives about 1, one with half its noise 0.25. 1 until a track has told.
    """

    def __init__(self) -> None:
        self.value = 1.0
        self._told = False

    def learn(self, misfits: Sequence[float]) -> None:
        """Take the misfits of the tracks of one frame that leave no doubt."""
        if misfits:
            told = float(np.median(misfits))
            self.value += (0.1 if self._told else 1.0) * (told - self.value)
            self._told = True


Occluders: TypeAlias = Mapping[int, tuple[TrackedModel, Float64]]
"""Track id -> model and T_camera_object of what is believed to stand around a candidate."""


class Prober:
    """Registers one candidate at a time in a scene of its own, among the objects that are believed already."""

    def __init__(self, registration: RegistrationConfig, fit: FitConfig) -> None:
        wide = Step(gate=0.06, kernel=16.0, edge_reach=18, silhouettes="always", coarsen=2)
        schedule = (wide, wide, *registration.schedule)
        probe = replace(registration, schedule=schedule)
        self._fit = fit
        self._coarse = [replace(step, repeats=1, coarsen=2) for step in schedule[:5]]
        self._refine = [replace(step, repeats=min(step.repeats, 2)) for step in schedule[3:]]
        self._follow = registration.track_schedule
        self._narrow = [replace(step, repeats=2, coarsen=2) for step in registration.track_schedule]
        self._held = [replace(registration.near, repeats=6), replace(registration.track_schedule[-1], repeats=4)]
        self._registration = Registration(probe)
        self._shown: dict[int, TrackedModel] = {}
        self._fixed: dict[int, Float64] = {}
        self._noise = 1.0

    def close(self) -> None:
        """Release the scene's memory."""
        self._registration.close()

    def count_casts(self, on_cast: Callable[[], None] | None) -> None:
        """Have a function called before every cast from now on."""
        self._registration.on_cast = on_cast

    def best(
        self,
        hypotheses: Sequence[PoseHypothesis],
        model: TrackedModel,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        occluders: Occluders,
        noise: float = 1.0,
    ) -> RegistrationResult | None:
        """Register each alternative and return the one that fits best, or None if none can be believed.

        `noise` is the misfit of right poses, see `NoiseLevel`.
        """
        self._noise = noise
        self._show(model, occluders)
        near = self._near(hypotheses, depth, intrinsics)
        found = self._settled(near, depth, intrinsics) if near else self._searched(hypotheses, depth, intrinsics)
        if found is not None:
            return found
        # What is in a hand has the hand's surface closely before it, to which wider gates lead away.
        held = [self._register(h.T_camera_object, depth, intrinsics, self._held) for h in hypotheses]
        return min((r for r in held if r is not None and believable(r, self._fit, noise)), key=cost, default=None)

    def _searched(
        self, hypotheses: Sequence[PoseHypothesis], depth: Float32, intrinsics: CameraIntrinsics
    ) -> RegistrationResult | None:
        """The best fit from poses that are slid to the measured depth, if it can be believed."""
        starts = [T for h in hypotheses for T in self._aligned(h.T_camera_object, depth, intrinsics)]
        result = self._best_of(starts, depth, intrinsics)
        if result is not None and self._fit.promising < result.support and not self._good(result):
            turned = [_turned(starts[0], axis, sign * self._fit.retry_angle) for axis in range(3) for sign in (1, -1)]
            result = min((r for r in (result, self._best_of(turned, depth, intrinsics)) if r), key=cost, default=None)
        if result is None or not believable(result, self._fit, self._noise):
            return None
        turned = min(angle_between(result.T_camera_object[:3, :3], h.T_camera_object[:3, :3]) for h in hypotheses)
        return result if turned <= self._fit.turn else None

    def _near(
        self, hypotheses: Sequence[PoseHypothesis], depth: Float32, intrinsics: CameraIntrinsics
    ) -> list[Float64]:
        """Poses of the hypotheses that agree with the depth image as they are."""
        judged = [
            self._registration.assess(depth, intrinsics, {PROBE: h.T_camera_object}, self._fixed).get(PROBE)
            for h in hypotheses
        ]
        return [r.T_camera_object for r in judged if r is not None and r.support >= self._fit.near_support]

    def _settled(
        self, poses: Sequence[Float64], depth: Float32, intrinsics: CameraIntrinsics
    ) -> RegistrationResult | None:
        """The best fit from poses that are nearly right, if it can be believed.

        Of fits that are about as good the earlier one is taken: the detection knows more than the depth image.
        """
        found: RegistrationResult | None = None
        for T in poses:
            result = self._register(T, depth, intrinsics, self._refine)
            if result is not None and (found is None or cost(result) < self._fit.near_margin * cost(found)):
                found = result
        if found is None or not self._good(found):
            wider = self._best_of(poses, depth, intrinsics)
            found = min((r for r in (found, wider) if r is not None), key=cost, default=None)
        return found if found is not None and believable(found, self._fit, self._noise) else None

    def _good(self, result: RegistrationResult) -> bool:
        return result.support >= self._fit.good_support and result.misfit <= self._fit.good_misfit * self._noise

    def _best_of(
        self, starts: Sequence[Float64], depth: Float32, intrinsics: CameraIntrinsics
    ) -> RegistrationResult | None:
        """Register roughly from each start, and the best of them to the end.

        Wide gates reach far but take what touches the object for the object; narrow ones do not. Both are tried.
        """
        rough = [
            (result, schedule[first:])
            for T in starts
            for schedule, first in ((self._coarse, 2), (self._narrow, 1))
            if (result := self._register(T, depth, intrinsics, schedule[:first])) is not None
        ]
        if not any(result.support > self._fit.hopeless for result, _ in rough):
            return None
        rough.sort(key=lambda entry: cost(entry[0]))
        finer = [
            self._register(result.T_camera_object, depth, intrinsics, rest)
            for result, rest in rough[: self._fit.survivors]
        ]
        found = min((r for r in finer if r is not None), key=cost, default=None)
        if found is None:
            return None
        settled = [self._register(found.T_camera_object, depth, intrinsics, s) for s in (self._refine, self._follow)]
        return min((r for r in settled if r is not None), key=cost, default=None)

    def _register(
        self, T_camera_object: Float64, depth: Float32, intrinsics: CameraIntrinsics, schedule: Sequence[Step]
    ) -> RegistrationResult | None:
        found = self._registration.register(depth, intrinsics, {PROBE: T_camera_object}, self._fixed, schedule)
        return found.get(PROBE)

    def follow(
        self,
        T_camera_object: Float64,
        model: TrackedModel,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        occluders: Occluders,
    ) -> RegistrationResult | None:
        """Register a candidate from a near pose, as the next frame of a track."""
        self._show(model, occluders)
        return self._register(T_camera_object, depth, intrinsics, self._follow)

    def judge(
        self,
        T_camera_object: Float64,
        model: TrackedModel,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        occluders: Occluders,
    ) -> RegistrationResult | None:
        """How well a pose fits as it stands."""
        self._show(model, occluders)
        return self._registration.assess(depth, intrinsics, {PROBE: T_camera_object}, self._fixed).get(PROBE)

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
        self._show(model, {})
        mine = self._registration.explained(depth, intrinsics, PROBE, T_camera_object)
        self._show(other, {})
        theirs = self._registration.explained(depth, intrinsics, PROBE, T_camera_other)
        return float(np.count_nonzero(mine & theirs)) / max(int(np.count_nonzero(mine)), 1)

    def _show(self, model: TrackedModel, occluders: Occluders) -> None:
        """Put a candidate and what stands around it into the scene, and nothing else."""
        wanted = {PROBE: model, **{i: other for i, (other, _) in occluders.items()}}
        for instance in [i for i, shown in self._shown.items() if wanted.get(i) is not shown]:
            self._registration.remove(instance)
            del self._shown[instance]
        for instance in [i for i in wanted if i not in self._shown]:
            self._registration.add(instance, wanted[instance])
            self._shown[instance] = wanted[instance]
        self._fixed = {i: T for i, (_, T) in occluders.items()}

    def _aligned(self, T_camera_object: Float64, depth: Float32, intrinsics: CameraIntrinsics) -> list[Float64]:
        """Slide the model along the viewing ray of its centre until its rendered depth matches the measured one.

        The most frequent differences count, not the mean: the window holds background and occluders too.
        """
        starts = []
        differences = self._differences(T_camera_object, depth, intrinsics, self._fit.align_reach)
        for shift in _modes(differences, 0.03, self._fit.modes):
            T = _slid(T_camera_object, shift)
            finer = _modes(self._differences(T, depth, intrinsics, 0.08), 0.015, 1)
            starts.append(_slid(T, finer[0]) if finer else T)
        return starts or [T_camera_object]

    def _differences(
        self, T_camera_object: Float64, depth: Float32, intrinsics: CameraIntrinsics, reach: float
    ) -> Float64:
        return self._registration.depth_differences(depth, intrinsics, PROBE, T_camera_object, reach, self._fixed)


def _slid(T_camera_object: Float64, shift: float) -> Float64:
    """A pose moved along the viewing ray of its centre by `shift` metres of depth."""
    T = T_camera_object.copy()
    T[:3, 3] *= (T[2, 3] + shift) / T[2, 3]
    return T


def _turned(T: Float64, axis: int, angle: float) -> Float64:
    """A pose turned about its own centre and one of its own axes, radians."""
    turn = np.eye(4)
    turn[:3, :3] = exp_so3(angle * np.eye(3)[axis])
    return T @ turn


def _modes(values: Float64, width: float, count: int) -> list[float]:
    """Means of the values in the fullest windows of the given width, metres, the fullest first.

    Windows do not overlap, and hold at least a fifth of what the first one holds, and 20 values.
    """
    ordered = np.sort(values)
    modes: list[float] = []
    fullest = 0
    while len(modes) < count and len(ordered) >= 20:
        ends = np.searchsorted(ordered, ordered + width, side="right")
        start = int(np.argmax(ends - np.arange(len(ordered))))
        size = int(ends[start]) - start
        fullest = max(fullest, size)
        if size < max(20, 0.2 * fullest):
            break
        modes.append(float(np.mean(ordered[start : ends[start]])))
        ordered = np.concatenate([ordered[:start], ordered[ends[start] :]])
    return modes
