"""How far a contact graph is from the true one: graph edit distance, as the reconstruction paper counts it and general.

Definitions
-----------
* Nodes are matched by name, or one to one by the overlap (IoU) of their boxes, which maximises the sum of overlaps.
* Wrong support W: a matched node whose true parent is matched (or the scene), and whose parent is not its match. A node
  that truly stands on several may have any of them as its parent.
* Missing M: true nodes without a match. Extra E: estimated nodes without one.
* Wrong class C: matched nodes of another class. The paper counts them among E ("wrong detection", its section 5.3: an
  entity that was detected under another label is not missing), one operation as the substitution that it is.
* `total` is the paper's distance 2 W + M + E, C in E (its Table 5): a wrong edge is taken out and another put in; the
  edges of missing and extra nodes are free. Where nodes are matched by class there is no C, and each such node is one
  of M and one of E.
* `general` is the distance under the five operations, each at cost 1: insertion and removal of nodes and of edges, and
  substitution of a node's class, given the matching; so it bounds the distance over all matchings from above.
* `optimal_edit_distance` minimises over all matchings, for small graphs only.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError

SCENE = ""
"""Name of the root."""
MAX_OPTIMAL = 12
"""Nodes of either graph up to which `optimal_edit_distance` is asked for an answer."""


@dataclass(frozen=True, slots=True)
class SupportTree:
    """A contact graph reduced to what is compared."""

    classes: Mapping[str, str]
    """Semantic class of every node, by name."""
    parents: Mapping[str, tuple[str, ...]]
    """Supporters of every node, the main one first; ``("",)`` for children of the scene."""

    def __post_init__(self) -> None:
        if self.classes.keys() != self.parents.keys():
            odd = sorted(self.classes.keys() ^ self.parents.keys())
            raise InvalidValueError("SupportTree.parents", odd, "one entry for every node of `classes`")
        for name, parents in self.parents.items():
            if not parents or any(parent != SCENE and parent not in self.classes for parent in parents):
                raise InvalidValueError(
                    f"SupportTree.parents[{name!r}]", parents, "names of nodes, or '' for the scene"
                )


@dataclass(frozen=True, slots=True)
class ContactGraphErrors:
    """Errors of an estimated contact graph."""

    nodes: int
    """Of the true graph."""
    wrong_support: tuple[str, ...]
    """True names: W."""
    missing: tuple[str, ...]
    """True names: M."""
    extra: tuple[str, ...]
    """Estimated names: E, without C."""
    wrong_class: tuple[str, ...]
    """True names: C."""
    general: int
    """Edit distance given the matching, edges of missing and extra nodes and classes counted."""

    @property
    def total(self) -> int:
        """2 W + M + E, as in the paper's Table 5; C counts as E."""
        return 2 * len(self.wrong_support) + len(self.missing) + len(self.extra) + len(self.wrong_class)


def contact_graph_errors(
    estimate: SupportTree, actual: SupportTree, matches: Mapping[str, str] | None = None
) -> ContactGraphErrors:
    """Compare an estimated graph with the true one.

    Args:
        estimate: what was inferred.
        actual: what is true.
        matches: true name -> estimated name, one to one; None matches equal names.

    Raises:
        InvalidValueError: `matches` names no such nodes, or is not one to one.
    """
    if matches is None:
        matches = {name: name for name in actual.classes if name in estimate.classes}
    unknown = (matches.keys() - actual.classes.keys()) | (set(matches.values()) - estimate.classes.keys())
    if unknown or len(set(matches.values())) != len(matches):
        raise InvalidValueError("matches", dict(matches), "a one-to-one map of true onto estimated names")
    back = {e: a for a, e in matches.items()} | {SCENE: SCENE}
    wrong = tuple(
        name
        for name, match in matches.items()
        if back.get(estimate.parents[match][0]) not in actual.parents[name]
        and (actual.parents[name][0] in matches or actual.parents[name][0] == SCENE)
    )
    missing = tuple(name for name in actual.classes if name not in matches)
    extra = tuple(name for name in estimate.classes if name not in back)
    true_edges = {(parents[0], name) for name, parents in actual.parents.items()}
    named = {name: back.get(name, f"extra: {name}") for name in estimate.classes} | {SCENE: SCENE}
    edges = set()
    for name, parents in estimate.parents.items():
        parent, child = named[parents[0]], named[name]
        alternatives = actual.parents.get(child, ())
        edges.add((alternatives[0] if parent in alternatives else parent, child))
    renamed = tuple(a for a, e in matches.items() if actual.classes[a] != estimate.classes[e])
    general = len(missing) + len(extra) + len(renamed) + len(true_edges ^ edges)
    return ContactGraphErrors(len(actual.classes), wrong, missing, extra, renamed, general)


def match_by_overlap(
    estimate: Mapping[str, tuple[Float64, Float64]],
    actual: Mapping[str, tuple[Float64, Float64]],
    least: float = 0.25,
) -> dict[str, str]:
    """True name -> estimated name where boxes overlap, the sum of IoUs greatest.

    Args:
        estimate: (T_map_box (4, 4), extents (3,)) of upright boxes, by name.
        actual: likewise.
        least: smallest IoU of a match.
    """
    from scipy.optimize import linear_sum_assignment

    first, second = list(actual), list(estimate)
    table = np.array([[upright_iou(*actual[a], *estimate[e]) for e in second] for a in first])
    if table.size == 0:
        return {}
    table[table < least] = 0.0
    rows, columns = linear_sum_assignment(-table)
    return {first[i]: second[j] for i, j in zip(rows, columns, strict=True) if table[i, j] > 0.0}


def upright_iou(T_a: Float64, extents_a: Float64, T_b: Float64, extents_b: Float64) -> float:
    """Intersection over union of two upright boxes."""
    import shapely

    height = min(T_a[2, 3] + 0.5 * extents_a[2], T_b[2, 3] + 0.5 * extents_b[2])
    height -= max(T_a[2, 3] - 0.5 * extents_a[2], T_b[2, 3] - 0.5 * extents_b[2])
    if height <= 0.0:
        return 0.0
    square = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = [(square * e[:2]) @ T[:2, :2].T + T[:2, 3] for T, e in ((T_a, extents_a), (T_b, extents_b))]
    common = shapely.Polygon(corners[0]).intersection(shapely.Polygon(corners[1])).area * float(height)
    return float(common / (np.prod(extents_a) + np.prod(extents_b) - common))


def optimal_edit_distance(estimate: SupportTree, actual: SupportTree, timeout: float = 10.0) -> float | None:
    """Least number of the five operations over all matchings of nodes, by their classes and edges alone.

    None for graphs of more than `MAX_OPTIMAL` nodes. What is found within `timeout` seconds is returned; it is an upper
    bound if time ran out.
    """
    if max(len(estimate.classes), len(actual.classes)) > MAX_OPTIMAL:
        return None
    import networkx as nx

    graphs = []
    for tree in (estimate, actual):
        graph = nx.DiGraph()
        graph.add_node(SCENE, kind="(scene)")
        graph.add_nodes_from((name, {"kind": kind}) for name, kind in tree.classes.items())
        graph.add_edges_from((parents[0], name) for name, parents in tree.parents.items())
        graphs.append(graph)
    return nx.graph_edit_distance(*graphs, node_match=_same_kind, roots=(SCENE, SCENE), timeout=timeout)


def _same_kind(first: Mapping[str, str], second: Mapping[str, str]) -> bool:
    return first["kind"] == second["kind"]
