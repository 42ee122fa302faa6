"""Floor layouts: a rectangle cut recursively into corridors and rooms of irregular sizes, all joined by open doors."""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.simulation.building.parts import polygon_area

SIDES = ("west", "east", "south", "north")

PARTITION = 0.12
"""Thickness of inner walls, metres; the outline of the floor lies half of it outside of the outermost clear space."""
MIN_ROOM = 2.7
"""Least clear side of a room, metres, before walls are taken off."""
DOOR_MARGIN = 0.35
"""Least distance between a door and the corner of a room, metres."""


@dataclass(frozen=True, slots=True)
class Cell:
    """A rectangle between the middles of its walls."""

    x0: float
    y0: float
    x1: float
    y1: float
    access: frozenset[str] = frozenset()
    """Sides along which a corridor runs."""

    @property
    def size(self) -> tuple[float, float]:
        """Metres along x and y."""
        return self.x1 - self.x0, self.y1 - self.y0

    @property
    def area(self) -> float:
        """Square metres."""
        return self.size[0] * self.size[1]

    def cut(self, axis: int, at: float, gap: float = 0.0) -> tuple["Cell", "Cell"]:
        """The parts below and above `at` metres along an axis (0: x, 1: y), `gap` apart, with that corridor between."""
        low_side, high_side = (SIDES[2 * axis], SIDES[2 * axis + 1])
        fresh = frozenset({high_side} if gap else ())
        low_access = (self.access - {high_side}) | fresh
        high_access = (self.access - {low_side}) | frozenset({low_side} if gap else ())
        if axis == 0:
            return (
                Cell(self.x0, self.y0, at - gap / 2, self.y1, low_access),
                Cell(at + gap / 2, self.y0, self.x1, self.y1, high_access),
            )
        return (
            Cell(self.x0, self.y0, self.x1, at - gap / 2, low_access),
            Cell(self.x0, at + gap / 2, self.x1, self.y1, high_access),
        )


@dataclass(frozen=True, slots=True)
class Door:
    """An open passage through a wall between two spaces."""

    axis: int
    """0: the wall runs along y at x = line; 1: along x at y = line."""
    line: float
    """Metres, the middle of the wall."""
    start: float
    """Metres along the wall, map coordinate."""
    end: float
    spaces: tuple[int, int]
    """Indices of the two spaces; for a junction first the corridor that ends there."""

    @property
    def middle(self) -> Float64:
        """(2,), map x and y of the passage's middle."""
        along = (self.start + self.end) / 2
        return np.array([self.line, along] if self.axis == 0 else [along, self.line])


@dataclass(frozen=True, slots=True)
class Layout:
    """Rooms, corridors and the passages between them. Spaces are numbered: corridors first, then rooms."""

    corridors: tuple[Cell, ...]
    rooms: tuple[Cell, ...]
    doors: tuple[Door, ...]
    """With a leaf, narrower than their wall."""
    junctions: tuple[Door, ...]
    """Where corridors open into each other over their whole width."""

    @property
    def spaces(self) -> tuple[Cell, ...]:
        """All cells in the order of their numbers."""
        return self.corridors + self.rooms

    def clear(self, index: int) -> Float64:
        """(4, 2) clear outline of a space, counter-clockwise from its lower left corner.

        A corridor reaches through the wall of the one that it opens into.
        """
        cell, half = self.spaces[index], PARTITION / 2
        low, high = np.array([cell.x0, cell.y0]) + half, np.array([cell.x1, cell.y1]) - half
        for junction in self.junctions:
            if junction.spaces[0] == index and junction.line > low[junction.axis] + half:
                high[junction.axis] = junction.line + half
            elif junction.spaces[0] == index:
                low[junction.axis] = junction.line - half
        return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])

    def area(self) -> float:
        """Clear floor of all spaces, square metres."""
        return sum(polygon_area(self.clear(k)) for k in range(len(self.spaces)))


def draw_layout(rng: np.random.Generator, width: float, depth: float) -> Layout:
    """Lay out a floor of `width` (x) by `depth` (y) metres with its lower left corner at the origin."""
    corridors: list[Cell] = []
    rooms: list[Cell] = []
    inner: list[tuple[Cell, Cell]] = []
    _divide(rng, Cell(0.0, 0.0, width, depth), corridors, rooms, inner)
    spaces = corridors + rooms
    doors = []
    for k, room in enumerate(rooms):
        doors += _doors_to_corridors(rng, room, len(corridors) + k, corridors)
    for a, b in inner:
        doors += _connect(rng, spaces, spaces.index(a), spaces.index(b))
    doors += _shortcuts(rng, spaces, len(corridors), doors)
    junctions = [j for k in range(len(corridors)) for j in _junctions(corridors, k)]
    return Layout(tuple(corridors), tuple(rooms), tuple(doors), tuple(junctions))


def _divide(
    rng: np.random.Generator,
    cell: Cell,
    corridors: list[Cell],
    rooms: list[Cell],
    inner: list[tuple[Cell, Cell]],
) -> None:
    """Cut a cell by a corridor that opens into one that exists, until blocks of rooms are left."""
    if cell.area < rng.uniform(130.0, 330.0) or min(cell.size) < 11.0:
        rooms.extend(_rooms(rng, cell, inner))
        return
    axis = 0 if cell.size[0] * rng.uniform(0.75, 1.33) > cell.size[1] else 1
    reachable = {SIDES[2 * (1 - axis)], SIDES[2 * (1 - axis) + 1]} & cell.access
    if corridors and not reachable:
        axis = 1 - axis
    gap = rng.uniform(1.9, 2.8)
    low = (cell.x0, cell.y0)[axis]
    at = low + cell.size[axis] * rng.uniform(0.36, 0.64)
    first, second = cell.cut(axis, at, gap)
    if axis == 0:
        corridors.append(Cell(at - gap / 2, cell.y0, at + gap / 2, cell.y1))
    else:
        corridors.append(Cell(cell.x0, at - gap / 2, cell.x1, at + gap / 2))
    for child in (first, second):
        _divide(rng, child, corridors, rooms, inner)


