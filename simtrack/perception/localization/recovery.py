"""Several poses at once: hypotheses that are carried along by odometry until the data single one out."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.transforms import angle_between, difference
from simtrack.perception.localization.assessment import UNJUDGED, Assessment, Verdicts, assess, lead
from simtrack.perception.localization.config import LocalizerConfig
from simtrack.perception.localization.measurement import Measurement
from simtrack.perception.localization.motion import OdometryTrack, propagate
from simtrack.perception.localization.registration import register
from simtrack.perception.localization.surface import MapSurface

MEMORY = 15
"""Scans over which a hypothesis is judged."""

INCUMBENT_BONUS = 0.2
"""Score: changes since the survey cost a true pose up to about as much; a robot that was carried off loses more."""


@dataclass(slots=True)
class Hypothesis:
    """One place where the robot may be."""

    T_map_base: Float64
    """(4, 4), at the stamp of the last scan."""
    covariance: Float64
    """(6, 6)."""
    travel: float
    """m, the odometry's travel when it was born."""
    streak: int = 0
    """Searches in a row, up to the last one, that found nothing better."""
    incumbent: bool = False
    """It continues what was believed before: kept whatever it scores, and overruled by clear evidence only."""
    settled: bool = False
    """Its last registration converged."""
    prior: float = 0.0
    """Added to the score: less the farther it is from a given start pose, and a bonus for what was believed before, as
    robots are seldom carried off."""
    scores: deque[float] = field(default_factory=lambda: deque(maxlen=MEMORY))
    shares: deque[float] = field(default_factory=lambda: deque(maxlen=MEMORY))
    """Explained share of the structure, one a scan."""
    verdicts: deque[Verdicts] = field(default_factory=lambda: deque(maxlen=MEMORY))
    assessment: Assessment = UNJUDGED
    residual: float = 0.0

    @property
    def score(self) -> float:
        """Mean over the remembered scans."""
        return self.prior + sum(self.scores) / max(len(self.scores), 1)

    @property
    def share(self) -> float:
        """Mean over the remembered scans."""
        return sum(self.shares) / max(len(self.shares), 1)

    def near(self, T_map_base: Float64, distance: float = 0.35, angle: float = 0.2) -> bool:
        """Whether a pose is practically this one."""
        gap = T_map_base[:3, 3] - self.T_map_base[:3, 3]
        return float(gap @ gap) < distance**2 and angle_between(T_map_base[:3, :3], self.T_map_base[:3, :3]) < angle


def start_covariance(sigma: float, sigma_yaw: float) -> Float64:
    """(6, 6) covariance of a pose on the floor."""
    return np.diag(np.square([sigma, sigma, 0.02, 0.02, 0.02, sigma_yaw]))


