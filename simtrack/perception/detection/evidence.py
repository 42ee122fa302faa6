"""What a detection and its image say of an object's pose, and the model that poses are tried with."""

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from simtrack.contracts import CameraIntrinsics, Detection, Float32, Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import rotation_from_quaternion
from simtrack.objects import ObjectModel
from simtrack.perception.detection import search_kernels as kernels
from simtrack.perception.tracking.correspondences import axial_variance
from simtrack.perception.tracking.registration_config import RegistrationConfig
from simtrack.raycast import RayScene

MIN_READINGS = 12
"""Fewest depth readings in the middle of a box for a search."""
LEAST_SIGMA = 0.02
"""Standard deviations of keypoints are never taken to be less than this, in shares of the box's longer side."""
CENTRE_SIGMA = 0.2
"""How far the object's centre may lie beside that of its box, likewise."""
DISTANCE_SIGMA = 0.15
"""How well the middle of a box tells the distance of an object, as a share."""


@dataclass(frozen=True, slots=True)
class PoseSearchConfig:
    """Settings of `PoseSearch`."""

    orientations: int = 1200
    """Of the grid: about 25 degrees from one to the next."""
    cast: int = 112
    """So many of them are cast."""
    rays: int = 9
    """A side of the grid of rays in a box, for these ..."""
    fine_rays: int = 16
    """... and for those that are refined."""
    refined: int = 9
    """So many of them."""
    kept: int = 3
    """Hypotheses at most ..."""
    least_support: float = 0.7
    """... and the least share of their rays, but for occluded ones, that must agree with the measured depth."""
    margin: float = 0.1
    """By which the rays' window is larger than the box, in shares of its sides."""
    box_sigma: float = 0.06
    """Standard deviation of a box's sides, in shares of the longer one."""
    reach: float = 0.3
    """Furthest that a model is slid along its viewing ray, metres."""
    distance_sigma: float = 0.12
    """Standard deviation of the distances that keypoints tell, as a share."""
    tolerance: float = 0.012
    """Of agreeing depths, metres, beside the sensor's noise."""
    front: float = 0.4
    """How much a reading in front of the model counts against it; one behind it counts 1."""
    depth_weight: float = 80.0
    """Of the share of agreeing rays, beside the costs of keypoints and box."""
    border_step: float = 0.02
    """Least depth step at a silhouette, metres."""
    border_weight: float = 16.0
    """Of the share of the silhouette with a depth step."""
    max_shift: float = 0.02
    """Longest step of the refinement, metres ..."""
    max_turn: float = np.deg2rad(6.0)
    """... largest one, radians ..."""
    last_step: float = 1e-4
    """... and one that is shorter than this is the last on the same rays, metres of surface."""
    slip: float = 10.0
    """A refinement that raises a pose's cost by more than this has slid onto something else."""
    distinct: float = np.deg2rad(20.0)
    """Hypotheses nearer to each other than this are the same, radians."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value, whole = getattr(self, field.name), field.type in (int, "int")
            if not value >= (1 if whole else 0):
                raise InvalidValueError(f"PoseSearchConfig.{field.name}", value, ">= 1" if whole else ">= 0")


def rotation_grid(count: int) -> Float64:
    """(count, 3, 3) rotations, evenly over all of them (Alexa, "Super-Fibonacci spirals", CVPR 2022)."""
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    r, R = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    alpha, beta = 2.0 * np.pi * s / phi, 2.0 * np.pi * s / psi
    q = np.stack([R * np.cos(beta), r * np.sin(alpha), r * np.cos(alpha), R * np.sin(beta)], axis=1)
    return np.stack([rotation_from_quaternion(wxyz) for wxyz in q])


@dataclass(frozen=True, slots=True, eq=False)
class ShownModel:
    """What the search needs of a model."""

    model: ObjectModel
    scene: RayScene
    """The model alone, in its own frame: rays are turned instead of it."""
    outline: Float64
    """(P, 3), points whose projections have the silhouette's box."""
    radius: float
    """Metres."""
    alike: Float64
    """(S, 3, 3), rotations of its symmetries."""


