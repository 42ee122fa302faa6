"""Tracked objects and mapped entities in one contact graph, while the objects move."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import pytest

from simtrack.contracts import Float64, Track, TrackStatus
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.meshes import Mesh, box_mesh
from simtrack.geometry.transforms import transform, transform_planar
from simtrack.perception.scene_graph import SceneGraph
from simtrack.perception.scene_graph.contact import (
    ContactGraph,
    EntityMesh,
    TrackedContacts,
    build_contact_graph,
    entity_node,
    entity_nodes,
    entity_shape,
)


@dataclass(frozen=True)
class Model:
    """A block."""

    extents: Float64
    semantic_class: str = "thing"
    mesh: Mesh = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mesh", box_mesh(self.extents))


MODELS = {"tray": Model(np.array([0.4, 0.3, 0.04])), "block": Model(np.array([0.06, 0.06, 0.06]))}
TABLE = EntityMesh("table", "table", box_mesh((1.2, 0.8, 0.7)), transform(None, (0.0, 0.0, 0.35)))
FLOOR = EntityMesh("floor", "floor", box_mesh((4.0, 4.0, 0.1)), transform(None, (0.0, 0.0, -0.05)))
CUP = EntityMesh("cup", "cup", box_mesh((0.08, 0.08, 0.1)), transform(None, (0.1, 0.0, 0.79)))
TRAY_AT, BLOCK_AT = transform(None, (0.0, 0.0, 0.72)), transform(None, (-0.1, 0.0, 0.77))


def track(number: int, model: str, T: Float64, *, stamp: int, seen: bool = True) -> Track:
    status = TrackStatus.CONFIRMED if seen else TrackStatus.OCCLUDED
    last_seen = stamp if seen else 0
    return Track(number, model, status, stamp, T, np.eye(6), T, np.zeros(6), last_seen, 1.0, False, 0.0, 1.0)


class Scene:
    """A live scene graph, and the contact graph that follows it."""

    def __init__(self) -> None:
        self.live = SceneGraph(None, MODELS)
        self.contacts = TrackedContacts(MODELS, np.random.default_rng(0))
        for node in entity_nodes([FLOOR, TABLE, CUP], np.random.default_rng(0))[0]:
            self.contacts.put(node)
        self.stamp = 0

    def see(self, *tracks: tuple[int, str, Float64], unseen: Iterable[int] = ()) -> frozenset[str]:
        self.stamp += 100_000_000
        hidden = set(unseen)
        self.live.update(self.stamp, [track(*t, stamp=self.stamp, seen=t[0] not in hidden) for t in tracks])
        return self.contacts.update(self.live)

    def tree(self) -> dict[str, str]:
        graph = self.contacts.graph()
        return {name: graph.parent(name) for name in graph.nodes}


@pytest.fixture
def scene() -> Scene:
    scene = Scene()
    scene.see((1, "tray", TRAY_AT), (2, "block", BLOCK_AT))
    return scene


ON_THE_TABLE = {"floor": "", "table": "floor", "cup": "tray-1", "tray-1": "table", "block-2": "tray-1"}


def test_objects_and_entities_stand_in_one_tree(scene: Scene) -> None:
    assert scene.tree() == ON_THE_TABLE


def test_what_moves_takes_along_what_nobody_tracks_and_what_is_hidden(scene: Scene) -> None:
    motion = transform_planar(0.2, 0.1, 0.4)
    moved = scene.see((1, "tray", motion @ TRAY_AT), (2, "block", BLOCK_AT), unseen=[2])
    assert moved == {"tray-1", "block-2", "cup"}
    assert scene.tree() == ON_THE_TABLE
    nodes = scene.contacts.graph().nodes
    np.testing.assert_allclose(nodes["cup"].T_map_entity, motion @ CUP.T_map_entity, atol=1e-9)
    np.testing.assert_allclose(nodes["block-2"].T_map_entity, motion @ BLOCK_AT, atol=1e-9)


def test_an_object_that_is_seen_elsewhere_is_not_carried(scene: Scene) -> None:
    beside = transform(None, (-0.45, 0.3, 0.73))
    scene.see((1, "tray", transform_planar(0.1, 0.0, 0.0) @ TRAY_AT), (2, "block", beside))
    assert scene.tree() == ON_THE_TABLE | {"block-2": "table"}
    np.testing.assert_array_equal(scene.contacts.graph().nodes["block-2"].T_map_entity, beside)


def test_jitter_leaves_the_graph_alone(scene: Scene) -> None:
    before = scene.contacts.graph()
    jitter = transform(None, (0.0003, -0.0002, 0.0004))
    assert scene.see((1, "tray", jitter @ TRAY_AT), (2, "block", jitter @ BLOCK_AT)) == frozenset()
    assert scene.contacts.graph() is before


def test_what_is_gone_leaves_and_its_load_stays(scene: Scene) -> None:
    scene.see((2, "block", BLOCK_AT))
    assert "tray-1" not in scene.tree()
    np.testing.assert_array_equal(scene.contacts.graph().nodes["cup"].T_map_entity, CUP.T_map_entity)


def test_a_graph_that_followed_equals_one_that_is_built_anew(scene: Scene) -> None:
    scene.see((1, "tray", transform_planar(0.2, -0.1, 0.3) @ TRAY_AT), (2, "block", BLOCK_AT), unseen=[2])
    scene.see((1, "tray", transform_planar(-0.1, 0.1, 1.0) @ TRAY_AT), (2, "block", transform(None, (0.5, 0.3, 0.73))))
    followed = scene.contacts.graph()
    rebuilt = build_contact_graph(
        followed.nodes[name].moved(followed.nodes[name].T_map_entity) for name in followed.nodes
    )
    assert _facts(followed) == _facts(rebuilt)


def _facts(graph: ContactGraph) -> tuple[object, ...]:
    return dict(graph.supports), graph.others, graph.proximal, graph.findings


def test_names_and_models_are_checked(scene: Scene) -> None:
    shape = entity_shape(TABLE.mesh, np.random.default_rng(0))
    with pytest.raises(InvalidValueError, match="no tracked object"):
        scene.contacts.put(entity_node("tray-1", "table", shape))
    scene.contacts.put(entity_node("block-3", "table", shape))
    with pytest.raises(InvalidValueError, match="no other entity"):
        scene.see((1, "tray", TRAY_AT), (3, "block", BLOCK_AT))
    with pytest.raises(UnknownNameError, match="tray"):
        TrackedContacts({"tray": MODELS["tray"]}, np.random.default_rng(0)).update(scene.live)
