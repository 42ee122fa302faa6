"""Worlds of rooms: from a hundred rooms to a million along corridors, ten objects in each, made in seconds from a seed.

Pairs of room rows share a corridor, which is cut into pieces as wide as a room. Every room has a door to its piece of
corridor; some have one to the room beside or behind them. Doors are open or closed. Rooms come first in the numbering
of regions, row by row, then the pieces of corridor; object ``10 r + k`` is the k-th of room r, and after the objects
comes the structure of every region, one object each. The hundred rooms in the middle are the same in worlds of every
size, so that one can drive and see the same in a small world and in a large one.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cache

import numpy as np
import numpy.typing as npt

from simtrack.benchmarks import room_models as models
from simtrack.benchmarks.room_models import CORRIDOR, DEPTH, DOOR_HEIGHT, DOOR_WIDTH, HEIGHT, LAYOUTS, WIDTH
from simtrack.contracts import Bool, Float32, Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.raycast import TriangleMesh
from simtrack.raycast.paging import ObjectIndex, Regions

OBJECTS_PER_ROOM = 10
_OPEN_TO_CORRIDOR, _OPEN_BETWEEN = 0.8, 0.6
"""Shares of the doors that are open."""
_CONNECTED = 0.3
"""Share of neighbouring rooms with a door between them."""
_PITCH = 2 * DEPTH + CORRIDOR
"""From one corridor to the next, metres."""
_MIDDLE = 10
"""Rows and columns of the middle that worlds of one seed share."""
_CHUNK = 1 << 16
"""Rooms that are furnished at a time, which bounds the memory that building takes."""


@dataclass(frozen=True, eq=False)
class Rooms:
    """A world of rooms."""

    count: int
    """Rooms."""
    columns: int
    """Rooms in a row."""
    middle: int
    """The piece of corridor in the middle, where drives start: a region."""
    index: ObjectIndex
    """Objects and structure; ``index.regions`` are the rooms and the pieces of corridor."""
    meshes: tuple[TriangleMesh, ...]
    """Of the models: those of the objects, then those of the structure."""

    @property
    def objects(self) -> int:
        """Number of objects: ids below it are objects, the others structure."""
        return self.count * OBJECTS_PER_ROOM


def build(count: int, objects: Sequence[TriangleMesh], seed: int = 0) -> Rooms:
    """Draw a world.

    Args:
        count: rooms, an even number.
        objects: what stands around, up to 0.4 m high and 0.38 m wide under any heading.
        seed: of everything.

    Raises:
        InvalidValueError: an odd number of rooms, or no objects.
    """
    if count < 2 or count % 2:
        raise InvalidValueError("count", count, "an even number of rooms")
    if not objects:
        raise InvalidValueError("objects", 0, "at least one mesh")
    rows = max(n for n in range(2, int(np.sqrt(count)) + 2, 2) if count % n == 0)
    plan = _Plan.drawn(rows, count // rows, seed)
    regions = plan.regions()
    meshes = (*objects, *(mesh for _, mesh in _structures()))
    bounds = np.array([[mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)] for mesh in meshes])
    first, total = count * OBJECTS_PER_ROOM, count * OBJECTS_PER_ROOM + len(regions)
    kinds, region_of = np.empty(total, np.uint16), np.empty(total, np.int32)
    positions, quaternions = np.zeros((total, 3), np.float32), np.zeros((total, 4), np.float32)
    parts = [(rooms, [seed, 4, number]) for number, rooms in enumerate(_chunks(count))]
    for rooms, entropy in (*parts, (plan.middle_rooms, [seed, 5])):
        rows_of = (OBJECTS_PER_ROOM * rooms[:, None] + np.arange(OBJECTS_PER_ROOM)).ravel()
        contents = _furnished(plan.layouts.ravel()[rooms], bounds[: len(objects)], np.random.default_rng(entropy))
        kinds[rows_of], positions[rows_of], quaternions[rows_of] = contents
        region_of[rows_of] = np.repeat(rooms, OBJECTS_PER_ROOM)
    kinds[first:] = len(objects) + plan.structure()
    region_of[first:] = np.arange(len(regions))
    quaternions[first:, 0] = 1.0
    index = ObjectIndex(regions, bounds, kinds, region_of, positions, quaternions)
    return Rooms(count, plan.columns, plan.middle_piece, index, meshes)


def drive(world: Rooms, frames: int, step: float = 0.1) -> Float64:
    """(F, 4, 4) poses T_map_base of a drive through open doors from room to room, from the middle of the world on.

    Args:
        world: the rooms.
        frames: poses.
        step: metres from one to the next.
    """
    way = _tour(world, frames * step + 2.0)
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))

    def at(distance: npt.NDArray[np.floating]) -> Float64:
        return np.stack([np.interp(distance, lengths, way[:, axis]) for axis in range(2)], axis=1)

    travelled = step * np.arange(frames)
    positions, ahead = at(travelled), at(travelled + 0.5)
    yaw = np.arctan2(*(ahead - positions).T[::-1])
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = np.cos(yaw), -np.sin(yaw), np.sin(yaw), np.cos(yaw)
    poses[:, :2, 3] = positions
    return poses


def along_corridor(world: Rooms, frames: int, step: float = 0.1) -> Float64:
    """(F, 3) positions on the floor of a drive east along the corridor in the middle; it ends where the corridor does.

    Args:
        world: the rooms.
        frames: positions, less if the corridor ends before.
        step: metres from one to the next.
    """
    regions = world.index.regions
    start = 0.5 * (regions.low + regions.high)[world.middle] - (0.0, 0.0, 0.5 * HEIGHT)
    length = regions.high[:, 0].max() - 0.5 * WIDTH - start[0]
    out = np.tile(start, (min(frames, int(length / step) + 1), 1))
    out[:, 0] += step * np.arange(len(out))
    return out


# ------------------------------------------------------------------------------------------------------- the floor plan


@dataclass(frozen=True, eq=False)
class _Plan:
    """How rooms are furnished and which doors there are; ``opened`` counts only where there is a door."""

    layouts: npt.NDArray[np.uint8]
    """(rows, columns)."""
    beside: Bool
    """(rows, columns - 1), door to the room on the east."""
    behind: Bool
    """(rows / 2 - 1, columns), door between the second row of a pair and the first of the next."""
    opened_to_corridor: Bool
    """(rows, columns)."""
    opened_beside: Bool
    opened_behind: Bool

    @staticmethod
    def drawn(rows: int, columns: int, seed: int) -> "_Plan":
        """A plan whose middle, if it is as large, is the one that all plans of a seed share."""
        plan = _Plan._random(rows, columns, np.random.default_rng([seed, 2]))
        if min(rows, columns) >= _MIDDLE:
            shared = _Plan._random(_MIDDLE, _MIDDLE, np.random.default_rng([seed, 3]))
            row, column = plan._middle_corner
            for field in fields(_Plan):
                part = getattr(shared, field.name)
                first = row // 2 if field.name.endswith("behind") else row
                getattr(plan, field.name)[first:, column:][: part.shape[0], : part.shape[1]] = part
        return plan

    @staticmethod
    def _random(rows: int, columns: int, rng: np.random.Generator) -> "_Plan":
        rooms, beside, behind = (rows, columns), (rows, columns - 1), (rows // 2 - 1, columns)
        layouts = rng.integers(LAYOUTS, size=rooms, dtype=np.uint8)
        shares = (
            (beside, _CONNECTED),
            (behind, _CONNECTED),
            (rooms, _OPEN_TO_CORRIDOR),
            (beside, _OPEN_BETWEEN),
            (behind, _OPEN_BETWEEN),
        )
        return _Plan(layouts, *(rng.random(shape, np.float32) < share for shape, share in shares))

    @property
    def columns(self) -> int:
        """Rooms in a row."""
        return self.layouts.shape[1]

    @property
    def _middle_corner(self) -> tuple[int, int]:
        """First row, which starts a pair, and first column of the middle."""
        rows, columns = self.layouts.shape
        return 2 * ((rows // 2 - _MIDDLE // 2 + 1) // 2), columns // 2 - _MIDDLE // 2

    @property
    def middle_rooms(self) -> Int32:
        """(100,) rooms of the middle, row by row; none if the world is smaller."""
        if min(self.layouts.shape) < _MIDDLE:
            return np.empty(0, np.int32)
        (row, column), size = self._middle_corner, np.arange(_MIDDLE, dtype=np.int32)
        return ((row + size)[:, None] * self.columns + column + size).ravel()

    @property
    def middle_piece(self) -> int:
        """The piece of corridor, as a region, in the middle."""
        pair, column = len(self.layouts) // 4, self.columns // 2
        if len(self.middle_rooms):
            row, first = self._middle_corner
            pair, column = row // 2 + _MIDDLE // 4, first + _MIDDLE // 2
        return self.layouts.size + pair * self.columns + column

    def regions(self) -> Regions:
        """Rooms and pieces of corridor with the doors and joints between them."""
        rows, columns = self.layouts.shape
        x, pairs = WIDTH * np.arange(columns), _PITCH * np.arange(rows // 2)
        y = np.stack([pairs, pairs + DEPTH + CORRIDOR], axis=1).ravel()
        corner = np.concatenate([_grid(x, y, 0.0), _grid(x, pairs + DEPTH, 0.0)])
        size = np.full_like(corner, (WIDTH, DEPTH, HEIGHT))
        size[rows * columns :, 1] = CORRIDOR

        room = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
        piece = np.arange(rows // 2 * columns, dtype=np.int32).reshape(-1, columns) + rows * columns
        thresholds = np.stack([pairs + DEPTH, pairs + DEPTH + CORRIDOR], axis=1).ravel()
        in_row, in_column = (0.5 * DOOR_WIDTH, 0.0, 0.0), (0.0, 0.5 * DOOR_WIDTH, 0.0)
        upright, lintel, joint = (0.0, 0.0, 0.5 * DOOR_HEIGHT), 0.5 * DOOR_HEIGHT, (0.0, 0.5 * CORRIDOR, 0.0)
        groups = [
            _portals(room, np.repeat(piece, 2, axis=0), _grid(x + 0.5 * WIDTH, thresholds, lintel), (in_row, upright)),
            _portals(room[:, :-1], room[:, 1:], _grid(x[1:], y + 0.5 * DEPTH, lintel), (in_column, upright)),
            _portals(room[1:-1:2], room[2::2], _grid(x + 0.5 * WIDTH, y[2::2], lintel), (in_row, upright)),
            _portals(
                piece[:, :-1],
                piece[:, 1:],
                _grid(x[1:], pairs + DEPTH + 0.5 * CORRIDOR, 0.5 * HEIGHT),
                (joint, (0.0, 0.0, 0.5 * HEIGHT)),
            ),
        ]
        joints = np.ones(len(groups[-1][0]), bool)
        exists = np.concatenate([np.ones(room.size, bool), self.beside.ravel(), self.behind.ravel(), joints])
        doors = self.opened_to_corridor, self.opened_beside, self.opened_behind
        opened = np.concatenate([*(door.ravel() for door in doors), joints])
        sides, centres, axes = (np.concatenate(column)[exists] for column in zip(*groups, strict=True))
        return Regions(corner, corner + size, sides, centres, axes, opened[exists])

    def structure(self) -> npt.NDArray[np.uint16]:
        """(R,) the structure of every region, a row of `_structures`."""
        doors = np.zeros(self.layouts.shape, np.uint8)
        doors[0::2] |= models.NORTH
        doors[1::2] |= models.SOUTH
        doors[:, :-1] |= np.where(self.beside, models.EAST, 0).astype(np.uint8)
        doors[:, 1:] |= np.where(self.beside, models.WEST, 0).astype(np.uint8)
        doors[1:-1:2] |= np.where(self.behind, models.NORTH, 0).astype(np.uint8)
        doors[2::2] |= np.where(self.behind, models.SOUTH, 0).astype(np.uint8)
        ends = np.zeros((len(doors) // 2, self.columns), np.uint8)
        ends[:, 0] |= models.WEST
        ends[:, -1] |= models.EAST
        keys = [key for key, _ in _structures()]
        table = np.zeros((2, 16, LAYOUTS), np.uint16)
        for number, key in enumerate(keys):
            table[key] = number
        return np.concatenate([table[0, doors.ravel(), self.layouts.ravel()], table[1, ends.ravel(), 0]])


def _grid(x: npt.NDArray[np.floating], y: npt.NDArray[np.floating], z: float) -> Float64:
    """(len(y) * len(x), 3) points, row by row."""
    out = np.empty((len(y), len(x), 3))
    out[..., 0], out[..., 1], out[..., 2] = x, y[:, None], z
    return out.reshape(-1, 3)


def _portals(
    a: Int32, b: Int32, centres: Float64, axes: tuple[tuple[float, float, float], tuple[float, float, float]]
) -> tuple[Int32, Float64, Float32]:
    """Sides (K, 2), centres (K, 3) and half-axes (K, 2, 3) of portals between regions `a` and `b`."""
    half_axes = np.empty((a.size, 2, 3), np.float32)
    half_axes[:] = axes
    return np.stack([a.ravel(), b.ravel()], axis=1), centres, half_axes


# ------------------------------------------------------------------------------------------------------------ contents


@cache
def _structures() -> tuple[tuple[tuple[int, int, int], TriangleMesh], ...]:
    """All kinds of structure: ((0, doors, layout), room) and ((1, ends, 0), piece of corridor)."""
    with_corridor = [doors for doors in range(16) if doors & (models.SOUTH | models.NORTH)]
    rooms = [((0, d, layout), models.room(d, layout)) for d in with_corridor for layout in range(LAYOUTS)]
    ends = (0, models.WEST, models.EAST, models.WEST | models.EAST)
    pieces = [((1, e, 0), models.corridor(e)) for e in ends]
    return tuple((key, TriangleMesh(mesh.vertices, mesh.faces)) for key, mesh in (*rooms, *pieces))


def _chunks(count: int) -> Iterator[Int32]:
    """All rooms, a chunk at a time."""
    for start in range(0, count, _CHUNK):
        yield np.arange(start, min(start + _CHUNK, count), dtype=np.int32)


def _furnished(
    layouts: npt.NDArray[np.uint8], bounds: Float64, rng: np.random.Generator
) -> tuple[npt.NDArray[np.uint16], Float32, Float32]:
    """Objects on different spots of the furniture: kinds (K,), positions (K, 3) in the room, quaternions (K, 4)."""
    places = [models.spots(layout) for layout in range(LAYOUTS)]
    spots = np.stack([place[: min(map(len, places))] for place in places]).astype(np.float32)
    draws = rng.random((len(layouts), spots.shape[1]), np.float32)
    chosen = np.argpartition(draws, OBJECTS_PER_ROOM - 1, axis=1)[:, :OBJECTS_PER_ROOM]
    kinds = rng.integers(len(bounds), size=chosen.size, dtype=np.uint16)
    positions = spots[layouts[:, None], chosen].reshape(-1, 3)
    positions[:, :2] += rng.uniform(-0.01, 0.01, (len(positions), 2))
    positions[:, 2] += (1e-3 - bounds[:, 0, 2]).astype(np.float32)[kinds]
    half = np.pi * rng.random(len(kinds), np.float32)
    quaternions = np.zeros((len(kinds), 4), np.float32)
    quaternions[:, 0], quaternions[:, 3] = np.cos(half), np.sin(half)
    return kinds, positions, quaternions


# ------------------------------------------------------------------------------------------------------------- driving


def _tour(world: Rooms, length: float) -> Float64:
    """(K, 2) way from the middle of a corridor through one room after the other, at least `length` metres long."""
    regions = world.index.regions
    middle = 0.5 * (regions.low + regions.high)[:, :2]
    here = world.middle
    way, travelled, visited = [middle[here]], 0.0, {here}
    while travelled < length:
        path = _path_to_new_room(world, here, visited)
        if not path:
            if len(visited) == 1:
                raise InvalidValueError("world", "no open door in the middle", "a world with open doors")
            visited = {here}
            continue
        for portal, region in path:
            for point in (regions.centres[portal][:2], middle[region]):
                travelled += float(np.linalg.norm(point - way[-1]))
                way.append(point)
        here = path[-1][1]
        visited.add(here)
    return np.array(way)


def _path_to_new_room(world: Rooms, start: int, visited: set[int]) -> list[tuple[int, int]]:
    """Portals, and where they lead, of the shortest way to a room not in `visited`; empty if there is none."""
    regions = world.index.regions
    came: dict[int, tuple[int, int]] = {start: (-1, -1)}
    queue = deque([start])
    while queue:
        region = queue.popleft()
        if region < world.count and region not in visited:
            path = []
            while region != start:
                portal, before = came[region]
                path.append((portal, region))
                region = before
            return path[::-1]
        for portal in regions.portals_of(region).tolist():
            a, b = regions.sides[portal].tolist()
            there = b if a == region else a
            if regions.is_open[portal] and there not in came:
                came[there] = (portal, region)
                queue.append(there)
    return []
