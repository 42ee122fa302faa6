"""CAD candidates of an entity: which models could stand for it, where and how large.

Ranking-based matching (section 4.2 of the reconstruction paper) and optimization-based alignment (4.3) in one call.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh, transformed
from simtrack.geometry.transforms import is_rigid
from simtrack.objects.cad import CadModel


@dataclass(frozen=True, slots=True, eq=False)
class PlacedSupport:
    """A rectangle of an aligned model that things can stand on, in the map."""

    part: str
    """Name of the model's part that it belongs to."""
    T_map_support: Float64
    """(4, 4), origin in the middle of the rectangle, z up; rigid."""
    size: Float64
    """(2,), side lengths along its x and y, metres."""
    clearance: float
    """Metres of free height above it; inf under the open sky."""

    @property
    def height(self) -> float:
        """Z in the map, metres."""
        return float(self.T_map_support[2, 3])


@dataclass(frozen=True, slots=True, eq=False)
class CadCandidate:
    """A model that could stand for an entity, aligned with it."""

    model: CadModel
    T_map_model: Float64
    """(4, 4), rigid: the model is scaled first, then moved."""
    scale: float
    """alpha of Eq. 11, uniform."""
    positions: Mapping[str, float] = field(default_factory=dict)
    """Joint name -> position in the model's own units: a prismatic joint moves by `scale` times its position in the
    map. Joints that are not named are at 0."""
    matching_error: float = 0.0
    """ME, Eq. 7."""
    alignment_error: float = 0.0
    """AE, metres (section 4.3)."""
    orientation: int = 0
    """Which of the 24 orientations it was matched in, see `matching.ORIENTATIONS`."""

    def __post_init__(self) -> None:
        if not is_rigid(np.asarray(self.T_map_model)):
            raise InvalidValueError("CadCandidate.T_map_model", self.T_map_model, "a (4, 4) rigid transform")
        if not (np.isfinite(self.scale) and self.scale > 0.0):
            raise InvalidValueError("CadCandidate.scale", self.scale, "a positive finite factor")

    @property
    def T_map_scaled(self) -> Float64:
        """(4, 4), similarity: metres of the model to the map."""
        T = np.array(self.T_map_model, dtype=float)
        T[:3, :3] *= self.scale
        return T

    @property
    def extents(self) -> Float64:
        """(3,), side lengths of the scaled model's box at rest along the model's axes, metres."""
        return self.scale * self.model.extents

    @property
    def upright(self) -> bool:
        """Whether the model's up direction points up in the map."""
        return bool(self.T_map_model[2, 2] > 0.99)

    def mesh(self) -> Mesh:
        """The aligned model, all parts in one, map frame."""
        return transformed(self.model.mesh(self.positions), self.T_map_scaled)

    def supports(self) -> tuple[PlacedSupport, ...]:
        """The faces that things can stand on, in the map; none of what was tipped over."""
        if not self.upright:
            return ()
        poses = self.model.part_poses(self.positions)
        placed = []
        for support in self.model.supports:
            T = np.array(self.T_map_model, dtype=float) @ _scaled_translation(poses[support.part], self.scale)
            T[:3, 3] += T[:3, :3] @ (self.scale * support.centre)
            placed.append(PlacedSupport(support.part, T, self.scale * support.size, self.scale * support.clearance))
        return tuple(placed)


def _scaled_translation(T: Float64, scale: float) -> Float64:
    out = T.copy()
    out[:3, 3] *= scale
    return out
