from dataclasses import replace

import numpy as np
import pytest
import small_rooms

from simtrack.geometry.meshes import Mesh, box_mesh, face_normals, subdivide_to, transformed
from simtrack.geometry.transforms import rotation_from_rpy, transform
from simtrack.perception.scene_graph.contact import (
    SCENE,
    ContactConfig,
    EntityMesh,
    EntityNode,
    FindingCode,
    build_contact_graph,
    entity_nodes,
)
from simtrack.perception.scene_graph.contact.evidence import HangOption, PairEvidence, Posed, SupportOption
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


def test_what_hangs_does_so_though_something_in_it_reaches_its_bottom(nodes: list[EntityNode]) -> None:
    """A cup in a wall cabinet, whose bottom is right above the cabinet's, and a book that the cabinet's door touches:
    it seems to be balanced on both.
    """
    bodies = {node.name: Posed(node) for node in nodes if node.name in ("cup", "picture", "wall", "tome")}
    edge = SupportOption(0, 0.7, 0.0, 0.01, SQUARE)
    on_cup = SupportOption(0, 0.7, -0.02, 0.3, SQUARE)
    in_case = SupportOption(0, 0.7, 0.0, 0.9, SQUARE)
    evidence = {
        ("picture", "wall"): PairEvidence(hang=HangOption(0, 0.0, 1.0, 0.1)),
        ("picture", "cup"): PairEvidence(options=(on_cup,)),
        ("picture", "tome"): PairEvidence(options=(replace(edge, corners=SQUARE + 2.0),)),
        ("cup", "picture"): PairEvidence(options=(in_case,)),
    }
    supports, _, findings = select_supports(bodies, evidence, ContactConfig())
    assert {name: support.parent for name, support in supports.items()} == {
        "cup": "picture", "picture": "wall", "wall": SCENE, "tome": SCENE,
    }  # fmt: skip
    assert [(f.code, f.entity) for f in findings] == [(FindingCode.UNSUPPORTED, "tome")]


def test_a_book_across_two_thin_ones_lies_on_them_and_not_on_the_table() -> None:
    floor = EntityMesh("floor", "floor", small_rooms.plate(6.0, 6.0))
    table = EntityMesh("table", "table", small_rooms.table_mesh())
    thin = box_mesh((0.13, 0.2, 0.028))
    bases = [
        EntityMesh(n, "book", thin, transform(None, np.array([x, 0.0, 0.764]))) for n, x in (("a", -0.1), ("b", 0.1))
    ]
    across = EntityMesh("across", "book", box_mesh((0.24, 0.16, 0.03)), transform(None, np.array([0.0, 0.0, 0.793])))
    nodes, _ = entity_nodes([floor, table, *bases, across], np.random.default_rng(0))
    assert set(build_contact_graph(nodes).supporters("across")) == {"a", "b"}
    beside, _ = entity_nodes([floor, table, bases[0], across], np.random.default_rng(0))
    assert build_contact_graph(beside).parent("across") == "table", "one of them alone does not carry it"


@pytest.mark.parametrize(("below", "parent"), [(True, "wall"), (False, "floor")])
def test_a_deep_thing_hangs_where_the_wall_below_it_was_seen(below: bool, parent: str) -> None:
    upright = transform(rotation_from_rpy(np.pi / 2, 0.0, 0.0), np.array([0.0, 3.0, 1.25]))
    sheet = subdivide_to(transformed(small_rooms.plate(4.0, 2.5), upright), 4000)
    x, _, z = sheet.triangles.mean(axis=1).T
    wall = Mesh(sheet.vertices, sheet.faces[below | (np.abs(x) > 0.4) | (z > 1.3)])
    case = transformed(box_mesh((0.6, 0.3, 0.4)), transform(None, np.array([0.0, 2.849, 1.5])))
    front = case.faces[face_normals(case)[:, 2] > -0.5]  # nobody saw its underside
    entities = [EntityMesh("floor", "floor", small_rooms.plate(6.0, 6.0)), EntityMesh("wall", "wall", wall)]
    nodes, _ = entity_nodes(
        [*entities, EntityMesh("case", "cabinet", Mesh(case.vertices, front))], np.random.default_rng(0)
    )
    assert build_contact_graph(nodes).parent("case") == parent


def test_what_stands_on_a_high_board_that_was_seen_from_below_stands_on_it() -> None:
    wall = transformed(small_rooms.plate(4.0, 2.5), transform(rotation_from_rpy(np.pi / 2, 0.0, 0.0), (0.0, 3.0, 1.25)))
    board = transformed(box_mesh((0.8, 0.2, 0.02)), transform(None, (0.0, 2.89, 1.6)))
    below = Mesh(board.vertices, board.faces[face_normals(board)[:, 2] < 0.5])  # nobody saw its top
    cup = transformed(box_mesh((0.07, 0.07, 0.1)), transform(None, (0.1, 2.86, 1.66)))
    shapes = [("floor", "floor", small_rooms.plate(6.0, 6.0)), ("wall", "wall", wall), ("shelf", "shelf", below)]
    entities = [EntityMesh(*each) for each in (*shapes, ("cup", "cup", cup))]
    graph = build_contact_graph(entity_nodes(entities, np.random.default_rng(0))[0])
    assert (graph.parent("cup"), graph.parent("shelf")) == ("shelf", "wall")
    assert graph.nodes["shelf"].planes[graph.supports["cup"].plane].hidden
