"""Ranking-based CAD matching: section 4.2 of the reconstruction paper, Eqs. 7-10.

A model in one of 24 orientations is compared with an entity by the proportions of their boxes and by their planes, both
in the frame of the box and relative to its size, so that neither scale nor place matters.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from simtrack.contracts import Bool, Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.objects.cad import CadModel
from simtrack.perception.scene_graph.contact import ContactGraph, EntityNode

SUPPORTING = 0.9
"""Cosine to the vertical from which a plane can support: -a_th of Eq. 1."""
_FORBIDDEN = 1e6
"""Cost of giving a support plane a counterpart that cannot support."""


def _orientations() -> Float64:
    """(24, 3, 3) turns of a cube onto itself; the upright ones (quarter turns about z) come first, 0 first of all."""
    found: list[Float64] = []
    for up in np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], float):
        right = np.roll(np.abs(up), 1)
        for _ in range(4):
            found.append(np.stack([right, np.cross(up, right), up], axis=1))
            right = np.cross(up, right)
    return np.stack(found)


ORIENTATIONS: Float64 = _orientations()
"""(24, 3, 3) R_box_model: the discretized orientations; 0 to 3 stand upright, a quarter turn about z apart."""

UPRIGHT = range(4)
"""Rows of `ORIENTATIONS` that stand upright."""


@dataclass(frozen=True, slots=True)
class MatchingConfig:
    """Settings of `matches`."""

    size_weight: float = 1.0
    """omega_1 of Eq. 7."""
    plane_weight: float = 1.0
    """omega_2."""
    up_weight: float = 0.2
    """omega_3."""
    unmatched: float = 1.0
    """What a plane without a counterpart costs: as much as one at right angles to its own. The paper's bijection does
    not say what happens to planes that one of the two has more of."""

    def __post_init__(self) -> None:
        for name in ("size_weight", "plane_weight", "up_weight", "unmatched"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"MatchingConfig.{name}", getattr(self, name), "a finite number, 0 or more")


@dataclass(frozen=True, slots=True, eq=False)
class BoxFeatures:
    """What Eqs. 8 and 9 compare: box and planes, in the frame of the box."""

    extents: Float64
    """(3,), metres."""
    normals: Float64
    """(P, 3), unit."""
    offsets: Float64
    """(P,), metres."""
    supports: Bool
    """(P,), planes on which something stands; of models: none is marked, all that face up can."""

    @staticmethod
    def of_entity(node: EntityNode, graph: ContactGraph) -> "BoxFeatures":
        """Box and planes of a node; hidden planes are features too."""
        T = node.box.T_map_box
        normals = np.array([plane.normal for plane in node.planes]).reshape(-1, 3)
        offsets = np.array([plane.offset for plane in node.planes]) + normals @ T[:3, 3]
        used = [support.plane for support in graph.supports.values() if support.parent == node.name]
        upward = normals[:, 2] >= SUPPORTING
        return BoxFeatures(
            node.box.extents, normals @ T[:3, :3], offsets, np.isin(np.arange(len(normals)), used) & upward
        )

    @staticmethod
    def of_model(model: CadModel) -> "BoxFeatures":
        """Box and planes of a model with its joints at 0."""
        normals = np.array([plane.normal for plane in model.planes]).reshape(-1, 3)
        offsets = np.array([plane.offset for plane in model.planes])
        return BoxFeatures(model.extents, normals, offsets, np.zeros(len(normals), bool))


@dataclass(frozen=True, slots=True, eq=False)
class CadMatch:
    """A model in one of the 24 orientations, and how well it matches an entity."""

    model: CadModel
    orientation: int
    """Row of `ORIENTATIONS`."""
    error: float
    """ME, Eq. 7."""
    planes: Int32
    """(K, 2), the assignment f of Eq. 9: planes of the entity and of the model."""


def matches(
    node: EntityNode,
    graph: ContactGraph,
    models: Sequence[CadModel],
    config: MatchingConfig | None = None,
    top: int | None = 10,
    *,
    upright: bool | None = None,
) -> tuple[CadMatch, ...]:
    """The oriented models with the lowest matching errors, best first; all if `top` is None.

    `upright` keeps upright orientations alone (True) or the others alone (False).

    Orientations that turn a model onto itself count once.
    """
    config = config or MatchingConfig()
    entity = BoxFeatures.of_entity(node, graph)
    found: list[CadMatch] = []
    open_cases = []
    for model in models:
        turns = distinct_orientations(model)
        if upright is not None:
            turns = turns[np.isin(turns, UPRIGHT) == upright]
        costs, bounds = oriented_costs(entity, BoxFeatures.of_model(model), turns, config)
        open_cases += [(float(bound), model, int(k), cost) for bound, k, cost in zip(bounds, turns, costs, strict=True)]
    open_cases.sort(key=lambda case: case[0])
    wanted = len(open_cases) if top is None else top
    for bound, model, k, cost in open_cases:
        if len(found) >= wanted and bound >= found[wanted - 1].error:
            break
        planes, d_planes = assign(cost, config.unmatched)
        rest = bound - config.plane_weight * _least(cost, config.unmatched)
        found.append(CadMatch(model, k, rest + config.plane_weight * d_planes, planes))
        found.sort(key=lambda match: match.error)
    return tuple(found[:wanted])


@lru_cache(maxsize=1024)
def distinct_orientations(model: CadModel) -> Int32:
    """(K,) rows of `ORIENTATIONS` that differ for a model: quarter turns among its yaw symmetries give the same."""
    steps = model.yaw_symmetries / (np.pi / 2)
    quarters = np.unique(np.round(steps[np.abs(steps - np.round(steps)) < 1e-6]).astype(int) % 4)
    # (24, 24): whether one orientation is another one after a turn that the model does not show
    same = np.zeros((24, 24), bool)
    for quarter in quarters:
        same |= np.abs(ORIENTATIONS[:, None] - ORIENTATIONS @ ORIENTATIONS[quarter]).max(axis=(2, 3)) < 0.5
    return np.flatnonzero(~np.tril(same, -1).any(axis=1)).astype(np.int32)


def oriented_costs(
    entity: BoxFeatures, model: BoxFeatures, orientations: Int32, config: MatchingConfig
) -> tuple[Float64, Float64]:
    """Costs of Eq. 9 for every pair of planes, and what ME is at least.

    Args:
        entity: of x.
        model: of y, in its own frame.
        orientations: (K,) rows of `ORIENTATIONS`.
        config: weights.

    Returns:
        (K, P_x, P_y) costs, and (K,) lower bounds of Eq. 7: every plane takes the counterpart that suits it best.
    """
    R = ORIENTATIONS[orientations]
    extents = np.abs(R) @ model.extents
    size_x, size_y = np.linalg.norm(entity.extents), np.linalg.norm(model.extents)
    d_size = np.linalg.norm(entity.extents / size_x - extents / size_y, axis=1)
    normals = np.einsum("kab,jb->kja", R, model.normals)
    apart = np.abs(entity.offsets[:, None] / size_x - model.offsets / size_y)
    costs = apart + 1.0 - np.einsum("ia,kja->kij", entity.normals, normals)
    unable = normals[:, None, :, 2] < SUPPORTING
    costs = np.where(entity.supports[None, :, None] & unable, _FORBIDDEN, costs)
    d_up = 1.0 - R[:, 2, 2]  # Eq. 10: g is -z
    planes = np.array([_least(cost, config.unmatched) for cost in costs])
    return costs, config.size_weight * d_size + config.plane_weight * planes + config.up_weight * d_up


def _least(cost: Float64, unmatched: float) -> float:
    """What the assignment costs at least."""
    return float(np.minimum(cost.min(axis=1, initial=unmatched), unmatched).sum())


def assign(cost: Float64, unmatched: float) -> tuple[Int32, float]:
    """The optimal assignment of Eq. 9 (Jonker and Volgenant, 1987).

    Args:
        cost: (P_x, P_y).
        unmatched: what a row costs that is given no column.

    Returns:
        (K, 2) rows and columns that belong together, and the sum over all rows.
    """
    from scipy.optimize import linear_sum_assignment

    count, columns = cost.shape
    padded = np.concatenate([cost, np.full((count, count), unmatched)], axis=1)
    rows, chosen = linear_sum_assignment(padded)
    real = chosen < columns
    return np.stack([rows[real], chosen[real]], axis=1).astype(np.int32), float(padded[rows, chosen].sum())
