import numpy as np
import pytest
import small_rooms

from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.meshes import Mesh, box_mesh, cylinder_mesh
from simtrack.geometry.transforms import transform, transform_planar, transform_xyz_rpy
from simtrack.perception.scene_graph.contact import (
    ContactConfig,
    ContactGraph,
    ContactGraphBuilder,
    EntityMesh,
    EntityNode,
    FindingCode,
    SupportKind,
    build_contact_graph,
    entity_nodes,
    eq1_distance,
)
from simtrack.perception.scene_graph.contact.serialization import dump_contact_graph

STANDING = (SupportKind.ON, SupportKind.INSIDE)


def built(*entities: EntityMesh, config: ContactConfig | None = None) -> ContactGraph:
    nodes, findings = entity_nodes(entities, np.random.default_rng(0))
    return build_contact_graph(nodes, config, findings=findings)


def at(name: str, kind: str, mesh: Mesh, *xyz: float, rpy: tuple[float, float, float] = (0, 0, 0)) -> EntityMesh:
    return EntityMesh(name, kind, mesh, transform_xyz_rpy((xyz[0], xyz[1], xyz[2]), rpy))


FLOOR = at("floor", "floor", small_rooms.plate(6.0, 6.0), 0, 0, 0)


def tree(graph: ContactGraph) -> dict[str, str]:
    return {name: support.parent for name, support in graph.supports.items()}


def assert_feasible(graph: ContactGraph) -> None:
    """Eq. 1 holds exactly along every edge, and every way up ends at the scene."""
    for s in (s for s in graph.supports.values() if s.kind in STANDING):
        assert abs(eq1_distance(graph.nodes[s.child], graph.nodes[s.parent], s)) < 1e-12
        assert graph.nodes[s.parent].planes[s.plane].normal[2] >= 0.9
    assert sorted(graph.descendants()) == sorted(graph.nodes)


def test_a_complete_room_is_understood(room: small_rooms.Room, graph: ContactGraph) -> None:
    assert tree(graph) == room.parents
    assert_feasible(graph)
    assert graph.supports["egg-cup"].kind is SupportKind.INSIDE
    assert graph.supports["picture"].kind is SupportKind.HUNG
    assert [(lean.child, lean.against) for lean in graph.leaning] == [("board", "wall")]
    assert all(s.touching for s in graph.supports.values())
    assert graph.findings == ()


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.005])
def test_a_room_seen_in_part_with_noise_is_understood(room: small_rooms.Room, noise: float) -> None:
    partial = small_rooms.seen(room, noise, np.random.default_rng(1))
    graph = built(*partial.entities)
    assert tree(graph) == {entity.name: room.parents[entity.name] for entity in partial.entities}
    assert_feasible(graph)
    assert [(lean.child, lean.against) for lean in graph.leaning] == [("board", "wall")]


def test_the_order_of_the_entities_does_not_matter(nodes: list[EntityNode], graph: ContactGraph) -> None:
    assert tree(build_contact_graph(nodes[::-1])) == tree(graph)


@pytest.mark.parametrize("yaw", [0.3, 1.9, -2.5])
def test_the_graph_turns_with_the_scene(nodes: list[EntityNode], graph: ContactGraph, yaw: float) -> None:
    T = transform_planar(0.7, -1.1, yaw)
    T[2, 3] = 0.4
    turned = build_contact_graph([node.moved(T @ node.T_map_entity) for node in nodes])
    assert tree(turned) == tree(graph)
    assert {lean.child for lean in turned.leaning} == {lean.child for lean in graph.leaning}
    assert_feasible(turned)


