"""Matching and alignment of an entity in one call: sections 4.2 and 4.3 of the reconstruction paper.

    candidates = shortlist(node, graph, cad_models(node.semantic_class))

Beyond the paper, all of it named where it happens: upright models come before tipped ones, which must fit far better;
the error that ranks looks at the directions in which surfaces face, at what the model has and the entity has not, and
at whether the front could be used.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.boxes import OrientedBox
from simtrack.geometry.meshes import face_areas, face_normals
from simtrack.geometry.upright_boxes import MIN_SIDE
from simtrack.objects.cad import CadModel
from simtrack.perception.reconstruction.alignment import AlignmentConfig
from simtrack.perception.reconstruction.candidates import CadCandidate
from simtrack.perception.reconstruction.clearances import SIDES, furniture_clearances
from simtrack.perception.reconstruction.entity_frames import frames
from simtrack.perception.reconstruction.fitting import (
    ALL_ROUND,
    YAW_STARTS,
    EntityView,
    Fit,
    coarse_fit,
    refined,
    with_open_joints,
)
from simtrack.perception.reconstruction.matching import UPRIGHT, MatchingConfig, matches
from simtrack.perception.scene_graph.contact import ContactGraph, EntityKind, EntityNode

FACING_THE_ROOM = {"monitor": 0.5, "sofa": 0.5}
"""Class of what is looked at or sat on from its front -> metres that its front needs to a wall."""
_UNSEEN_SIDES = 2
"""Sides of the box that may not have been seen of what is believed to lie."""
_FLAT = 0.3
"""Or the share of its surface that is flat."""
_SEEN_BOTTOM = 0.02
"""Share of the surface that faces down at the lower end of an entity whose bottom was seen."""


@dataclass(frozen=True, slots=True)
class ShortlistConfig:
    """Settings of `shortlist`."""

    matching: MatchingConfig = field(default_factory=MatchingConfig)
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    upright: int = 40
    """Upright matches of lowest ME that are aligned coarsely."""
    tipped: int = 12
    """Other matches of lowest ME, likewise: ME ranks what lies by planes that a thin thing hardly has."""
    advantage: float = 0.4
    """Share of the best upright candidate's error below which a tipped one goes before it: things stand as they are
    made to."""
    blocked_front: float = 1.5
    """Factor on the error of a candidate whose front faces a wall, if it is articulated or one of `FACING_THE_ROOM`, or
    another articulated one, if it is articulated: nobody could open it, or look at it."""
    access: float = 0.3
    """Metres that the front of what is articulated needs to a wall or to other furniture."""
    unseen_front: float = 0.3
    """Factor, added to 1, on the error of an articulated candidate whose front nobody saw where its rear was seen:
    rears stand against walls."""
    rear_off_wall: float = 0.5
    """Factor, added to 1, on the error of an articulated candidate that turns its side to a wall and its rear to none:
    what is opened is put up with its rear at a wall."""
    turned: int = 4
    """Best models of which every yaw is tried on what is no box: its box tells nothing of it."""
    natural_size: float = 0.25
    """What a scale that is off by a factor of e adds to the error, relative to it: things have their usual sizes."""
    opened: int = 3
    """Candidates of articulated models for which open positions of the joints are tried; all of them where the smallest
    box is not that of the carcass: something stands open."""

    def __post_init__(self) -> None:
        factors = ("access", "unseen_front", "rear_off_wall", "natural_size")
        for name in ("upright", "tipped", "turned", "opened", *factors):
            if not 0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"ShortlistConfig.{name}", getattr(self, name), "0 or more")
        if not 0.0 < self.advantage <= 1.0 or not 1.0 <= self.blocked_front < np.inf:
            allowed = "a share in (0, 1], and a factor of 1 or more"
            raise InvalidValueError("ShortlistConfig.advantage, blocked_front", self, allowed)


def shortlist(
    node: EntityNode,
    graph: ContactGraph,
    models: Sequence[CadModel],
    config: ShortlistConfig | None = None,
    top: int = 10,
) -> tuple[CadCandidate, ...]:
    """Aligned models that could stand for an entity, the best one first.

    Args:
        node: the entity, with its box refined as in a finished graph.
        graph: that it belongs to: what supports it, what it supports, walls.
        models: of its class; none gives no candidates.
        config: settings.
        top: how many candidates at most.

    Returns:
        Candidates by rising error of `ranking_error`; none for layout and for nodes without a mesh.
    """
    config = config or ShortlistConfig()
    if not models or top < 1 or node.kind is EntityKind.LAYOUT or node.shape is None:
        return ()
    found: list[tuple[float, CadCandidate]] = []
    framed = frames(on_its_bottom(node), graph)
    openable = 0 if node.kind is not EntityKind.ARTICULATED else config.opened if len(framed) == 1 else top
    for seen, T_back in framed:
        view = EntityView.of(seen, graph, config.alignment.samples)
        free = furniture_clearances(view.node, graph)
        for fit in _fits(view, graph, models, free, config, top, openable):
            error = view.diagonal * ranking_error(fit, view, free, config)
            found.append((error, _candidate(view, fit, T_back)))
    return tuple(candidate for _, candidate in sorted(found, key=lambda pair: pair[0])[:top])


def _fits(
    view: EntityView,
    graph: ContactGraph,
    models: Sequence[CadModel],
    free: Float64,
    config: ShortlistConfig,
    top: int,
    openable: int,
) -> list[Fit]:
    """The best aligned models in one frame, by rising error; of the first `openable` ones joints are tried open."""
    ways = ((True, config.upright), (False, config.tipped)) if could_lie(view) else ((True, config.upright),)
    fits = [
        coarse_fit(view, match, config.alignment)
        for upright, count in ways
        for match in matches(view.node, graph, models, config.matching, count, upright=upright)
    ]
    ranked = _ranked(fits, view, free, config)[:top]
    best = _best_of_models(ranked, config.turned)
    starts = {} if view.node.kind is EntityKind.ARTICULATED else {id(fit): ALL_ROUND for fit in best}
    refitted = [refined(view, fit, config.alignment, starts.get(id(fit), YAW_STARTS)) for fit in ranked]
    ranked = _ranked(refitted, view, free, config)
    opened = [with_open_joints(view, fit, config.alignment) for fit in ranked[:openable]]
    return _ranked([*opened, *ranked[openable:]], view, free, config)


def _best_of_models(ranked: Sequence[Fit], count: int) -> list[Fit]:
    """The first upright fit of each of the first `count` models."""
    first: dict[str, Fit] = {}
    for fit in ranked:
        if fit.match.orientation in UPRIGHT:
            first.setdefault(fit.match.model.name, fit)
    return list(first.values())[:count]


def could_lie(view: EntityView) -> bool:
    """Whether enough was seen to believe that a thing does not stand as it is made to: sides of it, or faces.

    What has doors or drawers stands.
    """
    if view.node.kind is EntityKind.ARTICULATED:
        return False
    flat = sum(plane.area for plane in view.node.planes)
    return bool(np.count_nonzero(view.open_sides) < _UNSEEN_SIDES or flat > _FLAT * view.area)


def on_its_bottom(node: EntityNode) -> EntityNode:
    """The node with its box down to its own lower end, if that was seen, and not to the support plane.

    A support plane may be a centimetre off, which is much of a bowl's height. Snapping closes the gap.
    """
    assert node.shape is not None
    mesh, T = node.shape.mesh, node.T_map_entity
    heights = mesh.vertices @ T[2, :3] + T[2, 3]
    low = float(heights[np.unique(mesh.faces)].min())
    areas = face_areas(mesh)
    at_bottom = heights[mesh.faces].max(axis=1) < low + max(0.1 * (node.top - low), 0.003)
    seen = float(areas[at_bottom & (face_normals(mesh) @ T[2, :3] < -0.7)].sum())
    if seen < _SEEN_BOTTOM * float(areas.sum()) or node.top - low < MIN_SIDE:
        return node
    T_box, extents = node.box.T_map_box.copy(), node.box.extents.copy()
    T_box[2, 3], extents[2] = 0.5 * (node.top + low), node.top - low
    return replace(node, box=OrientedBox(T_box, extents))


def _ranked(fits: Sequence[Fit], view: EntityView, free: Float64, config: ShortlistConfig) -> list[Fit]:
    errors = {id(fit): ranking_error(fit, view, free, config) for fit in fits}
    return sorted(fits, key=lambda fit: errors[id(fit)])


def ranking_error(fit: Fit, view: EntityView, free: Float64, config: ShortlistConfig) -> float:
    """What candidates are sorted by: the error of the surfaces, raised where the pose is no way to put such a thing.

    Args:
        fit: an aligned model.
        view: the entity.
        free: (4,) metres from each of `SIDES` to furniture before it.
        config: the factors.
    """
    error = fit.error * (1.0 + config.natural_size * abs(float(fit.unknowns[0])))
    if fit.match.orientation not in UPRIGHT:
        return error / config.advantage
    model = fit.match.model
    if not (model.articulated or model.semantic_class in FACING_THE_ROOM):
        return error
    side = int(np.argmax(SIDES @ -fit.T_box_model[:2, 1]))
    access = config.access if model.articulated else FACING_THE_ROOM[model.semantic_class]
    behind = (side + 2) % 4
    if view.to_walls[side] < access <= view.to_walls[behind]:
        error *= config.blocked_front
    if not model.articulated:
        return error
    if free[side] < access <= free[behind]:
        error *= config.blocked_front
    beside = min(view.to_walls[(side + 1) % 4], view.to_walls[(side + 3) % 4])
    if beside < access <= view.to_walls[behind]:
        error *= 1.0 + config.rear_off_wall
    front, rear = view.facing_sides[side], view.facing_sides[behind]
    return error * (1.0 + config.unseen_front * max(0.0, rear - front) / max(rear + front, 1e-9))


def _candidate(view: EntityView, fit: Fit, T_back: Float64) -> CadCandidate:
    return CadCandidate(
        model=fit.match.model,
        T_map_model=T_back @ view.node.box.T_map_box @ fit.T_box_model,
        scale=fit.scale,
        positions=dict(fit.surface.positions),
        matching_error=fit.match.error,
        alignment_error=view.alignment_error(fit),
        orientation=fit.match.orientation,
    )
