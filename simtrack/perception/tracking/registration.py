"""Registration of all visible models to one depth image by ray tracing (tracking paper, III.B).

Each outer iteration casts the rays of the models' image windows against the scene of instances, pairs measured with
model points, and moves every instance by a few Gauss-Newton steps on robust point-to-plane and silhouette residuals,
or by the paper's Umeyama fits. Directions that the data do not constrain are found from the information matrix and not
moved.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Bool, CameraIntrinsics, Float32, Float64
from simtrack.perception.tracking import correspondences as kernels
from simtrack.perception.tracking import solver
from simtrack.perception.tracking.iteration import NO_SILHOUETTES, iterate
from simtrack.perception.tracking.registration_config import RegistrationConfig, Step
from simtrack.raycast import RayBundle, RayHits, RayScene, TriangleMesh

_IDENTITY = np.eye(4)


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
        self._shown: set[int] = set()
        self._images = kernels.ModelImages.empty(0, 0)
        self._marks = kernels.no_marks(0, 0)
        """Where the casts of a track have hit something, or nearly: a fine one needs no other rays."""
        self._points, self._edges = kernels.Points.room(0), kernels.Edges.room(0)
        self.on_cast: Callable[[], None] | None = None
        """Called before every cast."""

    def add(self, instance: int, model: TrackedModel) -> None:
        """Put an instance of a model into the scene."""
        self._scene.add(model.mesh, instance=instance)
        self._scene.set_enabled(instance, False)
        self._models[instance] = model

    def remove(self, instance: int) -> None:
        """Take an instance out of the scene."""
        self._scene.remove(instance)
        self._shown.discard(instance)
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
        batch = self._batch(depth, intrinsics, poses, fixed)
        if batch is None:
            return {}
        self._follow(batch, schedule or self.config.schedule, np.ones(len(batch.instances), bool))
        return batch.results(self.config)

    def track(
        self, depth: Float32, intrinsics: CameraIntrinsics, poses: Mapping[int, Float64]
    ) -> dict[int, RegistrationResult]:
        """Register instances from good predictions, see `register`: those that are near get by with little work."""
        config = self.config
        batch = self._batch(depth, intrinsics, poses, None)
        if batch is None:
            return {}
        began = time.perf_counter()
        predicted = batch.poses.copy()
        self._marks[:] = 0
        self._follow(batch, (config.near,), np.ones(len(batch.instances), bool))
        # What no ray met is hidden: nothing tells where it is.
        far = ~batch.near(predicted, config) & (batch.counts[:, kernels.SUPPORTED :].sum(axis=1) > 0)
        if far.any():
            batch.poses[far] = predicted[far]
            self._follow(batch, config.track_schedule, far)
        hurried = config.patience is not None and time.perf_counter() - began > config.patience
        if config.finish is not None and not hurried:
            self._follow(batch, (config.finish,), np.ones(len(batch.instances), bool))
        return batch.results(config)

    def _follow(self, batch: "_Batch", steps: Sequence[Step], chosen: npt.NDArray[np.bool_]) -> None:
        """Take the chosen instances through outer iterations."""
        config = self.config
        for number, step in enumerate(steps):
            # What the last step hardly moved needs no more coarse ones.
            last = number == len(steps) - 1
            batch.active[:] = chosen if last or number == 0 else chosen & (batch.moved > config.settled)
            for _ in range(step.repeats):
                if not batch.active.any():
                    break
                self._iterate(batch, step, config.inner_iterations)
                batch.active &= (batch.moved > config.tolerance) & (batch.deviations > config.insignificant)

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
        bundle, hits = self._cast(batch, batch.strides)
        out = np.empty(len(bundle))
        count = kernels.ray_differences(bundle.pixels, hits.distances, hits.instances, depth, instance, reach, out)
        return out[:count]

    def explained(self, depth: Float32, intrinsics: CameraIntrinsics, instance: int, T_camera_object: Float64) -> Bool:
        """(H, W), True where a lone instance at a pose explains the measured depth."""
        out = np.zeros(depth.shape, bool)
        batch = self._batch(depth, intrinsics, {instance: T_camera_object}, None)
        if batch is not None:
            batch.strides[:] = 2
            bundle, hits = self._cast(batch, batch.strides)
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
        batch = _Batch(depth, intrinsics, self._models, poses, self.config)
        shown = {**(fixed or {}), **dict(zip(batch.instances, batch.poses, strict=True))}
        for instance in self._shown ^ shown.keys():
            self._scene.set_enabled(instance, instance in shown)
        self._shown = set(shown)
        self._scene.set_poses(list(shown), list(shown.values()))
        if self._images.depth.shape != depth.shape:
            self._images = kernels.ModelImages.empty(*depth.shape)
            self._marks = kernels.no_marks(*depth.shape)
        return batch if batch.instances else None

    def _cast(self, batch: "_Batch", strides: npt.NDArray[np.int64], marked: bool = False) -> tuple[RayBundle, RayHits]:
        """Cast the rays of the active instances' windows, on pixel grids (K,), or those that are marked."""
        if self.on_cast is not None:
            self.on_cast()
        windows, grids = batch.windows[batch.active], strides[batch.active]
        if marked:
            bundle = RayBundle.from_pixels(batch.intrinsics, kernels.take_marked(self._marks, *batch.depth.shape))
        else:
            bundle = RayBundle.from_windows(batch.intrinsics, windows, grids)
        # Rays a few pixels apart meet other triangles of a fine mesh: they are no coherent packets.
        hits = self._scene.cast(bundle, _IDENTITY, coherent=None if (grids == 1).all() else False)
        if len(bundle) > len(self._points.weight):
            self._points, self._edges = kernels.Points.room(len(bundle)), kernels.Edges.room(len(bundle))
        return bundle, hits

    def _iterate(self, batch: "_Batch", step: Step, iterations: int) -> None:
        """One outer iteration of the active instances: a cast, its correspondences, and solver steps on them."""
        config = self.config
        batch.locate()
        strides = batch.fine_strides if step.fine else step.coarsen * batch.strides
        bundle, hits = self._cast(batch, strides, marked=step.fine)
        reach = step.edge_reach if step.silhouettes != "never" else NO_SILHOUETTES
        iterate(
            bundle.pixels, bundle.directions, hits.distances, hits.normals, hits.instances, batch.depth, *self._images,
            self._marks, *self._points, *self._edges, batch.ids, batch.active, strides, batch.fine_strides,
            batch.radii, batch.camera, batch.poses, batch.counts, batch.edges, batch.used, batch.covariance,
            batch.constrained, batch.stats, batch.moved, batch.deviations, step.fine, step.gate, config.front,
            config.model_sigma, config.focal_baseline, reach, config.edge_step, config.correlation_area,
            config.edge_correlation, _EDGES[step.silhouettes], step.kernel, config.edge_kernel, config.edge_sigma,
            config.unconstrained_sigma, config.max_shift, config.max_turn, config.last_step, iterations,
            config.solver == "umeyama",
        )  # fmt: skip
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
        config: RegistrationConfig,
    ) -> None:
        self.depth, self.intrinsics = np.ascontiguousarray(depth), intrinsics
        self.camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
        self._take(models, poses, list(poses))
        inside = self.windows[:, 2] > self.windows[:, 0]
        if not inside.all():
            self._take(models, poses, [i for i, shown in zip(poses, inside, strict=True) if shown])
        area = (self.windows[:, 2] - self.windows[:, 0]) * (self.windows[:, 3] - self.windows[:, 1])
        self.strides, self.fine_strides = (
            np.where(area <= limit, 1, np.where(area <= 4 * limit, 2, 4))
            for limit in (config.max_rays, config.max_fine_rays)
        )
        """(K,), pixel grids; chosen once for a registration, so that iterations do not alternate."""
        count = len(self.instances)
        self.active, self.moved, self.deviations = np.ones(count, bool), np.zeros(count), np.zeros(count)
        """(K,), takes part in the present iteration; how far the last one moved, metres of surface and deviations."""
        self.counts, self.edges = np.zeros((count, kernels.FIELDS), np.int64), np.zeros(count, np.int64)
        self.used = self.strides.copy()
        self.covariance, self.constrained = np.zeros((count, 6, 6)), np.zeros(count, np.int64)
        self.stats = np.zeros((count, 3))

    def _take(self, models: Mapping[int, TrackedModel], poses: Mapping[int, Float64], instances: list[int]) -> None:
        self.instances, self.ids = instances, np.array(instances, np.int64)
        self.poses = np.array([poses[i] for i in instances]).reshape(-1, 4, 4)
        self._corners = np.array([models[i].corners for i in instances]).reshape(-1, 8, 3)
        self.radii = np.array([models[i].radius for i in instances])
        self.windows = np.zeros((len(instances), 4), np.int64)
        self.locate()

    def locate(self) -> None:
        """Find the pixel windows of the present poses."""
        size = (self.intrinsics.width, self.intrinsics.height)
        kernels.image_windows(self._corners, self.poses, self.camera, size, 4, self.windows)

    def near(self, predicted: Float64, config: RegistrationConfig) -> npt.NDArray[np.bool_]:
        """(K,), whether an instance fits well, not far from its predicted pose (K, 4, 4)."""
        supported, missing = self.counts[:, kernels.SUPPORTED], self.counts[:, kernels.MISSING]
        support = supported / np.maximum(supported + missing, 1)
        misfit = self.stats[:, 1] / np.maximum(self.stats[:, 0], 1e-9)
        shift = np.linalg.norm(self.poses[:, :3, 3] - predicted[:, :3, 3], axis=1)
        trace = np.einsum("kij,kij->k", self.poses[:, :3, :3], predicted[:, :3, :3])
        moved = shift + np.sqrt(np.maximum(3.0 - trace, 0.0)) * self.radii
        return (support >= config.near_support) & (misfit <= config.near_misfit) & (moved <= config.near_move)

    def results(self, config: RegistrationConfig) -> dict[int, RegistrationResult]:
        """Results of every instance at its present pose."""
        systematic = np.diag(np.repeat([config.systematic_translation**2, config.systematic_rotation**2], 3))
        out: dict[int, RegistrationResult] = {}
        for k, instance in enumerate(self.instances):
            supported, occluded, missing, invalid = (int(n) for n in self.counts[k, kernels.SUPPORTED :])
            inliers = max(float(self.stats[k, 0]), 1e-9)
            out[instance] = RegistrationResult(
                T_camera_object=self.poses[k].copy(),
                covariance=self.covariance[k] + systematic,
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