@dataclass(frozen=True, slots=True, eq=False)
class RayGrid:
    """Rays of some pixels, row by row."""

    pixels: Int32
    """(N,), flat indices of the image's pixels, ascending."""
    directions: Float32
    """(N, 3), camera frame, z = 1."""
    columns: int


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """A detection and its image, as the kernels take them."""

    keypoints: Float64
    pixels: Float64
    sigma: Float64
    rays: Float64
    solve: Float64
    distance: float
    outline: Float64
    box: Float64
    box_sigma: float
    size: Float64
    camera: Float64
    intrinsics: CameraIntrinsics
    depth: Float32
    """(H * W,), metres."""
    window: npt.NDArray[np.int64]
    """(4,) u0, v0, u1, v1, half-open, pixels that rays are cast in."""
    tolerance: float
    """Of agreeing depths, metres."""

    @classmethod
    def of(
        cls,
        detection: Detection,
        shown: ShownModel,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        config: PoseSearchConfig,
    ) -> "Evidence | None":
        """None where there is too little to go by: no depth in the box."""
        K, box = intrinsics, np.asarray(detection.box, float)
        if not np.isfinite(box).all():
            return None
        size, sides = np.array([K.width, K.height], float), box[2:] - box[:2]
        inner, window = (_pixels(box, by * sides, size) for by in (-0.25, config.margin))
        middle = depth[inner[1] : inner[3], inner[0] : inner[2]]
        middle = middle[middle > 0.0]
        if len(middle) < MIN_READINGS:
            return None
        distance, side = float(np.median(middle)) + 0.25 * shown.radius, float(sides.max())
        usable = np.isfinite(detection.keypoints).all(axis=1) & np.isfinite(detection.keypoint_sigma)
        pixels = np.ascontiguousarray(detection.keypoints[usable], float)
        sigma = np.maximum(detection.keypoint_sigma[usable], LEAST_SIGMA * side)
        camera = np.array([K.fx, K.fy, K.cx, K.cy])
        rays = (np.concatenate([pixels, 0.5 * (box[None, :2] + box[None, 2:])]) - camera[2:]) / camera[:2]
        metres = np.concatenate([sigma, [CENTRE_SIGMA * side]]) * distance / K.fx
        noise = np.sqrt(axial_variance(distance, 0.8, RegistrationConfig().focal_baseline))
        return cls(
            keypoints=np.ascontiguousarray(shown.model.keypoints[usable]),
            pixels=pixels,
            sigma=sigma,
            rays=rays,
            solve=_solution(rays, metres, DISTANCE_SIGMA * distance),
            distance=distance,
            outline=shown.outline,
            box=box,
            box_sigma=config.box_sigma * side,
            size=size,
            camera=camera,
            intrinsics=K,
            depth=np.ascontiguousarray(depth).reshape(-1),
            window=window,
            tolerance=config.tolerance + 2.0 * noise,
        )

    def grid(self, rays: int) -> RayGrid:
        """About rays x rays rays, evenly over the window."""
        u0, v0, u1, v1 = self.window
        step = max(np.sqrt((u1 - u0) * (v1 - v0)) / rays, 1.0)
        u = np.unique(np.round(np.arange(u0 + 0.5 * step, u1, step) - 0.5).astype(np.int32))
        v = np.unique(np.round(np.arange(v0 + 0.5 * step, v1, step) - 0.5).astype(np.int32))
        pixels = v[:, None] * np.int32(self.intrinsics.width) + u[None]
        directions = np.ones((*pixels.shape, 3), np.float32)
        directions[..., 0] = (u[None] - self.camera[2]) / self.camera[0]
        directions[..., 1] = (v[:, None] - self.camera[3]) / self.camera[1]
        return RayGrid(pixels.ravel(), directions.reshape(-1, 3), len(u))

    def cost(self, rotation: Float64, shift: Float64) -> float:
        """How far a pose's keypoints and silhouette are from the detected ones."""
        return kernels.expected_cost(
            np.ascontiguousarray(rotation), np.ascontiguousarray(shift), self.keypoints, self.pixels, self.sigma,
            self.outline, self.box, self.box_sigma, self.size, self.camera,
        )  # fmt: skip


def _pixels(box: Float64, by: Float64, size: Float64) -> npt.NDArray[np.int64]:
    """(4,) u0, v0, u1, v1, half-open: the pixels in a box that is enlarged on each side, as far as there are any."""
    low, high = np.round(box[:2] - by), np.round(box[2:] + by) + 1
    return np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)]).astype(np.int64)


def _solution(rays: Float64, sigma: Float64, distance_sigma: float) -> Float64:
    """(3, 2 N + 1): from the offsets of N points of an object across their rays, and its distance, to its position.

    Args:
        rays: (N, 2), directions with z = 1 that the points should lie on.
        sigma: (N,), how far they may lie beside them, metres.
        distance_sigma: how well the distance is known, metres.
    """
    A = np.zeros((2 * len(rays) + 1, 3))
    A[:-1:2, 0], A[1:-1:2, 1], A[-1, 2] = 1.0, 1.0, 1.0
    A[:-1:2, 2], A[1:-1:2, 2] = -rays[:, 0], -rays[:, 1]
    weights = np.append(np.repeat(1.0 / sigma, 2), 1.0 / distance_sigma)
    return np.asarray(np.linalg.pinv(A * weights[:, None]) * weights, np.float64)


def drawn_about(keypoints: Float64, box: Float64) -> bool:
    """Whether a box (4,) is only that of the keypoints (N, 2), pixels, and tells nothing more than they do."""
    known = keypoints[np.isfinite(keypoints).all(axis=1)]
    if not len(known):
        return False
    own = np.concatenate([known.min(axis=0), known.max(axis=0)])
    return bool((np.abs(box - own) <= 1e-5 * np.abs(own) + 1e-8).all())
