"""What the geometry of two entities says about one supporting the other: Eqs. 1 and 2, and what the paper leaves out.

Evidence is a function of two posed entities alone, so that it can be kept while neither of them moves.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import face_areas, face_normals
from simtrack.geometry.transforms import apply
from simtrack.geometry.upright_boxes import horizontal_hull
from simtrack.perception.scene_graph.contact.kernels import covered, enclosure
from simtrack.perception.scene_graph.contact.nodes import EntityKind, EntityNode, EntityShape

_GRAVITY = np.array([0.0, 0.0, -1.0])
_BINS = 64
BOARD = 0.05
"""Metres: thickness of a board that things stand on, noise included."""
_ANYWHERE = -np.inf, np.inf


@dataclass(frozen=True, slots=True)
class ContactConfig:
    """Thresholds of a contact graph. Lengths in metres."""

    level: float = -0.9
    """a_th of Eq. 1: a supporting plane's normal times the direction of gravity is at most this."""
    contact_area: float = 0.5
    """b_th of Eq. 2."""
    weak_area: float = 0.2
    """Share of the bottom from which contact is accepted where none reaches `contact_area` (public code: score 0.2)."""
    contact_gap: float = 0.03
    """Distance between bottom and plane up to which they touch: noise of both surfaces."""
    sink: float = 0.05
    """How far a bottom may lie below the plane, at most half of the entity's height."""
    margin: float = 0.03
    """Around a bottom: what it covers itself no camera sees, so the supporting surface is looked for around it, too."""
    inside: float = 0.875
    """Share of the horizontal directions in which a container has to stand around what is inside it."""
    within: float = 0.5
    """The same for an entity that stands in another one whose boards nobody saw."""
    hang_gap: float = 0.05
    """Between what hangs and what it hangs on."""
    hang_clearance: float = 0.1
    """Free height below what hangs."""
    hang_slender: float = 0.55
    """Largest depth of what hangs, in terms of the smaller of width and height, where its underside was not seen."""
    hang_bare: float = 0.5
    """Share of the wall right below a child that has to be seen: what is bare there holds no more of the child."""
    touch: float = 0.015
    """Between what leans and what it leans against."""
    lean_angle: float = float(np.radians(4.0))
    """Radians off upright and off level from which an entity counts as tilted."""
    standing_classes: frozenset[str] = frozenset(
        {"bed", "chair", "desk", "fridge", "sofa", "stool", "table", "washing-machine", "workbench"}
    )
    """Semantic classes that never hang: their legs may not have been seen."""

    def __post_init__(self) -> None:
        if not -1.0 <= self.level < 0.0:
            raise InvalidValueError("ContactConfig.level", self.level, "a cosine in [-1, 0)")
        for name in ("contact_area", "weak_area", "inside", "within", "hang_bare"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InvalidValueError(f"ContactConfig.{name}", getattr(self, name), "a share in (0, 1]")
        for name in ("contact_gap", "sink", "margin", "hang_gap", "hang_clearance", "hang_slender", "touch"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"ContactConfig.{name}", getattr(self, name), "finite and >= 0")


class Posed:
    """A node with what its pose implies, computed when first asked for."""

    def __init__(self, node: EntityNode) -> None:
        if node.shape is None:
            raise InvalidValueError("node.shape", None, f"a mesh; '{node.name}' was read from a file without one")
        self.node = node
        self.shape: EntityShape = node.shape
        self.vertices: Float64 = apply(node.T_map_entity, node.shape.coarse.vertices)
        self.faces: Int32 = node.shape.coarse.faces
        self.hull: Float64 = apply(node.T_map_entity, node.shape.hull)
        self.centre_of_mass: Float64 = apply(node.T_map_entity, node.shape.centre_of_mass[None])[0]
        T, half = node.box.T_map_box, 0.5 * node.box.extents
        self.frame = float(T[0, 0]), float(T[1, 0]), np.ascontiguousarray(half[:2])
        self.bottom_centre: Float64 = np.array([T[0, 3], T[1, 3], node.bottom])
        self.footprint = float(node.box.extents[0] * node.box.extents[1])
        self.radius = float(np.hypot(half[0], half[1]))
        self._planes: dict[int, tuple[Float64, Int32]] = {}
        self._outline: tuple[Float64, Int32] | None = None
        self._underside: float | None = None
        self.needs_hold: bool | None = None
        """Whether it is tilted and would topple, once that is known; see `leaning`."""

    def faces_of(self, plane: int) -> Int32:
        """(K, 3) faces on one of the node's planes; none on hidden ones."""
        return self.shape.coarse_planes[plane] if plane < len(self.shape.coarse_planes) else self.faces[:0]

    def plane_outline(self, plane: int) -> Float64:
        """(K, 3) corners of the convex hull of what lies on a plane."""
        return apply(self.node.T_map_entity, self.shape.outlines[plane])

    def plane_hull(self, plane: int) -> tuple[Float64, Int32]:
        """Horizontal convex hull of a plane's faces, as vertices and faces at height 0."""
        if plane not in self._planes:
            self._planes[plane] = _fan(horizontal_hull(self.plane_outline(plane)))
        return self._planes[plane]

    @property
    def outline(self) -> tuple[Float64, Int32]:
        """Horizontal convex hull of the entity, likewise."""
        if self._outline is None:
            self._outline = _fan(horizontal_hull(self.hull))
        return self._outline

    @property
    def underside(self) -> float:
        """Area of faces that look down from near the bottom, in terms of the footprint: whether it was seen."""
        if self._underside is None:
            mesh = self.shape.coarse
            down = (face_normals(mesh) @ self.node.T_map_entity[2, :3]) < -0.5
            low = self.vertices[self.faces, 2].max(axis=1) < self.node.bottom + 0.02 + 0.1 * self.node.box.extents[2]
            self._underside = float(face_areas(mesh)[down & low].sum()) / max(self.footprint, 1e-12)
        return self._underside


def _fan(outline: Float64) -> tuple[Float64, Int32]:
    """Triangles of a convex polygon of (K, 2) corners."""
    k = np.arange(1, max(len(outline) - 1, 1), dtype=np.int32)
    faces = np.stack([np.zeros_like(k), k, k + 1], axis=1) if len(outline) >= 3 else np.empty((0, 3), np.int32)
    return np.concatenate([outline, np.zeros((len(outline), 1))], axis=1), faces


@dataclass(frozen=True, slots=True, eq=False)
class SupportOption:
    """A way in which a parent may support a child from below."""

    plane: int
    """Index among the parent's planes, -1 for a hidden one."""
    height: float
    """Of the plane under the child's centre, metres."""
    distance: float
    """D(v_c, pi) of Eq. 1: height of the child's bottom above the plane, metres."""
    area: float
    """A(v_p, v_c) of Eq. 2, in [0, 1]."""
    corners: Float64
    """(4, 2), map: the rectangle of contact."""

    @property
    def score(self) -> float:
        """S(v_c, v_i, pi), Eq. 3."""
        return (1.0 - min(1.0, abs(self.distance))) * self.area


@dataclass(frozen=True, slots=True)
class HangOption:
    """A surface that a child may hang on."""

    plane: int
    gap: float
    """Metres between the child and the plane."""
    area: float
    """Share of the child's side that faces the plane's extent."""
    slenderness: float
    """Depth of the child off the plane in terms of the smaller of its width and height; 0 for what hangs from above."""
    bare: float = 0.0
    """Share of the plane right below the child that was seen; 0 where the child is slender anyhow."""


@dataclass(frozen=True, slots=True, eq=False)
class PairEvidence:
    """Everything that bears on one entity (the parent) supporting another (the child)."""

    options: tuple[SupportOption, ...] = ()
    """By planes that were seen."""
    inside: SupportOption | None = None
    """The parent encloses the child and there is no plane: hidden support (a bowl)."""
    top: SupportOption | None = None
    """The child stands on the very top of a parent without a plane there: hidden support (an occluded table top)."""
    within: SupportOption | None = None
    """No plane was seen there, but the parent stands around the child in part, at its height (a crammed shelf), or was
    seen from below right under it (a high shelf)."""
    hang: HangOption | None = None
    enclosure: float = 0.0
    """Share of the horizontal directions in which the parent stands around the child, above the child's bottom."""


NOTHING = PairEvidence()
Evidence = Mapping[tuple[str, str], PairEvidence]
"""(child, parent) -> evidence; pairs without any are missing."""


@dataclass(frozen=True, slots=True)
class _Look:
    """A child's footprint, and what of a surface lies under it."""

    child: Posed
    margin: float = field(default=0.0)

    def rectangle(
        self, vertices: Float64, faces: Int32, heights: tuple[float, float] = _ANYWHERE
    ) -> tuple[float, float, Float64]:
        """Share of the footprint under the rectangle around a surface, share under the surface, corners (4, 2)."""
        cosine, sine, half = self.child.frame
        found, area = covered(
            vertices, faces, self.child.bottom_centre, cosine, sine, half, self.margin, heights[0], heights[1]
        )
        x0, x1, y0, y1 = found
        local = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        corners = (
            np.where(np.isfinite(local), local, 0.0) @ np.array([[cosine, sine], [-sine, cosine]])
            + self.child.bottom_centre[:2]
        )
        share = max(x1 - x0, 0.0) * max(y1 - y0, 0.0) if x1 > x0 and y1 > y0 else 0.0
        return share / self.child.footprint, area / self.child.footprint, corners


def pair_evidence(child: Posed, parent: Posed, config: ContactConfig) -> PairEvidence:
    """Evidence of `parent` supporting `child`; `NOTHING` for entities that lie apart and for layout children."""
    c, p = child.node, parent.node
    reach = child.radius + parent.radius + max(config.hang_gap, config.margin)
    apart = np.hypot(*(child.bottom_centre[:2] - parent.bottom_centre[:2])) > reach
    if c.kind is EntityKind.LAYOUT or apart or p.bottom > c.top + config.hang_gap:
        return NOTHING
    hang = _hang(child, parent, config)
    if p.bottom > c.bottom + config.contact_gap:
        return NOTHING if hang is None else PairEvidence(hang=hang)
    options = _options(child, parent, config)
    if p.kind is EntityKind.LAYOUT:
        return PairEvidence(options=options, hang=hang) if options or hang else NOTHING
    overlap = _Look(child).rectangle(*parent.outline)[1]
    around = _enclosure(child, parent) if overlap > config.contact_area else 0.0
    seated = any(abs(o.distance) <= config.contact_gap and o.area >= config.contact_area for o in options)
    if seated or overlap < config.contact_area:
        return PairEvidence(options=options, hang=hang, enclosure=around) if options or hang or around else NOTHING
    hidden = SupportOption(-1, c.bottom, 0.0, min(overlap, 1.0), _Look(child).rectangle(*parent.outline)[2])
    # a container may not have been seen down to its bottom; what lies on the child is none
    in_range = p.bottom - min(config.contact_gap, 0.5 * float(c.box.extents[2])) <= c.bottom < p.top
    return PairEvidence(
        options=options,
        inside=hidden if in_range and around >= config.inside and _underneath(child, parent, config) else None,
        top=hidden if abs(c.bottom - p.top) <= config.contact_gap and p.top < 0.5 * (c.bottom + c.top) else None,
        within=hidden if in_range and (_amid(around, overlap, config) or _on_seen_board(child, parent)) else None,
        hang=hang,
        enclosure=around,
    )


def _amid(around: float, overlap: float, config: ContactConfig) -> bool:
    """Whether the parent stands around the child in part, and all of the child is above it."""
    return around >= config.within and overlap >= 0.8


def _on_seen_board(child: Posed, parent: Posed) -> bool:
    """Whether the child is right above the parent's underside, as on a board that was seen from below."""
    return child.node.bottom - parent.node.bottom <= BOARD and parent.underside >= 0.3


def _options(child: Posed, parent: Posed, config: ContactConfig) -> tuple[SupportOption, ...]:
    """Gravity-opposed planes of the parent under the child's bottom: D of Eq. 1 and A of Eq. 2."""
    found = []
    c = child.node
    look = _Look(child, config.margin)
    for k, plane in enumerate(parent.node.planes):
        if plane.normal @ _GRAVITY > config.level:
            continue
        height = plane.height_at(child.bottom_centre[0], child.bottom_centre[1])
        distance = c.bottom - height
        if distance < -min(config.sink, 0.5 * float(c.box.extents[2])):
            continue
        share, _, corners = look.rectangle(parent.vertices, parent.faces_of(k))
        if parent.node.kind is EntityKind.LAYOUT:  # a floor goes on under furniture, where no camera sees it
            _, whole, box = _Look(child).rectangle(*parent.plane_hull(k))
            share, corners = (whole, box) if whole > share else (share, corners)
        if share > 0.0:
            found.append(SupportOption(k, height, distance, min(float(share), 1.0), corners))
    return tuple(found)


def _enclosure(child: Posed, parent: Posed) -> float:
    """How far around the child the parent stands, above the child's bottom fifth and not above its top."""
    height = float(child.node.box.extents[2])
    low, high = 0.2 * min(height, parent.node.top - child.node.bottom), min(height, parent.node.top - child.node.bottom)
    if high <= low + 0.002:
        return 0.0
    return float(enclosure(parent.vertices, parent.faces, child.bottom_centre, low, high, _BINS))


def _underneath(child: Posed, parent: Posed, config: ContactConfig) -> bool:
    """Whether the parent has a bottom under the child, or might: it was seen in part."""
    if not parent.shape.closed:
        return True
    window = -config.sink, config.contact_gap
    return _Look(child).rectangle(parent.vertices, parent.faces, window)[1] >= 0.1


def _hang(child: Posed, parent: Posed, config: ContactConfig) -> HangOption | None:
    """Best upright or downward plane of the parent that the child nearly touches and faces."""
    best: HangOption | None = None
    for k, plane in enumerate(parent.node.planes):
        level = float(plane.normal[2])
        if abs(level) > 0.2 and level > config.level:
            continue
        off = plane.distance(child.hull)
        if not -config.sink <= off.min() <= config.hang_gap:
            continue
        if level <= config.level:
            area, slender = _Look(child).rectangle(*parent.plane_hull(k))[1], 0.0
        else:
            area, slender = _facing(child, parent, k, float(np.ptp(off)))
        bare = _bare(child, parent, k, config) if slender > config.hang_slender and area >= config.contact_area else 0.0
        option = HangOption(k, float(off.min()), min(area, 1.0), slender, bare)
        if area >= config.contact_area and (best is None or (option.area, -option.gap) > (best.area, -best.gap)):
            best = option
    return best


def _bare(child: Posed, parent: Posed, plane: int, config: ContactConfig) -> float:
    """Share of an upright plane that was seen within `hang_clearance` below the middle of a child's width."""
    n = parent.node.planes[plane].normal
    across = np.array([-n[1], n[0], 0.0]) / np.hypot(n[0], n[1])
    span = child.hull @ across
    half = np.array([0.3 * np.ptp(span), 0.5 * config.hang_clearance])
    middle = np.array([0.5 * (span.min() + span.max()), child.node.bottom - 0.02 - half[1], 0.0])
    used, faces = np.unique(parent.faces_of(plane), return_inverse=True)
    flat = np.stack([parent.vertices[used] @ across, parent.vertices[used, 2], np.zeros(len(used))], axis=1)
    seen = covered(flat, faces.reshape(-1, 3).astype(np.int32), middle, 1.0, 0.0, half, 0.0, -1.0, 1.0)[1]
    return min(float(seen) / float(4.0 * half[0] * half[1]), 1.0)


def _facing(child: Posed, parent: Posed, plane: int, depth: float) -> tuple[float, float]:
    """Share of the child's side within an upright plane's extent, and the child's slenderness off it."""
    n = parent.node.planes[plane].normal
    across = np.array([-n[1], n[0], 0.0]) / np.hypot(n[0], n[1])
    wall = parent.plane_outline(plane)
    own = np.stack([child.hull @ across, child.hull[:, 2]], axis=1)
    other = np.stack([wall @ across, wall[:, 2]], axis=1)
    size = np.maximum(np.ptp(own, axis=0), 1e-9)
    common = np.minimum(own.max(axis=0), other.max(axis=0)) - np.maximum(own.min(axis=0), other.min(axis=0))
    return float(np.prod(np.clip(common, 0.0, None) / size)), depth / float(size.min())
