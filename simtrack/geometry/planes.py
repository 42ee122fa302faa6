"""Surface planes of a mesh: RANSAC, iterated with removal of the inliers.

As the reconstruction paper finds them (section 2.2, after Taguchi et al., 2013): the plane with the most inliers is
taken, its inliers leave, and so on. Surface is counted by area: hypotheses and votes come from points sampled evenly
over the faces, so that a tessellation neither hides a plane nor makes one. A point with its normal is a hypothesis of
its own; an inlier lies close and faces the same way.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Bool, Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh, face_areas, face_normals, sample_surface, validate
from simtrack.geometry.upright_boxes import upright_box

_NO_FACES = np.empty(0, np.int32)


@dataclass(frozen=True, slots=True)
class PlaneConfig:
    """Settings of `detect_planes`; the figures are those of the paper's public code where it has them."""

    distance: float = 0.03
    """Metres off the plane up to which a point is an inlier; at most a quarter of the entity's smallest side."""
    least_distance: float = 0.003
    """Metres: the same for entities however thin."""
    iterations: int = 200
    """Hypotheses a plane."""
    min_fraction: float = 0.1
    """Share of the remaining surface that a plane has to explain, or no more planes are looked for."""
    enough: float = 0.04
    """Share of the whole surface that is enough anyhow: each side of a board of a shelf has about a twentieth."""
    min_share: float = 0.01
    """Share of the whole surface, likewise."""
    samples: int = 2000
    """Points on the surface."""
    normal_angle: float = float(np.radians(30.0))
    """Radians between a point's (smoothed) normal and the plane's."""
    mean_angle: float = float(np.radians(15.0))
    """Radians, likewise in the mean (of cosines): a curved surface is no plane, close as it may be."""
    max_planes: int = 40

    def __post_init__(self) -> None:
        for name in ("distance", "least_distance", "iterations", "samples", "normal_angle", "mean_angle", "max_planes"):
            if not 0 < getattr(self, name) < np.inf:
                raise InvalidValueError(f"PlaneConfig.{name}", getattr(self, name), "a positive finite number")
        for name in ("min_fraction", "enough", "min_share"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InvalidValueError(f"PlaneConfig.{name}", getattr(self, name), "a share in (0, 1)")


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePlane:
    """A plane `n . v + d = 0` of an entity's surface, facing outwards."""

    normal: Float64
    """(3,), unit."""
    offset: float
    """d, metres."""
    area: float
    """Square metres of surface that lie on it."""
    faces: Int32
    """(K,), faces of the mesh that lie on it; empty for a hidden plane."""
    hidden: bool = False
    """Never seen: inferred from what stands on it."""

    @property
    def vector(self) -> Float64:
        """(4,), the homogeneous vector [n, d]."""
        return np.append(self.normal, self.offset)

    def distance(self, points: Float64) -> Float64:
        """(N,) signed distances of (N, 3) points, metres, positive outside."""
        return np.asarray(points) @ self.normal + self.offset

    def height_at(self, x: float, y: float) -> float:
        """Z of the plane above or below a point of the map; the plane must not be vertical."""
        return float(-(self.offset + self.normal[0] * x + self.normal[1] * y) / self.normal[2])

    def moved(self, T: Float64) -> "SurfacePlane":
        """The plane after a rigid (4, 4) motion."""
        normal = T[:3, :3] @ self.normal
        return SurfacePlane(normal, self.offset - float(normal @ T[:3, 3]), self.area, self.faces, self.hidden)


def hidden_plane(height: float, area: float) -> SurfacePlane:
    """A horizontal plane that nobody saw, facing up at a height in metres."""
    return SurfacePlane(np.array([0.0, 0.0, 1.0]), -height, area, _NO_FACES, hidden=True)


def detect_planes(
    mesh: Mesh, rng: np.random.Generator, config: PlaneConfig | None = None, *, source: str = "detect_planes"
) -> tuple[SurfacePlane, ...]:
    """Planes of a mesh in its own frame (z up), largest share of what remained first; none if nothing on it is flat.

    Raises:
        MeshError: the mesh is not valid; names `source`.
    """
    config = config or PlaneConfig()
    validate(mesh, source)
    smallest = float(upright_box(mesh.vertices[np.unique(mesh.faces)]).extents.min())
    limit = max(min(config.distance, 0.25 * smallest), config.least_distance)
    points, index = sample_surface(mesh, config.samples, rng)
    normals, areas = face_normals(mesh), face_areas(mesh)
    smooth = _smoothed(points, normals[index])
    left = np.ones(len(points), bool)
    free = np.ones(len(mesh.faces), bool)
    planes: list[SurfacePlane] = []
    small = False
    while len(planes) < config.max_planes:
        rows = np.flatnonzero(left)
        if len(rows) < max(3.0, config.min_share * len(points)):
            break
        normal, offset, inliers = _best(points[rows], smooth[rows], limit, rng, config)
        least = min(config.min_fraction * len(rows), config.enough * len(points))
        if len(inliers) < max(3.0, least, config.min_share * len(points)):
            break
        left[rows[inliers]] = False
        facing = smooth[rows[inliers]] @ normal
        small = small or len(inliers) < config.min_fraction * len(rows)
        if small:  # from now on they have to be flat as far as their faces reach: else the caps of a ball were planes
            facing = smooth[np.abs(points @ normal + offset) <= 2.0 * limit] @ normal
            facing = facing[facing > 0.5]
        if facing.mean() < np.cos(config.mean_angle):
            continue
        faces = _faces_on(mesh, normals, normal, offset, 2.0 * limit, free)
        free[faces] = False
        if len(faces):
            planes.append(SurfacePlane(normal, offset, float(areas[faces].sum()), faces.astype(np.int32)))
    return tuple(planes)


def _smoothed(points: Float64, normals: Float64, neighbours: int = 16) -> Float64:
    """(N, 3) normals averaged over near points that face about the same way: noise goes, edges stay."""
    from scipy.spatial import KDTree

    near = KDTree(points).query(points, k=min(neighbours, len(points)))[1].reshape(len(points), -1)
    around = normals[near]
    sums = np.where(np.einsum("nkd,nd->nk", around, normals)[..., None] > 0.5, around, 0.0).sum(axis=1)
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)


