"""From a graph to a functional scene: every entity ends up in it, and bad input is said to be bad."""

import json
from collections.abc import Sequence

import numpy as np
import pytest
from corner import FLOOR, at, block, corner, cupboard_model, graph_of, table_mesh, table_model

from simtrack.geometry.meshes import Mesh, concatenate, is_closed
from simtrack.objects.cad import CadModel
from simtrack.objects.cad.builder import ModelBuilder
from simtrack.objects.cad.materials import OAK, STEEL
from simtrack.perception.reconstruction.candidates import CadCandidate
from simtrack.perception.reconstruction.layout import layout_slabs
from simtrack.perception.reconstruction.own_model import is_own, own_candidate
from simtrack.perception.reconstruction.reconstruct import NoteCode, Reconstruction, ReconstructionConfig, reconstruct
from simtrack.perception.reconstruction.record import dump_reconstruction
from simtrack.perception.scene_graph.contact import ContactGraph, EntityMesh, EntityNode, FindingCode

MODELS = {"table": table_model("table-test", (1.0, 0.6, 0.7)), "cabinet": cupboard_model()}


def centred(node: EntityNode, graph: ContactGraph, models: Sequence[CadModel]) -> list[CadCandidate]:
    """One model a class, put into the middle of the box."""
    return [CadCandidate(MODELS[node.semantic_class], node.box.T_map_box, 1.0)] if node.semantic_class in MODELS else []


def scene(**things: tuple[str, Mesh]) -> Reconstruction:
    return reconstruct(corner(**things), shortlist=centred)


@pytest.fixture(scope="module")
def laid() -> Reconstruction:
    return scene(
        desk=("table", table_mesh((1.0, 0.6, 0.74), (0.0, 0.0, 0.0))),
        gadget=("gadget", block((0.2, 0.2, 0.2), (0.1, 0.0, 0.74))),
        cup=("cup", block((0.08, 0.08, 0.1), (0.1, 0.0, 0.94))),
    )


def test_every_entity_is_in_the_scene_at_the_height_of_what_it_stands_on(laid: Reconstruction) -> None:
    assert {body.name for body in laid.tree.bodies} == {"scene", "floor", "wall", "desk", "gadget", "cup"}
    heights = {n: float(c.candidate.mesh().vertices[:, 2].min()) for n, c in laid.choices.items()}
    assert heights == pytest.approx({"desk": 0.0, "gadget": 0.7, "cup": 0.9}, abs=1e-3)
    assert all(abs(choice.residual) < 1e-6 for choice in laid.choices.values())


def test_what_has_no_model_is_its_own_mesh_and_that_is_said(laid: Reconstruction) -> None:
    assert {name: choice.own_mesh for name, choice in laid.choices.items()} == {
        "desk": False,
        "gadget": True,
        "cup": True,
    }
    assert {note.entity: note.code for note in laid.notes} == {
        "gadget": NoteCode.NO_MODEL,
        "cup": NoteCode.NO_CANDIDATE,
        "": NoteCode.NO_MODEL,
    }
    said = {note.entity: note.message for note in laid.notes}
    assert "'gadget'" in said["gadget"]
    assert "table" in said[""], "the classes that there are, said once"


def test_the_record_tells_which_model_stands_where(laid: Reconstruction) -> None:
    document = json.loads(dump_reconstruction(laid))
    rows = {row["name"]: row for row in document["entities"]}
    assert rows["desk"]["model"] == "table-test"
    assert rows["cup"]["parent"] == "gadget"
    np.testing.assert_allclose(rows["desk"]["T_map_model"], laid.choices["desk"].candidate.T_map_model)


def test_without_a_floor_there_is_a_level_ground_and_that_is_said() -> None:
    desk = EntityMesh("desk", "table", table_mesh((1.0, 0.6, 0.7), (0.0, 0.0, 0.2)))
    tin = EntityMesh("tin", "tin", block((0.1, 0.1, 0.1), (2.0, 0.0, 0.2)))
    made = reconstruct(graph_of([desk, tin]), shortlist=centred)
    assert FindingCode.NO_FLOOR in {finding.code for finding in made.graph.findings}
    assert NoteCode.GROUND_INFERRED in {note.code for note in made.notes}
    joints = {body.name: (body.joint.kind, body.joint.parent) for body in made.tree.bodies if body.joint is not None}
    assert joints["desk"] == ("fixed", "ground")
    assert joints["tin"] == ("floating", "ground")
    assert made.tree.by_name["ground"].collision[0].corners()[:, 2].max() == pytest.approx(0.2)


