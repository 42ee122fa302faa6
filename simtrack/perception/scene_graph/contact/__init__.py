"""Contact graph: entity nodes with planes and boxes, the tree of what supports what, and proximal relations.

    nodes, findings = entity_nodes(entities, rng)
    builder = ContactGraphBuilder()
    for node in nodes:
        builder.put(node)
    builder.move("table", T_map_table)  # what stands on it comes along
    graph = builder.graph()

Section 2 of the reconstruction paper, Eqs. 1-3. Names are imported on first use: the kernels are compiled code.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simtrack.perception.scene_graph.contact.builder import ContactGraphBuilder, build_contact_graph
    from simtrack.perception.scene_graph.contact.evidence import ContactConfig
    from simtrack.perception.scene_graph.contact.graph import (
        ContactGraph,
        Leaning,
        ProximalEdge,
        Support,
        SupportKind,
        eq1_distance,
    )
    from simtrack.perception.scene_graph.contact.nodes import (
        SCENE,
        EntityKind,
        EntityMesh,
        EntityNode,
        EntityShape,
        Finding,
        FindingCode,
        NodeConfig,
        entity_node,
        entity_nodes,
        entity_shape,
    )
    from simtrack.perception.scene_graph.contact.tracked import TrackedContacts, TrackedContactsConfig

_HOME = {
    "builder": ("ContactGraphBuilder", "build_contact_graph"),
    "evidence": ("ContactConfig",),
    "graph": ("ContactGraph", "Leaning", "ProximalEdge", "Support", "SupportKind", "eq1_distance"),
    "nodes": (
        "SCENE",
        "EntityKind",
        "EntityMesh",
        "EntityNode",
        "EntityShape",
        "Finding",
        "FindingCode",
        "NodeConfig",
        "entity_node",
        "entity_nodes",
        "entity_shape",
    ),
    "tracked": ("TrackedContacts", "TrackedContactsConfig"),
}
_MODULES = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "SCENE",
    "ContactConfig",
    "ContactGraph",
    "ContactGraphBuilder",
    "EntityKind",
    "EntityMesh",
    "EntityNode",
    "EntityShape",
    "Finding",
    "FindingCode",
    "Leaning",
    "NodeConfig",
    "ProximalEdge",
    "Support",
    "SupportKind",
    "TrackedContacts",
    "TrackedContactsConfig",
    "build_contact_graph",
    "entity_node",
    "entity_nodes",
    "entity_shape",
    "eq1_distance",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