def _best(
    points: Float64, normals: Float64, limit: float, rng: np.random.Generator, config: PlaneConfig
) -> tuple[Float64, float, npt.NDArray[np.int64]]:
    """Plane with the most inliers over the hypotheses, fitted to them twice by least squares."""
    chosen = rng.integers(len(points), size=config.iterations)
    guesses = normals[chosen].copy()
    level = np.abs(guesses[:, 2]) > np.cos(config.normal_angle)  # in a room much is level, and a normal is noisy
    half = level & (np.arange(len(chosen)) % 2 == 0)
    guesses[half] = np.sign(guesses[half, 2:]) * [0.0, 0.0, 1.0]
    offsets = -np.einsum("hd,hd->h", guesses, points[chosen])
    facing = normals @ guesses.T > np.cos(config.normal_angle)
    votes = ((np.abs(points @ guesses.T + offsets) <= limit) & facing).sum(axis=0)
    k = int(np.argmax(votes))
    normal, offset = guesses[k], float(offsets[k])
    inliers = _inliers(points, normals, normal, offset, limit, config)
    for _ in range(2):
        rows = np.flatnonzero(inliers)
        if len(rows) < 3:
            break
        off = np.abs(points[rows] @ normal + offset - np.median(points[rows] @ normal + offset))
        core = rows[off <= 4.5 * np.median(off) + 1e-9]  # three standard deviations: steps within the limit stay out
        fitted, level_at = _fitted(points[core], normal)
        trial = _inliers(points, normals, fitted, level_at, limit, config)
        if trial.sum() < 0.9 * inliers.sum():
            break
        normal, offset, inliers = fitted, level_at, trial
    return normal, offset, np.flatnonzero(inliers)


def _fitted(points: Float64, normal: Float64) -> tuple[Float64, float]:
    """Least-squares plane of (N >= 3, 3) points that faces the way of `normal`, which stays if they lie on a line."""
    centre = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - centre, full_matrices=False)
    if len(points) >= 3 and spread[1] > 1e-9 * max(spread[0], 1e-300):
        normal = axes[2] * (np.sign(axes[2] @ normal) or 1.0)
    return normal, -float(normal @ centre)


def _inliers(
    points: Float64, normals: Float64, normal: Float64, offset: float, limit: float, config: PlaneConfig
) -> Bool:
    return (np.abs(points @ normal + offset) <= limit) & (normals @ normal > np.cos(config.normal_angle))


def _faces_on(
    mesh: Mesh, normals: Float64, normal: Float64, offset: float, limit: float, free: Bool
) -> npt.NDArray[np.int64]:
    """Faces, not taken by another plane, that lie within `limit` of a plane and face its way, noise allowed."""
    near = np.abs(mesh.vertices @ normal + offset) <= limit
    return np.flatnonzero(free & near[mesh.faces].all(axis=1) & (normals @ normal > 0.5))
