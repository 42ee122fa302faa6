"""Global physical violation check (section 4.4 of the reconstruction paper): which candidate each entity gets.

Candidates that cannot support what stands on the entity (Eq. 2), or that stand in a wall, are discarded; then one is
selected for each entity, so that they stay out of each other: min-conflicts search (Minton et al., 1992) from the
candidates of least alignment error.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.boxes import OrientedBox
from simtrack.geometry.transforms import transform
from simtrack.perception.reconstruction.candidates import CadCandidate, PlacedSupport
from simtrack.perception.reconstruction.layout import layout_slabs
from simtrack.perception.reconstruction.own_model import is_own
from simtrack.perception.reconstruction.solids import Solid, depth_along, overlap, solid_of
from simtrack.perception.scene_graph.contact.graph import ContactGraph, SupportKind, is_layout
from simtrack.perception.scene_graph.contact.nodes import FLOOR

INNER = 0.8
"""Sides of the part of a child's box, about its middle, that has to be free: models are not exactly alike."""
OVERHANG = 0.3
"""Share of its width by which the middle of what stands on a face stays away from the face's edge."""
CLEAR = 0.9
"""Share of its height that has to be free above a face: boards and drawers are thin, and take little of it."""
MOST_TAKEN = 0.15
"""Share of it that the model may take."""
SAME_WAY = float(np.cos(np.radians(30.0)))
"""Cosine between the up-axes of models that lie on the same side."""


