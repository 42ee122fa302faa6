"""Carcasses without their open doors, and leaning things as they would stand."""

import numpy as np
import pytest
import trimesh
from corner import block, corner

from simtrack.geometry.meshes import Mesh, box_mesh, concatenate, transformed
from simtrack.geometry.transforms import rotation_from_rpy, transform, transform_planar, yaw_of
from simtrack.objects.cad import cad_model, cad_models
from simtrack.perception.reconstruction.entity_frames import carcass_box, frames, leaning_turn
from simtrack.perception.reconstruction.shortlist import ShortlistConfig, shortlist
from simtrack.perception.scene_graph.contact import ContactGraph, EntityMesh, EntityNode, entity_nodes

YAW = 0.3


def node_of(mesh: Mesh, semantic_class: str = "fridge") -> EntityNode:
    nodes, _ = entity_nodes([EntityMesh("thing", semantic_class, mesh)], np.random.default_rng(0))
    return nodes[0]


def fridge(share: float) -> EntityNode:
    """One with its doors open by a share of their range."""
    model = cad_model("fridge-side_by_side")
    positions = {joint.name: share * joint.upper for joint in model.joints}
    return node_of(transformed(model.mesh(positions), transform_planar(1.0, 2.0, YAW)))


@pytest.mark.parametrize("share", [0.4, 0.7, 1.0])
def test_the_carcass_of_a_fridge_is_found_however_far_its_doors_are_open(share: float) -> None:
    width, depth, height = cad_model("fridge-side_by_side").extents
    node = fridge(share)
    box = carcass_box(node)
    assert box is not None
    turn = (yaw_of(box.T_map_box) - YAW + np.pi / 4) % (np.pi / 2) - np.pi / 4
    assert abs(turn) < np.radians(2.0)
    across = abs(np.cos(yaw_of(box.T_map_box) - YAW)) > 0.7
    sides = box.extents[:2] if across else box.extents[1::-1]
    assert sides[0] == pytest.approx(width, abs=0.06)
    assert depth - 0.15 < sides[1] < depth + 0.06, "the doors are a part of the closed depth"
    assert box.extents[2] == pytest.approx(height, abs=1e-6)
    assert np.prod(box.extents) < 0.8 * np.prod(node.box.extents)


def test_what_is_closed_has_no_other_frame() -> None:
    assert carcass_box(fridge(0.0)) is None
    assert carcass_box(node_of(box_mesh((0.6, 0.6, 1.8)))) is None


def leaning_book(angle: float) -> ContactGraph:
    """A book on its lower edge that leans against a block."""
    book = transformed(box_mesh((0.03, 0.16, 0.24)), transform(rotation_from_rpy(0.0, angle, 0.0)))
    book = transformed(book, transform(None, (0.0, 0.0, -float(book.bounds[0, 2]))))
    stop = block((0.1, 0.2, 0.3), (float(book.bounds[1, 0]) + 0.0505, 0.0, 0.0))
    return corner(book=("book", book), stop=("box", stop))


def test_a_leaning_book_is_compared_upright_and_put_back() -> None:
    angle = 0.28
    graph = leaning_book(angle)
    node = graph.nodes["book"]
    turn = leaning_turn(node)
    assert turn is not None
    np.testing.assert_allclose(turn[:3, :3], rotation_from_rpy(0.0, angle, 0.0), atol=1e-6)
    ((framed, T_back),) = frames(node, graph)
    np.testing.assert_allclose(np.sort(framed.box.extents), (0.03, 0.16, 0.24), atol=1e-6)
    np.testing.assert_allclose(T_back, turn)
    best = shortlist(node, graph, cad_models("book"), ShortlistConfig(upright=8, tipped=6))[0]
    thin = best.T_map_model[:3, int(np.argmin(best.model.extents))]
    assert abs(thin @ [np.cos(angle), 0.0, -np.sin(angle)]) > np.cos(np.radians(2.0))
    assert best.alignment_error < 0.01


def test_a_carcass_seen_from_its_front_alone_is_left_as_it_is() -> None:
    """Nothing but a front and the edges of its sides: all of it would be peeled off."""
    front = block((0.6, 0.01, 1.8), (0.0, -0.3, 0.0))
    sides = [block((0.01, 0.6, 1.8), (x, 0.0, 0.0)) for x in (-0.3, 0.3)]
    assert carcass_box(node_of(concatenate([front, *sides]))) is None


def test_a_strip_of_a_round_side_does_not_turn_a_thing() -> None:
    """Of a thing on the floor little was seen: a strip of its rounded top, and a patch of a side further down."""
    strip = [(0.0, y, 0.18) for y in (-0.2, 0.2)] + [(0.066, y, 0.134) for y in (-0.2, 0.2)]
    patch = [(0.09, y, z) for z in (0.03, 0.0) for y in (-0.05, 0.05)]
    faces = np.array([(0, 2, 3), (0, 3, 1), (4, 6, 7), (4, 7, 5)], np.int32)
    few = Mesh(np.array(strip + patch), faces)
    assert leaning_turn(node_of(few)) is None, "four triangles tell nothing"
    vertices, faces = few.vertices, few.faces
    for _ in range(2):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)[:2]
    graph = corner(bag=("bag", Mesh(vertices, faces.astype(np.int32))))
    node = graph.nodes["bag"]
    assert leaning_turn(node) is not None
    ((framed, T_back),) = frames(node, graph)
    assert framed is node
    np.testing.assert_array_equal(T_back, np.eye(4))
