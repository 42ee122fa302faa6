"""How far measurements lie from a map, counted over any number of frames in the same memory."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float64
from simtrack.evaluation.metrics import Metric, measured, unmeasured
from simtrack.perception.localization.measurement import Measurement
from simtrack.raycast import RayScene

BIN, LIMIT = 0.0005, 5.0
"""Metres: resolution of the quantiles, and the distance beyond which all count as equally far."""


@dataclass(frozen=True, slots=True, eq=False)
class MapResiduals:
    """One measurement beside what the map shows from the same pose."""

    planes: Float64
    """(N,), metres, distance of each point from the plane that its ray meets in the map; NaN where it meets nothing."""
    along: Float64
    """(N,), metres, measured minus mapped distance along the ray; NaN likewise."""

    @property
    def covered(self) -> npt.NDArray[np.bool_]:
        """(N,), whether the ray meets the map at all."""
        return np.isfinite(self.along)


def map_residuals(shots: Measurement, T_map_base: Float64, scene: RayScene) -> MapResiduals:
    """Cast a measurement's rays from the pose `T_map_base` (4, 4) at the map and compare."""
    rotation = T_map_base[:3, :3]
    origins = shots.origins @ rotation.T + T_map_base[:3, 3]
    directions = shots.directions @ rotation.T
    hits = scene.cast_rays(origins.astype(np.float32), directions.astype(np.float32))
    distances = np.where(np.isfinite(hits.distances), hits.distances, np.nan).astype(np.float64)
    along = shots.ranges - distances
    cosine = np.abs(np.einsum("ij,ij->i", hits.normals.astype(np.float64), directions))
    return MapResiduals(np.abs(along) * cosine, along)


class Residuals:
    """Quantiles of absolute distances from a histogram that never grows."""

    def __init__(self) -> None:
        self._counts = np.zeros(round(LIMIT / BIN) + 1, np.int64)

    @property
    def count(self) -> int:
        """Distances taken so far."""
        return int(self._counts.sum())

    def add(self, distances: npt.ArrayLike) -> None:
        """Take distances in metres; what is not finite does not count."""
        values = np.abs(np.asarray(distances, dtype=float))
        index = np.minimum(values[np.isfinite(values)] / BIN, len(self._counts) - 1).astype(np.int64)
        self._counts += np.bincount(index, minlength=len(self._counts))

    def quantile(self, share: float) -> Metric:
        """Metres, to `BIN`."""
        if not self.count:
            return unmeasured("m", "no reading met the map")
        cumulative = np.cumsum(self._counts)
        wanted = share * cumulative[-1]
        k = int(np.searchsorted(cumulative, wanted))
        before = int(cumulative[k - 1]) if k else 0
        return measured(BIN * (k + (wanted - before) / self._counts[k]), "m")