@dataclass(frozen=True, slots=True)
class SelectionConfig:
    """Thresholds of the check; lengths in metres."""

    contact_area: float = 0.5
    """b_th of Eq. 2."""
    weak_area: float = 0.2
    """Share of a bottom on a face from which a child has at least a place there."""
    height: float = 0.12
    """How far a candidate's support may lie above or below where the child stands: snapping moves the child."""
    far: float = 0.2
    """The same for any place at all."""
    aside: float = 0.15
    """How far beside a face a child may stand to have a place there: snapping brings it on."""
    wall_depth: float = 0.09
    """How far a candidate may stand in layout: snapping pushes it out."""
    overlap_depth: float = 0.01
    """How deep two candidates may be in each other: snapping pushes them apart."""
    far_worse: float = 3.0
    """Times the least alignment error among those that survive, above which a candidate is not taken."""
    slack: float = 0.01
    """Metres of alignment error that count for nothing in that."""
    steps: int = 200
    """Of the min-conflicts search."""
    seed: int = 0
    """Of its random choices."""

    def __post_init__(self) -> None:
        for name in ("contact_area", "weak_area"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InvalidValueError(f"SelectionConfig.{name}", getattr(self, name), "a share in (0, 1]")
        for name in ("height", "far", "aside", "wall_depth", "overlap_depth", "far_worse", "slack"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"SelectionConfig.{name}", getattr(self, name), "finite and >= 0")
        if self.steps < 0:
            raise InvalidValueError("SelectionConfig.steps", self.steps, "0 or more")


@dataclass(frozen=True, slots=True)
class Rejection:
    """Why a candidate was not taken."""

    rank: int
    """Place in the shortlist, 0 for the least alignment error."""
    model: str
    reason: str


@dataclass(slots=True)
class Selection:
    """What the check decided."""

    chosen: dict[str, int] = field(default_factory=dict)
    """Entity -> rank of its candidate in the shortlist."""
    rejected: dict[str, list[Rejection]] = field(default_factory=dict)
    lost: dict[str, list[str]] = field(default_factory=dict)
    """Entity -> children that its chosen candidate does not support as Eq. 2 asks."""
    homeless: dict[str, list[str]] = field(default_factory=dict)
    """Entity -> those of them that none of its candidates has a place for beside the others; empty where all have."""
    dropped: dict[str, list[list[str]]] = field(default_factory=dict)
    """Entity -> such children of each of its candidates."""
    in_layout: dict[str, float] = field(default_factory=dict)
    """Entity -> depth in metres, where every candidate stands too deep in layout."""
    conflicts: list[tuple[str, str, float]] = field(default_factory=list)
    """Pairs that no selection keeps apart, and the depth in metres."""


def select(
    graph: ContactGraph,
    shortlists: Mapping[str, Sequence[CadCandidate]],
    config: SelectionConfig | None = None,
    barred: Mapping[str, Collection[int]] | None = None,
) -> Selection:
    """Select one candidate for every entity that has any; `shortlists` are sorted by alignment error.

    The ranks that are `barred` are taken only where nothing else is left.
    """
    config = config or SelectionConfig()
    out = Selection()
    solids = {name: [solid_of(candidate) for candidate in found] for name, found in shortlists.items() if found}
    layout = _Layout(graph)
    kept = {name: _kept(graph, name, shortlists[name], solids[name], layout, config, out) for name in solids}
    kept = {name: _well_aligned(name, ranks, shortlists[name], config, out) for name, ranks in kept.items()}
    for name, ranks in (barred or {}).items():
        kept[name] = [rank for rank in kept[name] if rank not in ranks] or kept[name]
    _min_conflicts(graph, kept, solids, config, out)
    for name, ranks in kept.items():
        taken = out.chosen[name]
        if out.dropped[name][taken]:
            out.lost[name] = out.dropped[name][taken]
        for rank in ranks:
            if rank < taken:
                less = out.dropped[name][rank]
                few = len(less) > len(out.dropped[name][taken])
                reason = f"cannot support {', '.join(less)} (Eq. 2)" if few else "stands in another entity's model"
                out.rejected.setdefault(name, []).append(Rejection(rank, shortlists[name][rank].model.name, reason))
    return out


# -------------------------------------------------------------------------------------------------------------- pruning


def _kept(
    graph: ContactGraph,
    name: str,
    candidates: Sequence[CadCandidate],
    solids: Sequence[Solid],
    layout: "_Layout",
    config: SelectionConfig,
    out: Selection,
) -> list[int]:
    """Ranks that survive, those first that support most children.

    They have a place for all children and stand out of the walls; if there is none, those with places for most, of them
    those least deep in layout.
    """
    children = [c for c in graph.children(name) if graph.supports[c].kind in (SupportKind.ON, SupportKind.INSIDE)]
    pairs = list(zip(candidates, solids, strict=True))
    dropped = [
        [c for c in children if place_of(y, solid, graph, c, config.height, config.contact_area) is None]
        for y, solid in pairs
    ]
    homeless = [
        [c for c in lost if place_of(y, solid, graph, c, config.far, config.weak_area, config.aside) is None]
        for (y, solid), lost in zip(pairs, dropped, strict=True)
    ]
    depths = [layout.depth(solid) for solid in solids]
    fewest = min(len(names) for names in homeless)
    able = [k for k, names in enumerate(homeless) if len(names) == fewest]
    least = max(min(depths[k] for k in able), config.wall_depth)
    ranks = sorted((k for k in able if depths[k] <= least), key=lambda k: len(dropped[k]))
    for k, candidate in enumerate(candidates):
        if k in ranks:
            continue
        names = ", ".join(homeless[k])
        reason = (
            f"cannot support {names} (Eq. 2)" if k not in able else f"stands {1e3 * depths[k]:.0f} mm deep in layout"
        )
        out.rejected.setdefault(name, []).append(Rejection(k, candidate.model.name, reason))
    out.dropped[name], out.homeless[name] = dropped, homeless[ranks[0]]
    if least > config.wall_depth:
        out.in_layout[name] = least
    return ranks


def _well_aligned(
    name: str, ranks: Sequence[int], candidates: Sequence[CadCandidate], config: SelectionConfig, out: Selection
) -> list[int]:
    """Those of the ranks that are not far worse aligned than the best, and lie on the same side as the first.

    A book on its edge does not lie down for a push, nor does a bottle stand on its head. Its own mesh counts as well
    aligned.
    """
    errors = {rank: 0.0 if is_own(candidates[rank]) else candidates[rank].alignment_error for rank in ranks}
    models = [rank for rank in ranks if not is_own(candidates[rank])]
    least = min((errors[rank] for rank in models), default=0.0)
    good = [rank for rank in ranks if errors[rank] <= config.far_worse * least + config.slack]
    reasons = {
        rank: f"is aligned far worse, AE {1e3 * errors[rank]:.0f} mm and not {1e3 * least:.0f} mm"
        for rank in ranks
        if rank not in good
    }
    best = candidates[min((rank for rank in good if rank in models), default=ranks[0])]
    turned = [rank for rank in good if not is_own(candidates[rank]) and not _same_way_up(candidates[rank], best)]
    reasons |= dict.fromkeys(turned, "lies on another side than the one that is aligned best")
    for rank, reason in reasons.items():
        out.rejected.setdefault(name, []).append(Rejection(rank, candidates[rank].model.name, reason))
    return [rank for rank in good if rank not in turned]


def _same_way_up(first: CadCandidate, second: CadCandidate) -> bool:
    """Whether two models lie on the same side; what does not stand upright may lie on either of its faces."""
    cosine = float(first.T_map_model[:3, 2] @ second.T_map_model[:3, 2])
    tipped = abs(float(second.T_map_model[2, 2])) < SAME_WAY
    return (abs(cosine) if tipped else cosine) > SAME_WAY


def place_of(
    candidate: CadCandidate,
    solid: Solid,
    graph: ContactGraph,
    child: str,
    reach: float,
    least: float,
    aside: float = 0.0,
) -> PlacedSupport | None:
    """Where a child of the graph would stand on (or in) a candidate, and has room; None if nowhere.

    Args:
        candidate: for the child's parent.
        solid: its pieces.
        graph: where the child stands now.
        child: its name.
        reach: metres that the face may lie above or below.
        least: A of Eq. 2 that is asked.
        aside: metres that the face may lie beside the child.
    """
    return best_face(candidate, graph.nodes[child].box, graph.supports[child].height, reach, least, solid, aside)


def standing_faces(candidate: CadCandidate) -> tuple[PlacedSupport, ...]:
    """The model's declared supports; the top of its box for one that declares none."""
    declared = candidate.supports()
    if declared or not candidate.upright:
        return declared
    T = candidate.T_map_model @ transform(None, (0.0, 0.0, 0.5 * float(candidate.extents[2])))
    return (PlacedSupport(candidate.model.parts[0].name, T, candidate.extents[:2], np.inf),)


def best_face(
    candidate: CadCandidate,
    child: OrientedBox,
    height: float,
    reach: float,
    least: float,
    solid: Solid,
    aside: float = 0.0,
) -> PlacedSupport | None:
    """The face nearest to a height under at least a share of the child's bottom (A of Eq. 2) that has room above it.

    None if there is none within `reach` metres up or down. With `aside`, the child is brought onto the face first, so
    many metres at most.
    """
    near = [face for face in standing_faces(candidate) if abs(face.height - height) <= reach]
    for face in sorted(near, key=lambda face: abs(face.height - height)):
        moved = child
        if aside > 0.0:
            step = step_onto(face, child.corners)
            if np.linalg.norm(step) > aside:
                continue
            moved = OrientedBox(transform(None, step) @ child.T_map_box, child.extents)
        low = face.clearance < CLEAR * child.extents[2]
        if not low and contact_share(moved, face) >= least and _has_room(solid, moved, face.height):
            return face
    return None


def step_onto(face: PlacedSupport, points: Float64, *, inside: bool = False) -> Float64:
    """(3,) level translation of (N, 3) points after which their middle is over a face, off its edges by `OVERHANG`.

    If they are `inside`, all of them are over the face, as far as it is large enough.
    """
    R, origin = face.T_map_support[:2, :2], face.T_map_support[:2, 3]
    local = (points[:, :2] - origin) @ R
    low, high = local.min(axis=0), local.max(axis=0)
    free = np.maximum(0.5 * face.size - (0.5 if inside else OVERHANG) * (high - low), 0.0)
    middle = 0.5 * (low + high)
    return np.append(R @ (np.clip(middle, -free, free) - middle), 0.0)


def _has_room(solid: Solid, child: OrientedBox, height: float) -> bool:
    """Whether the inner part of a child's box that is put at a height is nearly free of the solid."""
    T = child.T_map_box.copy()
    T[2, 3] = height + 0.5 * child.extents[2]
    inner = OrientedBox(T, INNER * child.extents)
    return overlap(solid, Solid.of([inner.corners]))[0] <= MOST_TAKEN * float(np.prod(inner.extents))


def contact_share(child: OrientedBox, face: PlacedSupport) -> float:
    """A(v_p and v_c) / A(v_c) of Eq. 2: share of the bottom of the child's box that lies over a face."""
    from shapely import Polygon

    bottom = Polygon(_rectangle(child.T_map_box, child.extents[:2]))
    top = Polygon(_rectangle(face.T_map_support, face.size))
    return bottom.intersection(top).area / max(bottom.area, 1e-12)


def _rectangle(T: Float64, size: Float64) -> Float64:
    corners = 0.5 * size * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    return corners @ T[:2, :2].T + T[:2, 3]


class _Layout:
    """Slabs of walls and ceilings; floors are a matter of support."""

    def __init__(self, graph: ContactGraph) -> None:
        names = [node.name for node in graph.nodes.values() if is_layout(node) and node.semantic_class != FLOOR]
        slabs = [slab for name in names for slab in layout_slabs(graph, name)]
        self._solids = [Solid.of([slab.mesh.vertices]) for slab in slabs]
        self._normals = [slab.normal for slab in slabs]
        self._low = np.array([solid.low[0] for solid in self._solids]).reshape(-1, 3)
        self._high = np.array([solid.high[0] for solid in self._solids]).reshape(-1, 3)

    def depth(self, solid: Solid) -> float:
        """How deep a solid stands in any of them, metres."""
        low, high = solid.low.min(axis=0), solid.high.max(axis=0)
        near = np.flatnonzero((np.maximum(low - self._high, self._low - high) < 0.0).all(axis=1))
        return max((depth_along(solid, self._solids[k], self._normals[k]) for k in near), default=0.0)


# --------------------------------------------------------------------------------------------------------------- search


class _Conflicts:
    """Volumes of interpenetration between candidates, found when first asked for."""

    def __init__(self, solids: Mapping[str, Sequence[Solid]], graph: ContactGraph, config: SelectionConfig) -> None:
        self.solids = solids
        self.limit = config.overlap_depth
        self.names = list(solids)
        low = np.array([np.min([s.low.min(0) for s in found], 0) for found in solids.values()]).reshape(-1, 3)
        high = np.array([np.max([s.high.max(0) for s in found], 0) for found in solids.values()]).reshape(-1, 3)
        supporters = {name: {*graph.supporters(name)} for name in self.names}
        self.near = {name: [] for name in self.names}
        for i, a in enumerate(self.names):
            close = (np.maximum(low[i] - high[i + 1 :], low[i + 1 :] - high[i]) <= 0.0).all(axis=1)
            for j in np.flatnonzero(close).tolist():
                b = self.names[i + 1 + j]
                if b not in supporters[a] and a not in supporters[b]:
                    self.near[a].append(b)
                    self.near[b].append(a)
        self._known: dict[tuple[str, int, str, int], tuple[float, float]] = {}

    def between(self, a: str, i: int, b: str, j: int) -> tuple[float, float]:
        """Volume and depth; (0, depth) for what is no conflict."""
        if a > b:
            a, i, b, j = b, j, a, i
        if (a, i, b, j) not in self._known:
            volume, depth = overlap(self.solids[a][i], self.solids[b][j])
            self._known[a, i, b, j] = (volume if depth > self.limit else 0.0), depth
        return self._known[a, i, b, j]

    def cost(self, name: str, rank: int, chosen: Mapping[str, int]) -> float:
        """Sum of the volumes that a candidate shares with the chosen ones."""
        return sum(self.between(name, rank, other, chosen[other])[0] for other in self.near[name])


def _min_conflicts(
    graph: ContactGraph,
    kept: Mapping[str, Sequence[int]],
    solids: Mapping[str, Sequence[Solid]],
    config: SelectionConfig,
    out: Selection,
) -> None:
    conflicts = _Conflicts(solids, graph, config)
    rng = np.random.default_rng(config.seed)
    chosen = {name: ranks[0] for name, ranks in kept.items()}
    best, least = dict(chosen), np.inf
    for _ in range(config.steps + 1):
        costs = {name: conflicts.cost(name, chosen[name], chosen) for name in chosen}
        total = 0.5 * sum(costs.values())
        if total < least:
            best, least = dict(chosen), total
        struck = [name for name, cost in costs.items() if cost > 0.0 and len(kept[name]) > 1]
        if not struck:
            break
        name = struck[int(rng.integers(len(struck)))]
        chosen[name] = min(kept[name], key=lambda rank: (conflicts.cost(name, rank, chosen), kept[name].index(rank)))
    out.chosen = best
    for name in best:
        for other in conflicts.near[name]:
            volume, depth = conflicts.between(name, best[name], other, best[other])
            if name < other and volume > 0.0:
                out.conflicts.append((name, other, depth))
