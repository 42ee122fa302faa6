"""Corners of images that are found again, and where the camera is by them.

ORB (Rublee et al., ICCV 2011) finds and describes corners, their readings make points of them, and a perspective pose
from three of them (P3P in RANSAC, refined over all that agree) tells where another image was taken from.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtrack.contracts import CameraIntrinsics, Float64, RgbdFrame, Uint8
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import inverse, transform


@dataclass(frozen=True, slots=True)
class FeatureConfig:
    """Settings of `FeatureMatcher`."""

    features: int = 700
    """Of an image at most."""
    contrast: int = 5
    """Grey levels, of FAST's circle to its middle."""
    reprojection: float = 2.0
    """Pixels within which a point that is seen again agrees with a pose."""
    iterations: int = 200
    """Of RANSAC at most."""

    def __post_init__(self) -> None:
        for name, least in (("features", 8), ("contrast", 1), ("iterations", 1)):
            if not least <= getattr(self, name) <= 100_000:
                raise InvalidValueError(f"FeatureConfig.{name}", getattr(self, name), f"{least} to 100000")
        if not 0.0 < self.reprojection < 100.0:
            raise InvalidValueError("FeatureConfig.reprojection", self.reprojection, "above 0 and below 100 pixels")


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Corners of one image."""

    pixels: Float64
    """(N, 2), columns and rows."""
    points: Float64
    """(N, 3), camera frame, metres; NaN where there is no reading."""
    descriptors: Uint8
    """(N, 32)."""

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, slots=True, eq=False)
class FeaturePose:
    """Where a camera is beside another one."""

    T_before_now: Float64
    """(4, 4)."""
    points: Float64
    """(M, 3), of the corners that agree, in the frame of the camera before, metres."""
    pixels: Float64
    """(M, 2), where they are now."""
    intrinsics: CameraIntrinsics

    def agreeing(self, T_before_now: Float64, pixels: float) -> int:
        """How many of those corners agree within so many pixels on another pose (4, 4)."""
        u, v, z = self._projected(T_before_now)
        off = np.hypot(u - self.pixels[:, 0], v - self.pixels[:, 1])
        return int(np.count_nonzero((z > 0.0) & (off <= pixels)))

    def information(self, T_map_camera: Float64, pixels: float) -> Float64:
        """What the corners tell of the pose: (6, 6) for a perturbation (metres, radians) of T_map_camera.

        Args:
            T_map_camera: (4, 4), of the camera now.
            pixels: standard deviation of a corner.
        """
        K = self.intrinsics
        T_now_before = inverse(self.T_before_now)
        x, y, z = (self.points @ T_now_before[:3, :3].T + T_now_before[:3, 3]).T
        zero = np.zeros_like(z)
        rows_u = np.stack([K.fx / z, zero, -K.fx * x / z**2], axis=1)
        rows_v = np.stack([zero, K.fy / z, -K.fy * y / z**2], axis=1)
        by_point = np.concatenate([rows_u, rows_v])  # of pixels, by the point in the camera's frame
        # p = R^T (q - t): a perturbation moves it by -R^T (rho + phi x (q - t)), and q - t = R p.
        R = T_map_camera[:3, :3]
        lever = np.tile(np.stack([x, y, z], axis=1) @ R.T, (2, 1))
        by_map = by_point @ R.T
        J = -np.concatenate([by_map, np.cross(lever, by_map)], axis=1)
        return J.T @ J / pixels**2

    def _projected(self, T_before_now: Float64) -> Float64:
        T, K = inverse(T_before_now), self.intrinsics
        x, y, z = (self.points @ T[:3, :3].T + T[:3, 3]).T
        depth = np.maximum(z, 1e-6)
        return np.stack([K.fx * x / depth + K.cx, K.fy * y / depth + K.cy, z])


class FeatureMatcher:
    """Finds corners, and the pose between images by them; the same images give the same pose."""

    def __init__(self, config: FeatureConfig | None = None) -> None:
        import cv2

        self.config = config or FeatureConfig()
        self._orb = cv2.ORB.create(nfeatures=self.config.features, fastThreshold=self.config.contrast)
        self._matcher = cv2.BFMatcher.create(cv2.NORM_HAMMING, crossCheck=True)

    def find(self, frame: RgbdFrame) -> Features:
        """Corners of an image; none without colours."""
        import cv2

        if frame.rgb is None:
            return _NO_FEATURES
        keypoints, descriptors = self._orb.detectAndCompute(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), None)
        if not keypoints:
            return _NO_FEATURES
        pixels = np.array([point.pt for point in keypoints], np.float64)
        K = frame.intrinsics
        columns, rows = np.round(pixels).astype(int).T
        z = frame.depth[rows.clip(0, K.height - 1), columns.clip(0, K.width - 1)].astype(np.float64)
        z[~(z > 0.0)] = np.nan
        points = np.stack([(pixels[:, 0] - K.cx) / K.fx * z, (pixels[:, 1] - K.cy) / K.fy * z, z], axis=1)
        return Features(pixels, points, np.asarray(descriptors, np.uint8))

    def pose(self, before: Features, now: Features, intrinsics: CameraIntrinsics) -> FeaturePose | None:
        """The pose of an image beside an earlier one by the corners that both show; None if there is none."""
        import cv2

        known = np.flatnonzero(np.isfinite(before.points[:, 2]))
        if min(len(known), len(now)) < 6:
            return None
        matches = self._matcher.match(before.descriptors[known], now.descriptors)
        first = known[[match.queryIdx for match in matches]]
        second = np.array([match.trainIdx for match in matches], np.intp)
        if len(first) < 6:
            return None
        points, pixels = before.points[first], now.pixels[second]
        done, rotation, translation, chosen = cv2.solvePnPRansac(
            points, pixels, intrinsics.matrix, None, iterationsCount=self.config.iterations,
            reprojectionError=self.config.reprojection, confidence=0.999, flags=cv2.SOLVEPNP_P3P,
        )  # fmt: skip
        if not done or chosen is None or len(chosen) < 6:
            return None
        chosen = np.asarray(chosen, np.intp).ravel()
        rotation, translation = cv2.solvePnPRefineLM(
            points[chosen], pixels[chosen], intrinsics.matrix, None, rotation, translation
        )
        T_now_before = transform(np.asarray(cv2.Rodrigues(rotation)[0], float), np.asarray(translation, float).ravel())
        if not np.isfinite(T_now_before).all():
            return None
        return FeaturePose(inverse(T_now_before), points[chosen], pixels[chosen], intrinsics)


def _empty(columns: int, kind: npt.DTypeLike) -> np.ndarray:
    return np.empty((0, columns), kind)


_NO_FEATURES = Features(_empty(2, np.float64), _empty(3, np.float64), _empty(32, np.uint8))
