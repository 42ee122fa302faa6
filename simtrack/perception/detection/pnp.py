"""Pose hypotheses from box keypoints by perspective-n-point (tracking paper, III.B).

The eight corners and the centre of a known object's box are detected in the image; the pose minimises the reprojection
error of these correspondences. Where the keypoints leave more than one answer (boxes that look alike from the far side,
symmetric objects whose corners a detector confuses) several hypotheses are returned, best first.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from simtrack.contracts import CameraIntrinsics, Detection, Float64, PoseHypothesis
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import angle_between, exp_so3, transform
from simtrack.objects import ObjectModel
from simtrack.perception.detection import pnp_kernels as kernels


@dataclass(frozen=True, slots=True)
class PnpConfig:
    """Settings of `solve_pose`."""

    max_error: float = 0.25
    """Hypotheses with a larger RMS reprojection error, as a share of the keypoints' image extent, are dropped."""
    ambiguity_ratio: float = 1.8
    """A further hypothesis is kept if its reprojection error is at most this many times the best one's."""
    distinct_angle: float = np.deg2rad(20.0)
    """Hypotheses nearer to each other than this rotation are the same, radians."""
    max_distance: float = 8.0
    """Hypotheses further from the camera are dropped, metres."""
    error_correlation: float = 3.0
    """Keypoint errors of one detection share causes: the covariance is inflated by this factor."""

    def __post_init__(self) -> None:
        if self.max_error <= 0.0:
            raise InvalidValueError("PnpConfig.max_error", self.max_error, "> 0")
        if self.ambiguity_ratio < 1.0:
            raise InvalidValueError("PnpConfig.ambiguity_ratio", self.ambiguity_ratio, ">= 1")


def solve_pose(
    detection: Detection,
    model: ObjectModel,
    intrinsics: CameraIntrinsics,
    stamp: int,
    config: PnpConfig | None = None,
) -> list[PoseHypothesis]:
    """Poses that explain a detection's keypoints, best first; empty if none does.

    Args:
        detection: its keypoints are (9, 2) pixels in the order of `model.keypoints`; non-finite ones are left out.
        model: the detected object's model, whose keypoints are in the object frame, metres.
        intrinsics: of the image.
        stamp: of the image, nanoseconds.
        config: settings.

    """
    config = config or PnpConfig()
    usable = np.isfinite(detection.keypoints).all(axis=1) & np.isfinite(detection.keypoint_sigma)
    if np.count_nonzero(usable) < 4:
        return []
    points, pixels = model.keypoints[usable], np.ascontiguousarray(detection.keypoints[usable], dtype=float)
    sigma = np.maximum(detection.keypoint_sigma[usable], 0.1)
    extent = float(np.max(np.ptp(pixels, axis=0)))
    if extent < 1.0:
        return []

    camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
    found: list[tuple[float, Float64]] = []
    for T, squared in _candidates(points, pixels, model, intrinsics, camera):
        error = float(np.sqrt(squared / len(pixels)))
        depth = T[2, 3]
        if np.isfinite(T).all() and 0.05 < depth < config.max_distance and error <= config.max_error * extent:
            found.append((error, T))
    found.sort(key=lambda item: item[0])

    hypotheses: list[PoseHypothesis] = []
    for error, T in found:
        if error > config.ambiguity_ratio * max(found[0][0], 0.5):
            break
        if any(angle_between(T[:3, :3], h.T_camera_object[:3, :3]) < config.distinct_angle for h in hypotheses):
            continue
        covariance = config.error_correlation * np.asarray(kernels.covariance(T, points, sigma, camera), np.float64)
        hypotheses.append(PoseHypothesis(detection.class_name, stamp, T, covariance, error, detection.score))
    return hypotheses


def project_points(T_camera_object: Float64, points: Float64, intrinsics: CameraIntrinsics) -> Float64:
    """(N, 2) pixels of (N, 3) object points; NaN behind the camera."""
    p = points @ T_camera_object[:3, :3].T + T_camera_object[:3, 3]
    z = np.where(p[:, 2] > 1e-6, p[:, 2], np.nan)
    return np.stack([intrinsics.fx * p[:, 0] / z + intrinsics.cx, intrinsics.fy * p[:, 1] / z + intrinsics.cy], axis=1)


def _candidates(
    points: Float64, pixels: Float64, model: ObjectModel, intrinsics: CameraIntrinsics, camera: Float64
) -> Iterator[tuple[Float64, float]]:
    """Poses (4, 4), each with the sum of its squared reprojection errors, pixels^2."""
    first = _pnp(points, pixels, intrinsics, camera)
    if first is None:
        return
    yield first
    # Seen from afar, a box tilted towards the camera looks like one tilted away: start again from the reversed tilt.
    poses, errors = kernels.tilted_back(first[0], points, pixels, camera)
    yield from zip(poses, errors.tolist(), strict=True)
    # A detector confuses the corners of symmetric objects: give each keypoint the nearest equivalent corner.
    mixed = np.empty_like(points)
    for symmetry in model.symmetries.discrete[1:]:
        solution = first
        for _ in range(3):
            if kernels.nearest_corners(solution[0], points, symmetry, pixels, camera, mixed) < 6:
                break  # too few different corners left to be a box
            solution = _pnp(mixed, pixels, intrinsics, camera)
            if solution is None:
                break
        else:
            yield solution


def _pnp(
    points: Float64, pixels: Float64, intrinsics: CameraIntrinsics, camera: Float64
) -> tuple[Float64, float] | None:
    """Pose and squared error from nothing but the correspondences; None where they have no answer."""
    try:
        ok, rotation, translation = cv2.solvePnP(
            points, pixels, intrinsics.matrix, np.zeros(5), flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:  # degenerate configurations (all keypoints on one line) have no answer
        return None
    if not ok or not np.isfinite(rotation).all() or not np.isfinite(translation).all():
        return None
    turn, place = rotation.astype(np.float64).ravel(), translation.astype(np.float64).ravel()
    return kernels.refine(transform(exp_so3(turn), place), points, pixels, camera)
