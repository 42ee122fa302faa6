"""The shell of a building: walls with doors, windows and niches, floors and ceilings, as conforming sheets.

Rooms are rectilinear polygons of clear space. A wall shows one face to each of its rooms, so that every visible surface
exists exactly once; the reveals of a door reach half-way through the wall from either side.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from simtrack.contracts import Bool, Float64, Room
from simtrack.geometry.meshes import Mesh, concatenate, painted, transformed
from simtrack.geometry.transforms import inverse, transform
from simtrack.simulation.building.parts import Box, StaticPart, room_at

Color: TypeAlias = tuple[int, int, int]
Box2: TypeAlias = tuple[float, float]

GLASS: Color = (148, 178, 196)
FRAME: Color = (226, 226, 222)
CEILING: Color = (238, 238, 234)
SLAB = 0.1
"""Thickness of the floor's collision boxes, metres."""
SEGMENT = 6.0
"""Longest stretch of wall or floor in one part, metres."""


@dataclass(frozen=True, slots=True)
class Opening:
    """A rectangular hole in a wall."""

    start: float
    """Metres along the wall from its first corner."""
    end: float
    bottom: float
    """Metres above the floor; 0 for a door."""
    top: float
    depth: float
    """How far it reaches into the wall, metres; 0 where two spaces simply open into each other."""
    back: Color | None
    """Colour of its rear face (glass, panel), or None for a passage."""


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """A planar rectilinear surface on a grid of breaks: conforming triangles at any resolution."""

    T_map_sheet: Float64
    """(4, 4); the surface lies in x, y and faces z."""
    x: Float64
    """(K,) ascending breaks, metres."""
    y: Float64
    """(L,) ascending breaks, metres."""
    filled: Bool
    """(K - 1, L - 1) cells that belong to the surface."""
    color: Color

    def count(self, edge: float) -> int:
        """Number of triangles if no edge along x or y is longer than `edge` metres."""
        return 2 * int(_steps(self.x, edge) @ (self.filled @ _steps(self.y, edge)))

    def mesh(self, edge: float) -> Mesh:
        """Tessellation in the map frame with no edge along x or y longer than `edge` metres."""
        x, y = _refined(self.x, edge), _refined(self.y, edge)
        cells = np.repeat(np.repeat(self.filled, _steps(self.x, edge), axis=0), _steps(self.y, edge), axis=1)
        i, j = np.nonzero(cells)
        a = i * len(y) + j
        b, c, d = a + len(y), a + len(y) + 1, a + 1
        turned = ((i + j) % 2 == 0)[:, None]
        first = np.where(turned, np.stack([a, b, c], 1), np.stack([a, b, d], 1))
        second = np.where(turned, np.stack([a, c, d], 1), np.stack([b, c, d], 1))
        used, faces = np.unique(np.concatenate([first, second]), return_inverse=True)
        points = np.stack([x[used // len(y)], y[used % len(y)], np.zeros(len(used))], axis=1)
        return transformed(painted(Mesh(points, faces.reshape(-1, 3).astype(np.int32)), self.color), self.T_map_sheet)


def _steps(breaks: Float64, edge: float) -> np.ndarray:
    return np.maximum(np.ceil((breaks[1:] - breaks[:-1]) / edge - 1e-9), 1.0).astype(np.int64)


def _refined(breaks: Float64, edge: float) -> Float64:
    pieces = [
        np.linspace(a, b, n, endpoint=False) for (a, b), n in zip(pairwise(breaks), _steps(breaks, edge), strict=True)
    ]
    return np.concatenate([*pieces, breaks[-1:]])


@dataclass(frozen=True, slots=True, eq=False)
class ShellPiece:
    """A stretch of wall, floor or ceiling before its resolution is chosen."""

    name: str
    semantic_class: str
    sheets: tuple[Sheet, ...]
    T_map_part: Float64
    room: str
    solids: tuple[Box, ...]
    """Collision boxes with poses in the map."""

    def count(self, edge: float) -> int:
        """Number of triangles at that resolution."""
        return sum(sheet.count(edge) for sheet in self.sheets)

    def part(self, edge: float) -> StaticPart:
        """The part, tessellated with edges of at most `edge` metres."""
        mesh = concatenate([sheet.mesh(edge) for sheet in self.sheets])
        local = transformed(mesh, inverse(self.T_map_part))
        low, high = local.bounds
        centre = transform(None, (low + high) / 2)
        T_map_part = self.T_map_part @ centre
        flat = self.semantic_class == "floor"
        return StaticPart(
            name=self.name,
            semantic_class=self.semantic_class,
            mesh=transformed(local, inverse(centre)),
            T_map_part=T_map_part,
            extents=high - low,
            supports=((np.eye(4), (high - low)[:2]),) if flat else (),
            room=self.room,
            collision=tuple((inverse(T_map_part) @ T, size) for T, size in self.solids),
            group="structure",
        )


def room_shell(
    room: Room, openings: Mapping[int, Sequence[Opening]], colors: tuple[Color, Color], thickness: float = 0.12
) -> list[ShellPiece]:
    """Floor, ceiling and walls of a room.

    Args:
        room: its polygon is the clear space, rectilinear and counter-clockwise.
        openings: wall number (from polygon corner i to i + 1) -> openings in it, which must not overlap.
        colors: of the walls and of the floor, RGB.
        thickness: of the walls, metres; collision boxes fill the half that belongs to this room.
    """
    wall_color, floor_color = colors
    pieces = _slabs(room, floor_color)
    ends = np.roll(room.polygon, -1, axis=0)
    for number, (start, end) in enumerate(zip(room.polygon, ends, strict=True)):
        holes = tuple(sorted(openings.get(number, ()), key=lambda hole: hole.start))
        length = float(np.linalg.norm(end - start))
        cuts = _cuts(length, holes)
        for k, (s0, s1) in enumerate(pairwise(cuts)):
            inside = [hole for hole in holes if s0 <= hole.start and hole.end <= s1]
            suffix = f".{k}" if len(cuts) > 2 else ""
            name = f"{room.name}/wall{number}{suffix}"
            pieces.append(_wall(name, room, (start, end), (s0, s1), inside, wall_color, floor_color, thickness))
    return pieces


def _cuts(length: float, holes: Sequence[Opening]) -> list[float]:
    """Where a wall is cut into parts: at most `SEGMENT` long, never through an opening."""
    cuts = []
    for cut in np.linspace(0.0, length, int(np.ceil(length / SEGMENT)) + 1)[1:-1]:
        hole = next((h for h in holes if h.start - 0.05 < cut < h.end + 0.05), None)
        moved = cut if hole is None else hole.end + 0.06
        if moved < length - 0.1 and not any(h.start <= moved <= h.end for h in holes):
            cuts.append(float(moved))
    return [0.0, *sorted(set(cuts)), length]


def _wall(
    name: str,
    room: Room,
    line: tuple[Float64, Float64],
    span: tuple[float, float],
    holes: Sequence[Opening],
    wall_color: Color,
    floor_color: Color,
    thickness: float,
) -> ShellPiece:
    start, end = line
    along = np.array([*((end - start) / np.linalg.norm(end - start)), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    into = np.cross(along, up)  # away from the room, which lies to the left of the way
    origin = np.array([*start, room.floor])
    T_map_wall = transform(np.stack([along, up, into], axis=1), origin)
    x = _breaks([*span, *(v for h in holes for v in (h.start, h.end))])
    y = _breaks([0.0, room.height, *(v for h in holes for v in (h.bottom, h.top))])
    filled = np.ones((len(y) - 1, len(x) - 1), bool)
    for hole in holes:
        filled &= ~np.outer(_within(y, hole.bottom, hole.top), _within(x, hole.start, hole.end))
    sheets = [Sheet(transform(np.stack([up, along, -into], axis=1), origin), y, x, filled, wall_color)]
    for hole in holes:
        sheets += _reveals(hole, T_map_wall, floor_color)
    T_map_part = transform(np.stack([-into, -along, up], axis=1), origin)
    solids = _solids(span, room.height, holes, T_map_wall, thickness / 2)
    return ShellPiece(name, "wall", tuple(sheets), T_map_part, room.name, solids)


def _breaks(values: Sequence[float] | Float64) -> Float64:
    return np.array(sorted({round(float(value), 6) for value in values}))


def _within(breaks: Float64, low: float, high: float) -> Bool:
    middle = (breaks[1:] + breaks[:-1]) / 2
    return (middle > low) & (middle < high)


def _reveals(hole: Opening, T_map_wall: Float64, floor_color: Color) -> list[Sheet]:
    """Jambs, lintel, sill or threshold, and the rear face of an opening. The wall frame is (along, up, into)."""
    w, h, d = hole.end - hole.start, hole.top - hole.bottom, hole.depth
    if d == 0.0:
        return []

    def sheet(origin: tuple[float, float], depth: float, x: Float64, y: Float64, size: Box2, color: Color) -> Sheet:
        pose = T_map_wall @ transform(np.stack([x, y, np.cross(x, y)], axis=1), (origin[0], origin[1], depth))
        return Sheet(pose, np.array([0.0, size[0]]), np.array([0.0, size[1]]), np.ones((1, 1), bool), color)

    along, up, into = np.eye(3)
    corner = (hole.start, hole.bottom)
    out = [
        sheet(corner, 0.0, up, into, (h, d), FRAME),
        sheet((hole.end, hole.bottom), 0.0, into, up, (d, h), FRAME),
        sheet((hole.start, hole.top), 0.0, along, into, (w, d), FRAME),
        sheet(corner, 0.0, into, along, (d, w), floor_color if hole.bottom == 0.0 else FRAME),
    ]
    if hole.back is not None:
        out.append(sheet(corner, d, up, along, (h, w), hole.back))
    return out


def _solids(
    span: tuple[float, float], height: float, holes: Sequence[Opening], T_map_wall: Float64, depth: float
) -> tuple[Box, ...]:
    """What is massive of a wall: around its openings, behind closed ones, below thresholds."""

    def solid(low: tuple[float, float, float], high: tuple[float, float, float]) -> Box:
        a, b = np.array(low), np.array(high)
        return T_map_wall @ transform(None, (a + b) / 2), b - a

    out = []
    position = span[0]
    for hole in holes:
        out.append(solid((position, 0.0, 0.0), (hole.start, height, depth)))
        out.append(solid((hole.start, hole.top, 0.0), (hole.end, height, depth)))
        out.append(
            solid((hole.start, min(0.0, hole.bottom - SLAB), 0.0), (hole.end, hole.bottom, max(depth, hole.depth)))
        )
        if hole.back is not None:
            out.append(solid((hole.start, hole.bottom, hole.depth), (hole.end, hole.top, hole.depth + 0.05)))
        position = hole.end
    out.append(solid((position, 0.0, 0.0), (span[1], height, depth)))
    return tuple(box for box in out if box[1].min() > 1e-6)


def _slabs(room: Room, floor_color: Color) -> list[ShellPiece]:
    """Floor and ceiling, cut into tiles of at most `SEGMENT`."""
    corners = room.polygon
    x, y = (_refined(_breaks(corners[:, k]), SEGMENT) for k in (0, 1))
    centres = [((a + b) / 2, (c + d) / 2) for a, b in pairwise(x) for c, d in pairwise(y)]
    inside = np.array([room_at((room,), *centre) is not None for centre in centres]).reshape(len(x) - 1, len(y) - 1)
    groups = [_tiles(breaks) for breaks in (x, y)]
    down = transform(np.diag([1.0, -1.0, -1.0]))
    pieces = []
    for i0, i1 in groups[0]:
        for j0, j1 in groups[1]:
            filled = inside[i0:i1, j0:j1]
            if not filled.any():
                continue
            bx, by = x[i0 : i1 + 1], y[j0 : j1 + 1]
            T_floor = transform(None, (0.0, 0.0, room.floor))
            T_ceiling = transform(None, (0.0, 0.0, room.floor + room.height)) @ down
            floor = Sheet(T_floor, bx, by, filled, floor_color)
            ceiling = Sheet(T_ceiling, bx, -by[::-1], filled[:, ::-1], CEILING)
            solids = tuple(
                (
                    transform(
                        None, np.array([(bx[i] + bx[i + 1]) / 2, (by[j] + by[j + 1]) / 2, room.floor - SLAB / 2])
                    ),
                    np.array([bx[i + 1] - bx[i], by[j + 1] - by[j], SLAB]),
                )
                for i, j in np.argwhere(filled)
            )
            suffix = f"{len(pieces) // 2}" if len(groups[0]) * len(groups[1]) > 1 else ""
            pieces.append(ShellPiece(f"{room.name}/floor{suffix}", "floor", (floor,), np.eye(4), room.name, solids))
            pieces.append(ShellPiece(f"{room.name}/ceiling{suffix}", "ceiling", (ceiling,), np.eye(4), room.name, ()))
    return pieces


def _tiles(breaks: Float64) -> list[tuple[int, int]]:
    """Runs of intervals (first, past last) that span at most `SEGMENT` metres together."""
    tiles, first = [], 0
    for i in range(1, len(breaks)):
        if i == len(breaks) - 1 or breaks[i + 1] - breaks[first] > SEGMENT + 1e-9:
            tiles.append((first, i))
            first = i
    return tiles
