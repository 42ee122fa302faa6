"""A furnished laboratory room around a workbench."""

from dataclasses import dataclass, replace

import numpy as np

from simtrack.contracts import Room
from simtrack.errors import InvalidValueError
from simtrack.simulation.building import fixtures, furniture
from simtrack.simulation.building.furniture import Furniture
from simtrack.simulation.building.parts import StaticPart, StaticWorld
from simtrack.simulation.building.shell import GLASS, Opening, room_shell

NORTH, EAST, SOUTH, WEST = np.pi / 2, 0.0, -np.pi / 2, np.pi
"""Headings, radians."""


@dataclass(frozen=True, slots=True)
class LabRoomConfig:
    """How the laboratory is built."""

    edge: float = 0.6
    """Longest triangle edge on walls, floor and ceiling, metres."""
    scatter: float = 1.0
    """0 puts the furniture exactly where the plan says; 1 moves it by up to 3 cm and 2 deg along each axis. Bench and
    shelf stay."""

    def __post_init__(self) -> None:
        if not 0.05 <= self.edge <= 10.0:
            raise InvalidValueError("LabRoomConfig.edge", self.edge, "0.05 to 10 metres")
        if not 0.0 <= self.scatter <= 1.0:
            raise InvalidValueError("LabRoomConfig.scatter", self.scatter, "0 to 1")


def lab_room(rng: np.random.Generator, config: LabRoomConfig | None = None) -> StaticWorld:
    """A laboratory of about 6 x 5 m with a piece of corridor behind its open door.

    The ``workbench`` (top 0.85 m high, 1.8 x 0.75 m) stands before the north wall and is used from the south; the
    ``shelf`` stands at the east wall. The map's origin is the south-west corner of the room. A robot of 0.54 m diameter
    can drive between the bench, the shelf, the ``desk`` in the south-west and the door.

    Args:
        rng: decides colours and where exactly the furniture stands.
        config: resolution and scatter.
    """
    config = LabRoomConfig() if config is None else config
    outline = np.array(
        [[0.0, 0.0], [6.2, 0.0], [6.2, 3.75], [5.85, 3.75], [5.85, 5.1], [0.45, 5.1], [0.45, 4.3], [0, 4.3]]
    )
    lab = Room("lab", outline, 0.0, 2.9)
    corridor = Room("corridor", np.array([[2.4, -1.95], [6.9, -1.95], [6.9, -0.12], [2.4, -0.12]]), 0.0, 2.6)
    door = (4.35, 5.35)
    windows = [Opening(0.5, 1.75, 0.9, 2.3, 0.16, GLASS), Opening(2.2, 3.3, 0.9, 2.3, 0.16, GLASS)]
    lab_openings = {
        0: [Opening(*door, 0.0, 2.08, 0.06, None)],
        7: windows,
        4: [Opening(0.5, 1.2, 0.95, 1.75, 0.12, (206, 202, 190))],
    }
    corridor_openings = {2: [Opening(6.9 - door[1], 6.9 - door[0], 0.0, 2.08, 0.06, None)]}
    shell = room_shell(lab, lab_openings, ((224, 220, 208), (124, 128, 130)))
    shell += room_shell(corridor, corridor_openings, ((208, 214, 218), (98, 110, 118)))
    parts = [piece.part(config.edge) for piece in shell]
    return StaticWorld(tuple(parts + _furnish(rng, config)), (lab, corridor))


def _furnish(rng: np.random.Generator, config: LabRoomConfig) -> list[StaticPart]:
    finishes = [furniture.FINISHES[k] for k in rng.permutation(len(furniture.FINISHES))]
    fabric = furniture.FABRICS[int(rng.integers(len(furniture.FABRICS)))]
    shelf = replace(furniture.shelf(color=finishes[0]), survey="as-is")
    fixed: list[tuple[str, Furniture, float, float, float]] = [
        ("workbench", furniture.workbench(), 2.6, 4.6, SOUTH),
        ("shelf", shelf, 5.96, 1.6, WEST),
        ("column", fixtures.column(0.3, 0.38, 2.9), 6.05, 2.95, WEST),
        ("radiator", fixtures.radiator(1.1), 0.0, 3.15, EAST),
        ("whiteboard", fixtures.whiteboard(), 3.0, 0.0, NORTH),
        ("door_frame", fixtures.door_frame(1.0, 2.08), 4.85, 0.0, NORTH),
        ("door_frame_outside", fixtures.door_frame(1.0, 2.08), 4.85, -0.12, SOUTH),
        ("door", fixtures.door_leaf(0.98), *fixtures.hinged(0.98, (5.33, 0.03), np.radians(rng.uniform(68, 84)))),
        ("carton1", fixtures.carton(0.32, 0.4, 0.24), 5.58, 4.3, WEST + 0.2),
        ("carton2", fixtures.carton(0.24, 0.33, 0.12), 1.45, 0.42, 0.4),
    ]
    scattered: list[tuple[str, Furniture, float, float, float]] = [
        ("cupboard", furniture.cupboard(0.42, 0.95, 1.95, finishes[1]), 5.56, 4.42, WEST),
        ("desk", furniture.desk(0.8, 1.6, 0.73, finishes[2]), 0.55, 1.5, EAST),
        ("table", furniture.table(0.7, 1.3, 0.74, finishes[3]), 2.9, 0.5, NORTH),
        ("cabinet", furniture.filing_cabinet(), 1.45, 0.42, NORTH),
        ("bin1", furniture.bin_box(0.4, 0.6, 0.22, furniture.BLUE), 1.1, 4.7, SOUTH),
        ("bin2", furniture.bin_box(0.4, 0.3, 0.28, furniture.RED), 3.95, 4.72, SOUTH),
        ("bin3", furniture.bin_box(0.3, 0.4, 0.17, furniture.GREEN), 4.5, 4.65, SOUTH),
        ("chair1", furniture.office_chair(color=fabric), 1.3, 1.55, WEST + 0.35),
        ("chair2", furniture.chair(color=fabric), 3.1, 1.12, SOUTH - 0.2),
        ("stool", fixtures.stool(), 4.3, 3.85, 0.3),
        ("cart", fixtures.cart(), 0.5, 3.5, EAST),
        ("plant", fixtures.plant(rng=rng), 5.85, 0.38, 0.0),
        ("trash_bin", fixtures.trash_bin(), 0.35, 2.55, 0.0),
    ]
    tops = {"carton1": 1.95, "carton2": furniture.filing_cabinet().extents[2]}
    parts = [piece.placed(name, x, y, yaw, room="lab", z=tops.get(name, 0.0)) for name, piece, x, y, yaw in fixed]
    for name, piece, x, y, yaw in scattered:
        dx, dy, turn = config.scatter * rng.uniform(-1.0, 1.0, 3) * (0.03, 0.03, np.radians(2.0))
        parts.append(piece.placed(name, x + dx, y + dy, yaw + turn, room="lab"))
    return parts
