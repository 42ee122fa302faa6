"""Furnishing a room from a seed: what stands where, before physics has settled it."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from simtrack.contracts import Float64, Room
from simtrack.geometry.transforms import transform, transform_planar
from simtrack.objects.cad.model import CadModel, CadSupport
from simtrack.simulation.building.parts import StaticPart
from simtrack.simulation.building.placement import FloorSpace
from simtrack.simulation.building.rooms.families import FAMILIES
from simtrack.simulation.building.shell import GLASS, Opening, room_shell

RoomKind: TypeAlias = Literal["bedroom", "living", "study", "kitchen"]
KINDS: tuple[RoomKind, ...] = ("bedroom", "living", "study", "kitchen")
CLEARANCE = 0.0008
"""Metres that a thing is put down above its support."""
MARGIN = 0.025
"""Metres between things on one support."""
AT_WALL: dict[RoomKind, tuple[str, ...]] = {
    "bedroom": ("bed", "cabinet", "cabinet", "table"),
    "living": ("sofa", "cabinet", "cabinet", "table"),
    "study": ("table", "cabinet", "cabinet", "fridge"),
    "kitchen": ("counter", "counter", "fridge", "cabinet"),
}
IN_THE_OPEN: dict[RoomKind, tuple[str, ...]] = {
    "bedroom": ("chair", "bag", "plant"),
    "living": ("table", "chair", "chair", "plant", "bag"),
    "study": ("table", "chair", "chair", "bag", "plant"),
    "kitchen": ("table", "chair", "chair", "chair", "plant"),
}
ON_TOP: dict[RoomKind, tuple[str, ...]] = {
    "bedroom": ("monitor", "book", "book", "cup", "box", "plant", "bottle", "bag"),
    "living": ("monitor", "book", "bowl", "cup", "bottle", "plant", "box", "book"),
    "study": ("monitor", "keyboard", "monitor", "book", "book", "cup", "bottle", "box"),
    "kitchen": ("microwave", "bowl", "bowl", "cup", "cup", "bottle", "bottle", "box", "plant"),
}
INSIDE = ("cup", "bowl", "bottle", "book", "box")


@dataclass(frozen=True, slots=True, eq=False)
class PlacedModel:
    """A thing of the room."""

    name: str
    """Unique in the room, e.g. ``chair2``."""
    model: CadModel
    T_map_model: Float64
    """(4, 4)."""
    positions: dict[str, float]
    """Joint name -> position."""


@dataclass(frozen=True, slots=True, eq=False)
class RoomPlan:
    """A furnished room before it has settled."""

    seed: int
    kind: RoomKind
    room: Room
    shell: tuple[StaticPart, ...]
    placed: tuple[PlacedModel, ...]


@dataclass(slots=True, eq=False)
class _Face:
    """A support in the map and what stands on it already."""

    T_map_face: Float64
    size: Float64
    clearance: float
    inside: bool
    taken: list[tuple[Float64, float]]
    """(2,) centre on the face and radius."""


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
    maker = _Furnisher(rng, room, (door + 0.45, 0.9))
    maker.furnish(kind)
    return RoomPlan(seed, kind, room, tuple(piece.part(0.5) for piece in shell), tuple(maker.placed))


class _Furnisher:
    """Puts things into one room."""

    def __init__(self, rng: np.random.Generator, room: Room, door: tuple[float, float]) -> None:
        self.rng = rng
        self.space = FloorSpace(room, [(np.array([door[0], 0.0]), np.array([0.0, 1.0]), door[1])])
        self.placed: list[PlacedModel] = []
        self.faces: list[_Face] = []
        self.counts: dict[str, int] = {}

    def furnish(self, kind: RoomKind) -> None:
        """Furniture first, then what stands on and in it."""
        for name in AT_WALL[kind]:
            self.on_floor(name, at_wall=True)
        for name in IN_THE_OPEN[kind]:
            self.on_floor(name, at_wall=False)
        for name in ON_TOP[kind]:
            self.on_support(name, inside=False)
        for name in self.rng.permutation(INSIDE)[: int(self.rng.integers(2, 5))].tolist():
            self.on_support(name, inside=True)

    def make(self, family: str) -> tuple[str, CadModel]:
        """A new thing of a family and its name in the room."""
        builder = FAMILIES[family](self.rng)
        kind = builder.semantic_class
        number = self.counts[kind] = self.counts.get(kind, 0) + 1
        return f"{kind}{number}", builder.finish(f"{kind}{number}")

    def on_floor(self, family: str, *, at_wall: bool) -> None:
        """Try to put a thing on the free floor."""
        name, model = self.make(family)
        # What opens needs room before it; the front of a model is -y, a heading is that of the front.
        footprint = _Footprint(model.extents[[1, 0, 2]])
        found = (
            self.space.put_at_wall(footprint, self.rng, attempts=40)
            if at_wall
            else self.space.put_anywhere(footprint, self.rng, attempts=40)
        )
        if found is not None:
            x, y, heading = found
            self.add(name, model, x, y, heading + np.pi / 2, 0.0)

    def on_support(self, family: str, *, inside: bool) -> None:
        """Try to put a thing on (or into) what stands already."""
        name, model = self.make(family)
        radius = float(np.linalg.norm(model.extents[:2])) / 2
        fits = [
            face
            for face in self.faces
            if face.inside == inside
            and face.clearance > model.extents[2] + 0.02
            and float(face.size.min()) > 2.0 * (min(radius, float(model.extents[:2].max()) / 2 + 0.01))
        ]
        for k in self.rng.permutation(len(fits)).tolist():
            face = fits[k]
            turn = float(self.rng.normal(0.0, 0.12))
            reach = np.abs([[np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ model.extents[:2] / 2
            free = face.size / 2 - reach - 0.012
            if (free <= 0.0).any():
                continue
            for _ in range(12):
                at = self.rng.uniform(-free, free)
                if all(np.linalg.norm(at - centre) > radius + other + MARGIN for centre, other in face.taken):
                    face.taken.append((at, radius))
                    T = face.T_map_face @ transform_planar(float(at[0]), float(at[1]), turn)
                    heading = float(np.arctan2(T[1, 0], T[0, 0]))
                    self.add(name, model, float(T[0, 3]), float(T[1, 3]), heading, float(T[2, 3]))
                    return

    def add(self, name: str, model: CadModel, x: float, y: float, yaw: float, z: float) -> None:
        """Put a thing down and offer its own faces."""
        T_map_floor = transform_planar(x, y, yaw)
        T_map_floor[2, 3] = z + CLEARANCE
        T = T_map_floor @ transform(None, np.array([0.0, 0.0, model.extents[2] / 2]))
        positions = self._opened(model, T) if z == 0.0 else {}
        self.placed.append(PlacedModel(name, model, T, positions))
        poses = model.part_poses(positions)
        for support in model.supports:
            if model.mass < 3.0 and model.semantic_class not in ("book", "box"):
                continue
            self.faces.append(_Face(T @ poses[support.part] @ transform(None, support.centre), support.size,
                                    support.clearance, _enclosed(model, support), []))  # fmt: skip

    def _opened(self, model: CadModel, T_map_model: Float64) -> dict[str, float]:
        """Some joints at rest where they are partly open, if the floor before the thing is free for it."""
        draws = self.rng.random((2, len(model.joints)))
        positions = {
            joint.name: float((0.2 + 0.55 * share) * joint.upper)
            for joint, chance, share in zip(model.joints, *draws, strict=True)
            if chance < 0.35 and joint.kind != "continuous"
        }
        if not positions:
            return {}
        low, high = model.mesh(positions).bounds
        front = -model.extents[1] / 2 - low[1] + 0.05
        T = T_map_model @ transform(None, np.array([(low[0] + high[0]) / 2, low[1] - 0.05 + front / 2, 0.0]))
        heading = float(np.arctan2(T[1, 0], T[0, 0])) - np.pi / 2
        strip = _Footprint(np.array([front, high[0] - low[0], 1.0]))
        return positions if self.space.put(strip, float(T[0, 3]), float(T[1, 3]), heading, gap=0.0) else {}


@dataclass(frozen=True, slots=True)
class _Footprint:
    """What the floor plan needs to know of a piece."""

    extents: Float64


def _enclosed(model: CadModel, support: CadSupport) -> bool:
    """Whether a face is the floor of a hollow."""
    return any(
        hollow.part == support.part
        and abs(hollow.centre[2] - hollow.extents[2] / 2 - support.centre[2]) < 1e-6
        and np.abs(hollow.centre[:2] - support.centre[:2]).max() < 1e-6
        for hollow in model.hollows
    )
