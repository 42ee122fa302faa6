"""The contact graph cg = (pt, E) as a value: the support tree, proximal relations, and what leans.

Section 2.1 of the reconstruction paper; hung, several supports, leaning and inside go beyond it (its section 6.5).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import UnknownNameError
from simtrack.perception.scene_graph.contact.nodes import SCENE, EntityKind, EntityNode, Finding


class SupportKind(StrEnum):
    """How a parent holds a child."""

    ROOT = "root"
    """The scene node holds layout, and whatever nothing else holds."""
    ON = "on"
    """The child's bottom stands on a plane of the parent: Eq. 1."""
    INSIDE = "inside"
    """The same, with the parent all around."""
    HUNG = "hung"
    """The child hangs on an upright plane, or below one that faces down."""


@dataclass(frozen=True, slots=True)
class Support:
    """An edge s_{p,c} of the tree."""

    child: str
    parent: str
    """Name of the parent, empty for the scene node."""
    kind: SupportKind
    plane: int = -1
    """Index of the support plane among the parent's planes; -1 for `ROOT`."""
    height: float = np.nan
    """Of the support plane under the child's centre, metres; NaN for `ROOT` and `HUNG`."""
    distance: float = np.nan
    """D of Eq. 1 before the box was refined, metres; for `HUNG` the gap to the plane."""
    area: float = 0.0
    """A of Eq. 2; for `HUNG` the share of the child's side that faces the plane."""
    score: float = 0.0
    """S of Eq. 3, in [0, 1]; the area for `HUNG`."""
    touching: bool = True
    """Whether contact was observed; otherwise the parent is the likeliest guess."""


@dataclass(frozen=True, slots=True, eq=False)
class Leaning:
    """A child that would topple over the edge of what it stands on, were it not for what it leans against."""

    child: str
    against: str
    point: Float64
    """(3,), map: where they touch."""


@dataclass(frozen=True, slots=True)
class ProximalEdge:
    """An undirected relation of E: two entities, neither supporting the other, whose boxes overlap."""

    first: str
    second: str
    """Later in order than `first`."""
    box_volume: float
    """Vol(B1 and B2), cubic metres, positive."""
    volume: float
    """Vol(M1 and M2), cubic metres: 0 in a feasible scene. An upper bound where `exact` is False."""
    exact: bool
    """Whether both meshes are closed; the hull stands in for an open one."""


@dataclass(frozen=True, slots=True, eq=False)
class ContactGraph:
    """A parse tree of entities by support, and the proximal relations among them."""

    nodes: Mapping[str, EntityNode]
    """By name; boxes refined so that Eq. 1 holds exactly, hidden support planes registered."""
    supports: Mapping[str, Support]
    """One for every node, by the child's name: the tree."""
    others: tuple[Support, ...]
    """Further supporters of children that stand on several."""
    leaning: tuple[Leaning, ...]
    proximal: tuple[ProximalEdge, ...]
    findings: tuple[Finding, ...]

    def parent(self, name: str) -> str:
        """Name of the node's parent, empty for the scene node.

        Raises:
            UnknownNameError: no such node.
        """
        self._require(name)
        return self.supports[name].parent

    def children(self, name: str = SCENE) -> list[str]:
        """Names of what a node (or the scene) supports.

        Raises:
            UnknownNameError: no such node.
        """
        if name != SCENE:
            self._require(name)
        return [support.child for support in self.supports.values() if support.parent == name]

    def descendants(self, name: str = SCENE) -> list[str]:
        """Names of all that would move with a node, parents before children."""
        return list(self._below(name))

    def supporters(self, name: str) -> list[str]:
        """Everything that supports a node, its parent first."""
        return [self.parent(name)] + [support.parent for support in self.others if support.child == name]

    def _below(self, name: str) -> Iterator[str]:
        for child in self.children(name):
            yield child
            yield from self._below(child)

    def _require(self, name: str) -> None:
        if name not in self.nodes:
            raise UnknownNameError("entity", name, self.nodes)


def eq1_distance(child: EntityNode, parent: EntityNode, support: Support) -> float:
    """D(v_c, pi_p^s) = p_c^g - (-d_p^s + s_c^g / 2) of Eq. 1, metres, at the child's centre."""
    centre = child.box.T_map_box[:3, 3]
    height = parent.planes[support.plane].height_at(float(centre[0]), float(centre[1]))
    return float(centre[2] - (height + 0.5 * child.box.extents[2]))


FAR_BELOW = 3.0
"""Largest sides of a thing: what nobody saw reach down to a support farther below does not reach down to it."""


def is_far_above(node: EntityNode, support: Support) -> bool:
    """Whether a support is guessed, and so far below that something between them was not seen.

    A table is as wide as it is high, and may have legs; a book on a shelf that nobody saw is not as high as the room.
    """
    guessed = support.kind in (SupportKind.ON, SupportKind.INSIDE) and not support.touching
    return guessed and support.distance > FAR_BELOW * float(node.box.extents[:2].max())


def is_layout(node: EntityNode) -> bool:
    """Whether a node is a floor, a ceiling or a wall."""
    return node.kind is EntityKind.LAYOUT
