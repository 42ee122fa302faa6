"""Builds a contact graph and keeps it up to date (section 2.2 of the reconstruction paper).

Evidence is kept for every pair and found again only for pairs of which an entity moved; the tree is selected anew from
all of it. So a graph that was brought up to date equals one that is built from the same entities at the same poses.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.boxes import OrientedBox
from simtrack.geometry.planes import hidden_plane
from simtrack.geometry.transforms import inverse, is_rigid
from simtrack.geometry.upright_boxes import MIN_SIDE
from simtrack.perception.scene_graph.contact.evidence import (
    NOTHING,
    ContactConfig,
    PairEvidence,
    Posed,
    pair_evidence,
)
from simtrack.perception.scene_graph.contact.graph import (
    ContactGraph,
    ProximalEdge,
    Support,
    SupportKind,
    is_far_above,
)
from simtrack.perception.scene_graph.contact.leaning import find_leaning
from simtrack.perception.scene_graph.contact.nodes import FLOOR, EntityNode, Finding, FindingCode
from simtrack.perception.scene_graph.contact.proximity import box_overlap, interpenetration
from simtrack.perception.scene_graph.contact.selection import select_supports


def build_contact_graph(
    nodes: Iterable[EntityNode], config: ContactConfig | None = None, *, findings: Iterable[Finding] = ()
) -> ContactGraph:
    """The contact graph of entities; `findings` about them (see `entity_nodes`) come first in its own.

    Raises:
        InvalidValueError: two nodes of one name, or a node without a mesh.
    """
    builder = ContactGraphBuilder(config)
    for node in nodes:
        if node.name in builder:
            raise InvalidValueError("nodes", node.name, "nodes of different names")
        builder.put(node)
    graph = builder.graph()
    return replace(graph, findings=(*findings, *graph.findings))


class ContactGraphBuilder:
    """Keeps the contact graph of entities that come, move and go.

    Args:
        config: thresholds.
    """

    def __init__(self, config: ContactConfig | None = None) -> None:
        self.config = config or ContactConfig()
        self._bodies: dict[str, Posed] = {}
        self._evidence: dict[tuple[str, str], PairEvidence] = {}
        self._volumes: dict[tuple[str, str], tuple[float, bool]] = {}
        self._changed: set[str] = set()
        self._graph: ContactGraph | None = None

    def __contains__(self, name: str) -> bool:
        return name in self._bodies

    def __len__(self) -> int:
        return len(self._bodies)

    def put(self, node: EntityNode) -> None:
        """Add an entity, or replace the one of its name.

        Raises:
            InvalidValueError: a node without a mesh.
        """
        self._bodies[node.name] = Posed(node)
        self._mark(node.name)

    def remove(self, name: str) -> None:
        """Take an entity away; what it supported stays where it is.

        Raises:
            UnknownNameError: no such entity.
        """
        self._require(name)
        del self._bodies[name]
        self._mark(name)

    def move(self, name: str, T_map_entity: Float64, *, carry: bool = True) -> None:
        """Put an entity elsewhere; with `carry`, all that it supports moves with it.

        Raises:
            UnknownNameError: no such entity.
            InvalidValueError: not a rigid transform.
        """
        self._require(name)
        T = np.asarray(T_map_entity, dtype=float)
        if not is_rigid(T):
            raise InvalidValueError("T_map_entity", T_map_entity, "a (4, 4) rigid transform")
        motion = T @ inverse(self._bodies[name].node.T_map_entity)
        for carried in self.graph().descendants(name) if carry else ():
            node = self._bodies[carried].node
            self.put(node.moved(motion @ node.T_map_entity))
        self.put(self._bodies[name].node.moved(T))

    def graph(self) -> ContactGraph:
        """The graph of the entities as they are now."""
        if self._graph is None:
            self._find_evidence()
            self._graph = self._built()
        return self._graph

    def _require(self, name: str) -> None:
        if name not in self._bodies:
            raise UnknownNameError("entity", name, self._bodies)

    def _mark(self, name: str) -> None:
        self._changed.add(name)
        self._graph = None

    def _find_evidence(self) -> None:
        changed = self._changed
        for table in (self._evidence, self._volumes):
            for pair in [pair for pair in table if pair[0] in changed or pair[1] in changed]:
                del table[pair]
        for child in self._bodies:
            for parent in self._bodies if child in changed else changed & self._bodies.keys():
                if child != parent:
                    found = pair_evidence(self._bodies[child], self._bodies[parent], self.config)
                    if found is not NOTHING:
                        self._evidence[child, parent] = found
        self._changed = set()

    def _built(self) -> ContactGraph:
        supports, others, findings = select_supports(self._bodies, self._evidence, self.config)
        if not any(body.node.semantic_class == FLOOR for body in self._bodies.values()):
            message = f"no entity of class '{FLOOR}': what stands on none of the others hangs in the air"
            findings.insert(0, Finding(FindingCode.NO_FLOOR, "", message))
        nodes = {name: body.node for name, body in self._bodies.items()}
        supports = register_hidden_planes(nodes, supports, self.config.contact_gap)
        findings += refine_boxes(nodes, supports)
        return ContactGraph(
            nodes=nodes,
            supports=supports,
            others=others,
            leaning=find_leaning(self._bodies, supports, self.config),
            proximal=self._proximal(nodes, supports, others),
            findings=tuple(findings),
        )

    def _proximal(
        self, nodes: dict[str, EntityNode], supports: dict[str, Support], others: tuple[Support, ...]
    ) -> tuple[ProximalEdge, ...]:
        """Overlapping boxes of entities of which neither supports the other."""
        names = sorted(nodes)
        T = np.array([nodes[name].box.T_map_box for name in names]).reshape(-1, 4, 4)
        half = np.array([0.5 * nodes[name].box.extents for name in names]).reshape(-1, 3)
        reach = np.einsum("nij,nj->ni", np.abs(T[:, :3, :3]), half)
        gaps = np.abs(T[:, None, :3, 3] - T[None, :, :3, 3]) - reach[:, None] - reach[None]
        holding = {frozenset((s.child, s.parent)) for s in (*supports.values(), *others)}
        edges = []
        for i, j in np.argwhere(np.triu((gaps < 0.0).all(axis=2), 1)):
            first, second = names[i], names[j]
            if frozenset((first, second)) in holding:
                continue
            overlap = box_overlap(nodes[first], nodes[second])
            if overlap > 0.0:
                if (first, second) not in self._volumes:
                    bodies = self._bodies[first], self._bodies[second]
                    self._volumes[first, second] = interpenetration(*bodies)
                volume, exact = self._volumes[first, second]
                edges.append(ProximalEdge(first, second, overlap, volume, exact))
        return tuple(edges)


def register_hidden_planes(
    nodes: dict[str, EntityNode], supports: dict[str, Support], gap: float
) -> dict[str, Support]:
    """Give parents the planes on which children stand that nobody saw (section 2.2); changes `nodes`.

    Children of one parent whose bottoms lie within `gap` metres of each other share a plane.
    """
    hidden: dict[str, list[str]] = {}
    for name, support in supports.items():
        if support.kind in (SupportKind.ON, SupportKind.INSIDE) and support.plane < 0:
            hidden.setdefault(support.parent, []).append(name)
    out = dict(supports)
    for parent, children in hidden.items():
        for level in _levels({name: supports[name].height for name in children}, gap):
            height = float(np.median([supports[name].height for name in level]))
            area = sum(float(np.prod(nodes[name].box.extents[:2])) for name in level)
            index = len(nodes[parent].planes)
            nodes[parent] = replace(nodes[parent], planes=(*nodes[parent].planes, hidden_plane(height, area)))
            for name in level:
                distance = nodes[name].bottom - height
                out[name] = replace(supports[name], plane=index, height=height, distance=distance)
    return out


def _levels(heights: dict[str, float], gap: float) -> list[list[str]]:
    """Names in groups of neighbouring heights."""
    levels: list[list[str]] = []
    for name in sorted(heights, key=lambda name: (heights[name], name)):
        if levels and heights[name] - heights[levels[-1][0]] <= gap:
            levels[-1].append(name)
        else:
            levels.append([name])
    return levels


def refine_boxes(nodes: dict[str, EntityNode], supports: dict[str, Support]) -> list[Finding]:
    """Stretch or cut every box down to its support plane, so that Eq. 1 holds exactly; changes `nodes`.

    Tops stay where they were seen, and so does all of what is far above a support that is only guessed. Support planes
    come from meshes and not from boxes, so the order does not matter.
    """
    findings = []
    for name, support in supports.items():
        if support.kind not in (SupportKind.ON, SupportKind.INSIDE):
            continue
        node = nodes[name]
        if is_far_above(node, support):
            continue
        if node.top - support.height < 10.0 * MIN_SIDE:
            message = f"its top at {node.top:.3f} m lies below its support plane at {support.height:.3f} m"
            findings.append(Finding(FindingCode.SUNK, name, f"{message}; its box was not refined"))
            continue
        T, extents = node.box.T_map_box.copy(), node.box.extents.copy()
        T[2, 3], extents[2] = 0.5 * (node.top + support.height), node.top - support.height
        nodes[name] = replace(node, box=OrientedBox(T, extents))
    return findings
