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
from simtrack.geometry.transforms import angle_between, exp_so3, log_so3, skew, transform
from simtrack.objects import ObjectModel


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

    found: list[tuple[float, Float64]] = []
    for T, matched in _candidates(points, pixels, model, intrinsics):
        error = reprojection_error(T, matched, pixels, intrinsics)
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
        covariance = keypoint_covariance(T, points, sigma, intrinsics) * config.error_correlation
        hypotheses.append(PoseHypothesis(detection.class_name, stamp, T, covariance, error, detection.score))
    return hypotheses


def project_points(T_camera_object: Float64, points: Float64, intrinsics: CameraIntrinsics) -> Float64:
    """(N, 2) pixels of (N, 3) object points; NaN behind the camera."""
    p = points @ T_camera_object[:3, :3].T + T_camera_object[:3, 3]
    z = np.where(p[:, 2] > 1e-6, p[:, 2], np.nan)
    return np.stack([intrinsics.fx * p[:, 0] / z + intrinsics.cx, intrinsics.fy * p[:, 1] / z + intrinsics.cy], axis=1)


def _candidates(
    points: Float64, pixels: Float64, model: ObjectModel, intrinsics: CameraIntrinsics
) -> Iterator[tuple[Float64, Float64]]:
    """Poses (4, 4), each with the object points (N, 3) that it takes the pixels for."""
    T = _pnp(points, pixels, intrinsics)
    if T is None:
        return
    yield T, points
    # Seen from afar, a box tilted towards the camera looks like one tilted away: start again from the reversed tilt.
    view = T[:3, 3] / np.linalg.norm(T[:3, 3])
    for axis in range(3):
        normal = T[:3, axis]
        tilt = np.cross(normal, view)
        if (norm := float(np.linalg.norm(tilt))) > 1e-3:
            angle = 2.0 * np.arctan2(norm, abs(float(normal @ view)))
            sign = 1.0 if normal @ view > 0 else -1.0
            start = transform(exp_so3(sign * angle * tilt / norm) @ T[:3, :3], T[:3, 3])
            yield _refine(start, points, pixels, intrinsics), points
    # A detector confuses the corners of symmetric objects: give each keypoint the nearest equivalent corner.
    for symmetry in model.symmetries.discrete[1:]:
        alternatives = np.stack([points, points @ symmetry[:3, :3].T + symmetry[:3, 3]])
        T_mixed, mixed = T, points
        for _ in range(3):
            projected = np.stack([project_points(T_mixed, p, intrinsics) for p in alternatives])
            distances = np.linalg.norm(projected - pixels, axis=2)
            mixed = alternatives[np.argmin(distances, axis=0), np.arange(len(points))]
            if not np.isfinite(distances).all() or len(np.unique(mixed.round(6), axis=0)) < 6:
                break  # too few different corners left to be a box
            solution = _pnp(mixed, pixels, intrinsics)
            if solution is None:
                break
            T_mixed = solution
        else:
            yield T_mixed, mixed


def _pnp(points: Float64, pixels: Float64, intrinsics: CameraIntrinsics) -> Float64 | None:
    try:
        ok, rotation, translation = cv2.solvePnP(
            points, pixels, intrinsics.matrix, np.zeros(5), flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:  # degenerate configurations (all keypoints on one line) have no answer
        return None
    if not ok or not np.isfinite(rotation).all() or not np.isfinite(translation).all():
        return None
    return _refine(_transform(rotation, translation), points, pixels, intrinsics)


def _refine(T: Float64, points: Float64, pixels: Float64, intrinsics: CameraIntrinsics) -> Float64:
    try:
        rotation, translation = cv2.solvePnPRefineLM(
            points, pixels, intrinsics.matrix, np.zeros(5), log_so3(T[:3, :3]).reshape(3, 1), T[:3, 3:].copy()
        )
    except cv2.error:
        return T
    return _transform(rotation, translation)


def _transform(rotation: np.ndarray, translation: np.ndarray) -> Float64:
    return transform(exp_so3(rotation.astype(np.float64).ravel()), translation.astype(np.float64).ravel())


def reprojection_error(T: Float64, points: Float64, pixels: Float64, intrinsics: CameraIntrinsics) -> float:
    """RMS distance of projected (N, 3) object points from (N, 2) pixels; inf if one lies behind the camera."""
    error = np.linalg.norm(project_points(T, points, intrinsics) - pixels, axis=1)
    return float(np.sqrt(np.mean(error**2))) if np.isfinite(error).all() else np.inf


def keypoint_covariance(T: Float64, points: Float64, sigma: Float64, intrinsics: CameraIntrinsics) -> Float64:
    """(6, 6) inverse Fisher information of the keypoints, camera frame."""
    information = np.zeros((6, 6))
    offsets = points @ T[:3, :3].T
    for p, offset, s in zip(offsets + T[:3, 3], offsets, sigma, strict=True):
        x, y, z = p
        projection = np.array([[intrinsics.fx, 0, -intrinsics.fx * x / z], [0, intrinsics.fy, -intrinsics.fy * y / z]])
        J = projection / z @ np.hstack([np.eye(3), -skew(offset)])
        information += J.T @ J / s**2
    return np.asarray(np.linalg.inv(information + 1e-3 * np.eye(6)), dtype=np.float64)