def test_what_stands_on_a_moved_table_comes_along(nodes: list[EntityNode]) -> None:
    builder = ContactGraphBuilder()
    for node in nodes:
        builder.put(node)
    before = builder.graph()
    motion = transform_planar(-0.5, -2.0, 0.6)
    builder.move("table", motion @ before.nodes["table"].T_map_entity)
    after = builder.graph()
    assert tree(after) == tree(before)
    for name in ("cup", "bowl", "egg-cup"):
        np.testing.assert_allclose(after.nodes[name].T_map_entity, motion @ before.nodes[name].T_map_entity, atol=1e-12)
    np.testing.assert_array_equal(after.nodes["desk"].T_map_entity, before.nodes["desk"].T_map_entity)


def test_an_updated_graph_is_the_one_built_from_scratch(nodes: list[EntityNode]) -> None:
    builder = ContactGraphBuilder()
    for node in nodes:
        builder.put(node)
    builder.graph()
    builder.move("cup", transform(None, (1.0, 0.4, 0.77)))  # from the table to the desk
    builder.move("box", transform(None, (-2.0, -2.0, 0.15)), carry=False)  # pulled from below the crate
    builder.remove("picture")
    fresh = ContactGraphBuilder()
    current = builder.graph()
    for name in current.nodes:
        shape = next(node for node in nodes if node.name == name)
        fresh.put(shape.moved(current.nodes[name].T_map_entity))
    assert dump_contact_graph(fresh.graph()) == dump_contact_graph(current)
    assert current.parent("cup") == "desk"
    assert current.parent("crate") == "floor"
    assert not current.supports["crate"].touching


def test_a_plank_across_two_boxes_is_held_by_both() -> None:
    side = box_mesh((0.2, 0.3, 0.4))
    left, right = at("left", "box", side, -0.5, 0, 0.2), at("right", "box", side, 0.45, 0, 0.2)
    graph = built(FLOOR, left, right, at("plank", "board", box_mesh((1.2, 0.2, 0.03)), 0, 0, 0.415))
    assert set(graph.supporters("plank")) == {"left", "right"}
    one = built(FLOOR, left, at("plank", "board", box_mesh((1.2, 0.2, 0.03)), 0, 0, 0.415))
    assert one.parent("plank") == "floor", "its centre of mass is not above the one box"


def test_a_table_top_that_nobody_saw_becomes_a_hidden_plane() -> None:
    table = small_rooms.table_mesh()
    legs = Mesh(table.vertices, table.faces[12:])  # the top, and with it the plane, is missing
    books = [at(f"book{i}", "book", box_mesh((0.5, 0.7, 0.06)), x, 0, 0.755) for i, x in enumerate((-0.28, 0.28))]
    graph = built(FLOOR, at("table", "table", legs, 0, 0, 0), *books)
    for name in ("book0", "book1"):
        support = graph.supports[name]
        assert support.parent == "table"
        assert graph.nodes["table"].planes[support.plane].hidden
    assert graph.supports["book0"].plane == graph.supports["book1"].plane, "one plane carries both"
    assert_feasible(graph)


def test_a_box_is_stretched_down_to_its_support() -> None:
    seat = Mesh(box_mesh((0.4, 0.4, 0.1)).vertices + [0, 0, 0.45], box_mesh((0.4, 0.4, 0.1)).faces)
    graph = built(FLOOR, at("chair", "chair", seat, 0, 0, 0))
    chair = graph.nodes["chair"]
    assert (chair.bottom, chair.top) == (pytest.approx(0.0), pytest.approx(0.5))
    assert [f.code for f in graph.findings] == [FindingCode.SUPPORT_GUESSED]


def test_a_cup_under_a_table_stands_on_the_floor_and_a_lamp_hangs_from_the_ceiling() -> None:
    table = at("table", "table", small_rooms.table_mesh(), 0, 0, 0)
    cup = at("cup", "cup", cylinder_mesh(0.04, 0.1), 0.1, 0, 0.05)
    ceiling = at("ceiling", "ceiling", small_rooms.plate(6, 6), 0, 0, 2.5, rpy=(np.pi, 0, 0))
    lamp = at("lamp", "lamp", cylinder_mesh(0.15, 0.3), 1.5, 1.5, 2.35)
    graph = built(FLOOR, table, cup, ceiling, lamp)
    assert tree(graph) | {"ceiling": "", "floor": ""} == tree(graph)
    assert (graph.parent("cup"), graph.parent("lamp")) == ("floor", "ceiling")


