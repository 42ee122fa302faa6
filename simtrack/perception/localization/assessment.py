"""How well a pose explains a measurement, judged by what a ray of the sensor must and must not pass."""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.perception.localization.measurement import Measurement
from simtrack.perception.localization.surface import MapSurface


@dataclass(frozen=True, slots=True)
class Assessment:
    """Shares of a measurement."""

    explained: float
    """Share of all shots that the map explains."""
    structure: float
    """Share explained among the shots that no level surface explains: floors and ceilings look alike everywhere."""
    through: float
    """Share, of the same, that reach through surfaces of the map: evidence against the pose, unlike things in front."""
    shots: int
    """Number of shots that no level surface explains."""

    @property
    def score(self) -> float:
        """For comparing poses: explained structure, less what the pose makes the sensor see through walls."""
        return self.structure - 0.5 * self.through


def assess(measurement: Measurement, surface: MapSurface, T_map_base: Float64, tolerance: float = 0.06) -> Assessment:
    """Judge the pose `T_map_base` (4, 4) by casting the measurement's shots from it.

    `tolerance` is the distance in metres between a measured point and the map's surface that still counts as
    explained, on top of three standard deviations of the sensor.
    """
    from simtrack.perception.localization.kernels import explain

    if not len(measurement):
        return Assessment(0.0, 0.0, 0.0, 0)
    hits = surface.cast(T_map_base, measurement)
    directions = measurement.directions @ T_map_base[:3, :3].T
    cosines = np.einsum("ij,ij->i", hits.normals, directions)
    kinds = explain(measurement.ranges, measurement.sigmas, hits.distances, hits.normals, cosines, tolerance)
    level, structure, _, through, _ = np.bincount(kinds, minlength=5)
    rest = max(len(kinds) - int(level), 1)
    return Assessment((int(level) + int(structure)) / len(kinds), int(structure) / rest, int(through) / rest, rest)
