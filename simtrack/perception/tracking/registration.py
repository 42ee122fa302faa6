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
import numpy.typing as npt

from simtrack.contracts import Bool, CameraIntrinsics, Float32, Float64
from simtrack.errors import InvalidValueError
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
    settled: float = 1e-3
    """... and by less than this needs no other coarse iteration."""
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
    """Registers instances in one scene; owns the scene and the buffers of its kernels.

    The scene is kept in the camera frame, so that errors of the robot's own pose do not enter. Work is done on arrays
    over all instances; those that have come to rest are not cast again, and only occlude.
    """

    def __init__(self, config: RegistrationConfig | None = None) -> None:
        self.config = config or RegistrationConfig()
        self._scene = RayScene()
        self._models: dict[int, TrackedModel] = {}
        self._images = kernels.ModelImages.empty(0, 0)
        self._points, self._edges = kernels.Points.room(0), kernels.Edges.room(0)

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
        config, steps = self.config, schedule or self.config.schedule
        batch = self._batch(depth, intrinsics, poses, fixed)
        if batch is None:
            return {}
        for number, step in enumerate(steps):
            # What the last step hardly moved needs no more coarse ones.
            last = number == len(steps) - 1
            batch.active[:] = True if last or number == 0 else batch.moved > config.settled
            for _ in range(step.repeats):
                if not batch.active.any():
                    break
                self._iterate(batch, step, config.inner_iterations)
                batch.active &= batch.moved > config.tolerance
        return batch.results(config)

    def assess(
        self,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        poses: Mapping[int, Float64],
        fixed: Mapping[int, Float64] | None = None,
    ) -> dict[int, RegistrationResult]:
        """Judge poses against a depth image without moving them: a single cast at the last gate."""
        batch = self._batch(depth, intrinsics, poses, fixed)
        if batch is None:
            return {}
        self._iterate(batch, self.config.schedule[-1], 0)
        return batch.results(self.config)

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
        batch = self._batch(depth, intrinsics, {instance: T_camera_object}, fixed)
        if batch is None:
            return np.empty(0)
        bundle, hits = self._cast(batch, 1)
        out = np.empty(len(bundle))
        count = kernels.ray_differences(bundle.pixels, hits.distances, hits.instances, depth, instance, reach, out)
        return out[:count]

    def explained(self, depth: Float32, intrinsics: CameraIntrinsics, instance: int, T_camera_object: Float64) -> Bool:
        """(H, W), True where a lone instance at a pose explains the measured depth."""
        out = np.zeros(depth.shape, bool)
        batch = self._batch(depth, intrinsics, {instance: T_camera_object}, None)
        if batch is not None:
            batch.strides[:] = 2
            bundle, hits = self._cast(batch, 1)
            measured = depth.reshape(-1)[bundle.pixels]
            variance = kernels.axial_variance(float(T_camera_object[2, 3]), 0.8, self.config.focal_baseline)
            reach = self.config.schedule[-1].gate + 3.0 * np.sqrt(variance)
            out.reshape(-1)[bundle.pixels] = (measured > 0.0) & (np.abs(measured - hits.distances) < reach)
        return out

    def _batch(
        self,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        poses: Mapping[int, Float64],
        fixed: Mapping[int, Float64] | None,
    ) -> "_Batch | None":
        """Show the given instances and no others; take up those of `poses` that project into the image."""
        batch = _Batch(depth, intrinsics, self._models, poses, self.config.max_rays)
        shown = {**(fixed or {}), **dict(zip(batch.instances, batch.poses, strict=True))}
        for instance in self._models:
            self._scene.set_enabled(instance, instance in shown)
        self._scene.set_poses(list(shown), list(shown.values()))
        if self._images.depth.shape != depth.shape:
            self._images = kernels.ModelImages.empty(*depth.shape)
        return batch if batch.instances else None

    def _cast(self, batch: "_Batch", coarsen: int) -> tuple[RayBundle, RayHits]:
        """Cast the rays of the active instances' windows."""
        windows, strides = batch.windows[batch.active], coarsen * batch.strides[batch.active]
        bundle = RayBundle.from_windows(batch.intrinsics, windows.tolist(), strides.tolist())
        # Rays a few pixels apart meet other triangles of a fine mesh: they are no coherent packets.
        hits = self._scene.cast(bundle, np.eye(4), coherent=False)
        if len(bundle) > len(self._points.weight):
            self._points, self._edges = kernels.Points.room(len(bundle)), kernels.Edges.room(len(bundle))
        return bundle, hits

    def _iterate(self, batch: "_Batch", step: Step, iterations: int) -> None:
        """One outer iteration of the active instances: a cast, its correspondences, and solver steps on them."""
        config, count = self.config, len(batch.instances)
        batch.locate()
        bundle, hits = self._cast(batch, step.coarsen)
        pixels = bundle.pixels
        assert pixels is not None
        # Occluders that are not registered keep their rays: they are neither misses nor rows.
        row = np.full(max(self._models) + 1, count, np.int32)
        row[batch.instances] = np.where(batch.active, np.arange(count), count)
        rows = np.empty(len(bundle), np.int32)
        kernels.rows_of(hits.instances, row, rows)
        batch.counts[batch.active], batch.edges[batch.active] = 0, 0
        strides = step.coarsen * batch.strides
        pairs = kernels.point_correspondences(
            pixels, bundle.directions, hits.distances, hits.normals, rows, batch.depth.reshape(-1),
            batch.depth.shape[1], strides, step.gate, 0.0, config.model_sigma, config.focal_baseline,
            0.4 / batch.camera[0], self._points, batch.counts,
        )  # fmt: skip
        edge_pairs = 0
        if step.silhouettes != "never":
            kernels.draw(pixels, hits.distances, rows, self._images)
            edge_pairs = kernels.edge_correspondences(
                pixels, rows, batch.depth, self._images, batch.camera, strides, step.edge_reach, config.edge_step,
                config.focal_baseline, self._edges, batch.edges,
            )  # fmt: skip
            kernels.erase(pixels, self._images)
        batch.solve(self._points, pairs, self._edges, edge_pairs, strides, step, config, iterations)
        if iterations:
            moved = np.flatnonzero(batch.active)
            self._scene.set_poses([batch.instances[k] for k in moved], batch.poses[moved])


