"""A room from a seed: its kind, its shell, and what stands, hangs and leans where, before physics has settled it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from simtrack.contracts import Room
from simtrack.simulation.building.parts import StaticPart
from simtrack.simulation.building.rooms.fittings import Cleat
from simtrack.simulation.building.rooms.furnisher import Furnisher, PlacedModel
from simtrack.simulation.building.shell import GLASS, Opening, room_shell

RoomKind: TypeAlias = Literal["bedroom", "living", "study", "kitchen", "open-kitchen", "split-table", "hidden-chair"]
KINDS: tuple[RoomKind, ...] = ("bedroom", "living", "study", "kitchen")
"""Those that are drawn from a seed."""
ALL_KINDS: tuple[RoomKind, ...] = (*KINDS, "open-kitchen", "split-table", "hidden-chair")
"""Those that can be asked for; in an ``open-kitchen`` the floor before fridge and microwave is kept clear,
and nothing lies or leans about on it that no survey would show. The last two are what mapping fails at (reconstruction
paper, section 5.5): a table that the chair before it cuts in two for a camera, and a chair of which it sees little."""
PAIRED: dict[RoomKind, tuple[str, str]] = {"split-table": ("table", "chair"), "hidden-chair": ("chair", "table")}
"""What stands against a wall, and what stands close before it, turned to it."""
SERVED: dict[RoomKind, tuple[tuple[str, str | None], ...]] = {
    "open-kitchen": (("fridge", None), ("counter", "microwave"))
}
"""What stands against walls with clear floor before it, and what stands on it, all of it closed."""
AT_WALL: dict[RoomKind, tuple[str, ...]] = {
    "bedroom": ("bed", "cabinet", "cabinet", "table", "board"),
    "living": ("sofa", "cabinet", "cabinet", "table", "board"),
    "study": ("table", "cabinet", "cabinet", "fridge", "board"),
    "kitchen": ("counter", "counter", "fridge", "cabinet", "board"),
    "open-kitchen": ("counter", "cabinet"),
    "split-table": ("cabinet", "sofa"),
    "hidden-chair": ("counter", "fridge"),
}
IN_THE_OPEN: dict[RoomKind, tuple[str, ...]] = {
    "bedroom": ("chair", "bag", "plant", "box"),
    "living": ("table", "chair", "chair", "plant", "bag"),
    "study": ("table", "chair", "chair", "bag", "plant", "box"),
    "kitchen": ("table", "chair", "chair", "chair", "plant", "bag"),
    "open-kitchen": ("table", "chair", "chair"),
    "split-table": ("plant", "bag"),
    "hidden-chair": ("plant",),
}
ON_WALLS: dict[RoomKind, tuple[str, ...]] = {
    "bedroom": ("shelf", "picture", "picture"),
    "living": ("picture", "shelf", "picture"),
    "study": ("shelf", "picture", "wall cabinet"),
    "kitchen": ("wall cabinet", "wall cabinet", "picture"),
    "open-kitchen": ("wall cabinet", "picture"),
    "split-table": ("picture", "shelf"),
    "hidden-chair": ("picture",),
}
ON_TOP: dict[RoomKind, tuple[str, ...]] = {
    "bedroom": ("monitor", "book", "book", "cup", "cup", "box", "plant", "bottle", "bag", "bowl", "keyboard"),
    "living": ("monitor", "book", "bowl", "cup", "bottle", "plant", "box", "book", "cup", "bowl", "bottle"),
    "study": ("monitor", "keyboard", "monitor", "book", "book", "cup", "bottle", "box", "plant", "keyboard"),
    "kitchen": ("microwave", "bowl", "bowl", "cup", "cup", "bottle", "bottle", "box", "plant", "cup", "book"),
    "open-kitchen": ("bowl", "bowl", "cup", "cup", "bottle", "bottle", "box", "plant", "cup", "book"),
    "split-table": ("monitor", "keyboard", "book", "cup", "bottle"),
    "hidden-chair": ("microwave", "bowl", "cup", "bottle", "box"),
}
INSIDE = ("cup", "bowl", "bottle", "book", "cup")


@dataclass(frozen=True, slots=True, eq=False)
class RoomPlan:
    """A furnished room before it has settled."""

    seed: int
    kind: RoomKind
    room: Room
    shell: tuple[StaticPart, ...]
    placed: tuple[PlacedModel, ...]
    cleats: tuple[Cleat, ...]
    """What things hang on; parts of the walls."""


def kind_of(config: Mapping[str, Any]) -> RoomKind | None:
    """The kind that the configuration of a scene's room names; None if it is drawn from the seed."""
    return next((kind for kind in ALL_KINDS if kind == config.get("kind")), None)


def plan_room(seed: int, kind: RoomKind | None = None) -> RoomPlan:
    """The room of a seed: its kind (drawn if None), shell, furniture against the walls and in the open, small things.

    The same seed gives the same room.
    """
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x526F6F6D]))
    drawn = KINDS[int(rng.integers(len(KINDS)))]
    kind = drawn if kind is None else kind
    width, depth = rng.uniform(4.0, 5.2), rng.uniform(3.4, 4.4)
    room = Room("room", np.array([[0.0, 0.0], [width, 0.0], [width, depth], [0.0, depth]]), 0.0, 2.5)
    door = float(rng.uniform(0.4, width - 1.5))
    openings = {
        0: [Opening(door, door + 0.9, 0.0, 2.05, 0.05, (196, 176, 150))],
        2: [Opening(0.3 * width, 0.3 * width + 1.2, 0.95, 2.1, 0.1, GLASS)],
    }
    paint = rng.integers(190, 240, 3).tolist(), rng.integers(90, 170, 3).tolist()
    shell = room_shell(
        room, openings, ((paint[0][0], paint[0][1], paint[0][2]), (paint[1][0], paint[1][1], paint[1][2]))
    )
    maker = Furnisher(rng, room, openings)
    _furnish(maker, kind)
    return RoomPlan(
        seed, kind, room, tuple(piece.part(0.5) for piece in shell), tuple(maker.placed), tuple(maker.cleats)
    )


def _furnish(maker: Furnisher, kind: RoomKind) -> None:
    """Furniture first, then what hangs, then what stands on, leans on and lies in all that."""
    for name, on_top in SERVED.get(kind, ()):
        maker.served(name, on_top)
    if kind in PAIRED:
        maker.paired(*PAIRED[kind])
    for name in AT_WALL[kind]:
        if name == "board":
            maker.against_wall(name)
        else:
            maker.on_floor(name, at_wall=True)
    for name in IN_THE_OPEN[kind]:
        maker.on_floor(name, at_wall=False)
    for name in ON_WALLS[kind]:
        maker.on_wall(name)
    maker.leaning_books()
    maker.bridging_book()
    for name in ON_TOP[kind]:
        maker.on_support(name, inside=False)
    for name in maker.rng.permutation(INSIDE)[: int(maker.rng.integers(3, 6))].tolist():
        maker.on_support(name, inside=True)
