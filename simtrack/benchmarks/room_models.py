"""The pieces that worlds of rooms are made of: room shells with door openings, furniture, places to put things.

All in the frame of a room: origin at the lower south-west corner, x east, y north, z up, metres. Walls stand inside the
room's box, so that those of neighbours do not coincide.
"""

from functools import cache

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import Mesh, box_mesh, concatenate, subdivide_to, transformed
from simtrack.geometry.transforms import transform, transform_planar

WIDTH, DEPTH, HEIGHT = 6.0, 5.0, 2.8
"""Of a room along x, y and z."""
CORRIDOR = 2.4
"""Width of the corridors, which run along x."""
DOOR_WIDTH, DOOR_HEIGHT = 0.9, 2.05
"""Doors are in the middle of a wall."""
SOUTH, NORTH, WEST, EAST = 1, 2, 4, 8
"""Bits of the set of walls that have a door."""
LAYOUTS = 4
"""Ways to furnish a room."""
ROOM_FACES, CORRIDOR_FACES = 3000, 400
"""Triangles of a room's structure."""
_WALL, _SLAB = 0.08, 0.02
"""Thickness of walls, and of floor and ceiling, between which the walls stand."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lower and upper corner."""


@cache
def room(doors: int, layout: int) -> Mesh:
    """Floor, ceiling, walls with openings for the doors in the set `doors`, and furniture."""
    shell = [*_slabs(DEPTH), *(box for wall in (SOUTH, NORTH, WEST, EAST) for box in _wall(wall, DEPTH, doors))]
    pieces = [transformed(_mesh(_PIECES[piece][0]), T) for piece, T in _arrangement(layout)]
    return subdivide_to(concatenate([_mesh(shell), *pieces]), ROOM_FACES)


@cache
def corridor(ends: int) -> Mesh:
    """A piece of corridor with a door on both sides, closed by walls at the `ends` in the set (`WEST`, `EAST`)."""
    closed = [wall for wall in (SOUTH, NORTH, WEST, EAST) if wall & (ends | SOUTH | NORTH)]
    boxes = [*_slabs(CORRIDOR), *(box for wall in closed for box in _wall(wall, CORRIDOR, SOUTH | NORTH))]
    return subdivide_to(_mesh(boxes), CORRIDOR_FACES)


@cache
def spots(layout: int) -> Float64:
    """(S, 3) places on furniture, 0.4 m apart, where something up to 0.4 m high and 0.38 m wide can stand."""
    return np.concatenate([_PIECES[piece][1] @ T[:3, :3].T + T[:3, 3] for piece, T in _arrangement(layout)])


def _arrangement(layout: int) -> list[tuple[str, Float64]]:
    """The piece of furniture of every corner and its (4, 4) pose; the middle and the ways to the doors stay free."""
    names = list(_PIECES)
    corners = ((0.1, 0.1, 0.0), (WIDTH - 0.1, DEPTH - 0.1, np.pi))
    out = [(names[(layout + k) % 4], transform_planar(*corner)) for k, corner in enumerate(corners)]
    mirrored = ((WIDTH - 2.0, 0.1, 0.0), (2.0, DEPTH - 0.1, np.pi))
    return out + [(names[(layout + 2 + k) % 4], transform_planar(*corner)) for k, corner in enumerate(mirrored)]


def _slabs(depth: float) -> list[Box]:
    return [((0.0, 0.0, 0.0), (WIDTH, depth, _SLAB)), ((0.0, 0.0, HEIGHT - _SLAB), (WIDTH, depth, HEIGHT))]


def _wall(wall: int, depth: float, doors: int) -> list[Box]:
    """Boxes of one wall; a door leaves two sides and a lintel."""
    length = WIDTH if wall in (SOUTH, NORTH) else depth
    across = {SOUTH: 0.0, NORTH: depth - _WALL, WEST: 0.0, EAST: WIDTH - _WALL}[wall]
    low, high = 0.5 * (length - DOOR_WIDTH), 0.5 * (length + DOOR_WIDTH)
    panels = [(0.0, length, _SLAB)]
    if wall & doors:
        panels = [(0.0, low, _SLAB), (high, length, _SLAB), (low, high, DOOR_HEIGHT)]
    boxes: list[Box] = []
    for begin, end, bottom in panels:
        if wall in (SOUTH, NORTH):
            boxes.append(((begin, across, bottom), (end, across + _WALL, HEIGHT - _SLAB)))
        else:
            boxes.append(((across, begin, bottom), (across + _WALL, end, HEIGHT - _SLAB)))
    return boxes


def _mesh(boxes: list[Box]) -> Mesh:
    parts = []
    for low, high in np.array(boxes):
        parts.append(transformed(box_mesh(high - low), transform(translation=0.5 * (low + high))))
    return concatenate(parts)


def _table(width: float, depth: float, height: float) -> list[Box]:
    legs: list[Box] = [
        ((x, y, 0.02), (x + 0.05, y + 0.05, height - 0.03)) for x in (0.02, width - 0.07) for y in (0.02, depth - 0.07)
    ]
    return [((0.0, 0.0, height - 0.03), (width, depth, height)), *legs]


def _shelf(width: float, depth: float, boards: tuple[float, ...]) -> list[Box]:
    sides: list[Box] = [((x, 0.0, 0.02), (x + 0.03, depth, boards[-1] + 0.45)) for x in (0.0, width - 0.03)]
    return [*sides, *(((0.03, 0.0, z - 0.03), (width - 0.03, depth, z)) for z in boards)]


def _grid(columns: int, rows: int, heights: tuple[float, ...], margin: float = 0.2) -> Float64:
    """(columns * rows * H, 3) spots 0.4 m apart, the first `margin` metres from the corner."""
    x, y, z = np.meshgrid(margin + 0.4 * np.arange(columns), 0.2 + 0.4 * np.arange(rows), heights, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)


_CHAIR: list[Box] = [
    ((0.6, 0.9, 0.42), (1.04, 1.34, 0.47)),
    ((0.6, 1.3, 0.47), (1.04, 1.34, 0.95)),
    ((0.79, 1.09, 0.02), (0.85, 1.15, 0.42)),
]
_BOARDS = (0.1, 0.55, 1.0, 1.45)

_PIECES: dict[str, tuple[list[Box], Float64]] = {
    "desk": (_table(1.6, 0.8, 0.74) + _CHAIR, _grid(4, 2, (0.74,))),
    "shelf": (_shelf(1.3, 0.4, _BOARDS), _grid(3, 1, _BOARDS, 0.25)),
    "bench": (_table(1.8, 0.8, 0.9) + [((0.2, 0.1, 0.3), (1.6, 0.7, 0.33))], _grid(4, 2, (0.9,))),
    "cabinet": ([((0.0, 0.0, 0.02), (1.2, 0.45, 0.85))], _grid(3, 1, (0.85,))),
}
"""Boxes of each piece, from its own corner on, and the spots on it."""
