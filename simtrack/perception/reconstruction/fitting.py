"""One oriented model against one entity: where it starts, its alignment, and the errors that rank it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from simtrack.contracts import Bool, Float64
from simtrack.geometry.meshes import area
from simtrack.geometry.transforms import transform
from simtrack.perception.reconstruction.alignment import (
    AlignmentConfig,
    AlignmentProblem,
    PlanePairs,
    PointPairs,
    solve,
)
from simtrack.perception.reconstruction.clearances import SIDES, wall_clearances
from simtrack.perception.reconstruction.matching import ORIENTATIONS, CadMatch
from simtrack.perception.reconstruction.surfaces import FACING, TOLERANCE, ModelSurface, SurfacePoints, model_surface
from simtrack.perception.scene_graph.contact import ContactGraph, EntityKind, EntityNode, SupportKind

OPENINGS = (0.25, 0.5, 0.75)
"""Shares of the range of a joint that are tried."""
OPENED = 0.9
"""Share of the error that an opened joint must not exceed to be believed."""
SURPLUS = 0.5
"""Weight of what the model has and the entity has not."""
PROPORTIONS = 0.3
"""What a side of the box that is larger or smaller by a factor of e adds to the error, relative to it."""
YAW_STARTS = (0.0, -np.pi / 6, np.pi / 6)
"""Where the yaw of what is no box starts: its smallest box may be turned against it."""
ALL_ROUND = tuple(float(turn) for turn in np.arange(12) * (np.pi / 6))
"""The same over all of the circle."""
DENSE = 5
"""Points of an entity's surface that a model's are compared with, for every point that is aligned."""
SPARSE = 3
"""Every how many-th point of a model is compared with the entity."""
_ROUND = 24
"""Yaw symmetries of a model that any turn maps onto itself."""
_OUTWARD = 0.7
"""Cosine between a point's normal and a side that it counts for."""


@dataclass(frozen=True, eq=False)
class EntityView:
    """What alignment needs to know of an entity, in the frame of its box."""

    node: EntityNode
    surface: SurfacePoints
    """Points that are aligned."""
    dense: SurfacePoints
    """More points, among which a model's find their nearest."""
    tied: bool
    """Whether it stands on the lower side of its box."""
    to_walls: Float64
    """(4,) metres from each of `SIDES` of its box to a wall; inf where there is none."""

    @staticmethod
    def of(node: EntityNode, graph: ContactGraph, samples: int) -> "EntityView":
        """The view of a node that has a mesh."""
        assert node.shape is not None
        points = SurfacePoints.of(node.shape.mesh, DENSE * samples)
        T = node.T_map_entity
        R_box, origin = node.box.T_map_box[:3, :3], node.box.T_map_box[:3, 3]
        places = (points.points @ T[:3, :3].T + T[:3, 3] - origin) @ R_box
        normals = points.normals @ T[:3, :3].T @ R_box
        few = SurfacePoints(places[:samples], normals[:samples])
        tied = graph.supports[node.name].kind is not SupportKind.HUNG
        return EntityView(node, few, SurfacePoints(places, normals), tied, wall_clearances(node.box, graph))

    @property
    def extents(self) -> Float64:
        """(3,), side lengths of the box."""
        return self.node.box.extents

    @property
    def diagonal(self) -> float:
        """Of the box, metres."""
        return float(np.linalg.norm(self.extents))

    @cached_property
    def area(self) -> float:
        """Of the seen surface, square metres."""
        assert self.node.shape is not None
        return area(self.node.shape.mesh)

    @cached_property
    def facing_sides(self) -> Float64:
        """(4,) shares of the surface that face the way of each of `SIDES`."""
        return (self.surface.normals[:, :2] @ SIDES.T > _OUTWARD).mean(axis=0)

    @cached_property
    def open_sides(self) -> Bool:
        """(4,) which of `SIDES` nothing was seen of: the entity may go on behind them."""
        facing = self.surface.normals[:, :2] @ SIDES.T > _OUTWARD
        depth = 0.5 * np.abs(SIDES) @ self.extents[:2] - self.surface.points[:, :2] @ SIDES.T
        near = depth < np.maximum(0.15 * np.abs(SIDES) @ self.extents[:2], 0.02)
        return (facing & near).sum(axis=0) < 0.01 * len(facing)

    @cached_property
    def boxy(self) -> bool:
        """Whether most of the upright surface is parallel to the sides of the box."""
        normals = self.surface.normals[np.abs(self.surface.normals[:, 2]) < 0.3]
        parallel = np.abs(normals[:, :2] @ SIDES[:2].T).max(axis=1, initial=0.0) > np.cos(np.radians(12.0))
        return len(normals) > 0.1 * len(self.surface.normals) and bool(parallel.mean() > 0.7)

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import KDTree

        return KDTree(np.concatenate([self.dense.points, FACING * self.diagonal * self.dense.normals], axis=1))

    def distances(self, points: Float64, normals: Float64) -> Float64:
        """(N,) distances in position and normal from (N, 3) points in the frame of the box to the surface, metres."""
        queries = np.concatenate([points, FACING * self.diagonal * normals], axis=1)
        return self._tree.query(queries, eps=TOLERANCE)[0]

    def alignment_error(self, fit: "Fit") -> float:
        """AE: root mean square distance of the entity's surface from the closest points of the aligned model, metres.

        The paper takes vertices, which are spread evenly in its meshes; here points are.
        """
        from simtrack.raycast import RayScene

        with RayScene() as scene:
            scene.add(fit.surface.triangles)
            T = fit.T_box_model
            distances = scene.closest_points((self.surface.points - T[:3, 3]) @ T[:3, :3] / fit.scale).distances
        return float(fit.scale * np.sqrt(np.mean(distances.astype(float) ** 2)))


