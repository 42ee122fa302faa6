"""How well a pose explains a measurement, judged by what a ray of the sensor must and must not pass."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float64
from simtrack.perception.localization.measurement import Measurement
from simtrack.perception.localization.surface import MapSurface, View

Verdicts: TypeAlias = npt.NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class Assessment:
    """Shares of a measurement."""

    explained: float
    """Share of all shots that the map explains."""
    structure: float
    """Share explained among the shots that no level surface explains: floors and ceilings look alike everywhere. A shot
    that is explained only if something was taken away counts half."""
    through: float
    """Share, of the same, that reach through surfaces of the map: evidence against the pose, unlike things in front."""
    verdicts: Verdicts
    """(N,), one a shot: 2 explained, 1 explained by what lies behind a thing that must have been taken away, 0 a thing
    is in front of the map or the map has nothing there, -1 the shot reaches through the map."""

    @property
    def score(self) -> float:
        """For comparing poses: explained structure, less what the pose makes the sensor see through walls."""
        return self.structure - 0.5 * self.through


def assess(measurement: Measurement, surface: MapSurface, T_map_base: Float64, tolerance: float = 0.06) -> Assessment:
    """Judge the pose `T_map_base` (4, 4) by casting the measurement's shots from it.

    `tolerance` is the distance in metres between a measured point and the map's surface that still counts as
    explained, on top of three standard deviations of the sensor.
    """
    return judge(surface.cast(T_map_base, measurement), tolerance) if len(measurement) else UNJUDGED


def judge(view: View, tolerance: float = 0.06) -> Assessment:
    """Judge the pose that a view was cast from; see `assess`."""
    from simtrack.perception.localization.kernels import explain

    hits = view.hits
    verdicts, explained, structure, through, rest = explain(
        len(view), view.ranges, view.sigmas, view.directions, hits.distances, hits.normals, view.passed, tolerance
    )
    return Assessment(explained / len(view), 0.5 * structure / max(rest, 1), through / max(rest, 1), verdicts)


def lead(a: list[Verdicts], b: list[Verdicts]) -> tuple[float, float]:
    """How clearly pose `a` explains the same scans better than pose `b`, judged by the shots on which they differ.

    Most of a scan often fits both (the walls of a corridor): the sign test of the rest tells them apart.

    Args:
        a: verdicts, one (N,) array a scan.
        b: of the same scans, newest last; the longer list is cut at its front.

    Returns:
        (wins - losses) / (wins + losses) in -1..1, and the share of the shots on which they differ.
    """
    wins, losses, differing, shots = 0, 0, 0, 0
    count = min(len(a), len(b))
    for first, second in zip(a[len(a) - count :], b[len(b) - count :], strict=True):
        margin = first.astype(np.int64) - second
        wins += int(margin[margin > 0].sum())
        losses -= int(margin[margin < 0].sum())
        differing += int(np.count_nonzero(margin))
        shots += len(margin)
    return (wins - losses) / max(wins + losses, 1), differing / max(shots, 1)


UNJUDGED = Assessment(0.0, 0.0, 0.0, np.zeros(0, np.int8))
"""Of an empty measurement."""
