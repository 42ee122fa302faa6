"""Optimization-based CAD alignment: section 4.3 of the reconstruction paper, Eqs. 11-14.

Unknowns are scale, yaw and the horizontal translation; the height follows from the support plane. Everything happens
in the frame of the entity's box: origin in its centre, z up.

Beyond the paper: e_s, distances of points of the entity's surface to the planes through corresponding points of the
model, so that what has no planes is aligned too; and sides of the box behind which nothing was seen are open.
"""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.perception.reconstruction.residuals import footprint_outside, plane_residuals, point_residuals

UNKNOWNS = ("log scale", "yaw", "x", "y")
"""What is solved for: x and y are those of the model's centre in the frame of the box."""
LEVEL = float(np.cos(np.radians(25.0)))
"""|z| of the normal of a plane that counts as level."""


@dataclass(frozen=True, slots=True)
class AlignmentConfig:
    """Settings of the alignment. Weights multiply residuals: they are the square roots of the diagonals of Sigma."""

    height_weight: float = 2.0
    """Of the height relative to the entity's, in diagonals of its box: what is flat has a height too."""
    footprint_weight: float = 0.5
    plane_weight: float = 1.0
    """Of all planes together; each has the share that it has in their area."""
    surface_weight: float = 2.0
    """Of all points of the surface together."""
    prior_weight: float = 0.02
    """Ties the unknowns to where they started, where nothing else does."""
    reach: float = 0.06
    """In diagonals of the box: residuals of the surface beyond lose weight, so that what has no counterpart does not
    pull."""
    rounds: int = 4
    """How often points of the surface are given their counterparts anew."""
    samples: int = 400
    """Points of the entity's surface."""
    model_samples: int = 2000
    """Points of a model's surface."""

    def __post_init__(self) -> None:
        for name in ("height_weight", "prior_weight", "reach", "samples", "model_samples"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InvalidValueError(f"AlignmentConfig.{name}", getattr(self, name), "a positive finite number")
        for name in ("footprint_weight", "plane_weight", "surface_weight", "rounds"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"AlignmentConfig.{name}", getattr(self, name), "a finite number, 0 or more")


@dataclass(frozen=True, slots=True, eq=False)
class PlanePairs:
    """Matched feature planes f(pi) of Eq. 14."""

    normals: Float64
    """(K, 3), of the entity, frame of its box."""
    offsets: Float64
    """(K,)."""
    model_normals: Float64
    """(K, 3), of the model, turned by its orientation."""
    model_offsets: Float64
    """(K,), not scaled."""
    weights: Float64
    """(K,)."""

    def level(self) -> "PlanePairs":
        """Those of which both planes are level within 25 degrees."""
        kept = np.minimum(np.abs(self.normals[:, 2]), np.abs(self.model_normals[:, 2])) >= LEVEL
        ours, theirs = (self.normals[kept], self.offsets[kept]), (self.model_normals[kept], self.model_offsets[kept])
        return PlanePairs(*ours, *theirs, self.weights[kept])


@dataclass(frozen=True, slots=True, eq=False)
class PointPairs:
    """Points of the entity's surface with the planes through corresponding points of the model."""

    points: Float64
    """(N, 3), frame of the entity's box."""
    model_points: Float64
    """(N, 3), of the model, turned by its orientation, not scaled."""
    model_normals: Float64
    """(N, 3)."""
    weights: Float64
    """(N,)."""


@dataclass(frozen=True, slots=True, eq=False)
class AlignmentProblem:
    """The objective of Eq. 12 as residuals of (4,) `UNKNOWNS`, weights included, all in metres."""

    footprint: Float64
    """(2, 2), lower and upper corner of the rectangle that the model's should not leave."""
    height: float
    """s_x^g, metres."""
    extents: Float64
    """(3,), of the model, turned by its orientation, not scaled."""
    tied: bool
    """Whether the model stands on the lower side of the box (p^g of Eq. 11); otherwise its centre stays in the box's:
    what hangs."""
    planes: PlanePairs
    points: PointPairs | None
    start: Float64
    """(4,), what the prior ties to."""
    config: AlignmentConfig

    def centre_height(self, scale: float) -> float:
        """p^g of Eq. 11 in the frame of the box, whose lower side is the support plane."""
        return float(0.5 * (scale * self.extents[2] - self.height)) if self.tied else 0.0

    def residuals(self, unknowns: Float64) -> Float64:
        """(M,) residuals: e_b (2), e_p (2 K), e_s (N), prior (4)."""
        return self.evaluated(unknowns)[0]

    def jacobian(self, unknowns: Float64) -> Float64:
        """(M, 4) derivatives of the residuals."""
        return self.evaluated(unknowns)[1]

    def evaluated(self, unknowns: Float64) -> tuple[Float64, Float64]:
        """Residuals and their derivatives."""
        config, pairs = self.config, self.planes
        scale = float(np.exp(unknowns[0]))
        count, sampled = len(pairs.weights), 0 if self.points is None else len(self.points.weights)
        residuals, J = np.empty(6 + 2 * count + sampled), np.empty((6 + 2 * count + sampled, 4))
        sides = self.footprint[1] - self.footprint[0]
        unit = config.footprint_weight / np.sqrt(sides[0] * sides[1])  # of square metres
        half = 0.5 * scale * self.extents[:2]
        outside, slopes = footprint_outside(self.footprint, half, unknowns[2:], unknowns[1])
        tall = scale * self.extents[2]
        residuals[0], J[0] = unit * outside, unit * slopes
        height, rise = self.centre_height(scale), 0.5 * tall if self.tied else 0.0
        diagonal = np.sqrt(sides @ sides + self.height**2)
        unit = config.height_weight * diagonal / self.height
        residuals[1], J[1] = unit * (tall - self.height), (unit * tall, 0.0, 0.0, 0.0)
        given = pairs.normals, pairs.offsets, pairs.model_normals, pairs.model_offsets
        end = 2 + 2 * count
        weights = config.plane_weight * pairs.weights
        plane_residuals(unknowns, height, rise, given, weights, 0.5 * diagonal, residuals[2:end], J[2:end])
        if self.points is not None:
            to = self.points
            rows = slice(end, end + sampled)
            points = to.points, to.model_points, to.model_normals
            point_residuals(unknowns, height, rise, *points, to.weights, residuals[rows], J[rows])
        ties = config.prior_weight * np.array([diagonal, diagonal, 1.0, 1.0])
        residuals[-4:], J[-4:] = ties * (unknowns - self.start), np.diag(ties)
        return residuals, J


def solve(problem: AlignmentProblem, start: Float64) -> Float64:
    """(4,) unknowns where Eq. 12 is least, by Levenberg-Marquardt (More, 1978) from `start`."""
    from scipy.optimize import leastsq

    at, found = start, problem.evaluated(start)

    def evaluated(unknowns: Float64, part: int) -> Float64:
        nonlocal at, found
        if not np.array_equal(unknowns, at):  # derivatives are asked for where the residuals were
            at, found = unknowns.copy(), problem.evaluated(unknowns)
        return found[part]

    result = leastsq(
        evaluated, start, args=(0,), Dfun=lambda unknowns, _: evaluated(unknowns, 1),
        full_output=True, maxfev=20, xtol=1e-7, ftol=1e-7, gtol=1e-8, diag=np.ones(len(start)),
    )  # fmt: skip
    return result[0] if np.isfinite(result[0]).all() else start
