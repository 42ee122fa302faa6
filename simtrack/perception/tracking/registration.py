"""Registration of all visible models to one depth image by ray tracing (tracking paper, III.B).

Each outer iteration casts the rays of the models' image windows against the scene of instances, pairs measured with
model points, and moves every instance by a few Gauss-Newton steps on robust point-to-plane and silhouette residuals,
or by the paper's Umeyama fits. Directions that the data do not constrain are found from the information matrix and not
moved.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from simtrack.contracts import Bool, CameraIntrinsics, Float32, Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import orthonormal
from simtrack.perception.tracking import correspondences as kernels
from simtrack.perception.tracking import solver
from simtrack.raycast import RayBundle, RayHits, RayScene, TriangleMesh


@dataclass(frozen=True, slots=True)
class Step:
    """One outer iteration: a cast and a few solver steps."""

    gate: float
    """Correspondences further apart than this along the model's normal are dropped, metres; 3 sigma of the sensor are
    added."""
    kernel: float
    """Scale of the Geman-McClure kernel, standard deviations."""
    edge_reach: int
    """How far from the model's edge a discontinuity is sought, pixels."""
    coarsen: int = 1
    """Take every so many-th row and column of each model's pixel grid."""
    repeats: int = 1
    """Cast again up to this often while an instance still moves by more than the configured tolerance."""
    silhouettes: Literal["always", "where-open", "never"] = "where-open"
    """Silhouettes widen the basin of convergence; they are coarse, so that in the end they only speak in directions
    that the faces leave open."""


@dataclass(frozen=True, slots=True)
class RegistrationConfig:
    """Settings of `Registration`."""

    solver: Literal["gauss-newton", "umeyama"] = "gauss-newton"
    """``umeyama`` is the tracking paper's closed-form fit, iterated on fixed correspondences."""
    schedule: tuple[Step, ...] = (
        Step(gate=0.04, kernel=12.0, edge_reach=14, silhouettes="always", coarsen=2),
        Step(gate=0.03, kernel=8.0, edge_reach=12, silhouettes="always", coarsen=2),
        Step(gate=0.02, kernel=6.0, edge_reach=10, silhouettes="always"),
        Step(gate=0.012, kernel=4.0, edge_reach=8, silhouettes="always", repeats=6),
        Step(gate=0.008, kernel=3.0, edge_reach=6),
        Step(gate=0.006, kernel=3.0, edge_reach=5, repeats=12),
    )
    """Outer iterations, coarse to fine."""
    track_schedule: tuple[Step, ...] = (
        Step(gate=0.02, kernel=6.0, edge_reach=8, silhouettes="always", coarsen=2),
        Step(gate=0.01, kernel=4.0, edge_reach=6, coarsen=2),
        Step(gate=0.006, kernel=3.0, edge_reach=5, repeats=2),
    )
    """Outer iterations from a good prediction, as of a track."""
    inner_iterations: int = 3
    """Solver steps on the same correspondences (the paper: 10 Umeyama fits)."""
    tolerance: float = 5e-5
    """An instance that an outer iteration moves by less than this has converged, metres of surface."""
    max_shift: float = 0.01
    """Longest solver step, metres: correspondences are only valid near where they were cast."""
    max_turn: float = np.deg2rad(2.0)
    """Largest solver step, radians."""
    edge_kernel: float = 3.0
    """Scale of the kernel on silhouette offsets, standard deviations."""
    edge_step: float = 0.02
    """Smallest depth step at a silhouette, metres."""
    model_sigma: float = 0.0005
    """Standard deviation of the models' surfaces, metres."""
    focal_baseline: float = 577.0 * 0.075
    """Focal length times baseline of the depth sensor, px m (Xtion)."""
    unconstrained_sigma: float = 0.01
    """A direction known less well than this from the data, metres (of the surface, for rotations), is not moved."""
    correlation_area: float = 12.0
    """Depth errors are correlated over this many pixels: that many readings count as one."""
    edge_correlation: float = 4.0
    """As `correlation_area`, for silhouette pixels."""
    edge_sigma: float = 0.0015
    """Silhouettes are listened to in directions that the faces leave less certain than this, metres of surface."""
    systematic_translation: float = 0.0004
    """Error of the pose that more pixels do not average out (model scale, sensor bias), metres."""
    systematic_rotation: float = 0.003
    """As `systematic_translation`, radians."""
    max_rays: int = 2500
    """Coarser pixel grids are used for models whose image window holds more pixels than this."""

    def __post_init__(self) -> None:
        if self.solver not in ("gauss-newton", "umeyama"):
            raise InvalidValueError("RegistrationConfig.solver", self.solver, "gauss-newton, umeyama")
        if not self.schedule or any(step.gate <= 0.0 or step.kernel <= 0.0 for step in self.schedule):
            raise InvalidValueError(
                "RegistrationConfig.schedule", self.schedule, "steps with positive gates and kernels"
            )


