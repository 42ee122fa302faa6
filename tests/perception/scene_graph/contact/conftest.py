"""The furnished room of `scenes.py`, built once."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

import scenes
from simtrack.perception.scene_graph.contact import ContactGraph, EntityNode, build_contact_graph, entity_nodes


@pytest.fixture(scope="session")
def room() -> scenes.Room:
    return scenes.furnished_room()


@pytest.fixture(scope="session")
def nodes(room: scenes.Room) -> list[EntityNode]:
    found, findings = entity_nodes(room.entities, np.random.default_rng(0))
    assert findings == []
    return found


@pytest.fixture(scope="session")
def graph(nodes: list[EntityNode]) -> ContactGraph:
    return build_contact_graph(nodes)