class _Batch:
    """The instances of one registration: poses, windows, and how they fared, one row each."""

    def __init__(
        self,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        models: Mapping[int, TrackedModel],
        poses: Mapping[int, Float64],
        max_rays: int,
    ) -> None:
        self.depth, self.intrinsics = np.ascontiguousarray(depth), intrinsics
        self.camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
        self._take(models, poses, list(poses))
        inside = self.windows[:, 2] > self.windows[:, 0]
        if not inside.all():
            self._take(models, poses, [i for i, shown in zip(poses, inside, strict=True) if shown])
        area = (self.windows[:, 2] - self.windows[:, 0]) * (self.windows[:, 3] - self.windows[:, 1])
        self.strides = np.where(area <= max_rays, 1, np.where(area <= 4 * max_rays, 2, 4))
        """(K,), pixel grids; chosen once for a registration, so that iterations do not alternate."""
        count = len(self.instances)
        self.active, self.moved = np.ones(count, bool), np.zeros(count)
        """(K,), takes part in the present iteration; (K,), metres of surface moved by its last one."""
        self.counts, self.edges = np.zeros((count, kernels.FIELDS), np.int64), np.zeros(count, np.int64)
        self.used = self.strides.copy()
        self.covariance, self.constrained = np.zeros((count, 6, 6)), np.zeros(count, np.int64)
        self.stats = np.zeros((count, 3))

    def _take(self, models: Mapping[int, TrackedModel], poses: Mapping[int, Float64], instances: list[int]) -> None:
        self.instances = instances
        self.poses = np.array([poses[i] for i in instances]).reshape(-1, 4, 4)
        self._corners = np.array([models[i].corners for i in instances]).reshape(-1, 8, 3)
        self._radii = np.array([models[i].radius for i in instances])
        self.windows = np.zeros((len(instances), 4), np.int64)
        self.locate()

    def locate(self) -> None:
        """Find the pixel windows of the present poses."""
        size = (self.intrinsics.width, self.intrinsics.height)
        kernels.image_windows(self._corners, self.poses, self.camera, size, 4, self.windows)

    def solve(
        self,
        points: kernels.Points,
        pairs: int,
        edges: kernels.Edges,
        edge_pairs: int,
        strides: npt.NDArray[np.int64],
        step: Step,
        config: RegistrationConfig,
        iterations: int,
    ) -> None:
        """Move the active instances by solver steps on fixed correspondences (0: only judge the present poses)."""
        count = len(self.instances)
        centres, shifts = self.poses[:, :3, 3].copy(), np.zeros((count, 3))
        rotations = np.tile(np.eye(3), (count, 1, 1))
        self.used[self.active] = strides[self.active]
        steps = iterations
        if config.solver == "umeyama":
            solver.umeyama(points, pairs, centres, rotations, shifts, iterations)
            steps = 0
        shares = np.array([[config.correlation_area / s**2, config.edge_correlation / s] for s in strides])
        settings = solver.SolverSettings(
            step.kernel, config.edge_kernel, _EDGES[step.silhouettes], config.edge_sigma, config.unconstrained_sigma,
            config.max_shift, config.max_turn,
        )  # fmt: skip
        solver.gauss_newton(
            points, pairs, edges, edge_pairs, self.camera, centres, rotations, shifts, self._radii,
            np.maximum(1.0, shares), self.active, settings, steps, self.covariance, self.constrained, self.stats,
        )  # fmt: skip
        if iterations:
            solver.advance(self.poses, rotations, shifts, self._radii, self.active, self.moved)

    def results(self, config: RegistrationConfig) -> dict[int, RegistrationResult]:
        """Results of every instance at its present pose."""
        systematic = np.repeat([config.systematic_translation**2, config.systematic_rotation**2], 3)
        out: dict[int, RegistrationResult] = {}
        for k, instance in enumerate(self.instances):
            supported, occluded, missing, invalid = (int(n) for n in self.counts[k, kernels.SUPPORTED :])
            inliers = max(float(self.stats[k, 0]), 1e-9)
            out[instance] = RegistrationResult(
                T_camera_object=self.poses[k].copy(),
                covariance=self.covariance[k] + np.diag(systematic),
                constrained=int(self.constrained[k]),
                rays=supported + occluded + missing + invalid,
                supported=supported,
                occluded=occluded,
                missing=missing,
                invalid=invalid,
                stride=int(self.used[k]),
                residual=float(np.sqrt(self.stats[k, 2] / inliers)),
                misfit=float(self.stats[k, 1]) / inliers,
                edges=int(self.edges[k]),
            )
        return out


_EDGES = {
    "never": solver.EDGES_NEVER,
    "where-open": solver.EDGES_WHERE_OPEN,
    "always": solver.EDGES_ALWAYS,
}