@dataclass(frozen=True, slots=True)
class TrackedModel:
    """A model as the registration needs it."""

    mesh: TriangleMesh
    corners: Float64
    """(8, 3) corners of its box, object frame, metres."""
    radius: float
    """Half the box's diagonal, metres: scales rotations against translations."""


@dataclass(frozen=True, slots=True)
class RegistrationResult:
    """How one instance fared."""

    T_camera_object: Float64
    """(4, 4), after registration."""
    covariance: Float64
    """(6, 6), camera frame; very large in directions that were not constrained."""
    constrained: int
    """Number of directions (0 to 6) that the data constrain."""
    rays: int
    """Rays that hit the model inside the image, on the instance's pixel grid."""
    supported: int
    """Rays on which the model's surface was measured."""
    occluded: int
    """Rays on which something was measured in front of the model."""
    missing: int
    """Rays that were measured to go through the model."""
    invalid: int
    """Rays without a reading."""
    stride: int
    """Pixel grid of the instance: a ray stands for stride x stride pixels."""
    residual: float
    """Metres: RMS of the inliers along the normal."""
    misfit: float
    """Mean squared residual of the inliers in units of the sensor model's variance: about 1 or less for a good fit."""
    edges: int
    """Silhouette pixels used."""

    @property
    def support(self) -> float:
        """Share of the model's unoccluded, valid rays that confirm it, 0 to 1; 0 without any."""
        seen = self.supported + self.missing
        return self.supported / seen if seen else 0.0