def test_entities_without_planes_and_empty_meshes_are_findings_and_the_rest_is_made() -> None:
    ball = Mesh(*_ball(0.15, (0.0, 0.0, 0.15)))
    nothing = EntityMesh("ghost", "cup", Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32)))
    made = reconstruct(graph_of([FLOOR, EntityMesh("ball", "ball", ball), nothing]), shortlist=centred)
    codes = {finding.entity: finding.code for finding in made.graph.findings}
    assert codes["ghost"] is FindingCode.INVALID_ENTITY
    assert codes["ball"] is FindingCode.NO_PLANES
    assert set(made.choices) == {"ball"}


def test_what_is_far_above_a_guessed_support_stays_where_it_was_seen() -> None:
    """A book on a shelf that nobody saw; a table top whose legs nobody saw reaches down."""
    top = block((1.0, 0.8, 0.03), (-1.5, 0.0, 0.7))
    made = scene(book=("tome", block((0.2, 0.15, 0.03), (0.0, 0.0, 1.4))), top=("desk", top))
    assert {name: made.graph.supports[name].touching for name in made.choices} == {"book": False, "top": False}
    heights = {n: c.candidate.mesh().bounds[:, 2] for n, c in made.choices.items()}
    np.testing.assert_allclose(heights["book"], (1.4, 1.43), atol=1e-3)
    np.testing.assert_allclose(heights["top"], (0.0, 0.73), atol=3e-3)
    joint = made.tree.by_name["book"].joint
    assert joint is not None and joint.kind == "fixed"
    assert [note.entity for note in made.notes if note.code is NoteCode.HELD] == ["book"]


def test_a_model_that_does_not_fit_is_made_smaller_and_that_is_said() -> None:
    """A tin between two boards that are 10 mm nearer to each other than its model is high."""
    boards = [block((0.6, 0.4, 0.02), (0.0, 0.0, z)) for z in (0.0, 0.22)]
    sides = [block((0.02, 0.4, 0.24), (x, 0.0, 0.0)) for x in (-0.29, 0.29)]
    graph = corner(rack=("table", concatenate([*boards, *sides])), tin=("tin", block((0.1, 0.1, 0.19), (0, 0, 0.02))))
    rack, tin = ModelBuilder("table", "two boards"), ModelBuilder("tin", "tin")
    part = rack.part()
    for low, high in (((-0.3, -0.2, 0.0), (0.3, 0.2, 0.02)), ((-0.3, -0.2, 0.22), (0.3, 0.2, 0.24)),
                      ((-0.3, -0.2, 0.0), (-0.28, 0.2, 0.24)), ((0.28, -0.2, 0.0), (0.3, 0.2, 0.24))):  # fmt: skip
        part.block(low, high, OAK)
    rack.hollow(part, (-0.28, -0.2, 0.02), (0.28, 0.2, 0.22))
    tin.part().block((-0.05, -0.05, 0.0), (0.05, 0.05, 0.21), STEEL)
    candidates = {
        "rack": [CadCandidate(rack.finish("rack"), at(0.0, 0.0, 0.12), 1.0)],
        "tin": [CadCandidate(tin.finish("tin"), at(0.0, 0.0, 0.125), 1.0)],
    }
    made = reconstruct(graph, known=candidates)
    assert made.choices["tin"].candidate.scale == pytest.approx(0.95)
    assert [note.entity for note in made.notes if note.code is NoteCode.SHRUNK] == ["tin"]
    assert NoteCode.INTERPENETRATING not in {note.code for note in made.notes if note.entity == "tin"}
    kept = reconstruct(graph, ReconstructionConfig(shrunk=()), known=candidates)
    assert kept.choices["tin"].candidate.scale == 1.0


def test_what_finds_no_rest_is_fixed_where_it_was_seen_and_that_is_said() -> None:
    """A thin board upright on its edge, and a tin that stands well."""
    made = scene(
        board=("sheet", block((0.3, 0.008, 0.4), (0.0, 0.0, 0.0))), tin=("tin", block((0.1, 0.1, 0.1), (1.0, 0.0, 0.0)))
    )
    joints = {body.name: body.joint.kind for body in made.tree.bodies if body.joint is not None}
    assert (joints["board"], joints["tin"]) == ("fixed", "floating")
    said = {note.entity: note.message for note in made.notes if note.code is NoteCode.UNSTABLE}
    assert list(said) == ["board"]
    assert "fixed where it was seen" in said["board"]
    assert np.abs(made.choices["board"].shift).max() < 1e-3


