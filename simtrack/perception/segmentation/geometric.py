"""Geometric segmentation of a depth image: regions that are convex and without jumps.

Section 3.1 of the reconstruction paper after Furrer, Novkovic, Fehr, Gawel, Grinvald, Sattler, Siegwart, Nieto,
*Incremental Object Database*, IROS 2018: an edge is where neighbours form a concave angle or lie off each other's
plane; segments are what edges leave connected. Objects stand on things, which makes a concave edge around them.
"""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Int32
from simtrack.errors import InvalidValueError


@dataclass(frozen=True, slots=True)
class GeometricConfig:
    """Settings of `depth_segments`; pixels are those of an image of 640 x 480."""

    columns: int = 320
    """The image is reduced to about so many columns, by means of blocks, before anything else."""
    smoothing: int = 2
    """Pixels of the reduced image on either side over which depth is averaged."""
    normal_reach: int = 4
    """Pixels of the reduced image on either side over which normals are taken."""
    edge_reach: int = 5
    """Pixels of the reduced image from a point to the neighbours that it may form a concave edge with."""
    convexity: float = 0.94
    """Cosine between the normals of a concave edge below which it is one."""
    mask: float = 0.0005
    """Metres above a point's plane from which a neighbour counts as above it ..."""
    mask_noise: float = 0.0005
    """... and what is added a square metre of squared depth, for the sensor's noise, 1/m."""
    discontinuity: float = 0.01
    """Share of the depth by which a neighbour is off a point's plane at a jump."""
    min_pixels: int = 200
    """Smaller segments are none."""
    grow: int = 6
    """Pixels of the reduced image by which segments take what lies on edges."""
    max_depth: float = 5.0
    """Metres; farther readings belong to no segment."""

    def __post_init__(self) -> None:
        for name, least in (("columns", 8), ("smoothing", 0), ("normal_reach", 1), ("edge_reach", 1),
                            ("min_pixels", 1), ("grow", 0)):  # fmt: skip
            if not least <= getattr(self, name) <= 100_000:
                raise InvalidValueError(f"GeometricConfig.{name}", getattr(self, name), f"{least} to 100000")
        for name in ("mask", "mask_noise", "discontinuity", "max_depth"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"GeometricConfig.{name}", getattr(self, name), "0 or more, finite")
        if not -1.0 <= self.convexity <= 1.0:
            raise InvalidValueError("GeometricConfig.convexity", self.convexity, "a cosine, -1 to 1")


def depth_segments(depth: Float32, intrinsics: CameraIntrinsics, config: GeometricConfig | None = None) -> Int32:
    """Number of the geometric segment of every pixel.

    Args:
        depth: (H, W), metres, 0 = no reading.
        intrinsics: of the image.
        config: settings, the defaults if None.

    Returns:
        (H, W), from 1; 0 = none.
    """
    import cv2

    from simtrack.perception.segmentation import depth_kernels as kernels

    config = config or GeometricConfig()
    readings = np.where(depth <= config.max_depth, depth, np.float32(0.0)).astype(np.float32)
    stride = max(1, round(intrinsics.width / config.columns))
    half = (stride - 1) / 2
    camera = (
        intrinsics.fx / stride, intrinsics.fy / stride, (intrinsics.cx - half) / stride, (intrinsics.cy - half) / stride
    )  # fmt: skip
    near = np.float32(0.05)
    coarse = kernels.reduced(readings, stride, near)
    smooth = kernels.smoothed(coarse, config.smoothing, near)
    normals = kernels.surface_normals(smooth, camera, config.normal_reach, near)
    inside = kernels.smooth_inside(
        smooth, normals, camera, config.edge_reach, config.convexity, config.mask, config.mask_noise,
        config.discontinuity,
    )  # fmt: skip
    _, labels, stats, _ = cv2.connectedComponentsWithStats(inside, connectivity=4, ltype=cv2.CV_32S)
    least = config.min_pixels * (intrinsics.width / 640.0) ** 2 / stride**2
    large = stats[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    numbers = np.where(large, np.cumsum(large), 0).astype(np.int32)
    kept = kernels.grown(numbers[np.asarray(labels, np.int32)], coarse, config.grow, np.float32(0.02))
    return kernels.enlarged(kept, readings, coarse, stride, near)
