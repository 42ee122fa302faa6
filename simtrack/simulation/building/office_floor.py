"""An office floor from a seed: irregular rooms along corridors, open doors, windows, furniture that never repeats."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from simtrack.contracts import Float64, Room
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh
from simtrack.simulation.building import fixtures
from simtrack.simulation.building.cache import cached_world, digest
from simtrack.simulation.building.furnishing import Furnisher, room_kind
from simtrack.simulation.building.layout import PARTITION, Door, Layout, draw_layout
from simtrack.simulation.building.parts import StaticPart, StaticWorld, polygon_area
from simtrack.simulation.building.placement import FloorSpace
from simtrack.simulation.building.shell import GLASS, Color, Opening, ShellPiece, room_shell

WALLS: tuple[Color, ...] = ((226, 222, 210), (210, 216, 220), (222, 214, 200), (212, 220, 208), (230, 230, 228))
FLOORS: tuple[Color, ...] = ((124, 128, 130), (98, 110, 118), (150, 132, 110), (116, 120, 104), (136, 122, 124))
GROSS = 1.05
"""Area between the outer walls' middles per area of clear floor."""


@dataclass(frozen=True, slots=True)
class OfficeFloorConfig:
    """How large the floor is and how finely it is tessellated."""

    triangles: int = 411_698
    """Exactly so many triangles has the world (the map of Niecksch et al., Table I, has as many)."""
    area: float = 2986.0
    """Clear floor of all rooms and corridors, square metres; met within about one percent."""

    def __post_init__(self) -> None:
        if not 200.0 <= self.area <= 20_000.0:
            raise InvalidValueError("OfficeFloorConfig.area", self.area, "200 to 20000 square metres")
        if not 100.0 * self.area <= self.triangles <= 5_000_000:
            allowed = f"{int(100 * self.area)} (100 per square metre) to 5000000"
            raise InvalidValueError("OfficeFloorConfig.triangles", self.triangles, allowed)


def office_floor(rng: np.random.Generator, config: OfficeFloorConfig | None = None) -> StaticWorld:
    """One storey of offices, meeting rooms, laboratories, lounges and storage rooms along corridors.

    The map's origin is the south-west corner. Every room can be reached through open doors at least 0.98 m wide, and
    the furniture leaves ways at least 0.72 m wide between all doors of a room.

    Floors are kept in the user's cache folder, by seed, configuration and version of the code.
    """
    config = OfficeFloorConfig() if config is None else config
    seed = int(rng.integers(2**63))
    return cached_world(digest(seed, config), lambda: _built(np.random.default_rng(seed), config))


def _built(rng: np.random.Generator, config: OfficeFloorConfig) -> StaticWorld:
    width = np.sqrt(config.area * GROSS) * rng.uniform(0.9, 1.12)
    layout = draw_layout(rng, width, config.area * GROSS / width)
    rooms = _rooms(layout, rng)
    pieces: list[ShellPiece] = []
    parts: list[StaticPart] = []
    for index, room in enumerate(rooms):
        openings, radiators = _openings(layout, rooms, index, rng)
        colors = WALLS[int(rng.integers(len(WALLS)))], FLOORS[int(rng.integers(len(FLOORS)))]
        pieces += room_shell(room, openings, colors, PARTITION)
        parts += _furnished(layout, rooms, index, radiators, rng)
    structure = _tessellated(pieces, config.triangles - sum(len(part.mesh.faces) for part in parts))
    return StaticWorld(tuple(structure + parts), tuple(rooms))


# ---------------------------------------------------------------------------------------------------------------- rooms


def _rooms(layout: Layout, rng: np.random.Generator) -> list[Room]:
    """Spaces as named rooms; some have a service shaft in a corner that no door is near."""
    height = rng.uniform(2.55, 2.75)
    rooms, counts = [], dict[str, int]()
    for index in range(len(layout.spaces)):
        polygon = layout.clear(index)
        is_corridor = index < len(layout.corridors)
        kind = "corridor" if is_corridor else room_kind(polygon_area(polygon), rng)
        counts[kind] = counts.get(kind, 0) + 1
        if not is_corridor and rng.random() < 0.3:
            polygon = _with_shaft(polygon, [d for d in layout.doors if index in d.spaces], rng)
        rooms.append(Room(f"{kind}{counts[kind]}", polygon, 0.0, height if is_corridor else rng.uniform(2.6, 3.1)))
    return rooms


def _with_shaft(polygon: Float64, doors: Sequence[Door], rng: np.random.Generator) -> Float64:
    """The rectangle without one of its corners, if one is far enough from all doors."""
    size = polygon[2] - polygon[0]
    shaft = np.minimum(rng.uniform(0.4, 1.3, 2), 0.3 * size)
    for corner in rng.permutation(4):
        tip = polygon[corner]
        if all(np.abs(door.middle - tip).max() > shaft.max() + 1.4 for door in doors):
            inner = tip + np.sign(polygon.mean(axis=0) - tip) * shaft
            before = polygon[corner - 1]
            # the corner gives way to three: down the first wall, inside, and out on the second
            along_x = abs(before[1] - tip[1]) < 1e-9
            first, last = ([inner[0], tip[1]], [tip[0], inner[1]])
            cut = [first, inner, last] if along_x else [last, inner, first]
            return np.concatenate([polygon[:corner], np.array(cut), polygon[corner + 1 :]])
    return polygon