class Registration:
    """Registers instances in one scene; owns the scene and its image buffers.

    The scene is kept in the camera frame, so that errors of the robot's own pose do not enter.
    """

    def __init__(self, config: RegistrationConfig | None = None) -> None:
        self.config = config or RegistrationConfig()
        self._scene = RayScene()
        self._models: dict[int, TrackedModel] = {}
        self._depth_image = np.zeros((0, 0), np.float32)
        self._instance_image = np.zeros((0, 0), np.int32)

    def add(self, instance: int, model: TrackedModel) -> None:
        """Put an instance of a model into the scene."""
        self._scene.add(model.mesh, instance=instance)
        self._scene.set_enabled(instance, False)
        self._models[instance] = model

    def remove(self, instance: int) -> None:
        """Take an instance out of the scene."""
        self._scene.remove(instance)
        del self._models[instance]

    def close(self) -> None:
        """Release the scene's memory."""
        self._scene.close()

    def register(
        self,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        poses: Mapping[int, Float64],
        fixed: Mapping[int, Float64] | None = None,
        schedule: Sequence[Step] | None = None,
    ) -> dict[int, RegistrationResult]:
        """Register instances to a depth image.

        Args:
            depth: (H, W) metres, 0 = no reading.
            intrinsics: of the depth camera.
            poses: instance -> predicted T_camera_object (4, 4).
            fixed: instances that only occlude, with their poses.
            schedule: outer iterations to run instead of the configured ones.

        Returns:
            A result for each instance in `poses` whose box projects into the image.

        """
        current = self._place(intrinsics, poses, fixed)
        strides = self._strides(intrinsics, current)
        if not current:
            return {}
        batch = None
        for step in schedule or self.config.schedule:
            grid = {i: stride * step.coarsen for i, stride in strides.items()}
            for _ in range(step.repeats):
                batch = _Batch(self, depth, intrinsics, current, grid, step)
                batch.solve(self.config.inner_iterations)
                current = batch.poses()
                for instance, T in current.items():
                    self._scene.set_pose(instance, T)
                if batch.largest_step() < self.config.tolerance:
                    break
        return batch.results() if batch is not None else {}

    def assess(
        self,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        poses: Mapping[int, Float64],
        fixed: Mapping[int, Float64] | None = None,
    ) -> dict[int, RegistrationResult]:
        """Judge poses against a depth image without moving them: a single cast at the last gate."""
        current = self._place(intrinsics, poses, fixed)
        if not current:
            return {}
        batch = _Batch(self, depth, intrinsics, current, self._strides(intrinsics, current), self.config.schedule[-1])
        batch.solve(0)
        return batch.results()

    def depth_differences(
        self,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        instance: int,
        T_camera_object: Float64,
        reach: float,
        fixed: Mapping[int, Float64] | None = None,
    ) -> Float64:
        """Measured minus model depth on the rays that hit an instance first, metres, where within `reach`."""
        if not self._place(intrinsics, {instance: T_camera_object}, fixed):
            return np.empty(0)
        window = self._window(instance, T_camera_object, intrinsics)
        assert window is not None
        hits, pixels = self._cast(intrinsics, [(window, self._stride(window))])
        out = np.empty(len(pixels))
        count = kernels.ray_differences(pixels, hits.distances, hits.instances, depth, instance, reach, out)
        return out[:count]

    def explained(self, depth: Float32, intrinsics: CameraIntrinsics, instance: int, T_camera_object: Float64) -> Bool:
        """(H, W), True where a lone instance at a pose explains the measured depth."""
        out = np.zeros(depth.shape, bool)
        for other in self._models:
            self._scene.set_enabled(other, other == instance)
        self._scene.set_pose(instance, T_camera_object)
        window = self._window(instance, T_camera_object, intrinsics)
        if window is not None:
            hits, pixels = self._cast(intrinsics, [(window, 2)])
            measured = depth.reshape(-1)[pixels]
            variance = kernels.axial_variance(float(T_camera_object[2, 3]), 0.8, self.config.focal_baseline)
            reach = self.config.schedule[-1].gate + 3.0 * np.sqrt(variance)
            out.reshape(-1)[pixels] = (measured > 0.0) & (np.abs(measured - hits.distances) < reach)
        return out

    def _place(
        self, intrinsics: CameraIntrinsics, poses: Mapping[int, Float64], fixed: Mapping[int, Float64] | None
    ) -> dict[int, Float64]:
        """Show the given instances and no others; returns those of `poses` that project into the image."""
        current = {i: T for i, T in poses.items() if self._window(i, T, intrinsics) is not None}
        shown = {**(fixed or {}), **current}
        for instance in self._models:
            self._scene.set_enabled(instance, instance in shown)
            if instance in shown:
                self._scene.set_pose(instance, shown[instance])
        return current

    def _window(self, instance: int, T: Float64, intrinsics: CameraIntrinsics) -> tuple[int, int, int, int] | None:
        """Half-open pixel box (u0, v0, u1, v1) of the instance's box with a margin; None if it is out of view."""
        p = self._models[instance].corners @ T[:3, :3].T + T[:3, 3]
        if p[:, 2].min() < 0.05:
            return None
        u = intrinsics.fx * p[:, 0] / p[:, 2] + intrinsics.cx
        v = intrinsics.fy * p[:, 1] / p[:, 2] + intrinsics.cy
        margin = 4
        u0, u1 = max(0, int(u.min()) - margin), min(intrinsics.width, int(u.max()) + margin + 2)
        v0, v1 = max(0, int(v.min()) - margin), min(intrinsics.height, int(v.max()) + margin + 2)
        return (u0, v0, u1, v1) if u0 < u1 and v0 < v1 else None

    def _stride(self, window: tuple[int, int, int, int]) -> int:
        area = (window[2] - window[0]) * (window[3] - window[1])
        return 1 if area <= self.config.max_rays else 2 if area <= 4 * self.config.max_rays else 4

    def _strides(self, intrinsics: CameraIntrinsics, poses: Mapping[int, Float64]) -> dict[int, int]:
        """Pixel grid of every instance; chosen once for a registration, so that iterations do not alternate."""
        windows = {i: self._window(i, T, intrinsics) for i, T in poses.items()}
        return {i: self._stride(w) for i, w in windows.items() if w is not None}

    def _cast(
        self, intrinsics: CameraIntrinsics, windows: Sequence[tuple[tuple[int, int, int, int], int]]
    ) -> tuple[RayHits, Int32]:
        shape = (intrinsics.height, intrinsics.width)
        if self._depth_image.shape != shape:
            self._depth_image = np.zeros(shape, np.float32)
            self._instance_image = np.full(shape, kernels.UNKNOWN_PIXEL, np.int32)
        bundle = RayBundle.from_windows(intrinsics, [w for w, _ in windows], [stride for _, stride in windows])
        assert bundle.pixels is not None
        return self._scene.cast(bundle, np.eye(4)), bundle.pixels


