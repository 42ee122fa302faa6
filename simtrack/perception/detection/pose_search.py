"""Poses of detected objects that agree with their keypoints, their boxes and the measured depth.

PnP takes keypoints at their word. Here they are one witness of three: orientations from a grid over all of them are
placed where keypoints and box want them, the likeliest are cast as models, alone, by a coarse grid of rays inside of
the box, slid along the viewing ray to the measured depth, and judged by where both depths agree. The best are refined
by the registration's solver and judged again. Detections whose keypoints are too poor for PnP have poses, too.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from simtrack.contracts import CameraIntrinsics, Detection, Float32, Float64, PoseHypothesis
from simtrack.geometry.transforms import transform
from simtrack.objects import ObjectModel
from simtrack.perception.detection import pnp_kernels
from simtrack.perception.detection import search_kernels as kernels
from simtrack.perception.detection.evidence import (
    Evidence,
    PoseSearchConfig,
    RayGrid,
    ShownModel,
    drawn_about,
    rotation_grid,
)
from simtrack.perception.detection.pnp import PnpConfig
from simtrack.perception.tracking import correspondences, solver
from simtrack.perception.tracking.registration_config import RegistrationConfig
from simtrack.raycast import RayScene, TriangleMesh

STEPS = ((0.03, 10.0), (0.03, 8.0), (0.02, 6.0), (0.015, 5.0))
"""Of the refinement: gates in metres and scales of the robust kernel, as of `Step` ..."""
NARROW_STEPS = ((0.012, 6.0), (0.012, 5.0), (0.01, 5.0))
"""... and where those slide onto something else."""
REGISTRATION = RegistrationConfig()


class PoseSearch:
    """Finds poses of one detection at a time."""

    def __init__(self, models: Mapping[str, ObjectModel], config: PoseSearchConfig | None = None) -> None:
        self.config = config or PoseSearchConfig()
        self._rotations = rotation_grid(self.config.orientations)
        self._models = dict(models)
        self._shown: dict[str, ShownModel] = {}

    def close(self) -> None:
        """Release the scenes' memory."""
        for shown in self._shown.values():
            shown.scene.close()
        self._shown.clear()

    def search(
        self,
        detection: Detection,
        depth: Float32,
        intrinsics: CameraIntrinsics,
        stamp: int,
        starts: Sequence[PoseHypothesis] = (),
    ) -> list[PoseHypothesis] | None:
        """Poses of a detected object, the likeliest first.

        Args:
            detection: keypoints (9, 2), their standard deviations and its box, pixels.
            depth: (H, W), metres, 0 = no reading.
            intrinsics: of the image.
            stamp: of the image, nanoseconds.
            starts: further poses to be looked at, as PnP's.

        Returns:
            Empty where no pose agrees with the measured depth: the detection is wrong. None where nothing can be said:
            there is no depth in the box, or the box is only that of the keypoints.
        """
        if drawn_about(detection.keypoints, np.asarray(detection.box, float)):
            return None
        shown = self.shown(detection.class_name)
        evidence = Evidence.of(detection, shown, depth, intrinsics, self.config)
        if evidence is None:
            return None
        rotations, shifts, costs = self._likeliest(evidence, starts)
        scores = self._slide(evidence, shown, rotations, shifts)
        placed = np.array([transform(R, t) for R, t in zip(rotations, shifts, strict=True)])
        poses = self._distinct(placed, costs - self.config.depth_weight * scores, shown, self.config.refined)
        poses, costs, supports = self._refined(evidence, shown, poses)
        seen = supports >= self.config.least_support
        best = self._distinct(poses[seen], costs[seen], shown, self.config.kept)
        return [_hypothesis(evidence, T, detection, stamp) for T in best]

    def shown(self, name: str) -> ShownModel:
        """A model as it is tried, made ready at first use."""
        if name not in self._shown:
            model, scene = self._models[name], RayScene()
            scene.add(TriangleMesh(model.mesh.vertices, model.mesh.faces))
            points = np.asarray(model.mesh.vertices, float)
            directions = rotation_grid(60)[:, 0]
            extreme = np.unique(np.argmax(points @ directions.T, axis=0))
            radius = 0.5 * float(np.linalg.norm(model.extents))
            alike = model.symmetries.poses(0.5 * self.config.distinct)[:, :3, :3]
            self._shown[name] = ShownModel(model, scene, points[extreme], radius, alike)
        return self._shown[name]

    def _likeliest(self, e: "Evidence", starts: Sequence[PoseHypothesis]) -> tuple[Float64, Float64, Float64]:
        """Rotations, positions and costs of the grid's orientations that suit keypoints and box best, and `starts`."""
        shifts, costs = np.empty((len(self._rotations), 3)), np.empty(len(self._rotations))
        kernels.place_and_judge(
            self._rotations, e.keypoints, e.pixels, e.sigma, e.rays, e.solve, e.distance, e.outline, e.box,
            e.box_sigma, e.size, e.camera, shifts, costs,
        )  # fmt: skip
        best = np.argsort(costs, kind="stable")[: self.config.cast]
        best = best[np.isfinite(costs[best])]
        given = [h.T_camera_object for h in starts]
        rotations = np.concatenate([self._rotations[best], np.array([T[:3, :3] for T in given]).reshape(-1, 3, 3)])
        positions = np.concatenate([shifts[best], np.array([T[:3, 3] for T in given]).reshape(-1, 3)])
        return rotations, positions, np.concatenate([costs[best], [e.cost(T[:3, :3], T[:3, 3]) for T in given]])

    def _slide(self, e: "Evidence", shown: ShownModel, rotations: Float64, shifts: Float64) -> Float64:
        """Slide poses to the measured depth, in place; returns the shares of rays that agree less those that do not."""
        grid = e.grid(self.config.rays)
        distances, _ = _cast(shown, rotations, shifts, grid.directions)
        slid, scores = np.empty(len(shifts)), np.empty(len(shifts))
        kernels.slide(
            distances, e.depth[grid.pixels], self.config.reach, e.tolerance, self.config.front, shifts[:, 2],
            self.config.distance_sigma, slid, scores,
        )  # fmt: skip
        shifts *= ((shifts[:, 2] + slid) / shifts[:, 2])[:, None]
        return scores / len(grid.pixels)

    def _distinct(self, poses: Float64, costs: Float64, shown: ShownModel, count: int) -> Float64:
        """(H, 4, 4): the best `count` of the poses (N, 4, 4) that are not turned alike, the best first."""
        rotations, order = poses[:, :3, :3].reshape(-1, 9), np.argsort(costs, kind="stable")
        kept: list[int] = []
        while len(order) and len(kept) < count:
            kept.append(int(order[0]))
            alike = (poses[order[0], :3, :3] @ shown.alike).reshape(-1, 9)
            # The trace of a rotation from one pose to another tells its angle.
            nearest = (rotations[order] @ alike.T).max(axis=1)
            order = order[nearest < 1.0 + 2.0 * np.cos(self.config.distinct)]
        return poses[kept]

    def _refined(self, e: Evidence, shown: ShownModel, poses: Float64) -> tuple[Float64, Float64, Float64]:
        """Poses (H, 4, 4) refined, their costs (H,) and supports (H,).

        The solver knows of depth alone, and takes a hand for the object in it, against keypoints and silhouette.
        Where that made a pose so much worse, it is done again with what is near, or the pose stays as it was.
        """
        before, supports = self._judge(e, shown, poses)
        refined = poses.copy()
        self._refine(e, shown, refined, STEPS)
        costs, support = self._judge(e, shown, refined)
        slid = costs > before + self.config.slip
        if slid.any():
            refined[slid], costs[slid], support[slid] = poses[slid], before[slid], supports[slid]
            again = poses[slid]
            self._refine(e, shown, again, NARROW_STEPS)
            after, seen = self._judge(e, shown, again)
            better = after < before[slid]
            rows = np.flatnonzero(slid)[better]
            refined[rows], costs[rows], support[rows] = again[better], after[better], seen[better]
        return refined, costs, support

    def _refine(self, e: Evidence, shown: ShownModel, poses: Float64, steps: Sequence[tuple[float, float]]) -> None:
        """Move poses (H, 4, 4) by the registration's solver on coarse rays, in place."""
        count = len(poses)
        grid = e.grid(self.config.fine_rays)
        points, no_edges = correspondences.Points.room(count * len(grid.pixels)), correspondences.Edges.room(0)
        radii, alone, active = np.full(count, shown.radius), np.ones((count, 2)), np.ones(count, bool)
        covariance, constrained, stats = np.zeros((count, 6, 6)), np.zeros(count, np.int64), np.zeros((count, 3))
        moved, deviations = np.zeros(count), np.zeros(count)
        for gate, kernel in steps:
            pairs = self._paired(e, grid, shown, poses, gate, points)[0]
            settings = solver.SolverSettings(
                kernel, 1.0, solver.EDGES_NEVER, REGISTRATION.edge_sigma, REGISTRATION.unconstrained_sigma,
                self.config.max_shift, self.config.max_turn, self.config.last_step,
            )  # fmt: skip
            rotations, shifts = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
            solver.gauss_newton(
                points, pairs, no_edges, 0, e.camera, poses[:, :3, 3].copy(), rotations, shifts, radii, alone, active,
                settings, REGISTRATION.inner_iterations, covariance, constrained, stats,
            )  # fmt: skip
            solver.advance(poses, rotations, shifts, radii, covariance, active, moved, deviations)

    def _judge(self, e: Evidence, shown: ShownModel, poses: Float64) -> tuple[Float64, Float64]:
        """Costs (H,) of poses (H, 4, 4), lower where keypoints, box, depth and silhouette agree, and their supports."""
        config, grid = self.config, e.grid(self.config.fine_rays)
        points = correspondences.Points.room(len(poses) * len(grid.pixels))
        _, counts, distances = self._paired(e, grid, shown, poses, config.tolerance, points)
        border = np.zeros((len(poses), 2), np.int64)
        kernels.borders(distances, e.depth[grid.pixels], grid.columns, config.border_step, border)
        supported, missing = counts[:, correspondences.SUPPORTED], counts[:, correspondences.MISSING]
        agree = (supported - missing - config.front * counts[:, correspondences.OCCLUDED]) / len(grid.pixels)
        silhouette = border[:, 0] / np.maximum(border.sum(axis=1), 1)
        expected = np.array([e.cost(T[:3, :3], T[:3, 3]) for T in poses])
        costs = expected - config.depth_weight * agree - config.border_weight * silhouette
        return costs, supported / np.maximum(supported + missing, 1)

    def _paired(
        self,
        e: Evidence,
        grid: RayGrid,
        shown: ShownModel,
        poses: Float64,
        gate: float,
        points: correspondences.Points,
    ) -> tuple[int, npt.NDArray[np.int64], Float32]:
        """Cast a model at poses (H, 4, 4), and pair what is met with what was measured.

        Returns:
            Number of pairs in `points`; rays by verdict (H, FIELDS); depths (H, N) of the model, metres, inf = none.
        """
        rotations, count = np.ascontiguousarray(poses[:, :3, :3]), len(poses)
        distances, turned = _cast(shown, rotations, np.ascontiguousarray(poses[:, :3, 3]), grid.directions)
        normals = np.empty(turned.shape)
        kernels.normals_of(rotations, turned, normals)
        owners = np.repeat(np.arange(count, dtype=np.int32), len(grid.pixels))
        rows = np.where(np.isfinite(distances.ravel()), owners, np.int32(-1))
        counts = np.zeros((count, correspondences.FIELDS), np.int64)
        pairs = correspondences.point_correspondences(
            np.tile(grid.pixels, count), np.tile(grid.directions, (count, 1)), distances.ravel(), normals, rows,
            e.depth, e.intrinsics.width, np.ones(count, np.int64), gate, 1.0, 0.0, REGISTRATION.model_sigma,
            REGISTRATION.focal_baseline, 0.4 / e.camera[0], np.zeros(3), points, 0, counts,
        )  # fmt: skip
        return pairs, counts, distances


def _hypothesis(e: Evidence, T: Float64, detection: Detection, stamp: int) -> PoseHypothesis:
    error = np.sqrt(pnp_kernels.squared_error(T, e.keypoints, e.pixels, e.camera) / max(len(e.pixels), 1))
    covariance = PnpConfig().error_correlation * np.asarray(
        pnp_kernels.covariance(T, e.keypoints, e.sigma, e.camera), np.float64
    )
    return PoseHypothesis(detection.class_name, stamp, T, covariance, float(error), detection.score)


def _cast(shown: ShownModel, rotations: Float64, shifts: Float64, directions: Float32) -> tuple[Float32, Float32]:
    """Depths (H, N) along camera rays (N, 3) of the model at each pose, inf = none, and normals (H * N, 3) there."""
    count = len(rotations) * len(directions)
    origins, turned = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    kernels.rays_of(rotations, shifts, directions, origins, turned)
    hits = shown.scene.cast_rays(origins, turned)
    return hits.distances.reshape(len(rotations), -1), hits.normals
