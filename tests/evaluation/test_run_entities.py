"""From the folder of a run to entities: the map's pieces, tracked objects with their models, what moved left out."""

from pathlib import Path

import numpy as np
import pytest

from simtrack.contracts import Belief, Localization, MapEntity, StaticMap, Status, Track, TrackStatus
from simtrack.errors import FileFormatError
from simtrack.evaluation.run_entities import tracked_entities
from simtrack.evaluation.run_folder import EstimateTables, RunFolder
from simtrack.geometry.meshes import box_mesh, concatenate, transformed
from simtrack.geometry.transforms import transform
from simtrack.objects import load_object
from simtrack.perception.mapping.static_entities import entity_meshes, face_owners
from simtrack.perception.reconstruction.known_objects import known_candidates
from simtrack.perception.scene_graph import SceneGraph
from simtrack.perception.scene_graph.contact import FindingCode, build_contact_graph, entity_nodes

BENCH_AT, CARTON_AT, FLOOR_AT = (transform(None, (0.0, 0.0, z)) for z in (0.4, 0.9, -0.01))
BENCH, CARTON, FLOOR = box_mesh((1.4, 0.8, 0.8)), box_mesh((0.2, 0.2, 0.2)), box_mesh((4.0, 4.0, 0.02))
RELAY = load_object("relay")


def surveyed() -> StaticMap:
    """A floor that reaches under a bench with a carton on it."""
    pieces = [("floor", FLOOR, FLOOR_AT), ("bench", BENCH, BENCH_AT), ("carton", CARTON, CARTON_AT)]
    whole = concatenate([transformed(mesh, T) for _, mesh, T in pieces])
    entities = tuple(MapEntity(name, name, T, mesh.extents) for name, mesh, T in pieces)
    return StaticMap(whole.vertices.astype(np.float32), whole.faces, entities)


def track(number: int, x: float, z: float, *, moving: bool = False) -> Track:
    T = transform(None, (x, 0.1, z))
    return Track(number, "relay", TrackStatus.CONFIRMED, 100, T, np.eye(6), T, np.zeros(6), 100, 1.0, moving, 0.0, 1.0)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Two relays: one rests on the bench, one moves in the air."""
    folder, survey = RunFolder(tmp_path / "run"), surveyed()
    folder.write_map(survey)
    tracks = (track(1, 0.4, 0.8 + RELAY.extents[2] / 2), track(2, -0.4, 1.2, moving=True))
    graph = SceneGraph(survey, {"relay": RELAY})
    relations = graph.update(100, tracks)
    folder.write_graph(graph.to_json())
    at = Localization(100, np.eye(4), np.eye(6), Status.OK)
    with EstimateTables(folder.path) as tables:
        tables.add(Belief(50, at, np.eye(4), (track(1, 0.4, 1.0, moving=True),), None, None, frozenset()))
        tables.add(Belief(100, at, np.eye(4), tracks, None, None, relations))
    return folder.path


def test_each_piece_of_the_map_belongs_to_the_smallest_box_around_it() -> None:
    survey = surveyed()
    owners = face_owners(survey)
    assert [np.count_nonzero(owners == k) for k in range(3)] == [12, 12, 12]
    meshes = entity_meshes(survey)
    for name, mesh in (("floor", FLOOR), ("bench", BENCH), ("carton", CARTON)):
        np.testing.assert_allclose(meshes[name].bounds, mesh.bounds, atol=1e-6)


def test_entities_are_what_was_believed_at_the_end(run: Path) -> None:
    found = tracked_entities(run)
    assert [(e.name, e.semantic_class) for e in found.entities] == [
        ("floor", "floor"), ("bench", "bench"), ("carton", "carton"), ("relay-1", "relay"),
    ]  # fmt: skip
    assert [(f.code, f.entity) for f in found.findings] == [(FindingCode.IN_MOTION, "relay-2")]
    assert set(found.models) == {"relay-1"}
    nodes, _ = entity_nodes(found.entities, np.random.default_rng(0))
    graph = build_contact_graph(nodes)
    assert {name: graph.parent(name) for name in graph.nodes} == {
        "floor": "", "bench": "floor", "carton": "bench", "relay-1": "bench",
    }  # fmt: skip


def test_a_tracked_object_is_its_own_only_candidate(run: Path) -> None:
    found = tracked_entities(run)
    nodes = {node.name: node for node in entity_nodes(found.entities, np.random.default_rng(0))[0]}
    candidates = known_candidates(nodes, {**found.models, "gone": RELAY})
    assert set(candidates) == {"relay-1"}
    (candidate,) = candidates["relay-1"]
    np.testing.assert_array_equal(candidate.T_map_model, nodes["relay-1"].T_map_entity)
    assert candidate.model.mass == RELAY.mass
    assert candidate.scale == 1.0
    np.testing.assert_allclose(candidate.mesh().bounds, transformed(RELAY.visual, candidate.T_map_model).bounds)
    assert max(s.height for s in candidate.supports()) == pytest.approx(0.8 + RELAY.extents[2], abs=0.005)


def test_an_object_without_a_model_is_its_box(run: Path) -> None:
    graph = (run / "graph.json").read_text()
    (run / "graph.json").write_text(graph.replace('"class_name": "relay"', '"class_name": "gadget"'))
    found = tracked_entities(run)
    assert (FindingCode.MODEL_MISSING, "relay-1") in [(f.code, f.entity) for f in found.findings]
    np.testing.assert_allclose(found.entities[-1].mesh.extents, RELAY.extents, atol=1e-6)
    assert found.models == {}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("map.npz", None, r"map\.npz.*no such file"),
        ("map.npz", b"PK nonsense", r"map\.npz.*no map of a run"),
        ("graph.json", b"{}", r"graph\.json"),
        ("tracks.csv", b"a,b\n1,2\n", r"tracks\.csv.*no table of tracks"),
    ],
)
def test_broken_files_are_told(run: Path, name: str, content: bytes | None, message: str) -> None:
    (run / name).unlink()
    if content is not None:
        (run / name).write_bytes(content)
    with pytest.raises(FileFormatError, match=message):
        tracked_entities(run)


def test_a_map_of_another_run_is_told(run: Path) -> None:
    other = StaticMap(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32), (
        MapEntity("sofa", "sofa", np.eye(4), np.ones(3)),
    ))  # fmt: skip
    folder = RunFolder(run.parent / "other")
    folder.write_map(other)
    (folder.path / "map.npz").replace(run / "map.npz")
    with pytest.raises(FileFormatError, match=r"'sofa' is no static entity"):
        tracked_entities(run)


def test_an_empty_map_has_no_owners() -> None:
    empty = StaticMap(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    assert len(face_owners(empty)) == 0
    assert entity_meshes(empty) == {}
