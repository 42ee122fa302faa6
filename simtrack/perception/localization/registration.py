"""MICP-L: registration of range measurements to a mesh by ray casting (Mock et al. 2023), with honest covariance.

Correspondences are found in the direction of the measuring ray, so that they obey the sensor's visibility. Each
ray-casting iteration minimises the point-to-plane error under a Geman-McClure kernel by a few Gauss-Newton steps,
together with the odometry prediction and with the prior that the base stands upright on the floor: the maximum of the
posterior, that is one iterated extended Kalman update.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float64
from simtrack.geometry.transforms import difference, perturb
from simtrack.perception.localization.config import RegistrationConfig
from simtrack.perception.localization.measurement import Measurement
from simtrack.perception.localization.surface import MapSurface


@dataclass(frozen=True, slots=True)
class Registration:
    """One measurement registered to the map."""

    T_map_base: Float64
    """(4, 4)."""
    covariance: Float64
    """(6, 6), map frame, of the fused pose."""
    converged: bool
    """Enough correspondences, and the last ray-casting iteration moved the pose by little."""
    correspondences: int
    """Rays that took part in the last iteration."""
    residual: float
    """m, robust RMS of the point-to-plane distances."""
    observed: int
    """Directions of the six that the data constrain."""
    steps: int
    """Gauss-Newton steps taken."""


def register(
    measurement: Measurement,
    surface: MapSurface,
    T_prior: Float64,
    covariance: Float64,
    config: RegistrationConfig,
    T_start: Float64 | None = None,
    systematic: Float64 | None = None,
    strides: tuple[int, ...] | None = None,
) -> Registration:
    """Register a measurement to the map.

    Args:
        measurement: shots in the base frame.
        surface: the map.
        T_prior: (4, 4) T_map_base as predicted.
        covariance: (6, 6) of the prediction.
        config: settings.
        T_start: (4, 4) where to start from, the prediction if None.
        systematic: (6, 6) covariance, map frame, of errors that the shots share (what de-skewing leaves).
        strides: thinning of the shots, one entry a ray-casting iteration; the config's if None.
    """
    T = np.array(T_prior if T_start is None else T_start)
    prior = np.linalg.inv(covariance + 1e-14 * np.eye(6))
    reach = float(np.median(measurement.ranges)) if len(measurement) else 0.0
    lever = np.array([1.0, 1.0, 1.0, reach, reach, reach])
    gate = _clip_gate(3.0 * _spread(covariance, reach), config)
    upright = floor_information(config)
    strides = config.strides if strides is None else strides
    info, map_info = np.zeros((6, 6)), np.zeros((6, 6))
    observed = _Subspace(np.zeros((6, 0)), np.zeros((6, 0)))
    count, residual, steps, moved = 0, 0.0, 0, 0.0
    for stride in strides:
        shots = measurement.thinned(stride)
        points, planes, weights, map_weights = _correspondences(T, shots, surface, gate, config)
        count = len(points)
        if count < config.min_correspondences:
            break
        T_cast = T
        for _ in range(config.inner_iterations):
            kernel = _kernel(T, points, planes, gate, config)
            info, gradient, map_info, feigned, stats = _normal_equations(
                T, points, planes, weights, map_weights, kernel
            )
            observed = _observed(info, feigned, stats, config)
            info, gradient = _symmetric(observed.restrict(info)), observed.restrict(gradient)
            A = info + prior + upright
            b = gradient + prior @ difference(T, T_prior) + upright @ floor_deviation(T, surface.floor)
            step = np.asarray(-np.linalg.solve(A, b), dtype=np.float64)
            T = perturb(T, step)
            steps += 1
            residual = float(np.sqrt(stats[1] / max(stats[0], 1e-12)))
            if float(np.abs(step * lever).max()) < config.step_tolerance:
                break
        change = difference(T, T_cast)
        moved = float(np.linalg.norm(change[:3])) + reach * float(np.linalg.norm(change[3:]))
        gate = _clip_gate(2.0 * moved + 3.0 * residual, config, ceiling=gate)
    fused = _symmetric(np.linalg.inv(prior + upright + info))
    if count >= config.min_correspondences:
        own = np.diag([config.systematic_sigma**2] * 3 + [config.systematic_angle**2] * 3)
        fused = _keep_shared_error(fused, map_info, observed, own if systematic is None else own + systematic)
    converged = count >= config.min_correspondences and moved < 0.5 * config.min_gate
    return Registration(T, _symmetric(fused), converged, count, residual, observed.basis.shape[1], steps)


def _correspondences(
    T: Float64, shots: Measurement, surface: MapSurface, gate: float, config: RegistrationConfig
) -> tuple[Float64, Float64, Float64, Float64]:
    from simtrack.perception.localization.kernels import correspond

    hits, _ = surface.cast(T, shots)
    points, planes, weights, map_weights, _ = correspond(
        T,
        shots.origins,
        shots.directions,
        shots.ranges,
        shots.sigmas,
        hits.distances,
        hits.normals,
        hits.faces,
        hits.instances,
        surface.normals,
        surface.patches,
        surface.instance,
        gate,
        config.pointing_sigma,
        surface.patch_variance,
        surface.counts,
    )
    return points, planes, weights, map_weights


def _normal_equations(
    T: Float64, points: Float64, planes: Float64, weights: Float64, map_weights: Float64, kernel: float
) -> tuple[Float64, Float64, Float64, Float64, Float64]:
    from simtrack.perception.localization.kernels import normal_equations

    return normal_equations(T, points, planes, weights, map_weights, kernel)


@dataclass(frozen=True, slots=True)
class _Subspace:
    """The directions that the data constrain."""

    basis: Float64
    """(6, K), steps that stay in it: metres and radians a unit."""
    dual: Float64
    """(6, K), with ``dual.T @ basis = I``: reads the coordinates of a step."""

    def restrict(self, gradient: Float64) -> Float64:
        """Gradient or information with what acts on other directions taken out."""
        return self.dual @ (self.basis.T @ gradient)


def floor_information(config: RegistrationConfig) -> Float64:
    """(6, 6) information of the prior that the base stands upright on the floor."""
    return np.diag([0.0, 0.0, config.floor_sigma**-2, config.tilt_sigma**-2, config.tilt_sigma**-2, 0.0])


def floor_deviation(T_map_base: Float64, floor: float) -> Float64:
    """(6,) deviation from standing upright at height `floor`.

    The tilt is ``e_z x (R e_z)``, whose derivative by a left rotation is the identity about x and y near upright.
    """
    return np.array([0.0, 0.0, T_map_base[2, 3] - floor, -T_map_base[1, 2], T_map_base[0, 2], 0.0])


def _kernel(T: Float64, points: Float64, planes: Float64, gate: float, config: RegistrationConfig) -> float:
    """m, scale of the Geman-McClure kernel: anneals with the median distance, which outliers hardly touch."""
    from simtrack.perception.localization.kernels import plane_distances

    return float(min(max(3.0 * np.median(plane_distances(T, points[::3], planes[::3])), config.min_kernel), gate))


def _observed(info: Float64, feigned: Float64, stats: Float64, config: RegistrationConfig) -> _Subspace:
    """The directions that the data constrain (Zhang et al. 2016, with a threshold from the noise).

    Normals that are off by `normal_sigma` at random give every direction some information, at most
    ``normal_sigma^2 (sum w B B^T - sum w J J^T)``. A direction whose information is not well above that is not
    observed: the pose stays as predicted there. Rotations are scaled by the RMS distance of the points, which makes
    eigenvalues comparable.
    """
    lever = np.sqrt(max(stats[2] / max(stats[0], 1e-12), 1e-4))
    scale = np.array([1.0, 1.0, 1.0, 1.0 / lever, 1.0 / lever, 1.0 / lever])
    values, vectors = np.linalg.eigh(_symmetric(scale[:, None] * info * scale))
    noise = config.normal_sigma**2 * (scale[:, None] * (feigned - info) * scale)
    least = np.einsum("ik,ij,jk->k", vectors, noise, vectors)
    good = vectors[:, values > config.observability * np.maximum(least, 1e-9)]
    return _Subspace(scale[:, None] * good, good / scale[:, None])


def _keep_shared_error(covariance: Float64, map_info: Float64, observed: _Subspace, own: Float64) -> Float64:
    """Covariance that is nowhere below what the errors leave that no averaging removes.

    The map's error is the same in every scan from about the same place, and the systematic ones (`own`) in every shot:
    the filter must not average them away.
    """
    basis, dual = observed.basis, observed.dual
    count = basis.shape[1]
    if not count:
        return covariance
    limit = np.linalg.inv(basis.T @ map_info @ basis + 1e-9 * np.eye(count)) + dual.T @ own @ dual
    root = np.asarray(np.linalg.cholesky(_symmetric(limit)), dtype=np.float64)
    inverse_root = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(_symmetric(inverse_root @ dual.T @ covariance @ dual @ inverse_root.T))
    lift = basis @ root @ vectors
    return covariance + (lift * np.maximum(1.0 - values, 0.0)) @ lift.T


def _spread(covariance: Float64, reach: float) -> float:
    """m: standard deviation of where points at distance `reach` are expected."""
    return float(np.sqrt(np.trace(covariance[:2, :2]) / 2.0 + covariance[5, 5] * reach**2))


def _clip_gate(value: float, config: RegistrationConfig, ceiling: float = np.inf) -> float:
    return float(min(max(value, config.min_gate), config.max_gate, ceiling))


def _symmetric(matrix: npt.NDArray[np.floating]) -> Float64:
    return np.asarray(0.5 * (matrix + matrix.T), dtype=np.float64)