@dataclass(frozen=True, eq=False)
class Fit:
    """An aligned model."""

    match: CadMatch
    surface: ModelSurface
    """The model at its joint positions."""
    unknowns: Float64
    """(4,), see `alignment.UNKNOWNS`."""
    centre_height: float
    """Of the model's centre in the frame of the box."""
    error: float
    """See `surface_error`."""

    @property
    def scale(self) -> float:
        """The factor alpha of Eq. 11."""
        return float(np.exp(self.unknowns[0]))

    @cached_property
    def T_box_model(self) -> Float64:
        """(4, 4), rigid."""
        yaw = _turn(self.unknowns[1])
        return transform(yaw @ ORIENTATIONS[self.match.orientation], np.array([*self.unknowns[2:], self.centre_height]))


def coarse_fit(view: EntityView, match: CadMatch, config: AlignmentConfig) -> Fit:
    """Align an oriented model with an entity by boxes and planes alone: e_b and e_p."""
    problem = _problem(view, match, config)
    surface = model_surface(match.model, config.model_samples)
    return _rated(view, match, surface, problem, solve(problem, problem.start))


def refined(view: EntityView, fit: Fit, config: AlignmentConfig, starts: Sequence[float] = YAW_STARTS) -> Fit:
    """Align a model further with the points of the entity's surface, which find their counterparts anew in rounds.

    The yaw of what is no box is tried from each of the `starts`, radians.
    """
    turns = starts if not view.boxy and len(fit.match.model.yaw_symmetries) < _ROUND else (0.0,)
    return min((fit, *(_from(view, fit, turn, config) for turn in turns)), key=lambda found: found.error)


def _from(view: EntityView, fit: Fit, turn: float, config: AlignmentConfig) -> Fit:
    """The refined fit when its yaw starts `turn` radians off.

    Footprint and upright planes of what is no box say nothing of its yaw: a cup's box is turned as its handle and its
    rim happen to fill it best, and its planes are flat strips of something round. What has doors has planes that tell.
    """
    if not view.boxy:
        config = replace(config, footprint_weight=0.0)
    problem = _problem(view, fit.match, config)
    if not view.boxy and view.node.kind is not EntityKind.ARTICULATED:
        problem = replace(problem, planes=problem.planes.level())
    unknowns = fit.unknowns + [0.0, turn, 0.0, 0.0]
    for _ in range(config.rounds):
        previous = unknowns
        points = _point_pairs(view, fit, problem, unknowns)
        unknowns = solve(replace(problem, points=points, start=unknowns), unknowns)
        if np.abs(unknowns - previous).max() < 1e-4:
            break
    return _rated(view, fit.match, fit.surface, problem, unknowns)


def with_open_joints(view: EntityView, fit: Fit, config: AlignmentConfig) -> Fit:
    """The fit with joints opened one by one where that explains the surface better, beyond the paper.

    Planes and the box are those of the closed model, so that only e_s knows of what is open.
    """
    best = fit
    for joint in fit.match.model.joints:
        if joint.kind == "continuous":
            continue
        trials = []
        for share in OPENINGS:
            positions = {**best.surface.positions, joint.name: share * joint.upper}
            surface = best.surface.at(positions)
            trials.append(replace(best, surface=surface, error=surface_error(view, best, surface)))
        found = min(trials, key=lambda trial: trial.error)
        if found.error < OPENED * best.error:
            best = found
    return best if best is fit else refined(view, best, config)