def _edge_of(polygon: Float64, door: Door) -> tuple[int, float, float]:
    """The wall of a room in which a passage lies, and from where to where on the way along it."""
    ends = np.roll(polygon, -1, axis=0)
    for k, (a, b) in enumerate(zip(polygon, ends, strict=True)):
        across, along = door.axis, 1 - door.axis
        low, high = sorted((a[along], b[along]))
        straight = abs(a[across] - b[across]) < 1e-9 and abs(a[across] - door.line) < PARTITION
        if straight and low - 1e-6 <= door.start and door.end <= high + 1e-6:
            start, end = abs(door.start - a[along]), abs(door.end - a[along])
            return k, min(start, end), max(start, end)
    raise InvalidValueError("door", door, "inside one wall of the room")


def _openings(
    layout: Layout, rooms: list[Room], index: int, rng: np.random.Generator
) -> tuple[dict[int, list[Opening]], list[tuple[int, float, float]]]:
    """Openings of a room's walls by wall number, and (wall, middle, width) of the radiators below its windows."""
    room = rooms[index]
    openings: dict[int, list[Opening]] = {}
    for door in layout.doors:
        if index in door.spaces:
            wall, start, end = _edge_of(room.polygon, door)
            openings.setdefault(wall, []).append(Opening(start, end, 0.0, 2.08, PARTITION / 2, None))
    for junction in layout.junctions:
        if index in junction.spaces:
            wall, start, end = _edge_of(room.polygon, junction)
            openings.setdefault(wall, []).append(Opening(start, end, 0.0, room.height, 0.0, None))
    windows, radiators = _windows(layout, room, rng)
    for wall, holes in windows.items():
        openings.setdefault(wall, []).extend(holes)
    return openings, radiators


def _windows(
    layout: Layout, room: Room, rng: np.random.Generator
) -> tuple[dict[int, list[Opening]], list[tuple[int, float, float]]]:
    """Windows in a room's outer walls, in a rhythm of their own, some with a radiator below."""
    outer = np.array([[0.0, 0.0], np.max([[cell.x1, cell.y1] for cell in layout.spaces], axis=0)])
    width, gap = rng.uniform(0.9, 1.9), rng.uniform(0.35, 1.2)
    sill, top = rng.uniform(0.75, 1.0), rng.uniform(2.0, min(2.45, room.height - 0.1))
    windows: dict[int, list[Opening]] = {}
    radiators = []
    for wall, (a, b) in enumerate(zip(room.polygon, np.roll(room.polygon, -1, axis=0), strict=True)):
        axis = 0 if abs(a[0] - b[0]) < 1e-9 else 1
        length = float(np.linalg.norm(b - a))
        if np.abs(outer[:, axis] - a[axis]).min() > PARTITION or length < width + 0.6:
            continue
        position = rng.uniform(0.25, 0.7)
        while position + width < length - 0.25:
            windows.setdefault(wall, []).append(Opening(position, position + width, sill, top, 0.17, GLASS))
            if rng.random() < 0.6:
                radiators.append((wall, position + width / 2, width * rng.uniform(0.6, 0.95)))
            position += width + gap * rng.uniform(0.8, 1.3)
    return windows, radiators


# ------------------------------------------------------------------------------------------------------------ furniture


def _furnished(
    layout: Layout,
    rooms: list[Room],
    index: int,
    radiators: list[tuple[int, float, float]],
    rng: np.random.Generator,
) -> list[StaticPart]:
    room = rooms[index]
    passages = [door for door in layout.doors + layout.junctions if index in door.spaces]
    space = FloorSpace(room, [_entrance(room, door) for door in passages])
    furnisher = Furnisher(space, rng)
    for door in layout.doors:
        if index in door.spaces:
            _hang(furnisher, door, leaf=door.spaces[0] == index)
    for wall, middle, width in radiators:
        a, b = room.polygon[wall], np.roll(room.polygon, -1, axis=0)[wall]
        along = (b - a) / np.linalg.norm(b - a)
        inwards = np.array([-along[1], along[0]])
        piece = fixtures.radiator(width, rng.uniform(0.4, 0.6))
        x, y = a + middle * along + piece.extents[0] / 2 * inwards
        pose = float(x), float(y), float(np.arctan2(inwards[1], inwards[0]))
        if space.put(piece, *pose, gap=-0.01):
            furnisher.add(piece, pose)
    area = polygon_area(room.polygon)
    kind = room.name.rstrip("0123456789")
    if kind == "corridor":
        furnisher.corridor(float(np.ptp(room.polygon, axis=0).max()))
        return furnisher.parts
    for _ in range(int(area / 30.0)):
        column = fixtures.column(rng.uniform(0.25, 0.5), rng.uniform(0.25, 0.5), room.height)
        if rng.random() < 0.3:
            column = fixtures.round_column(rng.uniform(0.3, 0.5), room.height)
        (furnisher.wall if rng.random() < 0.5 else furnisher.open)(column)
    {
        "office": furnisher.office,
        "meeting": furnisher.meeting,
        "laboratory": furnisher.laboratory,
        "lounge": furnisher.lounge,
        "storage": furnisher.storage,
    }[kind](area)
    return furnisher.parts


