"""Snapping: selected models are moved so that Eq. 1 holds exactly, and out of each other.

The end of section 4.4 of the reconstruction paper, from the root of the tree to its leaves. Heights follow the faces
that models really have, down to the convex pieces that collide; what stands on a model moves along with it. Then
models that are still in each other, beside or in a wall, are pushed apart on the level, the lighter one more.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.boxes import OrientedBox
from simtrack.geometry.transforms import transform
from simtrack.perception.reconstruction.candidates import CadCandidate, PlacedSupport
from simtrack.perception.reconstruction.interference import Contact, Interference
from simtrack.perception.reconstruction.kinematic_tree import FIXED_CLASSES, scaled_mass
from simtrack.perception.reconstruction.layout import layout_slabs
from simtrack.perception.reconstruction.selection import best_face, step_onto
from simtrack.perception.reconstruction.solids import Solid, compacted, resting_rise, solid_of
from simtrack.perception.scene_graph.contact.graph import ContactGraph, SupportKind, is_far_above, is_layout
from simtrack.perception.scene_graph.contact.nodes import SCENE

SLACK = 2e-4
"""Metres that pushed models keep between them."""
LEAST_AREA = 0.2
"""Share of a bottom over a face from which it is taken for the one that is stood on."""
STILL = 1e-7
"""Metres that are no motion."""
TOP = 0.01
"""Metres by which an entity may stand lower than the top of another to stand on it."""
LEVEL = 0.7
"""|z| of a contact's normal from which it is a matter of support."""