def test_what_finds_no_rest_gets_another_candidate_that_does() -> None:
    """A post whose first model stands on a pin, and whose second one on all of its bottom."""
    graph = corner(post=("post", block((0.1, 0.1, 0.4), (0.0, 0.0, 0.0))))
    models = []
    for foot in (0.004, 0.05):
        builder = ModelBuilder("post", f"post on a foot of {foot} m")
        part = builder.part()
        part.block((-foot, -foot, 0.0), (foot, foot, 0.02), OAK)
        part.block((-0.05, -0.05, 0.02), (0.05, 0.05, 0.4), OAK)
        models.append(builder.finish(f"post-{foot}"))
    offered = [CadCandidate(model, at(0.0, 0.0, 0.2), 1.0) for model in models]
    made = reconstruct(graph, known={"post": offered})
    assert made.choices["post"].rank == 1
    assert NoteCode.UNSTABLE not in {note.code for note in made.notes}
    only = reconstruct(graph, known={"post": offered[:1]})
    assert [note.entity for note in only.notes if note.code is NoteCode.UNSTABLE] == ["post"]


def test_the_floor_goes_on_under_what_stands_on_it() -> None:
    part = EntityMesh("floor", "floor", block((2.0, 2.0, 0.02), (0.0, 0.0, -0.02)))
    crate = EntityMesh("crate", "crate", block((0.5, 0.5, 0.4), (1.1, 0.0, 0.0)))
    graph = graph_of([part, crate])
    assert graph.parent("crate") == "floor"
    (slab,) = layout_slabs(graph, "floor")
    assert slab.mesh.bounds[1, 0] >= 1.35


def test_what_opens_keeps_a_model_though_it_has_no_place_for_what_is_inside() -> None:
    """Its own mesh would have no doors."""
    solid = table_model("table-solid", (0.84, 0.3, 0.9))
    graph = corner(case=("cabinet", shelf_mesh()), cup=("cup", block((0.08, 0.08, 0.1), (0.0, 0.0, 0.46))))
    made = reconstruct(graph, shortlist=lambda node, graph, models: [CadCandidate(solid, node.box.T_map_box, 1.0)]
                       if node.name == "case" else [])  # fmt: skip
    assert made.choices["case"].candidate.model is solid
    assert made.choices["cup"].own_mesh


def shelf_mesh() -> Mesh:
    boards = [block((0.02, 0.3, 0.9), (x, 0.0, 0.0)) for x in (-0.41, 0.41)]
    boards += [block((0.8, 0.3, 0.02), (0.0, 0.0, z)) for z in (0.0, 0.44, 0.88)]
    return Mesh(
        np.concatenate([board.vertices for board in boards]),
        np.concatenate([board.faces + 8 * k for k, board in enumerate(boards)]),
    )


def test_where_no_model_has_a_place_for_what_is_inside_the_own_mesh_has() -> None:
    """A bookcase whose only model is a solid block."""
    graph = corner(case=("table", shelf_mesh()), cup=("cup", block((0.08, 0.08, 0.1), (0.0, 0.0, 0.46))))
    assert graph.parent("cup") == "case"
    solid = table_model("table-solid", (0.84, 0.3, 0.9))
    made = reconstruct(graph, shortlist=lambda node, graph, models: [CadCandidate(solid, node.box.T_map_box, 1.0)]
                       if node.name == "case" else [])  # fmt: skip
    cup = made.choices["cup"].candidate.mesh().bounds
    assert NoteCode.INTERPENETRATING not in {note.code for note in made.notes}
    assert cup[0, 2] == pytest.approx(0.46, abs=5e-3) or cup[0, 2] == pytest.approx(0.02, abs=5e-3)


def test_an_own_mesh_reaches_down_to_its_support() -> None:
    """Of a table only the top and the upper half of the legs was seen."""
    table = table_mesh((1.0, 0.6, 0.7), (0.0, 0.0, 0.0))
    seen = Mesh(np.maximum(table.vertices, [-np.inf, -np.inf, 0.4]), table.faces)
    graph = corner(desk=("table", seen))
    candidate, _ = own_candidate(graph.nodes["desk"])
    assert is_own(candidate)
    low, high = candidate.mesh().bounds[:, 2]
    assert (low, high) == pytest.approx((0.0, 0.7), abs=2e-3)
    assert all(is_closed(convex) for convex in candidate.model.parts[0].convex)
    assert candidate.model.mass > 0.0


def _ball(radius: float, centre: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return mesh.vertices + centre, mesh.faces