@pytest.mark.parametrize("depth", [0.0, 0.02, 0.05])
def test_the_volume_of_interpenetration_is_exact(depth: float) -> None:
    cube = box_mesh((0.2, 0.2, 0.2))
    graph = built(FLOOR, at("a", "box", cube, 0, 0, 0.1), at("b", "box", cube, 0.2 - depth, 0, 0.1))
    if depth == 0.0:
        assert graph.proximal == ()
    else:
        (edge,) = graph.proximal
        assert (edge.first, edge.second, edge.exact) == ("a", "b", True)
        assert edge.volume == pytest.approx(depth * 0.04)
        assert edge.box_volume == pytest.approx(depth * 0.04)


def test_the_papers_score_falls_with_the_gap_and_the_area() -> None:
    def score(height: float, x: float) -> float:
        block = at("block", "box", box_mesh((0.4, 0.4, 0.2)), x, 0, height + 0.1)
        return built(FLOOR, block).supports["block"].score

    assert score(0.0, 0.0) == pytest.approx(1.0)
    assert score(0.25, 0.0) == pytest.approx(0.75)
    assert score(0.0, 3.0) == pytest.approx(0.5)
    assert score(0.25, 3.0) == pytest.approx(0.375)


def test_bad_entities_are_found_and_left_out() -> None:
    empty = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
    broken = Mesh(np.array([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    cup = at("cup", "cup", cylinder_mesh(0.04, 0.1), 0, 0, 1.0)
    skewed = EntityMesh("skewed", "cup", cup.mesh, np.diag([2.0, 1, 1, 1]))
    twins = at("cup", "cup", cylinder_mesh(0.04, 0.1), 0, 0, 1.0)
    graph = built(at("empty", "cup", empty, 0, 0, 0), at("broken", "cup", broken, 0, 0, 0), cup, skewed, twins)
    assert list(graph.nodes) == ["cup"]
    found = [(finding.code, finding.entity) for finding in graph.findings]
    left_out = [(FindingCode.INVALID_ENTITY, name) for name in ("empty", "broken", "skewed", "cup")]
    assert found == [*left_out, (FindingCode.NO_FLOOR, ""), (FindingCode.UNSUPPORTED, "cup")]
    assert tree(graph) == {"cup": ""}


def test_a_thing_without_planes_is_said_to_have_none() -> None:
    import trimesh

    ball = trimesh.creation.icosphere(4, 0.1)
    graph = built(FLOOR, at("ball", "ball", Mesh(ball.vertices, ball.faces), 0, 0, 0.1))
    assert [(f.code, f.entity) for f in graph.findings] == [(FindingCode.NO_PLANES, "ball")]
    assert graph.parent("ball") == "floor"


def test_nothing_makes_an_empty_graph_that_says_so() -> None:
    graph = build_contact_graph([])
    assert graph.nodes == {}
    assert [finding.code for finding in graph.findings] == [FindingCode.NO_FLOOR]


def test_misuse_is_refused(nodes: list[EntityNode]) -> None:
    builder = ContactGraphBuilder()
    builder.put(nodes[0])
    with pytest.raises(UnknownNameError, match="nothing"):
        builder.move("nothing", np.eye(4))
    with pytest.raises(InvalidValueError, match="rigid"):
        builder.move(nodes[0].name, np.diag([2.0, 1.0, 1.0, 1.0]))
    with pytest.raises(InvalidValueError, match="different names"):
        build_contact_graph([nodes[0], nodes[0]])
    with pytest.raises(InvalidValueError, match="contact_area"):
        ContactConfig(contact_area=2.0)