@dataclass(frozen=True, slots=True)
class SnappingConfig:
    """Limits of snapping; lengths in metres."""

    reach: float = 0.2
    """How far above or below its place a face to stand on is looked for."""
    aside: float = 0.15
    """How far beside its place it is looked for, if there is none at its place."""
    sink: float = 0.04
    """How far a model may stand in what it stands on, at most half of its height; what is deeper in is beside it."""
    depth: float = 0.001
    """Interpenetration that is left alone."""
    beside: float = 0.008
    """Interpenetration of two things that are left in each other from which one of them is laid on the other one."""
    rounds: int = 40
    """Of pushing apart."""

    def __post_init__(self) -> None:
        for name in ("reach", "aside", "sink", "depth", "beside"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InvalidValueError(f"SnappingConfig.{name}", getattr(self, name), "a positive finite length")
        if self.rounds < 0:
            raise InvalidValueError("SnappingConfig.rounds", self.rounds, "0 or more")


@dataclass(slots=True)
class Snapped:
    """The scene after snapping."""

    candidates: dict[str, CadCandidate]
    """At their final poses."""
    shifts: dict[str, Float64]
    """Entity -> (3,) translation from where alignment had it, metres."""
    parts: dict[str, str]
    """Entity -> part of its supporter's model that it stands on, a drawer say; where the model tells."""
    afloat: list[str] = field(default_factory=list)
    """Entities below which there is nothing of their supporter."""
    stuck: list[tuple[str, str, float]] = field(default_factory=list)
    """Pairs that are still in each other, and how deep, metres."""
    resting: frozenset[str] = frozenset()
    """What is far above a support that is only guessed, but rests on something else."""


def snap(
    graph: ContactGraph,
    chosen: Mapping[str, CadCandidate],
    config: SnappingConfig | None = None,
    ground: float | None = None,
) -> Snapped:
    """Move the chosen models; `ground` is the height of an unseen floor under those that nothing supports."""
    return _Snapping(graph, chosen, config or SnappingConfig(), ground).run()


def eq1_residuals(
    graph: ContactGraph, placed: Mapping[str, CadCandidate], config: SnappingConfig | None = None
) -> dict[str, float]:
    """D of Eq. 1 that is left, metres, of all that stands on something.

    It is the height of the model's lowest point above the highest that it can stand on; NaN where there is nothing
    below it.
    """
    config = config or SnappingConfig()
    solids = _solids(graph, placed)
    residuals = {}
    for name in placed:
        if graph.supports[name].kind in (SupportKind.ON, SupportKind.INSIDE):
            below = {p: solids[p] for p in graph.supporters(name) if p in solids}
            found = resting_rise(solids[name], below, (-config.reach, config.sink))
            residuals[name] = np.nan if found is None else -found
    return residuals


def _solids(graph: ContactGraph, placed: Mapping[str, CadCandidate]) -> dict[str, Solid]:
    """Of all entities, parents before children, and of the layout."""
    solids = {name: solid_of(placed[name]) for name in graph.descendants() if name in placed}
    for node in graph.nodes.values():
        if is_layout(node):
            solids[node.name] = Solid.of([slab.mesh.vertices for slab in layout_slabs(graph, node.name)])
    return solids


def _top(graph: ContactGraph, name: str) -> float:
    """Height of the highest point of an entity's box, metres."""
    return float(graph.nodes[name].box.corners[:, 2].max())


class _Snapping:
    def __init__(
        self, graph: ContactGraph, chosen: Mapping[str, CadCandidate], config: SnappingConfig, ground: float | None
    ) -> None:
        self.graph, self.config, self.ground = graph, config, ground
        self.chosen = chosen
        self.order = [name for name in graph.descendants() if name in chosen]
        self.start = _solids(graph, chosen)
        self.shifts = {name: np.zeros(3) for name in self.start}
        self.afloat: set[str] = set()
        self.resting: set[str] = set()
        self.parts: dict[str, str] = {}
        self.faces: dict[str, tuple[str, PlacedSupport]] = {}
        """What each stands on: a face of its supporter as that was before it moved."""
        self.rested: dict[str, Float64] = {}
        self.ancestors = {name: self._above(name) for name in self.order}
        self.weight = {name: self._mobility(name) for name in self.start}

    def run(self) -> Snapped:
        self._stack()
        stuck: list[Contact] = []
        if self.order:
            scene = Interference({name: compacted(solid) for name, solid in self.start.items()})
            for _ in range(self.config.rounds):
                stuck = self._deepest(self._beside(scene.contacts(self.shifts)))
                if not any(self._push(contact) for contact in stuck):
                    break
                self._stack()
            for contact in self._deepest(scene.contacts(self.shifts)):
                self._lay_on(contact)
            stuck = self._deepest(scene.contacts(self.shifts))
        candidates = {name: self._placed(name) for name in self.order}
        return Snapped(
            candidates,
            {name: self.shifts[name] for name in self.order},
            self.parts,
            sorted(self.afloat),
            [(c.first, c.second, c.depth) for c in stuck],
            frozenset(self.resting),
        )

    # ---------------------------------------------------------------------------------------------------------- heights

    def _stack(self) -> None:
        """From the root to the leaves: put everything down on what supports it, if it has moved against that."""
        for name in self.order:
            support = self.graph.supports[name]
            if name in self.rested and np.abs(self._against(name) - self.rested[name]).max() < STILL:
                continue
            self.afloat.discard(name)
            if support.kind is SupportKind.HUNG:
                self._hang(name, support.parent, support.plane)
            elif support.kind is SupportKind.ROOT:
                if self.ground is not None:
                    self.shifts[name][2] += self.ground - self._solid(name).bottom
            elif is_far_above(self.graph.nodes[name], support):
                self._onto_whatever(name)
            else:
                self._put_down(name, support.parent, support.height)
            self.rested[name] = self._against(name)

    def _against(self, name: str) -> Float64:
        """(N, 3) shifts of an entity against those of its supporters; its own, if it has none."""
        below = [self.shifts[p] for p in self.graph.supporters(name) if p in self.start]
        return self.shifts[name] - np.array(below or [np.zeros(3)])

    def _put_down(self, name: str, parent: str, height: float) -> None:
        solid = self._solid(name)
        if parent in self.chosen:
            box = self.graph.nodes[name].box
            moved = OrientedBox(transform(None, self.shifts[name]) @ box.T_map_box, box.extents)
            at = height + self.shifts[parent][2]
            placed, below = self._placed(parent), self._solid(parent)
            face = None
            for aside in (0.0, self.config.aside):
                face = face or best_face(placed, moved, at, self.config.reach, LEAST_AREA, below, aside)
            if face is not None:
                self.parts[name] = face.part
                back = transform(None, -self.shifts[parent]) @ face.T_map_support
                self.faces[name] = parent, replace(face, T_map_support=back)
                self._keep_on(name)
                solid = self._shift(name, np.array([0.0, 0.0, face.height - solid.bottom]))
        found = self._rise(name, solid, self.config.reach)
        if found is None:
            found = self._rise(name, solid, np.inf)
        if found is None:
            self.afloat.add(name)
        else:
            self._shift(name, np.array([0.0, 0.0, found]))

    def _onto_whatever(self, name: str) -> None:
        """Rest on anything right below, though nobody saw that it stands on that."""
        below = {
            other: self._solid(other) for other in self.start if other not in (name, *self.graph.descendants(name))
        }
        found = resting_rise(self._solid(name), below, (-self.config.sink, self.config.sink))
        if found is not None:
            self.resting.add(name)
            self._shift(name, np.array([0.0, 0.0, found]))

    def _rise(self, name: str, solid: Solid, reach: float) -> float | None:
        """Vertical translation onto the supporters, at most `reach` down; onto the top of those it stood on top of."""
        below = {p: self._solid(p) for p in self.graph.supporters(name) if p != SCENE and p in self.start}
        bottom = self.graph.nodes[name].bottom
        topped = {p: s for p, s in below.items() if p in self.chosen and _top(self.graph, p) < bottom + TOP}
        tall = float(solid.high[:, 2].max() - solid.bottom)
        rises = (
            resting_rise(solid, below, (-reach, min(self.config.sink, 0.5 * tall))),
            resting_rise(solid, topped, (-reach, self.config.reach)),
        )
        return max((rise for rise in rises if rise is not None), default=None)

    def _keep_on(self, name: str) -> None:
        """Shift on the level: what stands on a face has its middle over it, what is inside its whole footprint."""
        if name in self.faces:
            parent, face = self.faces[name]
            face = replace(face, T_map_support=transform(None, self.shifts[parent]) @ face.T_map_support)
            inside = self.graph.supports[name].kind is SupportKind.INSIDE
            step = step_onto(face, np.concatenate(self._solid(name).pieces), inside=inside)
            if np.abs(step).max() > STILL:
                self._shift(name, step)

    def _hang(self, name: str, parent: str, index: int) -> None:
        """Move along the normal of the plane that it hangs on, so that they touch."""
        plane = self.graph.nodes[parent].planes[index]
        shift = self.shifts[parent]
        off = min(float(plane.distance(piece - shift).min()) for piece in self._solid(name).pieces)
        self._shift(name, -off * plane.normal)

    def _shift(self, name: str, step: Float64) -> Solid:
        """Move an entity by (3,); what stands on it follows."""
        for moved in (name, *self.graph.descendants(name)):
            if moved in self.chosen:
                self.shifts[moved] += step
        return self._solid(name)

    # ---------------------------------------------------------------------------------------------------- pushing apart

    def _beside(self, contacts: list[Contact]) -> list[Contact]:
        """Contacts with level normals between entities that may be moved."""
        return [
            contact
            for contact in contacts
            if contact.depth > self.config.depth
            and abs(contact.normal[2]) < LEVEL
            and self.weight[contact.first] + self.weight[contact.second] > 0.0
        ]

    def _push(self, contact: Contact) -> bool:
        a, b = contact.first, contact.second
        level = contact.normal * [1.0, 1.0, 0.0]
        length = float(np.linalg.norm(level))
        step = (contact.depth / length + SLACK) * level / length  # so that it is out along the sloping normal, too
        share = self.weight[b] / (self.weight[a] + self.weight[b])
        if a in self.ancestors.get(b, ()):
            share = 1.0
        elif b in self.ancestors.get(a, ()):
            share = 0.0
        for name, part in ((a, (share - 1.0) * step), (b, share * step)):
            if np.any(part):
                self._shift(name, part)
                self._keep_on(name)
        return True

    def _lay_on(self, contact: Contact) -> None:
        """Where two things have no place beside each other, the higher or lighter one is laid on the other one."""
        pair = [name for name in (contact.first, contact.second) if self._liftable(name)]
        if contact.depth < self.config.beside or len(pair) < 2 or pair[0] in self._above(pair[1]):
            return
        if pair[1] in self._above(pair[0]):
            return
        lower, upper = sorted(pair, key=lambda name: (round(self._solid(name).bottom, 2), self.weight[name]))
        rise = resting_rise(self._solid(upper), {lower: self._solid(lower)}, (0.0, self.config.reach))
        if rise is not None:
            self._shift(upper, np.array([0.0, 0.0, rise]))

    def _liftable(self, name: str) -> bool:
        return self.weight[name] > 0.0 and self.graph.nodes[name].semantic_class not in FIXED_CLASSES

    def _deepest(self, contacts: list[Contact]) -> list[Contact]:
        """The deepest contact of every pair of entities that is too deep."""
        worst: dict[tuple[str, str], Contact] = {}
        for contact in contacts:
            key = contact.first, contact.second
            movable = self.weight[contact.first] + self.weight[contact.second] > 0.0
            if movable and contact.depth > max(worst[key].depth if key in worst else 0.0, self.config.depth):
                worst[key] = contact
        return sorted(worst.values(), key=lambda contact: -contact.depth)

    # ----------------------------------------------------------------------------------------------------------- access

    def _solid(self, name: str) -> Solid:
        return self.start[name].moved(self.shifts[name])

    def _placed(self, name: str) -> CadCandidate:
        T = np.array(self.chosen[name].T_map_model, dtype=float)
        T[:3, 3] += self.shifts[name]
        return replace(self.chosen[name], T_map_model=T)

    def _above(self, name: str) -> list[str]:
        names = []
        while (name := self.graph.parent(name)) != SCENE:
            names.append(name)
        return names

    def _mobility(self, name: str) -> float:
        """Zero for layout and what hangs; else the lighter, the more, and furniture less."""
        if name not in self.chosen:
            return 0.0
        mass = scaled_mass(self.chosen[name]) * (
            10.0 if self.graph.nodes[name].semantic_class in FIXED_CLASSES else 1.0
        )
        return 1.0 / max(mass, 1e-3)
