"""Where a handheld RGB-D camera is, from its images alone.

A frame's pose is first told from the frame before by OpenCV's RGB-D odometry (Steinbruecker, Sturm, Cremers, 2011),
then refined against the signed distance field of all frames so far (Bylow, Sturm, Kerl, Kahl, Cremers, RSS 2013), which
keeps errors from adding up where the camera comes by again.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64, RgbdFrame, Status
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import difference, inverse, perturb, transform
from simtrack.perception.mapping.odometry import field_kernels as kernels
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
    slack: float = 0.02
    max_translation: float = 0.5
    """Metres from frame to frame."""
    max_rotation: float = 0.6
    """Radians."""

    def __post_init__(self) -> None:
        for name, least in (("columns", 32), ("points", 1), ("steps", 1)):
            if not least <= getattr(self, name) <= 10_000:
                raise InvalidValueError(f"OdometryConfig.{name}", getattr(self, name), f"{least} to 10000")
        for name in ("voxel", "truncation", "max_depth", "robust", "reading", "acceleration", "slack"):
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


class RgbdOdometry:
    """Follows a camera; a frame that does not fit what was seen has no pose, and the next one is tried."""

    def __init__(self, T_map_camera: Float64 | None = None, config: OdometryConfig | None = None) -> None:
        """Begin at a pose, at the origin if it is None."""
        self.config = config or OdometryConfig()
        self.field = Volume(VolumeConfig(self.config.voxel, self.config.truncation, 1.0))
        self._T = np.eye(4) if T_map_camera is None else np.array(T_map_camera, float)
        self._step = np.eye(4)
        self._before: Any = None
        """The last image that had a pose, as OpenCV keeps it."""
        self._now: Any = None
        self._stamp = 0
        self._odometry: Any = None

    def update(self, frame: RgbdFrame) -> OdometryResult:
        """The pose of the next frame."""
        config = self.config
        small = reduced_frame(frame, max(1, round(frame.intrinsics.width / config.columns)))
        depth = np.where((small.depth > 0.0) & (small.depth <= config.max_depth), small.depth, np.float32(0.0))
        K = small.intrinsics
        camera = (K.fx, K.fy, K.cx, K.cy)
        points = kernels.sampled_points(depth, camera, config.points, 4, 0.02)
        if len(points) < 6:
            return OdometryResult(Status.NO_DATA, None)
        steps = self._steps(small, depth)
        if not self.field.count:
            return self._take(self._T, depth, small, 1.0)
        found = [self._aligned(points, self._T @ step, deviations) for step, deviations in steps]
        # What OpenCV tells holds unless the other guess fits clearly better.
        T, known, near = found[0] if found[0][2] > found[-1][2] - 0.03 else found[-1]
        if known < config.least_known or near < config.least_near:
            return OdometryResult(Status.LOST, None, near)
        return self._take(T, depth, small, near)

    def _take(self, T: Float64, depth: np.ndarray, small: RgbdFrame, near: float) -> OdometryResult:
        self._step, self._T, self._before, self._stamp = inverse(self._T) @ T, T, self._now, small.stamp
        self.field.integrate(depth, None, np.zeros(depth.shape, np.int32), small.intrinsics, T)
        return OdometryResult(Status.OK, T.copy(), near)

    def _steps(self, small: RgbdFrame, depth: np.ndarray) -> list[tuple[Float64, tuple[float, float]]]:
        """T_before_now (4, 4) with deviations: as OpenCV sees it, else as if the camera moved on or stood still."""
        import cv2

        config = self.config
        if self._odometry is None:
            settings = cv2.OdometrySettings()
            settings.setCameraMatrix(small.intrinsics.matrix.astype(np.float32))
            settings.setMaxDepth(config.max_depth)
            settings.setMaxTranslation(config.max_translation)
            settings.setMaxRotation(float(np.degrees(config.max_rotation)))
            kind = cv2.OdometryType_DEPTH if small.rgb is None else cv2.OdometryType_RGB_DEPTH
            self._odometry = cv2.Odometry(kind, settings, cv2.OdometryAlgoType_COMMON)
        image = np.zeros((*depth.shape, 3), np.uint8) if small.rgb is None else small.rgb
        now = cv2.OdometryFrame(np.where(depth > 0.0, depth, np.nan).astype(np.float32), image)
        self._odometry.prepareFrame(now)
        self._now = now
        if self._before is None:
            return [(self._step, config.blind)]
        done, found = self._odometry.compute(now, self._before, np.eye(4))
        seconds = max(small.stamp - self._stamp, 0) / NANOSECONDS
        if done and _length(found, self._step) <= config.slack + config.acceleration * seconds**2:
            return [(_rigid(np.asarray(found, float)), config.prior), (self._step, config.blind)]
        return [(self._step, config.blind), (np.eye(4), config.blind)]

    def _aligned(
        self, points: Float64, guess: Float64, deviations: tuple[float, float]
    ) -> tuple[Float64, float, float]:
        """The pose refined against the field; shares of the points in known space, and of those that fit.

        Directions that the surface does not hold, as along a wall, stay as they were guessed.
        """
        config, field = self.config, self.field
        reach = 0.95 * config.truncation * config.voxel
        information = np.diag(np.repeat(np.array(deviations) ** -2.0, 3))
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


def _length(T: np.ndarray, other: Float64) -> float:
    return float(np.linalg.norm(np.asarray(T)[:3, 3] - other[:3, 3]))


def _rigid(T: Float64) -> Float64:
    """The rigid transform nearest to one that is so up to rounding."""
    u, _, v = np.linalg.svd(T[:3, :3])
    return transform(u @ v, T[:3, 3])