def _rooms(rng: np.random.Generator, cell: Cell, inner: list[tuple[Cell, Cell]]) -> list[Cell]:
    """Cut a block into rooms, each beside a corridor or, now and then, behind another room."""
    longest = max(cell.size)
    if cell.area < rng.choice([11.0, 18.0, 26.0, 45.0, 80.0]) * rng.uniform(0.8, 1.4) or longest < 2 * MIN_ROOM + 0.4:
        return [cell]
    axis = 0 if cell.size[0] >= cell.size[1] else 1
    for candidate in (axis, 1 - axis):
        size = cell.size[candidate]
        if size < 2 * MIN_ROOM + 0.4:
            continue
        low = (cell.x0, cell.y0)[candidate]
        at = low + float(np.clip(size * rng.uniform(0.3, 0.7), MIN_ROOM, size - MIN_ROOM))
        first, second = cell.cut(candidate, at)
        if first.access and second.access:
            return _rooms(rng, first, inner) + _rooms(rng, second, inner)
        if candidate == axis and min(first.area, second.area) > 9.0 and cell.area < 110.0 and rng.random() < 0.5:
            inner.append((first, second))
            return [first, second]
    return [cell]


def _width(rng: np.random.Generator) -> float:
    return float(rng.uniform(0.98, 1.25))


def _doors_to_corridors(rng: np.random.Generator, room: Cell, index: int, corridors: list[Cell]) -> list[Door]:
    sides = [side for side in SIDES if side in room.access]
    count = min(len(sides), 2 if room.area > 40.0 else 1)
    doors = []
    for side in rng.permutation(np.array(sides, dtype=object))[:count]:
        axis = SIDES.index(side) // 2
        line = _edges(room, axis)[SIDES.index(side) % 2]
        low, high = _extent(room, axis)
        doors.append(_door(rng, axis, line, (low, high), index, _beside(corridors, axis, line, (low + high) / 2)))
    return doors


def _beside(corridors: list[Cell], axis: int, line: float, along: float) -> int:
    """The corridor that has `line` as its edge at `along`; a side with access always has one."""
    return next(
        k
        for k, corridor in enumerate(corridors)
        for edge in _edges(corridor, axis)
        if abs(line - edge) < 1e-6 and _extent(corridor, axis)[0] < along < _extent(corridor, axis)[1]
    )


def _edges(cell: Cell, axis: int) -> tuple[float, float]:
    """Where the two sides lie that are normal to an axis."""
    return (cell.x0, cell.x1) if axis == 0 else (cell.y0, cell.y1)


def _extent(cell: Cell, axis: int) -> tuple[float, float]:
    """From where to where those two sides run."""
    return _edges(cell, 1 - axis)


def _door(rng: np.random.Generator, axis: int, line: float, span: tuple[float, float], index: int, other: int) -> Door:
    width, margin = _width(rng), DOOR_MARGIN + PARTITION / 2
    start = rng.uniform(span[0] + margin, span[1] - margin - width)
    return Door(axis, line, float(start), float(start) + width, (index, other))


def _connect(rng: np.random.Generator, spaces: list[Cell], a: int, b: int) -> list[Door]:
    """A door in the wall that two cells share, if it is wide enough."""
    p, q = spaces[a], spaces[b]
    for axis in (0, 1):
        spans = np.array([_extent(p, axis), _extent(q, axis)])
        low, high = float(spans[:, 0].max()), float(spans[:, 1].min())
        common = [line for line in _edges(p, axis) if min(abs(line - edge) for edge in _edges(q, axis)) < 1e-6]
        if common and high - low > 2.3:
            return [_door(rng, axis, common[0], (low, high), a, b)]
    return []


def _shortcuts(rng: np.random.Generator, spaces: list[Cell], first: int, doors: list[Door]) -> list[Door]:
    """Some doors between neighbouring rooms, so that the floor has loops."""
    joined = {frozenset(door.spaces) for door in doors}
    out = []
    for a in range(first, len(spaces)):
        for b in range(a + 1, len(spaces)):
            if frozenset((a, b)) not in joined and rng.random() < 0.12:
                out += _connect(rng, spaces, a, b)
    return out


def _junctions(corridors: list[Cell], index: int) -> list[Door]:
    """Passages from the ends of one corridor into the corridors that its ends touch."""
    corridor, half = corridors[index], PARTITION / 2
    axis = 0 if corridor.size[0] > corridor.size[1] else 1
    low, high = _extent(corridor, axis)
    return [
        Door(axis, line, low + half, high - half, (index, k))
        for line in _edges(corridor, axis)
        for k, other in enumerate(corridors)
        if k != index
        and min(abs(line - edge) for edge in _edges(other, axis)) < 1e-6
        and _extent(other, axis)[0] - 1e-6 <= low
        and high <= _extent(other, axis)[1] + 1e-6
    ]
