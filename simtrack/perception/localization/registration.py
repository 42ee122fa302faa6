"""MICP-L: registration of range measurements to a mesh by ray casting (Mock et al. 2023), with honest covariance.

Correspondences are found in the direction of the measuring ray, so that they obey the sensor's visibility. Each
ray-casting iteration minimises the point-to-plane error under a Geman-McClure kernel by a few Gauss-Newton steps,
together with the odometry prediction and with the prior that the base stands upright on the floor: the maximum of the
posterior, that is one iterated extended Kalman update.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float32, Float64
from simtrack.geometry.transforms import difference, orthonormal
from simtrack.perception.localization.assessment import Assessment, assess, judge
from simtrack.perception.localization.config import RegistrationConfig
from simtrack.perception.localization.measurement import Measurement
from simtrack.perception.localization.surface import PASSED_OVER, MapSurface

if TYPE_CHECKING:
    from simtrack.perception.localization.solver import Rules


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
    assessment: Assessment | None = None
    """Of the pose, if it was asked for."""


def register(
    measurement: Measurement,
    surface: MapSurface,
    T_prior: Float64,
    covariance: Float64,
    config: RegistrationConfig,
    T_start: Float64 | None = None,
    systematic: Float64 | None = None,
    strides: tuple[int, ...] | None = None,
    assessed: bool = False,
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
        assessed: judge the pose too, by the last cast if the pose moved little since.
    """
    from simtrack.perception.localization.solver import descend, map_information

    T = np.array(T_prior if T_start is None else T_start, dtype=np.float64)
    T_prior = np.ascontiguousarray(T_prior, dtype=np.float64)
    prior, upright = np.linalg.inv(covariance + 1e-14 * np.eye(6)), floor_information(config)
    own = np.diag([config.systematic_sigma**2] * 3 + [config.systematic_angle**2] * 3)
    own = own if systematic is None else own + systematic
    reach = _typical(measurement.ranges)
    gate = _clip_gate(3.0 * _spread(covariance, reach), config)
    strides = config.strides if strides is None else strides
    assessment: Assessment | None = None
    found, count, steps, moved, turn = None, 0, 0, 0.0, 0
    fused = _symmetric(np.linalg.inv(prior + upright))
    while turn < len(strides):
        view = surface.cast(T, measurement, strides[turn], _second_surfaces(gate))
        pairs, count = surface.pair(T, view, gate, config.pointing_sigma)
        if count < config.min_correspondences:
            break
        T_cast, last = T, turn == len(strides) - 1
        found = descend(T_cast, pairs, count, T_prior, prior, upright, surface.floor, _rules(config, reach, gate))
        T = found.T
        T[:3, :3], steps = orthonormal(T[:3, :3]), steps + found.steps
        change = difference(T, T_cast)
        moved = float(np.linalg.norm(change[:3])) + reach * float(np.linalg.norm(change[3:]))
        if last:
            map_info = map_information(T_cast, T, pairs, count, found.kernel)
            fused = _symmetric(np.linalg.inv(prior + upright + found.info))
            fused = _keep_shared_error(fused, map_info, found.basis, found.dual, own)
            assessment = judge(view) if assessed and moved < config.settled else None
        gate = _clip_gate(2.0 * moved + 3.0 * found.residual, config, ceiling=gate)
        turn = len(strides) - 1 if moved < config.settled and not last else turn + 1
    if assessed and assessment is None:
        assessment = assess(measurement.thinned(7), surface, T)
    if found is None or turn < len(strides):
        return Registration(T, fused, False, count, 0.0, 0, steps, assessment)
    converged = moved < 0.5 * config.min_gate
    return Registration(T, fused, converged, count, found.residual, found.basis.shape[1], steps, assessment)


def _rules(config: RegistrationConfig, reach: float, gate: float) -> "Rules":
    from simtrack.perception.localization.solver import Rules

    return Rules(
        iterations=config.inner_iterations,
        tolerance=config.step_tolerance,
        reach=reach,
        gate=gate,
        min_kernel=config.min_kernel,
        normal_sigma=config.normal_sigma,
        observability=config.observability,
    )


def floor_information(config: RegistrationConfig) -> Float64:
    """(6, 6) information of the prior that the base stands upright on the floor."""
    return np.diag([0.0, 0.0, config.floor_sigma**-2, config.tilt_sigma**-2, config.tilt_sigma**-2, 0.0])


def _second_surfaces(gate: float) -> float:
    """Metres by which a shot must reach through a surface to be sought behind it; none is while the pose is vague."""
    return max(2.0 * PASSED_OVER, 6.0 * gate) if gate <= PASSED_OVER else np.inf


def _keep_shared_error(covariance: Float64, map_info: Float64, basis: Float64, dual: Float64, own: Float64) -> Float64:
    """Covariance that is nowhere below what the errors leave that no averaging removes.

    The map's error is the same in every scan from about the same place, and the systematic ones (`own`) in every shot:
    the filter must not average them away. `basis` and `dual` are (6, K), see `solver.observable`.
    """
    count = basis.shape[1]
    if not count:
        return covariance
    limit = np.linalg.inv(basis.T @ map_info @ basis + 1e-9 * np.eye(count)) + dual.T @ own @ dual
    root = np.asarray(np.linalg.cholesky(_symmetric(limit)), dtype=np.float64)
    whiten = np.linalg.solve(root, dual.T)
    values, vectors = np.linalg.eigh(_symmetric(whiten @ covariance @ whiten.T))
    lift = basis @ root @ vectors
    return _symmetric(covariance + (lift * np.maximum(1.0 - values, 0.0)) @ lift.T)


def _typical(ranges: Float32) -> float:
    """m: median of a sixteenth of the ranges, 0 if there are none."""
    some = ranges[::16]
    return float(np.partition(some, len(some) // 2)[len(some) // 2]) if len(some) else 0.0


def _spread(covariance: Float64, reach: float) -> float:
    """m: standard deviation of where points at distance `reach` are expected."""
    return float(np.sqrt(np.trace(covariance[:2, :2]) / 2.0 + covariance[5, 5] * reach**2))


def _clip_gate(value: float, config: RegistrationConfig, ceiling: float = np.inf) -> float:
    return float(min(max(value, config.min_gate), config.max_gate, ceiling))


def _symmetric(matrix: npt.NDArray[np.floating]) -> Float64:
    return np.asarray(0.5 * (matrix + matrix.T), dtype=np.float64)
