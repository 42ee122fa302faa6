"""What stands in a room of an office floor: kinds of rooms, and furniture with sizes that never repeat exactly."""

from collections.abc import Callable

import numpy as np

from simtrack.simulation.building import fixtures, furniture
from simtrack.simulation.building.furniture import FABRICS, FINISHES, Color, Furniture
from simtrack.simulation.building.parts import StaticPart
from simtrack.simulation.building.placement import FloorSpace


class Furnisher:
    """Furnishes one room: draws pieces, places them, numbers them."""

    def __init__(self, space: FloorSpace, rng: np.random.Generator) -> None:
        self.space, self.rng, self.room = space, rng, space.room
        self.finish = _pick(FINISHES, rng)
        self.fabric = _pick(FABRICS, rng)
        self.parts: list[StaticPart] = []
        self.counts: dict[str, int] = {}

    def add(self, piece: Furniture, pose: tuple[float, float, float] | None, z: float = 0.0) -> bool:
        """Make a part of a piece that found a place; says whether it did."""
        if pose is None:
            return False
        kind = piece.semantic_class
        self.counts[kind] = self.counts.get(kind, 0) + 1
        name = f"{self.room.name}/{kind}{self.counts[kind]}"
        self.parts.append(piece.placed(name, *pose, room=self.room.name, z=z + self.room.floor))
        return True

    def wall(self, piece: Furniture, gap: float = 0.04) -> bool:
        """Place a piece with its rear to a wall."""
        return self.add(piece, self.space.put_at_wall(piece, self.rng, gap=gap))

    def open(self, piece: Furniture, *, square: bool = True) -> bool:
        """Place a piece anywhere on the floor."""
        return self.add(piece, self.space.put_anywhere(piece, self.rng, square=square))

    def seats(self, at: StaticPart, seat: Callable[[], Furniture], sides: tuple[float, ...]) -> None:
        """Put seats along the sides of a table, `sides` being headings in its frame; some are pulled out or missing."""
        x, y = at.T_map_part[:2, 3]
        heading = float(np.arctan2(at.T_map_part[1, 0], at.T_map_part[0, 0]))
        for side in sides:
            lengthwise = abs(np.cos(side)) > 0.5
            reach, run = at.extents[:2] / 2 if lengthwise else at.extents[1::-1] / 2
            places = max(1, int(2 * run / 0.75))
            for k in range(places):
                if self.rng.random() < 0.12:
                    continue
                offset = (k + 0.5) / places * 2 * run - run + self.rng.normal(0.0, 0.05)
                distance = reach + self.rng.uniform(0.16, 0.42)
                piece = seat()
                angle = heading + side
                px = x + distance * np.cos(angle) - offset * np.sin(angle)
                py = y + distance * np.sin(angle) + offset * np.cos(angle)
                yaw = angle + np.pi + self.rng.normal(0.0, 0.25)
                if self.space.put(piece, px, py, yaw, gap=0.0):
                    self.add(piece, (px, py, yaw))

    def clutter(self, count: int) -> None:
        """Cartons on the floor and on top of what stands in the room."""
        for _ in range(count):
            rng = self.rng
            piece = fixtures.carton(*rng.uniform((0.15, 0.15, 0.1), (0.45, 0.4, 0.4)))
            tops = [p for p in self.parts if p.semantic_class in ("cupboard", "cabinet", "shelf", "table", "desk")]
            if tops and rng.random() < 0.6:
                top = tops[int(rng.integers(len(tops)))]
                face, size = top.supports[-1]
                room = np.maximum(size - np.linalg.norm(piece.extents[:2]), 0.0) / 2
                T = top.T_map_part @ face
                at = T[:3, :3] @ np.array([*rng.uniform(-room, room), 0.0]) + T[:3, 3]
                self.add(piece, (at[0], at[1], rng.uniform(-np.pi, np.pi)), at[2] - self.room.floor)
            else:
                self.wall(piece)

    # ------------------------------------------------------------------------------------------ kinds of rooms

    def office(self, area: float) -> None:
        """Desks with chairs, shelves, cabinets."""
        rng = self.rng
        for _ in range(max(1, round(area / rng.uniform(7.5, 12.0)))):
            desk = furniture.desk(rng.uniform(0.7, 0.9), rng.uniform(1.2, 1.9), rng.uniform(0.7, 0.78), self.finish)
            if (self.open if rng.random() < 0.4 else self.wall)(desk):
                at = self.parts[-1]
                self.seats(at, lambda: furniture.office_chair(rng.uniform(0.46, 0.54), color=self.fabric), (0.0,))
        for _ in range(1 + int(area / 16)):
            self.wall(self._shelf())
        self._storage_furniture(1 + int(area / 22))
        if rng.random() < 0.5:
            self.wall(fixtures.whiteboard(rng.uniform(1.0, 2.0), rng.uniform(0.8, 1.2)), gap=0.0)
        self._decoration()
        self.clutter(int(rng.integers(0, 3)))

    def meeting(self, area: float) -> None:
        """A large table with chairs all around."""
        rng, low, high = self.rng, self.room.polygon.min(axis=0), self.room.polygon.max(axis=0)
        size = high - low
        along = 0 if size[0] >= size[1] else 1
        width = float(np.clip(size[along] - rng.uniform(2.6, 3.4), 1.2, 5.0))
        depth = float(np.clip(size[1 - along] - rng.uniform(2.6, 3.2), 0.8, 1.6))
        table = furniture.table(depth, width, rng.uniform(0.71, 0.76), self.finish)
        x, y = (low + high) / 2 + rng.normal(0.0, 0.15, 2)
        yaw = (np.pi / 2 if along == 0 else 0.0) + rng.normal(0.0, 0.03)
        if self.space.put(table, x, y, yaw):
            self.add(table, (x, y, yaw))
        elif not self.open(table):
            return self.office(area)
        at = self.parts[-1]
        seat, back = rng.uniform(0.44, 0.48), rng.uniform(0.82, 0.98)
        self.seats(at, lambda: furniture.chair(rng.uniform(0.43, 0.5), seat, back, self.fabric), (0.0, np.pi))
        if rng.random() < 0.5:
            self.seats(at, lambda: furniture.chair(0.46, seat, back, self.fabric), (np.pi / 2,))
        self.wall(fixtures.whiteboard(rng.uniform(1.4, 2.6), rng.uniform(0.9, 1.2)), gap=0.0)
        self._storage_furniture(1)
        self._decoration()
        return None

    def laboratory(self, area: float) -> None:
        """Workbenches, shelves, bins, stools, a cart."""
        rng = self.rng
        for _ in range(max(1, round(area / 12.0))):
            bench = furniture.workbench(
                rng.uniform(0.7, 0.9), rng.uniform(1.5, 2.4), rng.uniform(0.8, 0.95), self.finish
            )
            if (self.open if rng.random() < 0.25 else self.wall)(bench) and rng.random() < 0.7:
                self.seats(
                    self.parts[-1], lambda: fixtures.stool(rng.uniform(0.32, 0.4), rng.uniform(0.5, 0.7)), (0.0,)
                )
        for _ in range(1 + int(area / 14)):
            self.wall(self._shelf())
        self._storage_furniture(1 + int(area / 20))
        for _ in range(int(rng.integers(2, 6))):
            self.wall(self._bin())
        for _ in range(int(rng.integers(0, 3))):
            self.open(
                fixtures.cart(rng.uniform(0.45, 0.6), rng.uniform(0.7, 1.0), rng.uniform(0.8, 0.95)), square=False
            )
        self.clutter(int(rng.integers(1, 5)))

    def lounge(self, area: float) -> None:
        """Sofas, round tables, a kitchen counter, plants."""
        rng = self.rng
        self.wall(furniture.counter(0.6, rng.uniform(1.6, 3.4), rng.uniform(0.88, 0.94)), gap=0.002)
        for _ in range(max(1, round(area / 18.0))):
            self.wall(furniture.sofa(rng.uniform(0.8, 0.95), rng.uniform(1.3, 2.3), self.fabric))
        for _ in range(max(1, round(area / 11.0))):
            if self.open(furniture.round_table(rng.uniform(0.7, 1.1), rng.uniform(0.7, 0.76))):
                chair = furniture.chair(rng.uniform(0.42, 0.48), color=self.fabric)
                self.seats(self.parts[-1], lambda chair=chair: chair, (0.3, 1.9, 3.5, 5.0))
        for _ in range(2 + int(area / 25)):
            self._decoration()

    def storage(self, area: float) -> None:
        """Rows of shelves, bins, cartons."""
        rng = self.rng
        for _ in range(2 + int(area / 4.5)):
            (self.wall if rng.random() < 0.75 else self.open)(self._shelf())
        for _ in range(int(rng.integers(1, 5))):
            self.wall(self._bin())
        self.open(fixtures.cart(rng.uniform(0.45, 0.6), rng.uniform(0.7, 1.0)), square=False)
        self.clutter(int(rng.integers(2, 7)))

    def corridor(self, length: float) -> None:
        """What may stand in a corridor."""
        rng = self.rng
        for _ in range(int(length / 6.0)):
            draw = rng.random()
            if draw < 0.3:
                self.wall(
                    furniture.cupboard(
                        rng.uniform(0.32, 0.4), rng.uniform(0.7, 1.3), rng.uniform(0.9, 2.0), self.finish
                    )
                )
            elif draw < 0.6:
                self.wall(
                    fixtures.whiteboard(rng.uniform(0.8, 1.8), rng.uniform(0.6, 1.1), rng.uniform(0.9, 1.2)), gap=0.0
                )
            elif draw < 0.8:
                self.wall(fixtures.plant(rng.uniform(0.3, 0.45), rng.uniform(0.9, 1.6), rng=rng))
            else:
                self.wall(fixtures.column(rng.uniform(0.1, 0.25), rng.uniform(0.3, 0.5), self.room.height), gap=0.0)
        self.wall(fixtures.trash_bin(rng.uniform(0.26, 0.34), rng.uniform(0.3, 0.5)))

    # -------------------------------------------------------------------------------------------- their pieces

    def _shelf(self) -> Furniture:
        rng = self.rng
        size = rng.uniform((0.28, 0.7, 1.1), (0.48, 1.5, 2.2))
        return furniture.shelf(*size, boards=int(rng.integers(3, 7)), color=_pick(FINISHES, rng))

    def _bin(self) -> Furniture:
        rng = self.rng
        return furniture.bin_box(*rng.uniform((0.3, 0.25, 0.15), (0.6, 0.45, 0.4)), color=_pick(FABRICS, rng))

    def _storage_furniture(self, count: int) -> None:
        rng = self.rng
        for _ in range(count):
            if rng.random() < 0.5:
                self.wall(
                    furniture.cupboard(*rng.uniform((0.38, 0.8, 1.6), (0.5, 1.3, 2.1)), color=_pick(FINISHES, rng))
                )
            else:
                self.wall(furniture.filing_cabinet(*rng.uniform((0.5, 0.4, 0.6), (0.65, 0.5, 1.4))))

    def _decoration(self) -> None:
        rng = self.rng
        if rng.random() < 0.6:
            self.wall(fixtures.plant(rng.uniform(0.3, 0.5), rng.uniform(0.8, 1.7), rng=rng))
        self.wall(fixtures.trash_bin(rng.uniform(0.26, 0.34), rng.uniform(0.3, 0.45)))


def room_kind(area: float, rng: np.random.Generator) -> str:
    """What a room of that many square metres is used as."""
    if area < 13.0:
        return str(rng.choice(["office", "storage", "storage", "meeting"], p=[0.45, 0.25, 0.1, 0.2]))
    if area < 30.0:
        return str(
            rng.choice(["office", "meeting", "laboratory", "storage", "lounge"], p=[0.5, 0.17, 0.18, 0.07, 0.08])
        )
    return str(rng.choice(["office", "meeting", "laboratory", "lounge"], p=[0.4, 0.15, 0.3, 0.15]))


def _pick(colors: tuple[Color, ...], rng: np.random.Generator) -> Color:
    return colors[int(rng.integers(len(colors)))]
