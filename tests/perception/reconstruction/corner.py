"""A small furnished corner: floor, wall, table, cupboard with door and drawer, cups; and models of such things."""

from collections.abc import Sequence

import numpy as np

from simtrack.geometry.meshes import Mesh, box_mesh, concatenate, transformed
from simtrack.geometry.transforms import transform, transform_planar
from simtrack.objects.cad.builder import ModelBuilder
from simtrack.objects.cad.materials import OAK, STEEL
from simtrack.objects.cad.model import CadModel
from simtrack.perception.scene_graph.contact import ContactGraph, EntityMesh, build_contact_graph, entity_nodes


def block(size: Sequence[float], at: Sequence[float], yaw: float = 0.0) -> Mesh:
    """A box of a size that stands at (x, y, z of its bottom)."""
    T = transform_planar(at[0], at[1], yaw)
    T[2, 3] = at[2] + size[2] / 2
    return transformed(box_mesh(size), T)


def table_mesh(size: Sequence[float], at: Sequence[float]) -> Mesh:
    """A plate on four legs."""
    x, y, h = size
    legs = [block((0.05, 0.05, h - 0.03), (at[0] + a * (x / 2 - 0.05), at[1] + b * (y / 2 - 0.05), at[2]))
            for a in (-1, 1) for b in (-1, 1)]  # fmt: skip
    return concatenate([block((x, y, 0.03), (at[0], at[1], at[2] + h - 0.03)), *legs])


def table_model(name: str, size: Sequence[float]) -> CadModel:
    """The same as a model that can be stood on."""
    builder = ModelBuilder("table", "plate on legs")
    part = builder.part()
    x, y, h = size
    part.block((-x / 2, -y / 2, h - 0.03), (x / 2, y / 2, h), OAK)
    for a in (-1, 1):
        for b in (-1, 1):
            px, py = a * (x / 2 - 0.05), b * (y / 2 - 0.05)
            part.block((px - 0.025, py - 0.025, 0.0), (px + 0.025, py + 0.025, h - 0.03), OAK)
    builder.support(part, (0.0, 0.0, h), (x, y))
    return builder.finish(name)


def cupboard_model(name: str = "cabinet-test") -> CadModel:
    """A carcass with a door and, above it, a drawer."""
    builder = ModelBuilder("cabinet", "door below, drawer above")
    body = builder.part()
    for low, high in (((-0.3, -0.2, 0.0), (-0.28, 0.2, 0.8)), ((0.28, -0.2, 0.0), (0.3, 0.2, 0.8)),
                      ((-0.28, 0.18, 0.0), (0.28, 0.2, 0.8)), ((-0.3, -0.2, 0.8), (0.3, 0.2, 0.82)),
                      ((-0.28, -0.2, 0.0), (0.28, 0.18, 0.02)), ((-0.28, -0.2, 0.55), (0.28, 0.18, 0.57))):  # fmt: skip
        body.block(low, high, OAK)
    door = builder.part("door")
    door.block((-0.29, -0.222, 0.01), (0.29, -0.202, 0.55), OAK)
    builder.joint("revolute", door, (-0.29, -0.212, 0.0), (0.0, 0.0, -1.0), (0.0, 1.6), 0.2)
    drawer = builder.part("drawer")
    drawer.block((-0.27, -0.2, 0.58), (0.27, 0.1, 0.6), STEEL)
    drawer.block((-0.29, -0.222, 0.58), (0.29, -0.202, 0.79), OAK)
    builder.joint("prismatic", drawer, (0.0, 0.0, 0.6), (0.0, -1.0, 0.0), (0.0, 0.25), 1.0)
    builder.support(body, (0.0, 0.0, 0.82), (0.6, 0.4))
    builder.hollow(body, (-0.28, -0.2, 0.02), (0.28, 0.18, 0.55))
    return builder.finish(name)


def graph_of(entities: Sequence[EntityMesh]) -> ContactGraph:
    """The contact graph of entities."""
    nodes, findings = entity_nodes(entities, np.random.default_rng(0))
    return build_contact_graph(nodes, findings=findings)


FLOOR = EntityMesh("floor", "floor", block((6.0, 6.0, 0.02), (0.0, 0.0, -0.02)))
"""6 x 6 m at height 0."""
WALL = EntityMesh("wall", "wall", block((6.0, 0.02, 2.4), (0.0, 2.01, 0.0)))
"""In the plane y = 2, seen from smaller y."""


def corner(**things: tuple[str, Mesh]) -> ContactGraph:
    """The graph of the floor, the wall and more entities, given as name -> (class, mesh)."""
    return graph_of([FLOOR, WALL, *(EntityMesh(name, kind, mesh) for name, (kind, mesh) in things.items())])


def at(x: float, y: float, z: float, yaw: float = 0.0) -> np.ndarray:
    """(4, 4) pose of a model whose box's centre is at (x, y, z)."""
    return transform(None, (0.0, 0.0, z)) @ transform_planar(x, y, yaw)
