"""Errors of 6D object poses: ADD, ADD-S, MSSD, MSPD, translation and rotation, symmetries respected.

ADD and ADD-S (there ADI) follow Hinterstoisser et al., "Model based training, detection and pose estimation of
texture-less 3D objects in heavily cluttered scenes", ACCV 2012; MSSD and MSPD the BOP challenge (Hodan et al., "BOP
Challenge 2020", ECCVW 2020). Values agree with bop_toolkit. Lengths are in the unit of the points and poses handed in.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import apply, exp_so3, inverse, quaternion_from_rotation

if TYPE_CHECKING:
    from scipy.spatial import KDTree


class AxisLike(Protocol):
    """A continuous rotational symmetry (see `simtrack.objects`)."""

    @property
    def axis(self) -> Float64:
        """(3,), unit vector, object frame."""
        ...

    @property
    def offset(self) -> Float64:
        """(3,), a point on the axis, object frame."""
        ...


class SymmetriesLike(Protocol):
    """The symmetries of an object (see `simtrack.objects`)."""

    @property
    def discrete(self) -> Float64:
        """(S, 4, 4), identity first."""
        ...

    @property
    def axes(self) -> Sequence[AxisLike]:
        """Continuous axes."""
        ...


def add(T_est: Float64, T_true: Float64, points: Float64) -> float:
    """Mean distance between corresponding (N, 3) model points (ADD)."""
    return float(np.linalg.norm(apply(T_est, points) - apply(T_true, points), axis=1).mean())


def add_s(T_est: Float64, T_true: Float64, points: Float64, tree: "KDTree | None" = None) -> float:
    """Mean distance of true (N, 3) model points to the nearest estimated one (ADD-S, also called ADI).

    `tree` is a KD-tree of model points in the object frame, built once by the caller; distances do not change under the
    rigid motion into the estimate's frame, so that no tree is built for every pose.
    """
    from scipy.spatial import KDTree

    distances, _ = (tree or KDTree(points)).query(apply(inverse(T_est) @ T_true, points))
    return float(np.mean(distances))


def mssd(T_est: Float64, T_true: Float64, points: Float64, equivalents: Float64) -> float:
    """Maximum symmetry-aware surface distance over (S, 4, 4) symmetry transformations of the object."""
    estimated = apply(T_est, points)
    errors = [np.linalg.norm(estimated - apply(T_true @ S, points), axis=1).max() for S in equivalents]
    return float(min(errors))


def mspd(T_est: Float64, T_true: Float64, points: Float64, equivalents: Float64, intrinsics: CameraIntrinsics) -> float:
    """Maximum symmetry-aware projection distance, pixels; poses are T_camera_object."""
    estimated = _project(apply(T_est, points), intrinsics)
    errors = [
        np.linalg.norm(estimated - _project(apply(T_true @ S, points), intrinsics), axis=1).max() for S in equivalents
    ]
    return float(min(errors))


def translation_error(T_est: Float64, T_true: Float64) -> float:
    """Distance between the two origins."""
    return float(np.linalg.norm(T_est[:3, 3] - T_true[:3, 3]))


def rotation_error(T_est: Float64, T_true: Float64, symmetries: SymmetriesLike | None = None) -> float:
    """Angle between two orientations, radians; the smallest over the object's symmetries, continuous ones exact."""
    if symmetries is not None:
        T_true = closest_equivalent(T_est, T_true, symmetries)
    wxyz = quaternion_from_rotation(T_est[:3, :3].T @ T_true[:3, :3])
    return float(2.0 * np.arctan2(np.linalg.norm(wxyz[1:]), wxyz[0]))