class HypothesisSet:
    """The places that are being considered."""

    def __init__(self, surface: MapSurface, config: LocalizerConfig) -> None:
        self._surface, self._config = surface, config
        self.items: list[Hypothesis] = []
        self._stamp = 0

    def carry(self, odometry: OdometryTrack, stamp: int) -> None:
        """Move all hypotheses from where they were last to `stamp` (nanoseconds) by odometry."""
        if self.items and stamp > self._stamp:
            motion, noise = odometry.relative(self._stamp, stamp), odometry.noise(self._stamp, stamp)
            for h in self.items:
                h.T_map_base, h.covariance = propagate(h.T_map_base, h.covariance, motion, noise)
        self._stamp = stamp

    def add(
        self,
        poses: Float64,
        measurement: Measurement,
        travel: float,
        start: tuple[Float64, Float64] | None = None,
        incumbent: bool = False,
    ) -> None:
        """Refine the poses (K, 4, 4) of a search by registration and take those that are new; others are confirmed.

        Args:
            poses: (K, 4, 4), T_map_base at the measurement's stamp, to which all others have been carried.
            measurement: what was searched with.
            travel: m, the odometry's travel by now.
            start: (4, 4) pose and (6, 6) covariance that were given from outside, to prefer what agrees with them.
            incumbent: the poses continue what was believed before.
        """
        shots = measurement.thinned(max(1, len(measurement) // 1500) | 1)
        covariance = start_covariance(0.15, 0.05)
        self._stamp = measurement.stamp
        fresh: list[tuple[float, Float64]] = []
        for pose in poses:
            found = register(shots, self._surface, pose, covariance, self._config.registration, strides=(1, 1, 1, 1))
            fresh.append((assess(shots, self._surface, found.T_map_base).score, found.T_map_base))
        fresh.sort(key=lambda item: -item[0])
        for h in self.items:
            h.streak = h.streak + 1 if fresh and h.near(fresh[0][1]) else 0
        for rank, (score, pose) in enumerate(fresh):
            if score > fresh[0][0] - 0.4 and not any(h.near(pose) for h in self.items):
                prior = _agreement(pose, start) + (INCUMBENT_BONUS if incumbent else 0.0)
                self.items.append(
                    Hypothesis(pose, covariance.copy(), travel, int(rank == 0), incumbent=incumbent, prior=prior)
                )

    def weigh(self, measurement: Measurement) -> None:
        """Correct every hypothesis with a measurement, judge it, merge those that met and drop the poor."""
        shots = measurement.thinned(max(1, len(measurement) // 4000) | 1)
        for h in self.items:
            found = register(
                shots, self._surface, h.T_map_base, h.covariance, self._config.registration, strides=(3, 1, 1)
            )
            h.T_map_base, h.covariance = found.T_map_base, found.covariance
            h.settled, h.residual = found.converged, found.residual
            h.assessment = assess(shots, self._surface, h.T_map_base)
            h.scores.append(h.assessment.score)
            h.shares.append(h.assessment.structure)
            h.verdicts.append(h.assessment.verdicts)
        self._prune()

    def _prune(self) -> None:
        kept: list[Hypothesis] = []
        for h in sorted(self.items, key=lambda h: -h.score):
            twin = next((k for k in kept if k.near(h.T_map_base)), None)
            if twin is not None:
                if len(h.scores) > len(twin.scores):  # the older one brings its history along
                    twin.scores, twin.shares, twin.verdicts, twin.travel = h.scores, h.shares, h.verdicts, h.travel
                twin.streak = max(twin.streak, h.streak)
                twin.incumbent |= h.incumbent
                twin.prior = max(twin.prior, h.prior)
            elif not kept or h.incumbent or h.score > kept[0].score - 0.35:
                kept.append(h)
        limit = self._config.recovery.hypotheses
        self.items = [h for k, h in enumerate(kept) if k < limit or h.incumbent]

    def winner(self, travel: float, everywhere: bool) -> Hypothesis | None:
        """The hypothesis that may be believed by now, if any: good in itself, and ahead of all rivals for long enough.

        Args:
            travel: m, the odometry's travel by now.
            everywhere: the whole map is being searched, so the place may be one that no search has come up with yet:
                several searches in a row, with what was measured meanwhile, must find nothing better.
        """
        c = self._config.recovery
        if not self.items:
            return None
        best = self.items[0]
        if not best.settled or best.share < c.accept_share:
            return None
        doubtful = everywhere and not best.incumbent
        if len(best.scores) < (c.accept_scans if everywhere else 2) or (doubtful and best.streak < c.accept_searches):
            return None
        moved = travel - best.travel >= c.accept_travel
        for rival in self.items[1:]:
            needed = c.accept_lead if moved else c.accept_lead_still
            if rival.incumbent:
                needed = c.accept_lead_still
            elif best.incumbent or rival.prior < best.prior - 0.1:
                needed = c.accept_lead
            ahead, differing = lead(list(best.verdicts), list(rival.verdicts))
            if ahead < needed or differing < c.min_difference:
                return None
        return best


def _agreement(pose: Float64, start: tuple[Float64, Float64] | None) -> float:
    """Bonus, at most 0, of a pose (4, 4) that agrees with a given start pose and its covariance."""
    if start is None:
        return 0.0
    away = difference(pose, start[0])[[0, 1, 5]]
    spread = start[1][np.ix_([0, 1, 5], [0, 1, 5])]
    return -0.02 * min(float(away @ np.linalg.solve(spread, away)), 10.0)
