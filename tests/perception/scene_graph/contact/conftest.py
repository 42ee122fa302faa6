"""The furnished room of `small_rooms.py`, built once."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

import small_rooms

from simtrack.perception.scene_graph.contact import ContactGraph, EntityNode, build_contact_graph, entity_nodes


@pytest.fixture(scope="session")
def room() -> small_rooms.Room:
    return small_rooms.furnished_room()


@pytest.fixture(scope="session")
def nodes(room: small_rooms.Room) -> list[EntityNode]:
    found, findings = entity_nodes(room.entities, np.random.default_rng(0))
    assert findings == []
    return found


@pytest.fixture(scope="session")
def graph(nodes: list[EntityNode]) -> ContactGraph:
    return build_contact_graph(nodes)
