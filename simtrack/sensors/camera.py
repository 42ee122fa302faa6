"""The RGB-D camera: pinhole geometry and the specification of known models."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtrack.contracts import CameraIntrinsics, Float32, Float64
from simtrack.errors import InvalidValueError


@dataclass(frozen=True, slots=True)
class CameraModel:
    """What a data sheet says of an RGB-D camera."""

    intrinsics: CameraIntrinsics
    rate_hz: float = 30.0
    min_range: float = 0.4
    """Metres along the optical axis; nearer surfaces give no reading."""
    max_range: float = 8.0
    """Metres along the optical axis."""
    baseline: float = 0.075
    """Metres from the infrared camera to its projector (or second camera), along +x of the image; 0 if it has none."""

    def __post_init__(self) -> None:
        camera = self.intrinsics
        if camera.width < 1 or camera.height < 1 or not camera.fx > 0 or not camera.fy > 0:
            raise InvalidValueError("intrinsics", camera, "width, height >= 1 and fx, fy > 0")
        if not self.rate_hz > 0:
            raise InvalidValueError("rate_hz", self.rate_hz, "> 0")
        if not 0 <= self.min_range < self.max_range:
            raise InvalidValueError("min_range, max_range", (self.min_range, self.max_range), "0 <= min < max")
        if not self.baseline >= 0:
            raise InvalidValueError("baseline", self.baseline, ">= 0")

    @property
    def period(self) -> int:
        """Nanoseconds between frames, rounded."""
        return round(1e9 / self.rate_hz)


XTION = CameraModel(CameraIntrinsics(640, 480, 577.0, 577.0, 319.5, 239.5))
"""ASUS Xtion PRO Live: 640x480 at 30 Hz, horizontal field of view 58 deg, reads 0.4 to about 8 m, baseline 75 mm."""

KINECT_V2 = CameraModel(CameraIntrinsics(512, 424, 366.0, 366.0, 255.5, 211.5), 30.0, 0.5, 4.5, 0.0)
"""Microsoft Kinect v2 (time of flight): 512x424 at 30 Hz, f = 366 px, 0.5 to 4.5 m."""


def project(points: npt.ArrayLike, intrinsics: CameraIntrinsics) -> Float64:
    """(N, 2) pixel coordinates (u, v) of (N, 3) points in the camera frame; NaN for points not in front of it."""
    p = np.asarray(points, dtype=np.float64)
    z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
    u = intrinsics.fx * p[..., 0] / z + intrinsics.cx
    v = intrinsics.fy * p[..., 1] / z + intrinsics.cy
    return np.stack([u, v], axis=-1)


def unproject(depth: npt.ArrayLike, intrinsics: CameraIntrinsics) -> Float32:
    """(H, W, 3) points in the camera frame of an (H, W) depth image; (0, 0, 0) where there is no reading."""
    z = np.asarray(depth, dtype=np.float32)
    return z[..., None] * pixel_rays(intrinsics)


def pixel_rays(intrinsics: CameraIntrinsics) -> Float32:
    """(H, W, 3) directions through the pixel centres, camera frame, z = 1."""
    rays = np.ones((intrinsics.height, intrinsics.width, 3), np.float32)
    rays[..., 0] = (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx
    rays[..., 1] = ((np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy)[:, None]
    return rays