def closest_equivalent(T_est: Float64, T_true: Float64, symmetries: SymmetriesLike) -> Float64:
    """(4, 4): the pose that cannot be told from `T_true` and whose orientation is closest to `T_est`.

    About a continuous axis the best angle is found in closed form: with the remaining rotation as a quaternion (w,
    v), a turn of theta about the axis a leaves ``cos(half the angle) = w cos(theta/2) - (v . a) sin(theta/2)``, which
    is largest at ``theta = 2 atan2(-(v . a), w)``. An object with two axes that are not parallel is a sphere.
    """
    axes = symmetries.axes
    if len(axes) > 1:
        return T_true @ _turn(T_true[:3, :3].T @ T_est[:3, :3], np.asarray(axes[0].offset, dtype=float))
    best, best_cosine = T_true, -1.0
    for S in symmetries.discrete:
        candidate = T_true @ S
        wxyz = quaternion_from_rotation(T_est[:3, :3].T @ candidate[:3, :3])
        if axes:
            axis = np.asarray(axes[0].axis, dtype=float)
            theta = 2.0 * np.arctan2(-float(wxyz[1:] @ axis), float(wxyz[0]))
            candidate = candidate @ _turn(exp_so3(theta * axis), np.asarray(axes[0].offset, dtype=float))
            cosine = float(np.hypot(wxyz[0], wxyz[1:] @ axis))
        else:
            cosine = float(wxyz[0])
        # A tie (a half turn against the identity) keeps the earlier one, so that rounding does not decide.
        if cosine > best_cosine + 1e-12:
            best, best_cosine = candidate, cosine
    return best


def equivalents(symmetries: SymmetriesLike, max_step: float = 0.01) -> Float64:
    """(S, 4, 4) symmetry transformations, continuous axes in ``ceil(pi / max_step)`` turns, as bop_toolkit does."""
    steps = int(np.ceil(np.pi / max_step))
    turns = [
        _turn(exp_so3(2.0 * np.pi * i / steps * np.asarray(axis.axis, dtype=float)), np.asarray(axis.offset))
        for axis in symmetries.axes
        for i in range(steps)
    ]
    discrete = np.asarray(symmetries.discrete, dtype=float)
    return np.stack([turn @ S for turn in turns for S in discrete]) if turns else discrete


def auc(errors: Float64, limit: float = 0.1) -> float:
    """Area under the accuracy-threshold curve up to `limit`, 0 to 1; an infinite error is a miss.

    The curve is a step function, so its area is exact: the mean of ``max(0, 1 - error / limit)``. (Xiang et al.,
    "PoseCNN", RSS 2018, integrate the same curve up to 0.1 m.)
    """
    errors = np.asarray(errors, dtype=float)
    if errors.size == 0:
        raise InvalidValueError("errors", errors, "at least one error")
    return float(np.clip(1.0 - errors / limit, 0.0, 1.0).mean())


@dataclass(frozen=True)
class PoseScorer:
    """Scores poses of one object model: ADD for objects without symmetry, ADD-S for the others."""

    points: Float64
    """(N, 3) model points, object frame."""
    symmetries: SymmetriesLike
    diameter: float
    """Largest distance of two model points."""
    max_queries: int = 1000
    """At most so many points are measured; the nearest ones of ADD-S are sought among all."""

    @property
    def symmetric(self) -> bool:
        """Whether the object looks alike in several poses."""
        return len(self.symmetries.axes) > 0 or len(self.symmetries.discrete) > 1

    @cached_property
    def queries(self) -> Float64:
        """(Q, 3), the points that are measured."""
        stride = -(-len(self.points) // self.max_queries)
        return np.ascontiguousarray(self.points[::stride], dtype=float)

    @cached_property
    def _tree(self) -> "KDTree":
        from scipy.spatial import KDTree

        return KDTree(self.points)

    def add(self, T_est: Float64, T_true: Float64) -> float:
        """ADD, or ADD-S for symmetric objects."""
        if self.symmetric:
            return add_s(T_est, T_true, self.queries, self._tree)
        return add(T_est, T_true, self.queries)

    def errors(self, T_est: Float64, T_true: Float64) -> tuple[float, float]:
        """Translation error and rotation error (radians) against the closest equivalent of the true pose."""
        T_equivalent = closest_equivalent(T_est, T_true, self.symmetries)
        return translation_error(T_est, T_equivalent), rotation_error(T_est, T_equivalent)


def _turn(rotation: Float64, offset: Float64) -> Float64:
    """(4, 4) rotation about a point."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = offset - rotation @ offset
    return T


def _project(points: Float64, intrinsics: CameraIntrinsics) -> Float64:
    projected = points @ intrinsics.matrix.T
    return projected[:, :2] / projected[:, 2:]
