"""Range measurements as registration takes them: shots with own origins, all in the base frame of one stamp."""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import NANOSECONDS, Bool, Float32, Float64, Int32, LidarScan, RgbdFrame
from simtrack.geometry.transforms import inverse
from simtrack.perception.localization.motion import OdometryTrack
from simtrack.raycast import RayBundle


@dataclass(frozen=True, slots=True)
class Measurement:
    """Shots of a range sensor; only such as returned."""

    stamp: int
    """Nanoseconds: the time at which the base frame is meant."""
    origins: Float32
    """(N, 3), base frame, metres: where each shot left the sensor."""
    directions: Float32
    """(N, 3), base frame, unit length."""
    ranges: Float32
    """(N,), metres along the ray, finite."""
    sigmas: Float32
    """(N,), metres, standard deviation along the ray."""
    shots: Int32
    """(N,), index of each in the sensor's own order."""

    def __len__(self) -> int:
        return len(self.ranges)

    @property
    def points(self) -> Float64:
        """(N, 3), base frame: what was hit."""
        return self.origins + self.ranges[:, None].astype(np.float64) * self.directions

    def thinned(self, stride: int) -> "Measurement":
        """Every `stride`-th shot."""
        if stride == 1:
            return self
        return Measurement(
            self.stamp,
            self.origins[::stride].copy(),
            self.directions[::stride].copy(),
            self.ranges[::stride].copy(),
            self.sigmas[::stride].copy(),
            self.shots[::stride].copy(),
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
    stamps, poses = odometry.knots(scan.stamp, end)
    T_end_odom = inverse(poses[-1])
    knots = np.stack([T_end_odom @ T for T in poses])
    knot_times = np.array([(stamp - scan.stamp) / NANOSECONDS for stamp in stamps])
    origins, directions, ranges, shots = deskew_shots(
        np.ascontiguousarray(scan.directions, dtype=np.float32),
        np.ascontiguousarray(scan.times, dtype=np.float32),
        np.ascontiguousarray(scan.ranges, dtype=np.float32),
        np.ascontiguousarray(scan.rings, dtype=np.uint8),
        np.zeros(0, np.bool_) if mask is None else np.ascontiguousarray(mask, dtype=np.bool_),
        min_range,
        max_range,
        np.ascontiguousarray(scan.T_base_lidar, dtype=np.float64),
        knot_times,
        knots,
    )
    return Measurement(end, origins, directions, ranges, np.full(len(shots), sigma, np.float32), shots)


def depth_measurement(frame: RgbdFrame, stride: int, max_range: float, mask: Bool | None = None) -> Measurement:
    """Every `stride`-th pixel of a depth image as shots in the base frame at the image's stamp.

    `mask` is (H, W), True for pixels to leave out. The standard deviation is that of the Xtion (Nguyen et al. 2012),
    carried from depth to the ray.
    """
    from simtrack.sensors.depth_noise import axial_sigma

    bundle = RayBundle.from_camera(frame.intrinsics, stride=stride)
    pixels = np.asarray(bundle.pixels)
    depth = frame.depth.ravel()[pixels].astype(np.float64)
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(depth) & (depth > 0.0) & (depth <= max_range)
    if mask is not None:
        valid &= ~mask.ravel()[pixels]
    rays, depth, pixels = bundle.directions[valid].astype(np.float64), depth[valid], pixels[valid]
    length = np.sqrt((rays * rays).sum(axis=1))
    T = np.asarray(frame.T_base_camera, dtype=float)
    directions = (rays / length[:, None]) @ T[:3, :3].T
    sigmas = np.asarray(axial_sigma(depth), dtype=np.float64) * length
    return Measurement(
        stamp=frame.stamp,
        origins=np.tile(T[:3, 3], (len(depth), 1)).astype(np.float32),
        directions=np.ascontiguousarray(directions, np.float32),
        ranges=(depth * length).astype(np.float32),
        sigmas=sigmas.astype(np.float32),
        shots=pixels,
    )