def _problem(view: EntityView, match: CadMatch, config: AlignmentConfig) -> AlignmentProblem:
    """Eq. 12 for an oriented model; it starts with the entity's height, in the middle of the box, or, where a side of
    that is open, against the opposite side. Behind an open side the model may go on as far as the wall.
    """
    R = ORIENTATIONS[match.orientation]
    extents = np.abs(R) @ match.model.extents
    scale = float(view.extents[2] / extents[2])
    half = 0.5 * view.extents[:2]
    beyond = np.where(view.open_sides, np.minimum(view.to_walls, view.diagonal), 0.0)
    excess = np.tile(np.maximum(scale * extents[:2] - view.extents[:2], 0.0) / 2, 2)
    towards = np.where(view.open_sides, np.clip(beyond - excess, -excess, excess), 0.0)
    centre = towards[:2] - towards[2:]
    return AlignmentProblem(
        footprint=np.stack([-half - beyond[2:], half + beyond[:2]]),
        height=float(view.extents[2]),
        extents=extents,
        tied=view.tied,
        planes=_plane_pairs(view.node, match, R),
        points=None,
        start=np.array([np.log(scale), 0.0, *centre]),
        config=config,
    )


def _plane_pairs(node: EntityNode, match: CadMatch, R: Float64) -> PlanePairs:
    rows, columns = match.planes[:, 0], match.planes[:, 1]
    T = node.box.T_map_box
    normals = np.array([node.planes[i].normal for i in rows]).reshape(-1, 3)
    offsets = np.array([node.planes[i].offset for i in rows]) + normals @ T[:3, 3]
    areas = np.array([node.planes[i].area for i in rows])
    model_normals = np.array([match.model.planes[j].normal for j in columns]).reshape(-1, 3) @ R.T
    model_offsets = np.array([match.model.planes[j].offset for j in columns])
    weights = np.sqrt(areas / max(float(areas.sum()), 1e-12))
    return PlanePairs(normals @ T[:3, :3], offsets, model_normals, model_offsets, weights)


def _turn(yaw: float) -> Float64:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _point_pairs(view: EntityView, fit: Fit, problem: AlignmentProblem, unknowns: Float64) -> PointPairs:
    config, R = problem.config, ORIENTATIONS[fit.match.orientation]
    scale = float(np.exp(unknowns[0]))
    turn = _turn(unknowns[1]) @ R
    points = (view.surface.points - [*unknowns[2:], problem.centre_height(scale)]) @ turn / scale
    index, distances = fit.surface.corresponding(points, view.surface.normals @ turn)
    weights = 1.0 / (1.0 + (scale * distances / (config.reach * view.diagonal)) ** 2)
    samples = fit.surface.samples
    return PointPairs(
        view.surface.points,
        samples.points[index] @ R.T,
        samples.normals[index] @ R.T,
        config.surface_weight * weights / np.sqrt(len(weights)),
    )


def _rated(
    view: EntityView, match: CadMatch, surface: ModelSurface, problem: AlignmentProblem, unknowns: Float64
) -> Fit:
    height = problem.centre_height(float(np.exp(unknowns[0])))
    fit = Fit(match, surface, unknowns, height, np.inf)
    return replace(fit, error=surface_error(view, fit, surface))


def surface_error(view: EntityView, fit: Fit, surface: ModelSurface) -> float:
    """How far the surfaces of an entity and of an aligned model lie apart, in diagonals of the entity's box.

    Root mean squares of distances in position and normal, both ways: what the entity has and the model has not counts
    for 1, what the model has and the entity has not for `SURPLUS`, as it may be unseen. Other proportions raise it.
    """
    R, p, scale = fit.T_box_model[:3, :3], fit.T_box_model[:3, 3], fit.scale
    _, distances = surface.corresponding((view.surface.points - p) @ R / scale, view.surface.normals @ R)
    samples = surface.samples
    back = view.distances(samples.points[::SPARSE] * scale @ R.T + p, samples.normals[::SPARSE] @ R.T)
    sides = np.abs(R) @ fit.match.model.extents * scale / view.extents
    error = (scale * _rms(distances) + SURPLUS * _rms(back)) / view.diagonal
    return error * (1.0 + PROPORTIONS * float(np.linalg.norm(np.log(sides))))


def _rms(distances: Float64) -> float:
    return float(np.sqrt(np.mean(distances**2)))
