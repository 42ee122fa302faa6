"""What is before the sides of an entity, and which way models are turned by it."""

from dataclasses import replace

import numpy as np
import pytest
from corner import block
from test_matching import graph_of
from test_shortlist import ALONE, turned_apart

from simtrack.geometry.meshes import Mesh
from simtrack.objects.cad import cad_model, cad_models
from simtrack.perception.reconstruction.clearances import SIDES, furniture_clearances, wall_clearances
from simtrack.perception.reconstruction.shortlist import shortlist
from simtrack.perception.scene_graph.contact import ContactGraph, EntityMesh, build_contact_graph, entity_nodes

NORTH = 1
"""Of `SIDES`, as long as the box is not turned."""


def kitchen(**things: tuple[str, Mesh]) -> ContactGraph:
    """Things before a wall in the north (y = 0), on a floor."""
    layout = {
        "floor": ("floor", block((6.0, 6.0, 0.1), (0.0, -3.0, -0.1))),
        "wall": ("wall", block((6.0, 0.1, 2.5), (0.0, 0.05, 0.0))),
    }
    named = [EntityMesh(name, kind, mesh) for name, (kind, mesh) in (layout | things).items()]
    nodes, findings = entity_nodes(named, np.random.default_rng(0))
    return build_contact_graph(nodes, findings=findings)


def directions(graph: ContactGraph, name: str) -> list[str]:
    """The sides of a box by compass, as `SIDES` are sorted."""
    R = graph.nodes[name].box.T_map_box[:2, :2]
    compass = {(1, 0): "east", (0, 1): "north", (-1, 0): "west", (0, -1): "south"}
    return [compass[round(float(x)), round(float(y))] for x, y in SIDES @ R.T]


def test_walls_and_furniture_before_the_sides_are_measured() -> None:
    graph = kitchen(
        fridge=("fridge", block((0.7, 0.6, 1.5), (0.0, -0.4, 0.0))),
        cabinet=("cabinet", block((0.6, 0.6, 0.9), (0.85, -0.4, 0.0))),
        cup=("cup", block((0.1, 0.1, 0.1), (-0.5, -0.4, 0.0))),
    )
    node = graph.nodes["fridge"]
    ways = directions(graph, "fridge")
    walls = dict(zip(ways, wall_clearances(node.box, graph), strict=True))
    assert walls["north"] == pytest.approx(0.1, abs=0.01)
    assert all(np.isinf(walls[way]) for way in ("east", "south", "west"))
    furniture = dict(zip(ways, furniture_clearances(node, graph), strict=True))
    assert furniture["east"] == pytest.approx(0.2, abs=0.01)
    assert all(np.isinf(furniture[way]) for way in ("north", "south", "west")), "a cup blocks nothing"


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_plain_fridge_has_its_rear_at_the_wall(side: float) -> None:
    """Its box is nearly square, and nothing of it tells where its front is but where it stands."""
    graph = kitchen(fridge=("fridge", block((0.66, 0.7, 1.5), (side, -0.4, 0.0))))
    best = shortlist(graph.nodes["fridge"], graph, cad_models("fridge"), replace(ALONE, upright=40))[0]
    front = -best.T_map_model[:3, 1]
    assert front[1] < -0.9


def test_a_plain_fridge_opens_where_no_cabinet_is() -> None:
    """No wall tells; a cabinet stands close by in the east, another one in the south."""
    wide, near = block((0.6, 0.9, 0.9), (0.75, -2.5, 0.0)), block((0.9, 0.6, 0.9), (0.0, -3.25, 0.0))
    fridge = block((0.66, 0.66, 1.5), (0.0, -2.5, 0.0))
    graph = kitchen(fridge=("fridge", fridge), cabinet1=("cabinet", wide), cabinet2=("cabinet", near))
    best = shortlist(graph.nodes["fridge"], graph, cad_models("fridge"), replace(ALONE, upright=40))[0]
    front = -best.T_map_model[:3, 1]
    assert max(front[0], -front[1]) < 0.1


@pytest.mark.parametrize("yaw", [0.2, 0.9, 1.6, 2.3, 3.0])
def test_a_handle_is_found_wherever_it_points(yaw: float) -> None:
    """The smallest box of a mug is turned as its handle and rim fill it best, and its planes are strips of its side."""
    model = cad_model("cup-mug")
    graph = graph_of(model, 1.1, yaw)
    best = shortlist(graph.nodes["thing"], graph, [model], ALONE)[0]
    assert turned_apart(model, best.T_map_model, yaw) < np.radians(3.0)
