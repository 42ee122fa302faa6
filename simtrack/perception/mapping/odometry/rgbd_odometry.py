"""Where a handheld RGB-D camera is, from its images alone.

Corners that an image shares with an earlier one, the keyframe, tell the pose of the camera beside that; where there are
too few, OpenCV's RGB-D odometry tells the step from the image before. Either is refined against the signed distance
field of all frames so far (Bylow, Sturm, Kerl, Kahl, Cremers, RSS 2013), which keeps errors from adding up where the
camera comes by again. A camera that is lost is looked for in all keyframes.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64, RgbdFrame, Status
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import difference, inverse, perturb
from simtrack.perception.mapping.odometry import field_kernels as kernels
from simtrack.perception.mapping.odometry.dense import DenseSteps
from simtrack.perception.mapping.odometry.features import (
    FeatureConfig,
    FeatureMatcher,
    FeaturePose,
    Features,
)
from simtrack.perception.mapping.panoptic.volume import Volume, VolumeConfig
from simtrack.perception.segmentation.frames import reduced_frame


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """Settings of `RgbdOdometry`."""

    columns: int = 320
    """Images are reduced to about so many columns."""
    voxel: float = 0.03
    """Metres, of the field."""
    truncation: float = 5.0
    """Voxels: a guess must be off by less."""
    max_depth: float = 4.5
    """Metres; farther readings are not used."""
    points: int = 6
    """Every so many-th row and column of the reduced image is aligned with the field."""
    steps: int = 15
    """Of Gauss-Newton at most."""
    robust: float = 0.03
    """Metres from the surface beyond which a point counts less, and as one that does not fit."""
    reading: float = 0.01
    """Metres at one metre: standard deviation of a point's distance, enlarged for what neighbouring ones share."""
    features: FeatureConfig = field(default_factory=FeatureConfig)
    """Of the corners."""
    agreeing: int = 20
    """Corners that must agree on the pose beside a keyframe for it to be believed; images with fewer corners are
    followed without ..."""
    enough: int = 80
    """... and with fewer that agree, OpenCV's step is asked for, too, and the image is compared with a nearer keyframe
    from then on, or becomes one."""
    same: float = 0.8
    """Share of them that must agree on OpenCV's step, too, within `off` pixels, for it to be believed."""
    off: float = 3.0
    corner: float = 8.0
    """Pixels of the reduced image: standard deviation of a corner, enlarged for what those of one image share."""
    prior: tuple[float, float] = (0.003, 0.002)
    """Metres and radians: standard deviations of a step as OpenCV tells it ..."""
    blind: tuple[float, float] = (0.05, 0.05)
    """... and of one that is guessed."""
    least_known: float = 0.2
    """Share of the points that must lie where the field is known ..."""
    least_near: float = 0.75
    """... and share of those that must fit, for the pose to be believed."""
    acceleration: float = 3.0
    """m/s^2: a step of OpenCV's that asks for more, and `slack` metres, is not believed: it saw one wall alone."""
    speed: float = 1.5
    """m/s: the same where the step before is not known."""
    slack: float = 0.02
    max_translation: float = 0.5
    """Metres from frame to frame."""
    max_rotation: float = 0.6
    """Radians."""

    def __post_init__(self) -> None:
        for name, least in (("columns", 32), ("points", 1), ("steps", 1), ("agreeing", 6), ("enough", 6)):
            if not least <= getattr(self, name) <= 10_000:
                raise InvalidValueError(f"OdometryConfig.{name}", getattr(self, name), f"{least} to 10000")
        for name in ("voxel", "truncation", "max_depth", "robust", "reading", "acceleration", "speed", "slack"):
            if not 0.0 < getattr(self, name) < 100.0:
                raise InvalidValueError(f"OdometryConfig.{name}", getattr(self, name), "above 0 and below 100")
        for name in ("max_translation", "max_rotation"):
            if not 0.0 < getattr(self, name) < 3.0:
                raise InvalidValueError(f"OdometryConfig.{name}", getattr(self, name), "above 0 and below 3")
        for name in ("least_known", "least_near"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidValueError(f"OdometryConfig.{name}", getattr(self, name), "a share, 0 to 1")


@dataclass(frozen=True, slots=True)
class OdometryResult:
    """Where the camera is."""

    status: Status
    """OK, NO_DATA or LOST."""
    T_map_camera: Float64 | None
    """(4, 4); None where it is not known."""
    near: float = 0.0
    """Share of the points in known space that fit it."""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """An image that others are compared with."""

    T_map_camera: Float64
    """(4, 4)."""
    features: Features


@dataclass(frozen=True, slots=True, eq=False)
class _Image:
    """A frame as it is compared with others."""

    frame: RgbdFrame
    """Reduced, without what is too far."""
    features: Features


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    """Where the camera may be, before it is refined."""

    T_map_camera: Float64
    """(4, 4)."""
    information: Float64
    """(6, 6), for a perturbation in metres and radians."""
    keyframe: int | None = None
    """Number of the one that it was told by ..."""
    agreeing: int = 0
    """... and corners that say so."""


class RgbdOdometry:
    """Follows a camera; a frame that does not fit what was seen has no pose, and the next one is tried."""

    def __init__(self, T_map_camera: Float64 | None = None, config: OdometryConfig | None = None) -> None:
        """Begin at a pose, at the origin if it is None."""
        self.config = config or OdometryConfig()
        self.field = Volume(VolumeConfig(self.config.voxel, self.config.truncation, 1.0))
        self.keyframes: list[Keyframe] = []
        """Images that showed what no earlier one did."""
        self._matcher = FeatureMatcher(self.config.features)
        self._dense = DenseSteps(self.config.max_depth, self.config.max_translation, self.config.max_rotation)
        self._T = np.eye(4) if T_map_camera is None else np.array(T_map_camera, float)
        self._last: _Image | None = None
        """The last image that had a pose."""
        self._step: Float64 | None = None
        """The camera's last step; None if it is not known, as after frames without pose."""
        self._lost = True
        """Whether the frame before has no pose."""
        self._reference = 0
        """Number of the keyframe that images are compared with first."""

    def update(self, frame: RgbdFrame) -> OdometryResult:
        """The pose of the next frame."""
        config = self.config
        small = reduced_frame(frame, max(1, round(frame.intrinsics.width / config.columns)))
        depth = np.where((small.depth > 0.0) & (small.depth <= config.max_depth), small.depth, np.float32(0.0))
        small, K = replace(small, depth=depth), small.intrinsics
        points = kernels.sampled_points(depth, (K.fx, K.fy, K.cx, K.cy), config.points, 4, 0.02)
        if len(points) < 6:
            return OdometryResult(Status.NO_DATA, None)
        image = _Image(small, self._matcher.find(small))
        if self._last is None:
            return self._take(_Guess(self._T, np.eye(6)), self._T, image, 1.0)
        near = 0.0
        for guess in self._guesses(image, self._last):
            T, known, near = self._aligned(points, guess.T_map_camera, guess.information)
            if known >= config.least_known and near >= config.least_near:
                return self._take(guess, T, image, near)
        self._lost, self._step = True, None
        return OdometryResult(Status.LOST, None, near)

    def _take(self, guess: _Guess, T: Float64, image: _Image, near: float) -> OdometryResult:
        self._step = None if self._lost else inverse(self._T) @ T
        self._T, self._last, self._lost = T, image, False
        depth = image.frame.depth
        self.field.integrate(depth, None, np.zeros(depth.shape, np.int32), image.frame.intrinsics, T)
        if guess.keyframe is not None:
            self._reference = guess.keyframe
        if guess.agreeing < self.config.enough and len(image.features) >= self.config.agreeing:
            self._reference = self._nearer_keyframe(T, image)
        return OdometryResult(Status.OK, T.copy(), near)

    def _nearer_keyframe(self, T: Float64, image: _Image) -> int:
        """Number of an earlier keyframe that shows the same, or of this image, which becomes one."""
        if self.keyframes:
            off = [np.abs(difference(T, each.T_map_camera)).max() for each in self.keyframes]
            nearest = int(np.argmin(off))
            found = self._matcher.pose(self.keyframes[nearest].features, image.features, image.frame.intrinsics)
            if found is not None and len(found.points) >= self.config.enough:
                return nearest
        self.keyframes.append(Keyframe(T, image.features))
        return len(self.keyframes) - 1

    def _guesses(self, now: _Image, before: _Image) -> Iterator[_Guess]:
        """Where the camera may be, the likeliest first."""
        config = self.config
        seen = self._match(self._reference, now) if self.keyframes else None
        if seen is None or len(seen.points) < config.enough:
            step = self._dense.step(before.frame, now.frame)
            if step is not None and seen is not None and self._confirmed(self._T @ step, seen):
                yield self._beside(self._reference, seen, self._T @ step)
            elif step is not None and seen is None and self._plausible(step, now):
                yield _Guess(self._T @ step, _information(config.prior))
        if seen is not None:
            yield self._beside(self._reference, seen)
        others = ((k, self._match(k, now)) for k in range(len(self.keyframes)) if k != self._reference)
        elsewhere = [self._beside(k, found) for k, found in others if found is not None]
        yield from sorted(elsewhere, key=lambda guess: -guess.agreeing)[:3]
        if len(now.features) < config.agreeing:
            steps = (np.eye(4),) if self._step is None else (self._step, np.eye(4))
            yield from (_Guess(self._T @ each, _information(config.blind)) for each in steps)

    def _match(self, keyframe: int, image: _Image) -> FeaturePose | None:
        """The pose of an image beside a keyframe, if enough corners agree on it."""
        found = self._matcher.pose(self.keyframes[keyframe].features, image.features, image.frame.intrinsics)
        return None if found is None or len(found.points) < self.config.agreeing else found

    def _confirmed(self, T_map_camera: Float64, seen: FeaturePose) -> bool:
        """Whether the corners that agree on one pose agree on another one (4, 4), too."""
        beside = inverse(self.keyframes[self._reference].T_map_camera) @ T_map_camera
        return seen.agreeing(beside, self.config.off) >= self.config.same * len(seen.points)

    def _beside(self, keyframe: int, found: FeaturePose, T_step: Float64 | None = None) -> _Guess:
        """Where corners of a keyframe say that the camera is, and OpenCV's step, if they confirm it."""
        T = self.keyframes[keyframe].T_map_camera @ found.T_before_now
        told = found.information(T, self.config.corner)
        if T_step is not None:
            T, told = T_step, told + _information(self.config.prior)
        return _Guess(T, told, keyframe, len(found.points))

    def _plausible(self, step: Float64, now: _Image) -> bool:
        """Whether a step that no corners confirm is one that hands can have made."""
        config, before = self.config, self._last
        if before is None:
            return False
        seconds = max(now.frame.stamp - before.frame.stamp, 0) / NANOSECONDS
        if self._step is not None:
            change = float(np.linalg.norm(step[:3, 3] - self._step[:3, 3]))
            return change <= config.slack + config.acceleration * seconds**2
        blind = len(now.features) < config.agreeing
        return blind and float(np.linalg.norm(step[:3, 3])) <= config.slack + config.speed * seconds

    def _aligned(self, points: Float64, guess: Float64, information: Float64) -> tuple[Float64, float, float]:
        """The pose refined against the field; shares of the points in known space, and of those that fit.

        Directions that the surface does not hold, as along a wall, stay as they were guessed.
        """
        config, field = self.config, self.field
        reach = 0.95 * config.truncation * config.voxel
        T, known, near = guess, 0, 0
        for _ in range(config.steps):
            H, g, known, near, _ = kernels.normal_equations(
                points, T, config.voxel, reach, config.robust, field.keys, field.table, field.distances, field.weights
            )
            if known < 6:
                break
            weight = config.reading**-2.0
            step = -np.linalg.solve(weight * H + information, weight * g + information @ difference(T, guess))
            T = perturb(T, step)
            if np.abs(step).max() < 1e-5:
                break
        return T, known / len(points), near / max(known, 1)


def _information(deviations: tuple[float, float]) -> Float64:
    """(6, 6) of independent standard deviations in metres and radians."""
    return np.diag(np.repeat(np.array(deviations) ** -2.0, 3))
