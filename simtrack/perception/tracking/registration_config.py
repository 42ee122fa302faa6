"""Settings of the registration: its outer iterations, when they end, and what the sensor is taken to do."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from simtrack.errors import InvalidValueError


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
    fine: bool = False
    """Every pixel instead, of models whose windows are not too large: see `RegistrationConfig.max_fine_rays`."""
    silhouettes: Literal["always", "where-open", "never"] = "where-open"
    """Silhouettes widen the basin of convergence. On a coarse grid they are coarse, so that in the end they only speak
    in directions that the faces leave open; on every pixel they tell about as much as the faces."""


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
    """Outer iterations from a prediction, as of a track."""
    near: Step = field(default=Step(gate=0.008, kernel=4.0, edge_reach=5, silhouettes="always"))
    """What a track is tried with first: most predictions are so good that wide gates would only lead away from them."""
    finish: Step | None = field(default=Step(gate=0.006, kernel=3.0, edge_reach=5, fine=True, silhouettes="always"))
    """How a track ends, near or not: a single cast at full resolution, from a pose that leaves little to be moved."""
    front: float = 0.5
    """Readings before a model count within this share of the gates only: what holds a thing, or leans on it, stands
    closely before it, and nothing stands behind its surface. With 1, things in a hand slide onto the fingers."""
    patience: float | None = None
    """Seconds of the wall clock after which the finish is left out, where a late answer is worse than a less exact one;
    None: it never is, and results do not depend on the machine."""
    near_support: float = 0.9
    """It is enough for an instance that it leaves with no less support than this, ..."""
    near_misfit: float = 1.25
    """... no larger a misfit than this ..."""
    near_move: float = 0.012
    """... and not further than this from the prediction, metres of surface."""
    inner_iterations: int = 3
    """Solver steps on the same correspondences (the paper: 10 Umeyama fits)."""
    last_step: float = 1e-5
    """... of which one that is shorter than this is the last, metres of surface."""
    tolerance: float = 5e-5
    """An instance that an outer iteration moves by less than this has converged, metres of surface, ..."""
    insignificant: float = 0.3
    """... and so has one that it moves by less than this many of its standard deviations."""
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

    max_fine_rays: int = 40_000
    """As `max_rays`, of fine steps."""

    def __post_init__(self) -> None:
        if self.solver not in ("gauss-newton", "umeyama"):
            raise InvalidValueError("RegistrationConfig.solver", self.solver, "gauss-newton, umeyama")
        if any(step.fine for step in (*self.schedule, *self.track_schedule, self.near)):
            raise InvalidValueError("RegistrationConfig.schedule", "a fine step", "fine steps only as `finish`")
        if not 0.0 < self.front <= 1.0:
            raise InvalidValueError("RegistrationConfig.front", self.front, "more than 0, at most 1")
        if self.patience is not None and not self.patience >= 0.0:
            raise InvalidValueError("RegistrationConfig.patience", self.patience, ">= 0 s, or None")
        if self.finish is not None and self.finish.repeats != 1:  # a fine cast takes the rays that coarse ones marked
            raise InvalidValueError("RegistrationConfig.finish", self.finish.repeats, "a single cast: repeats=1")
        if not self.schedule or any(step.gate <= 0.0 or step.kernel <= 0.0 for step in self.schedule):
            raise InvalidValueError(
                "RegistrationConfig.schedule", self.schedule, "steps with positive gates and kernels"
            )