def _entrance(room: Room, door: Door) -> tuple[Float64, Float64, float]:
    """Middle of a passage on the room's side of the wall, direction into the room, width."""
    wall, start, end = _edge_of(room.polygon, door)
    a, b = room.polygon[wall], np.roll(room.polygon, -1, axis=0)[wall]
    along = (b - a) / np.linalg.norm(b - a)
    return a + (start + end) / 2 * along, np.array([-along[1], along[0]]), end - start


def _hang(furnisher: Furnisher, door: Door, leaf: bool) -> None:
    """Case a door on the room's side and hang its open leaf there if it opens into this room."""
    rng = furnisher.rng
    middle, inwards, width = _entrance(furnisher.room, door)
    yaw = float(np.arctan2(inwards[1], inwards[0]))
    frame = fixtures.door_frame(width, 2.08)
    x, y = middle + frame.extents[0] / 2 * inwards
    furnisher.add(frame, (float(x), float(y), yaw))
    if not leaf:
        return
    piece = fixtures.door_leaf(width - 0.02, color=furnisher.finish)
    along = np.array([inwards[1], -inwards[0]])
    for side in rng.permutation([-1.0, 1.0]):
        hinge = middle + side * (width / 2 + fixtures.LEAF / 2) * along + 0.05 * inwards
        angle = np.radians(rng.uniform(89.0, 104.0))
        direction = -side * np.cos(angle) * along + np.sin(angle) * inwards
        pose = fixtures.hinged(width - 0.02, (hinge[0], hinge[1]), float(np.arctan2(direction[1], direction[0])))
        if furnisher.space.put(piece, *pose, gap=-0.02, on_way=True):
            furnisher.add(piece, pose)
            return


# --------------------------------------------------------------------------------------------------------- tessellation


def _tessellated(pieces: Sequence[ShellPiece], triangles: int) -> list[StaticPart]:
    """Shell parts with exactly `triangles` triangles together: the finest even edge length, then single splits."""
    low, high = 0.05, 5.0
    while high - low > 5e-4:
        middle = (low + high) / 2
        low, high = (middle, high) if sum(p.count(middle) for p in pieces) > triangles else (low, middle)
    parts = [piece.part(high) for piece in pieces if piece.count(high)]
    missing = triangles - sum(len(part.mesh.faces) for part in parts)
    if missing < 0:
        raise InvalidValueError(
            "OfficeFloorConfig.triangles", triangles, f"at least {triangles - missing} for the walls"
        )
    floors = [k for k, part in enumerate(parts) if part.semantic_class == "floor"]
    if missing % 2:
        parts[floors[0]] = replace(parts[floors[0]], mesh=_border_split(parts[floors[0]].mesh))
    shares = np.diff(np.linspace(0, missing // 2, len(floors) + 1).astype(int))
    for k, share in zip(floors, shares.tolist(), strict=True):
        parts[k] = replace(parts[k], mesh=_centre_splits(parts[k].mesh, share))
    return parts


def _centre_splits(mesh: Mesh, count: int) -> Mesh:
    """Split the first `count` faces, and then those that came of it, at their centres: two more faces each."""
    while count > 0:
        now = min(count, len(mesh.faces))
        corners, rest = mesh.faces[:now], mesh.faces[now:]
        centre = (len(mesh.vertices) + np.arange(now)).astype(np.int32)
        a, b, c = corners.T
        faces = [rest, *(np.stack(f, axis=1) for f in ((a, b, centre), (b, c, centre), (c, a, centre)))]
        colors = mesh.face_colors
        if colors is not None:
            colors = np.concatenate([colors[now:], *([colors[:now]] * 3)])
        vertices = np.concatenate([mesh.vertices, mesh.triangles[:now].mean(axis=1)])
        mesh, count = Mesh(vertices, np.concatenate(faces), colors), count - now
    return mesh


def _border_split(mesh: Mesh) -> Mesh:
    """Split one face at the middle of an edge that no other face has: one more face."""
    start, end = mesh.faces.ravel().astype(np.int64), np.roll(mesh.faces, -1, axis=1).ravel().astype(np.int64)
    count = len(mesh.vertices)
    edge = int(np.flatnonzero(~np.isin(start * count + end, end * count + start))[0])
    face, corner = divmod(edge, 3)
    a, b, c = np.roll(mesh.faces[face], -corner)
    faces = mesh.faces.copy()
    faces[face] = a, count, c
    vertices = np.concatenate([mesh.vertices, mesh.vertices[[a, b]].mean(axis=0, keepdims=True)])
    colors = mesh.face_colors
    if colors is not None:
        colors = np.concatenate([colors, colors[face : face + 1]])
    return Mesh(vertices, np.concatenate([faces, [[count, b, c]]]).astype(np.int32), colors)
