"""Spatial relations between bodies, with the semantics of SEMAP, as pure functions of shapes and poses.

SEMAP: H. Deeken et al., "SEMAP - a semantic environment mapping framework", ECMR 2015, as used by the tracking paper,
section III.D. Every body has its own frame: x points to its front, y to its left, z to its top. For each of the six
directions a reference has two regions: the half-space beyond the face of its box, and the projection, a box of the same
cross-section that starts at the face and is 3.5 times as long as the box. Each can be asked strictly (the region
contains the target's box) or relaxed (it meets it). Where a viewer is given, the reference's frame is replaced by one
that looks from the viewer to the reference: in front of is towards the viewer, left is the viewer's left.

A margin is the signed distance of a pair from the boundary of a relation, in metres: >= 0 where the relation holds.
docs/scene_graph.md shows every definition.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.boxes import OrientedBox
from simtrack.perception.scene_graph import kernels
from simtrack.perception.scene_graph.bodies import Body, BodyArrays
from simtrack.perception.scene_graph.kernels import Parameters
from simtrack.perception.scene_graph.shapes import Shape

RELATIONS = (
    "on",
    "in",
    "above",
    "below",
    "left-of",
    "right-of",
    "in-front-of",
    "behind",
    "near",
    "touching",
    "intersects",
)
"""Names in the order of the last axis of `relation_margins`."""
DIRECTIONS = RELATIONS[2:8]
SYMMETRIC = RELATIONS[8:]
CONVERSE = {"above": "below", "left-of": "right-of", "in-front-of": "behind"}
"""Opposite directions. Not inverse: with tilted or turned objects `a left-of b` does not imply `b right-of a`."""


@dataclass(frozen=True, slots=True)
class RelationConfig:
    """Thresholds of the relations and which variant of the directions is kept live."""

    projection: bool = True
    """Directions by projection (else half-space)."""
    strict: bool = False
    """Regions contain the target (else meet it)."""
    projection_factor: float = 3.5
    """Length of a projection in lengths of the box."""
    on_distance: float = 0.02
    """Metres: largest vertical gap between a body and what it rests on. Twice the survey's error and the tracker's."""
    near_range: float = 0.25
    """Metres between the boxes."""
    touch_distance: float = 0.01
    """Metres between the boxes."""
    intersection_depth: float = 0.005
    """Metres of penetration of the boxes from which bodies count as intersecting; pose errors stay below."""
    meet_depth: float = 0.01
    """Metres of penetration from which a region meets a target that it does not contain: a bench is not to the left of
    what stands on it because pose errors let their surfaces cross."""
    enter_margin: float = 0.0
    """Metres: margin at which a relation begins to hold."""
    leave_margin: float = 0.002
    """Metres: a relation that holds ends when its margin falls below minus this (hysteresis against flicker)."""
    container_classes: frozenset[str] = frozenset({"bin", "cabinet", "container", "cupboard", "shelf", "trash-bin"})
    """Semantic classes of the static map that are hollow. Tracked models are recognised by their mesh."""
    layout_classes: frozenset[str] = frozenset({"ceiling", "door", "door-frame", "floor", "wall", "window"})
    """Semantic classes that carry, touch and are near things, but are no landmarks: no directions, no `in`."""

    def __post_init__(self) -> None:
        for name in ("projection_factor", "on_distance", "near_range", "touch_distance"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InvalidValueError(f"RelationConfig.{name}", getattr(self, name), "a positive finite number")
        for name in ("intersection_depth", "meet_depth", "enter_margin", "leave_margin"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"RelationConfig.{name}", getattr(self, name), "a finite number >= 0, metres")

    def parameters(self, *, strict: bool | None = None, projection: bool | None = None) -> Parameters:
        """The thresholds for compiled code, optionally of another variant than the live one."""
        return Parameters(
            float(self.projection_factor),
            float(self.on_distance),
            float(self.near_range),
            float(self.touch_distance),
            float(self.intersection_depth),
            float(self.meet_depth),
            float(self.enter_margin),
            float(self.leave_margin),
            bool(self.strict if strict is None else strict),
            bool(self.projection if projection is None else projection),
        )


def relation_margins(
    bodies: Sequence[Body], config: RelationConfig, *, strict: bool | None = None, projection: bool | None = None
) -> Float64:
    """(N, N, 11) margins in metres, ``[subject, reference, relation]`` in the order of `RELATIONS`; diagonal -inf."""
    arrays = BodyArrays({}, config, capacity=max(1, len(bodies)))
    kinds: dict[int, str] = {}
    for body in bodies:
        if id(body.shape) not in kinds:
            kinds[id(body.shape)] = str(len(kinds))
            arrays.declare(kinds[id(body.shape)], body.shape)
    for body in bodies:
        arrays.add(kinds[id(body.shape)], body.T_map)
    n = len(bodies)
    pairs = np.stack(np.divmod(np.arange(n * n), max(n, 1)), axis=1)
    parameters = config.parameters(strict=strict, projection=projection)
    return kernels.margin_table(arrays.world, pairs, parameters).reshape(n, n, kernels.COUNT)


class MarginMeter:
    """The margin of one relation between two bodies, as `relation_margin` gives it, for many poses of theirs."""

    def __init__(self, subject: Shape, name: str, reference: Shape, config: RelationConfig) -> None:
        """Shapes and relation stay; raises UnknownNameError if `name` is no relation."""
        if name not in RELATIONS:
            raise UnknownNameError("relation", name, RELATIONS)
        self._arrays = BodyArrays({"subject": subject, "reference": reference}, config, capacity=2)
        self._slots = np.array([self._arrays.add(kind, np.eye(4)) for kind in ("subject", "reference")])
        self._column, self._parameters = RELATIONS.index(name), config.parameters()

    def margin(self, T_map_subject: Float64, T_map_reference: Float64) -> float:
        """Metres, >= 0 where the relation holds; poses (4, 4)."""
        self._arrays.set_poses(self._slots, np.stack([T_map_subject, T_map_reference]))
        return float(kernels.margin_table(self._arrays.world, self._slots[None], self._parameters)[0, self._column])


def relation_margin(
    subject: Body,
    name: str,
    reference: Body,
    config: RelationConfig,
    *,
    strict: bool | None = None,
    projection: bool | None = None,
    viewer: Float64 | None = None,
) -> float:
    """Margin of one relation in metres, >= 0 where it holds.

    Args:
        subject: what the relation is said of.
        name: one of `RELATIONS`.
        reference: the landmark.
        config: thresholds; its variant is taken where `strict` or `projection` are None.
        strict: whether the region has to contain the subject; matters to directions and `in`.
        projection: projection or half-space; matters to directions.
        viewer: (4, 4) T_map_camera of who looks (optical axes); directions are then seen from there.

    Raises:
        UnknownNameError: `name` is no relation.
    """
    if name not in RELATIONS:
        raise UnknownNameError("relation", name, RELATIONS)
    if viewer is None or name not in DIRECTIONS:
        margins = relation_margins([subject, reference], config, strict=strict, projection=projection)
        return float(margins[0, 1, RELATIONS.index(name)])
    if subject.shape.layout or reference.shape.layout:
        return -np.inf
    seen = viewer_box(reference.box, viewer)
    axis, sign = kernels.DIRECTION_AXES[DIRECTIONS.index(name)]
    # The viewer's left and front are mirrored against a body's own: x of the box looks at the viewer, y to his right.
    sign = -sign if axis == 1 else sign
    (ca, Ra, ha), (cb, Rb, hb) = _parts(subject.box), _parts(seen)
    t, e = np.empty(3), np.empty(3)
    kernels.relative_box(ca, Ra, ha, cb, Rb, t, e)
    parameters = config.parameters(strict=strict, projection=projection)
    return float(kernels.direction_margin(ca, Ra, ha, cb, Rb, hb, t, e, axis, sign, parameters, np.inf))


def viewer_box(box: OrientedBox, T_map_viewer: Float64) -> OrientedBox:
    """The box around a box whose x axis points horizontally at the viewer; z is up.

    `T_map_viewer` is an optical camera's pose. A viewer straight above takes his image's upper edge as away from him.
    """
    towards = T_map_viewer[:2, 3] - box.T_map_box[:2, 3]
    if np.hypot(*towards) < 1e-6:
        towards = T_map_viewer[:2, 1]
    norm = float(np.hypot(*towards))
    x, y = towards / norm if norm > 1e-9 else (1.0, 0.0)
    R = np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, box.T_map_box[:3, 3]
    return OrientedBox(T, np.abs(R.T @ box.T_map_box[:3, :3]) @ np.asarray(box.extents, dtype=float))


def _parts(box: OrientedBox) -> tuple[Float64, Float64, Float64]:
    T = np.asarray(box.T_map_box, dtype=float)
    return T[:3, 3].copy(), T[:3, :3].copy(), 0.5 * np.asarray(box.extents, dtype=float)
