"""Cramer-Rao bounds: the least error of an object's position that the readings of one image allow anybody.

An unbiased estimate of a pose has no smaller covariance than the inverse of its Fisher information (Cramer 1946, Rao
1945), ``I = sum J J^T / sigma^2`` over the readings on the surface. A depth reading z along the ray d = (x, y, 1)
changes with a motion of the surface by ``J = [n, (p - c) x n] / (n . d)``, where n is the normal, p the point and c the
object's origin. The bound knows the true shape and takes readings inside of the outline alone: what the outline itself
tells, and what earlier images did, can do better; models that are off cannot be bounded so and do worse. Noise that
neighbours share (`DepthNoiseConfig.correlated_share`) does not average out within its window: its variance counts as
often as pixels share it.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Float64, RgbdFrame
from simtrack.evaluation.metrics import Metrics, quantile
from simtrack.evaluation.tracking import ObjectFrame
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.sensors.depth_noise import DepthNoiseConfig

if TYPE_CHECKING:
    from simtrack.objects import ObjectModel

STRIDE = 2
"""Every how many-th column and row is looked at; the others count as it does."""
OWN = 0.03
"""Metres: a reading that is farther from the true surface is not of it (a hand in front, a mixed pixel)."""
LEAST_INFORMATION = 1e-9
"""Share of the largest eigenvalue below which a direction counts as open."""


def translation_bound(normals: Float64, points: Float64, directions: Float64, sigmas: Float64) -> Float64:
    """(3, 3) least covariance of a translation, the rotation being unknown too; infinite where nothing bounds it.

    Args:
        normals: (N, 3) unit normals of the surface at the readings.
        points: (N, 3) metres, from the point whose translation is asked for.
        directions: (N, 3) of the rays; readings are measured in multiples of their length.
        sigmas: (N,) standard deviations of the readings, in those multiples.
    """
    if not len(normals):
        return np.full((3, 3), np.inf)
    slope = np.einsum("ij,ij->i", normals, directions)
    J = np.hstack([normals, np.cross(points, normals)]) / (slope * sigmas)[:, None]
    info = J.T @ J
    across, coupling = info[3:, 3:], info[:3, 3:]
    schur = info[:3, :3] - coupling @ np.linalg.pinv(across, rcond=LEAST_INFORMATION, hermitian=True) @ coupling.T
    values, vectors = np.linalg.eigh(0.5 * (schur + schur.T))
    if values[0] <= LEAST_INFORMATION * values[-1]:
        return np.full((3, 3), np.inf)
    return (vectors / values) @ vectors.T


def median_length(covariance: Float64) -> float:
    """Median length of a normal vector with this covariance, by Satterthwaite's and Wilson and Hilferty's formulas."""
    trace = float(np.trace(covariance))
    if not np.isfinite(trace) or trace <= 0.0:
        return trace
    freedoms = trace**2 / float(np.sum(covariance**2))
    return float(np.sqrt(trace * (1.0 - 2.0 / (9.0 * freedoms)) ** 3))


def shared_pixels(noise: DepthNoiseConfig) -> float:
    """How much larger the variance of an average of many neighbours is than if their errors were independent."""
    if noise.correlated_share <= 0.0 or noise.correlation_window <= 1:
        return 1.0
    from simtrack.sensors.depth_kernels import window

    weights = window(noise.correlation_window).astype(np.float64)
    line = weights.sum() ** 2 / np.sum(weights**2)
    return 1.0 - noise.correlated_share + noise.correlated_share * line**2


class BoundEvaluator:
    """The bounds of the objects in view, beside the errors that the stack made on them."""

    def __init__(self, models: "Mapping[str, ObjectModel]", noise: DepthNoiseConfig) -> None:
        """`models`: class name -> the true model; `noise` of the camera."""
        self._noise, self._shared = noise, shared_pixels(noise)
        self._models = {name: TriangleMesh(m.mesh.vertices, m.mesh.faces) for name, m in models.items()}
        self._scene = RayScene()
        self._instances: dict[str, int] = {}
        self._bundle: RayBundle | None = None
        self._bounds: dict[bool, list[float]] = {False: [], True: []}
        self._efficiencies: list[float] = []

    def observe(self, frame: RgbdFrame, objects: Sequence[ObjectFrame]) -> None:
        """Take one depth image and its object-frames."""
        noise, K = self._noise, frame.intrinsics
        if self._bundle is None:
            self._bundle = RayBundle.from_camera(K, STRIDE)
        for thing in objects:
            if thing.name not in self._instances:
                self._instances[thing.name] = self._scene.add(self._models[thing.class_name])
            self._scene.set_pose(self._instances[thing.name], thing.T_camera_object)
        hits = self._scene.cast(self._bundle, np.eye(4))
        read = frame.depth[::STRIDE, ::STRIDE].ravel()
        own = (read > 0.0) & (np.abs(read - hits.distances) < OWN)
        for thing in objects:
            rays = np.flatnonzero(own & (hits.instances == self._instances[thing.name]))
            if not thing.scored or thing.track is None or not len(rays):
                continue
            directions = self._bundle.directions[rays].astype(np.float64)
            depth, normals = hits.distances[rays].astype(np.float64), hits.normals[rays].astype(np.float64)
            cosine = np.abs(np.einsum("ij,ij->i", normals, directions)) / np.linalg.norm(directions, axis=1)
            sigmas = noise.sigma(depth, np.arccos(np.clip(cosine, 0.0, 1.0)))
            if not np.all(sigmas > 0.0):
                continue  # without noise there is no bound
            seen = cosine > np.cos(noise.max_incidence)
            points = depth[:, None] * directions - thing.T_camera_object[:3, 3]
            scale = np.sqrt(self._shared) / STRIDE
            covariance = translation_bound(normals[seen], points[seen], directions[seen], scale * sigmas[seen])
            bound = median_length(covariance)
            if np.isfinite(bound):
                self._bounds[thing.moving].append(bound)
                self._efficiencies.append(bound / max(thing.translation_error, 1e-9))

    def metrics(self) -> Metrics:
        """``tracking.bound.*``, and how near the errors come: 1 is as good as one image alone allows."""
        missing = "no object was tracked in a noisy image that bounds its position"
        return {
            "tracking.bound.static.translation_error.median": quantile(self._bounds[False], 0.5, "m", missing),
            "tracking.bound.moving.translation_error.median": quantile(self._bounds[True], 0.5, "m", missing),
            "tracking.bound.share": quantile(self._efficiencies, 0.5, "1", missing),
        }

    def close(self) -> None:
        """Release the ray scene."""
        self._scene.close()
