import numpy as np

from simtrack.perception.scene_graph.contact import SCENE, ContactConfig, EntityNode, FindingCode
from simtrack.perception.scene_graph.contact.evidence import PairEvidence, Posed, SupportOption
from simtrack.perception.scene_graph.contact.selection import select_supports

SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def test_a_cycle_is_broken_at_its_weakest_support_and_said(nodes: list[EntityNode]) -> None:
    bodies = {node.name: Posed(node) for node in nodes if node.name in ("cup", "bowl", "tome")}
    areas = {("cup", "bowl"): 0.9, ("bowl", "tome"): 0.6, ("tome", "cup"): 0.8}
    evidence = {pair: PairEvidence(options=(SupportOption(0, 0.7, 0.0, area, SQUARE),)) for pair, area in areas.items()}
    supports, others, findings = select_supports(bodies, evidence, ContactConfig())
    assert {name: support.parent for name, support in supports.items()} == {"cup": "bowl", "bowl": SCENE, "tome": "cup"}
    assert others == ()
    assert [(f.code, f.entity) for f in findings] == [
        (FindingCode.SUPPORT_CYCLE, "bowl"),
        (FindingCode.UNSUPPORTED, "bowl"),
    ]
    assert "tome -> cup -> bowl -> tome" in findings[0].message