class _Batch:
    """One outer iteration: a cast, its correspondences, and solver steps for every instance."""

    def __init__(
        self,
        registration: Registration,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        poses: Mapping[int, Float64],
        strides: Mapping[int, int],
        step: Step,
    ) -> None:
        config = registration.config
        self._config, self._step = config, step
        self._poses = poses
        self._instances = list(poses)
        self._models = [registration._models[i] for i in self._instances]
        self._camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
        windows = [(w, strides[i]) for i, T in poses.items() if (w := registration._window(i, T, intrinsics))]
        self._strides = np.array([strides[i] for i in poses], np.int32)
        hits, pixels = registration._cast(intrinsics, windows)
        K = len(self._instances)
        self._centres = np.array([T[:3, 3] for T in poses.values()])
        self._rotations = np.tile(np.eye(3), (K, 1, 1))
        self._shifts = np.zeros((K, 3))
        self._correspond(registration, hits, pixels, depth)
        self._radii = np.array([m.radius for m in self._models])
        self._covariance, self._constrained = np.zeros((K, 6, 6)), np.zeros(K, np.int64)
        self._stats = np.zeros((K, 3))

    def _correspond(self, registration: Registration, hits: RayHits, pixels: Int32, depth: Float32) -> None:
        config, K, N = self._config, len(self._instances), len(pixels)
        row_of = np.full(max([*registration._models, 0]) + 1, -1, np.int32)
        row_of[self._instances] = np.arange(K, dtype=np.int32)
        # Occluders that are not registered keep their rays: they are neither misses nor rows.
        rows = np.where(hits.instances >= 0, row_of[hits.instances], -1).astype(np.int32)
        seen = np.where((hits.instances >= 0) & (rows < 0), np.int32(K), rows)
        kernels.model_images(pixels, hits.distances, seen, registration._depth_image, registration._instance_image)
        gates = np.full(K, self._step.gate)
        self._measured, self._model, self._normal = (np.empty((N, 3)) for _ in range(3))
        self._weight, self._owner = np.empty(N), np.empty(N, np.int32)
        self._counts = np.zeros((K, kernels.FIELDS), np.int64)
        count = kernels.point_correspondences(
            pixels, hits.distances, hits.normals, rows, depth, self._camera, self._strides, gates, config.model_sigma,
            config.focal_baseline, self._measured, self._model, self._normal, self._weight, self._owner, self._counts,
        )  # fmt: skip
        self._measured, self._model, self._normal = self._measured[:count], self._model[:count], self._normal[:count]
        self._weight, self._owner = self._weight[:count], self._owner[:count]
        M = 0 if self._step.silhouettes == "never" else N
        self._edge_point, self._edge_direction = np.empty((M, 3)), np.empty((M, 2))
        self._edge_offset, self._edge_weight, self._edge_owner = np.empty(M), np.empty(M), np.empty(M, np.int32)
        count = 0
        if M:
            count = kernels.edge_correspondences(
                pixels, rows, depth, registration._depth_image, registration._instance_image, self._camera,
                self._strides, self._step.edge_reach, config.edge_step, config.focal_baseline,
                self._edge_point, self._edge_direction, self._edge_offset, self._edge_weight, self._edge_owner,
            )  # fmt: skip
        self._edge_point, self._edge_direction = self._edge_point[:count], self._edge_direction[:count]
        self._edge_offset, self._edge_weight = self._edge_offset[:count], self._edge_weight[:count]
        self._edge_owner = self._edge_owner[:count]
        registration._instance_image.reshape(-1)[pixels] = kernels.UNKNOWN_PIXEL

    def solve(self, iterations: int) -> None:
        """Move every instance by solver steps on the fixed correspondences (0: only judge the present poses)."""
        config = self._config
        if config.solver == "umeyama":
            solver.umeyama(
                self._measured, self._model, self._normal, self._owner, self._centres, self._rotations, self._shifts,
                iterations,
            )  # fmt: skip
            iterations = 0
        stride = self._strides.astype(float)
        points, edges = config.correlation_area / stride**2, config.edge_correlation / stride
        solver.gauss_newton(
            self._measured, self._model, self._normal, self._weight, self._owner,
            self._edge_point, self._edge_direction, self._edge_offset, self._edge_weight, self._edge_owner,
            self._camera, self._centres, self._rotations, self._shifts, self._radii,
            np.maximum(1.0, np.stack([points, edges], axis=1)), self._step.kernel, config.edge_kernel,
            _EDGES[self._step.silhouettes], config.edge_sigma, config.unconstrained_sigma, config.max_shift,
            config.max_turn, iterations, self._covariance, self._constrained, self._stats,
        )  # fmt: skip

    def poses(self) -> dict[int, Float64]:
        """T_camera_object (4, 4) of every instance after the steps so far."""
        out: dict[int, Float64] = {}
        for k, instance in enumerate(self._instances):
            T = np.eye(4)
            T[:3, :3] = orthonormal(self._rotations[k] @ self._poses[instance][:3, :3])
            T[:3, 3] = self._centres[k] + self._shifts[k]
            out[instance] = T
        return out

    def largest_step(self) -> float:
        """How far this iteration moved an instance at most, metres of surface."""
        moved = np.linalg.norm(self._shifts, axis=1)
        turned = np.sqrt(np.maximum(3.0 - np.trace(self._rotations, axis1=1, axis2=2), 0.0))
        return float(np.max(moved + turned * self._radii))

    def results(self) -> dict[int, RegistrationResult]:
        """Results of every instance at its present pose."""
        config = self._config
        out: dict[int, RegistrationResult] = {}
        for k, (instance, T) in enumerate(self.poses().items()):
            covariance = self._covariance[k].copy()
            covariance[:3, :3] += config.systematic_translation**2 * np.eye(3)
            covariance[3:, 3:] += config.systematic_rotation**2 * np.eye(3)
            supported, occluded, missing, invalid = (int(n) for n in self._counts[k, kernels.SUPPORTED :])
            inliers = max(float(self._stats[k, 0]), 1e-9)
            out[instance] = RegistrationResult(
                T, covariance, int(self._constrained[k]), supported + occluded + missing + invalid, supported,
                occluded, missing, invalid, int(self._strides[k]), float(np.sqrt(self._stats[k, 2] / inliers)),
                float(self._stats[k, 1]) / inliers,
                int(np.count_nonzero(self._edge_owner == k)),
            )  # fmt: skip
        return out


_EDGES = {
    "never": solver.EDGES_NEVER,
    "where-open": solver.EDGES_WHERE_OPEN,
    "always": solver.EDGES_ALWAYS,
}
