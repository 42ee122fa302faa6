"""Which detection belongs to which track, and which two objects cannot both be there."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64, PoseHypothesis
from simtrack.geometry.transforms import angle_between, apply, inverse
from simtrack.objects import ObjectModel


def nearest_equivalent(T: Float64, T_reference: Float64, model: ObjectModel) -> Float64:
    """(4, 4) of the poses that look like `T` (the model's symmetries) the one turned least from `T_reference`."""
    poses = model.symmetries.poses(np.deg2rad(5.0))
    if len(poses) == 1:
        return T
    rotations = T[:3, :3] @ poses[:, :3, :3]
    cosines = np.einsum("nij,ij->n", rotations, T_reference[:3, :3])
    return np.asarray(T @ poses[int(np.argmax(cosines))], dtype=np.float64)


def rotation_apart(T: Float64, T_reference: Float64, model: ObjectModel) -> float:
    """Angle between two poses, radians, the model's symmetries respected."""
    return angle_between(nearest_equivalent(T, T_reference, model)[:3, :3], T_reference[:3, :3])


@lru_cache(maxsize=1)
def _grid() -> Float64:
    axis = (np.arange(6) + 0.5) / 6.0 - 0.5
    return np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3).astype(np.float64)


def box_overlap(T_a: Float64, extents_a: Float64, T_b: Float64, extents_b: Float64) -> float:
    """Share of the larger object's box that two boxes have in common, 0 to 1 (sampled on a grid)."""
    if np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]) > 0.5 * (np.linalg.norm(extents_a) + np.linalg.norm(extents_b)):
        return 0.0
    in_b = apply(inverse(T_b) @ T_a, _grid() * extents_a)
    in_a = apply(inverse(T_a) @ T_b, _grid() * extents_b)
    share_a = float(np.mean(np.all(np.abs(in_b) <= 0.5 * extents_b, axis=1)))
    share_b = float(np.mean(np.all(np.abs(in_a) <= 0.5 * extents_a, axis=1)))
    return min(share_a, share_b)


def association_cost(
    hypothesis: PoseHypothesis, T_camera_object: Float64, diameter: float, intrinsics: CameraIntrinsics
) -> float:
    """How badly a hypothesis fits a track: offset in the image in units of the object's size plus relative depth error.

    Pose errors from RGB lie nearly all along the viewing ray, so the image position decides. inf where it cannot match.
    """
    p, q = hypothesis.T_camera_object[:3, 3], T_camera_object[:3, 3]
    if q[2] < 0.1:
        return np.inf
    focal = np.array([intrinsics.fx, intrinsics.fy])
    offset = float(np.linalg.norm(focal * (p[:2] / p[2] - q[:2] / q[2])))
    size = max(intrinsics.fx * diameter / q[2], 12.0)
    depth = abs(float(p[2]) / float(q[2]) - 1.0)
    if offset > 0.6 * size or depth > 0.35:
        return np.inf
    return offset / size + depth


def assign(costs: Float64) -> list[tuple[int, int]]:
    """Pairs (row, column) of the assignment that matches the most finite entries at the least total cost."""
    from scipy.optimize import linear_sum_assignment

    if costs.size == 0:
        return []
    rows, columns = linear_sum_assignment(np.where(np.isfinite(costs), costs, 1e6))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if np.isfinite(costs[r, c])]


def group_by_detection(hypotheses: Sequence[PoseHypothesis]) -> list[list[PoseHypothesis]]:
    """Alternatives for the same detection, best first: those of one class and stamp at one place of the image."""
    groups: list[list[PoseHypothesis]] = []
    for h in hypotheses:
        p = h.T_camera_object[:3, 3]
        for group in groups:
            first = group[0]
            q = first.T_camera_object[:3, 3]
            same_ray = float(p @ q) > 0.998 * float(np.linalg.norm(p) * np.linalg.norm(q))
            if first.class_name == h.class_name and first.stamp == h.stamp and first.score == h.score and same_ray:
                group.append(h)
                break
        else:
            groups.append([h])
    return groups
