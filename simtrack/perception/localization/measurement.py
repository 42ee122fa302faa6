"""Range measurements as registration takes them: shots with own origins, all in the base frame of one stamp."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from simtrack.contracts import NANOSECONDS, Bool, Float64, LidarScan, RgbdFrame
from simtrack.geometry.transforms import inverse, log_so3
from simtrack.perception.localization.motion import OdometryTrack


@dataclass(frozen=True, slots=True)
class Measurement:
    """Shots of a range sensor; only such as returned."""

    stamp: int
    """Nanoseconds: the time at which the base frame is meant."""
    origins: Float64
    """(N, 3), base frame, metres: where each shot left the sensor."""
    directions: Float64
    """(N, 3), base frame, unit length."""
    ranges: Float64
    """(N,), metres along the ray, finite."""
    sigmas: Float64
    """(N,), metres, standard deviation along the ray."""
    shots: np.ndarray
    """(N,) int64: index of each in the sensor's own order."""

    def __len__(self) -> int:
        return len(self.ranges)

    @property
    def points(self) -> Float64:
        """(N, 3), base frame: what was hit."""
        return self.origins + self.ranges[:, None] * self.directions

    def thinned(self, stride: int) -> "Measurement":
        """Every `stride`-th shot."""
        if stride == 1:
            return self
        take = slice(None, None, stride)
        return Measurement(
            self.stamp,
            self.origins[take],
            self.directions[take],
            self.ranges[take],
            self.sigmas[take],
            self.shots[take],
        )


def scan_end(scan: LidarScan) -> int:
    """Nanoseconds of the scan's last shot."""
    times = scan.times
    finite = times[np.isfinite(times)] if len(times) else times
    return scan.stamp + (round(float(finite.max()) * NANOSECONDS) if len(finite) else 0)


def deskew(
    scan: LidarScan,
    odometry: OdometryTrack,
    sigma: float,
    min_range: float,
    max_range: float,
    mask: Bool | None = None,
) -> Measurement:
    """Move every shot of a turning lidar into the base frame at the scan's end.

    Args:
        scan: one turn.
        odometry: where the base was meanwhile.
        sigma: m, standard deviation of a range.
        min_range: m, shorter ranges are left out.
        max_range: m, longer ones (and no returns) too.
        mask: (N,), True for shots to leave out (the robot's own body).

    Returns:
        The shots, ring by ring (neighbours in memory are neighbours in space, which ray casting likes).
    """
    from simtrack.perception.localization.kernels import deskew_shots

    end = scan_end(scan)
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(ranges) & (ranges >= min_range) & (ranges <= max_range)
    valid &= np.isfinite(scan.times) & np.isfinite(scan.directions).all(axis=1)
    if mask is not None:
        valid &= ~mask
    order = np.argsort(scan.rings, kind="stable")
    shots = order[valid[order]]
    stamps, poses = odometry.knots(scan.stamp, end)
    T_end_odom = inverse(poses[-1])
    knots = np.stack([T_end_odom @ T for T in poses])
    turns = np.stack([log_so3(b[:3, :3] @ a[:3, :3].T) for a, b in pairwise(knots)] or [np.zeros(3)])
    knot_times = np.array([(stamp - scan.stamp) / NANOSECONDS for stamp in stamps])
    origins, directions = deskew_shots(
        np.ascontiguousarray(scan.directions, dtype=np.float64),
        np.asarray(scan.times, dtype=np.float64),
        shots,
        np.asarray(scan.T_base_lidar, dtype=np.float64),
        knot_times,
        knots,
        turns,
    )
    return Measurement(end, origins, directions, ranges[shots], np.full(len(shots), sigma), shots)


def depth_measurement(frame: RgbdFrame, stride: int, max_range: float, mask: Bool | None = None) -> Measurement:
    """Every `stride`-th pixel of a depth image as shots in the base frame at the image's stamp.

    `mask` is (H, W), True for pixels to leave out. The standard deviation is that of the Xtion (Nguyen et al. 2012),
    carried from depth to the ray.
    """
    from simtrack.sensors.camera import pixel_rays
    from simtrack.sensors.depth_noise import axial_sigma

    height, width = frame.depth.shape
    rays = pixel_rays(frame.intrinsics).reshape(height, width, 3)[::stride, ::stride].reshape(-1, 3).astype(np.float64)
    pixels = np.arange(height * width).reshape(height, width)[::stride, ::stride].ravel()
    depth = frame.depth[::stride, ::stride].ravel().astype(np.float64)
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(depth) & (depth > 0.0) & (depth <= max_range)
    if mask is not None:
        valid &= ~mask[::stride, ::stride].ravel()
    rays, depth, pixels = rays[valid], depth[valid], pixels[valid]
    length = np.sqrt((rays * rays).sum(axis=1))
    T = np.asarray(frame.T_base_camera, dtype=float)
    directions = (rays / length[:, None]) @ T[:3, :3].T
    origins = np.broadcast_to(T[:3, 3], directions.shape).copy()
    sigmas = np.asarray(axial_sigma(depth), dtype=np.float64) * length
    return Measurement(frame.stamp, origins, directions, depth * length, sigmas, pixels)
