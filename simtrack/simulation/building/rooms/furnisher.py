"""Puts things into one room: on the floor, on walls, onto, into and against what stands there already."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64, Room
from simtrack.geometry.transforms import apply, rotation_from_rpy, transform, transform_planar
from simtrack.objects.cad.model import CadModel, CadSupport
from simtrack.simulation.building.placement import FloorSpace
from simtrack.simulation.building.rooms.families import FAMILIES
from simtrack.simulation.building.rooms.fittings import Cleat, cleat
from simtrack.simulation.building.shell import Opening

CLEARANCE = 0.0008
"""Metres that a thing is put down above its support."""
MARGIN = 0.02
"""Metres between things on one support."""
WALL_NAMES = ("wall-south", "wall-east", "wall-north", "wall-west")
"""Of the walls that start at the polygon's corners."""
LEAN = (np.radians(9.0), np.radians(15.0))
"""Radians off the vertical of what leans."""
AJAR = 0.35
"""Share of a joint's range from which one can look and reach into what it closes."""
SERVICE = (1.3, 1.7)
"""Metres, depth and width, of clear floor before what a robot is to work at."""
AMID = 0.2
"""Metres off the middle of what it stands on, at most, of what a robot is to work at."""
NEAR = 0.03
"""Metres between what is paired."""
OPENS = 0.45
"""Chance of a joint to be open."""


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


@dataclass(slots=True, eq=False)
class _Face:
    """A support in the map and what stands on it already."""

    T_map_face: Float64
    size: Float64
    clearance: float
    inside: bool
    taken: list[tuple[Float64, Float64]]
    """(2,) centre on the face and (2,) half sides of rectangles along it."""

    def free(self, centre: Float64, half: Float64) -> bool:
        """Whether nothing stands within `MARGIN` of a rectangle."""
        return all((np.abs(centre - at) > half + other + MARGIN).any() for at, other in self.taken)


@dataclass(frozen=True, slots=True)
class _Footprint:
    """What the floor plan needs to know of a piece."""

    extents: Float64


class Furnisher:
    """Furnishes a room.

    Args:
        rng: draws everything.
        room: a rectangle from the origin, counter-clockwise.
        openings: wall number -> doors and windows; doors begin at the floor.
    """

    def __init__(self, rng: np.random.Generator, room: Room, openings: Mapping[int, Sequence[Opening]]) -> None:
        self.rng = rng
        self.room = room
        self.openings = openings
        doors = []
        for number, holes in openings.items():
            start, along, inwards, _ = self._wall(number)
            for hole in (hole for hole in holes if hole.bottom == 0.0):
                doors.append((start + along * (hole.start + hole.end) / 2, inwards, hole.end - hole.start))
        self.space = FloorSpace(room, doors)
        self.placed: list[PlacedModel] = []
        self.cleats: list[Cleat] = []
        self.faces: list[_Face] = []
        self.counts: dict[str, int] = {}
        self.bounds: list[Float64] = []

    def _wall(self, number: int) -> tuple[Float64, Float64, Float64, float]:
        """Start (2,), direction (2,), direction into the room (2,), length of a wall."""
        start, end = self.room.polygon[number], self.room.polygon[(number + 1) % len(self.room.polygon)]
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        return start, along, np.array([-along[1], along[0]]), length

    def make(self, family: str) -> tuple[str, CadModel]:
        """A new thing of a family and its name in the room."""
        builder = FAMILIES[family](self.rng)
        kind = builder.semantic_class
        name = self._named(kind)
        return name, builder.finish(name)

    def _named(self, kind: str) -> str:
        number = self.counts[kind] = self.counts.get(kind, 0) + 1
        return f"{kind}{number}"

    def on_floor(self, family: str, *, at_wall: bool) -> None:
        """Try to put a thing on the free floor; some of its joints may be open."""
        name, model = self.make(family)
        # What opens needs room before it; the front of a model is -y, a heading is that of the front.
        footprint = _Footprint(model.extents[[1, 0, 2]])
        found = (
            self.space.put_at_wall(footprint, self.rng, attempts=60)
            if at_wall
            else self.space.put_anywhere(footprint, self.rng, attempts=60)
        )
        if found is not None:
            x, y, heading = found
            T = _standing(model, x, y, heading + np.pi / 2, 0.0)
            self.add(name, model, T, self._opened(model, T))

    def served(self, family: str, on_top: str | None = None) -> None:
        """Put a closed thing to a wall and keep the floor before it clear; stand another one at its front edge."""
        name, model = self.make(family)
        depth, width = model.extents[[1, 0]].tolist()
        clear = SERVICE[0], max(width, SERVICE[1])
        footprint, heading = _Footprint(model.extents[[1, 0, 2]]), 0.0
        for _ in range(60):
            before = self.space.free.copy(), self.space.ways
            found = self.space.put_at_wall(footprint, self.rng, attempts=60)
            if found is None:
                return
            x, y, heading = found
            front = np.array([np.cos(heading), np.sin(heading)])
            middle = np.array([x, y]) + front * (depth / 2 + clear[0] / 2 + 0.06)
            ahead, aside = middle.tolist()
            if self.space.keep_clear(ahead, aside, heading, clear[0], clear[1]):
                T = _standing(model, x, y, heading + np.pi / 2, 0.0)
                known = len(self.faces)
                self.add(name, model, T, {})
                half = np.full(2, clear[0] / 2)
                self.bounds.append(np.array([[*(middle - half), 0.0], [*(middle + half), 1.8]]))
                if on_top is not None:
                    self._at_front_edge(on_top, max(self.faces[known:], key=lambda face: float(face.T_map_face[2, 3])))
                return
            self.space.free, self.space.ways = before

    def paired(self, family: str, before: str) -> None:
        """Put a thing to a wall, and another one close before its middle, turned to it."""
        (name, model), (name_before, model_before) = self.make(family), self.make(before)
        depth, depth_before = float(model.extents[1]), float(model_before.extents[1])
        for _ in range(60):
            taken = self.space.free.copy(), self.space.ways
            found = self.space.put_at_wall(_Footprint(model.extents[[1, 0, 2]]), self.rng, attempts=60)
            if found is None:
                return
            x, y, heading = found
            away = depth / 2 + NEAR + depth_before / 2
            x_before, y_before = x + away * float(np.cos(heading)), y + away * float(np.sin(heading))
            footprint = _Footprint(model_before.extents[[1, 0, 2]])
            if self.space.put(footprint, x_before, y_before, heading + np.pi, gap=0.0):
                self.add(name, model, _standing(model, x, y, heading + np.pi / 2, 0.0), {})
                turned = heading + np.pi + np.pi / 2
                self.add(name_before, model_before, _standing(model_before, x_before, y_before, turned, 0.0), {})
                return
            self.space.free, self.space.ways = taken

    def _at_front_edge(self, family: str, face: _Face) -> None:
        """Stand a closed thing at the front edge of a face, turned to it."""
        name, model = self.make(family)
        turn = float(np.clip(self.rng.normal(0.0, 0.04), -0.1, 0.1))
        turning = np.abs([[np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        half = turning @ model.extents[:2] / 2
        free = face.size / 2 - half - 0.012
        at = np.array(
            [
                self.rng.uniform(*np.clip([-free[0], free[0]], -AMID, AMID)),
                self.rng.uniform(-free[1], min(0.05 - free[1], free[1])),
            ]
        )
        face.taken.append((at, half + (0.08, 0.0)))
        face.taken.append((np.array([at[0], -face.size[1] / 2]), np.array([half[0] + 0.08, 0.1])))
        T = face.T_map_face @ transform_planar(float(at[0]), float(at[1]), turn)
        yaw = float(np.arctan2(T[1, 0], T[0, 0]))
        self.add(name, model, _standing(model, float(T[0, 3]), float(T[1, 3]), yaw, float(T[2, 3])), {})

    def against_wall(self, family: str) -> None:
        """Try to lean a thing against a wall: its rear side's upper edge touches it, its lower edge stands off."""
        name, model = self.make(family)
        angle = self.rng.uniform(*LEAN)
        lean = transform(rotation_from_rpy(-angle, 0.0, 0.0))
        low, high = _bounds(model, lean)
        footprint = _Footprint(np.array([high[1] - low[1], high[0] - low[0], high[2] - low[2]]))
        for _ in range(8):
            before = self.space.free.copy(), self.space.ways
            found = self.space.put_at_wall(footprint, self.rng, gap=0.0)
            if found is None:
                return
            x, y, heading = found
            T = transform_planar(x, y, heading + np.pi / 2) @ lean
            T[:3, 3] += transform_planar(0.0, 0.0, heading + np.pi / 2)[:3, :3] @ [0.0, -(low[1] + high[1]) / 2, 0.0]
            T[2, 3] = CLEARANCE - low[2]
            if self._before_wall(_bounds(model, T)):
                self.add(name, model, T, {})
                return
            self.space.free, self.space.ways = before

    def on_wall(self, family: str) -> None:
        """Try to hang a thing where the wall is free, at the height of the eyes."""
        name, model = self.make(family)
        width, depth, height = model.extents
        for _ in range(40):
            number = int(self.rng.integers(len(self.room.polygon)))
            start, along, inwards, length = self._wall(number)
            if length < width + 0.2:
                continue
            x, y = (
                start
                + along * self.rng.uniform(width / 2 + 0.1, length - width / 2 - 0.1)
                + inwards * (depth / 2 + CLEARANCE)
            )
            bottom = self.rng.uniform(1.25, min(1.6, self.room.height - 0.15 - height))
            yaw = float(np.arctan2(inwards[1], inwards[0])) + np.pi / 2
            T = _standing(model, float(x), float(y), yaw, bottom)
            bounds = _bounds(model, T)
            if self._clear(bounds, 0.04) and self._before_wall(bounds):
                self.cleats.append(cleat(name, WALL_NAMES[number], model, T))
                self.add(name, model, T, self._free_positions(model, T))
                return

    def leaning_books(self) -> None:
        """Try to stand a thick book on its edge somewhere and to lean another one against it."""
        drawn = self._books(4)
        pairs = [
            (prop, book)
            for prop, book in itertools.permutations(drawn, 2)
            if prop.extents[2] > 0.03 and prop.extents[1] > book.extents[1] and prop.mass > 1.2 * book.mass
        ]
        if not pairs:
            return
        prop, book = pairs[0]
        # on edge: the spine to the front, the thickness along the face
        edge = transform(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
        tilted = transform(rotation_from_rpy(0.0, -self.rng.uniform(*LEAN), 0.0)) @ edge
        a, b = _bounds(prop, edge), _bounds(book, tilted)
        size = np.array([np.ptp(a[:, 0]) + np.ptp(b[:, 0]) + 0.002, max(np.ptp(a[:, 1]), np.ptp(b[:, 1]))])
        found = self._place(size, float(prop.extents[1]))
        if found is None:
            return
        left = -size[0] / 2
        for model, T_here, low, x in (
            (prop, edge, a[0], left),
            (book, tilted, b[0], left + np.ptp(a[:, 0]) + 0.001),
        ):
            T_face = transform(None, np.array([x - low[0], 0.0, CLEARANCE - low[2]])) @ T_here
            self.add(self._named("book"), model, found @ T_face, {})

    def bridging_book(self) -> None:
        """Try to lay a book across two copies of another one."""
        gap = self.rng.uniform(0.04, 0.06)
        base, top = sorted(self._books(2), key=lambda book: float(book.extents[1]))
        if top.extents[1] < gap + 0.12:
            return
        width, depth, height = base.extents
        size = np.array([2 * width + gap, depth])
        found = self._place(size, float(height + top.extents[2]))
        if found is None:
            return
        for x in (-(width + gap) / 2, (width + gap) / 2):
            T = transform(None, np.array([x, 0.0, height / 2 + CLEARANCE]))
            self.add(self._named("book"), base, found @ T, {})
        across = transform(
            rotation_from_rpy(0.0, 0.0, np.pi / 2), np.array([0.0, 0.0, height + top.extents[2] / 2 + 2 * CLEARANCE])
        )
        self.add(self._named("book"), top, found @ across, {})

    def _books(self, count: int) -> list[CadModel]:
        """Books that have no name yet."""
        return [FAMILIES["book"](self.rng).finish("book") for _ in range(count)]

    def _place(self, size: Float64, height: float) -> Float64 | None:
        """(4, 4) T_map_rectangle of a free place for a rectangle on some piece of furniture."""
        half = size / 2
        fits = [
            f
            for f in self.faces
            if not f.inside and f.clearance > height + 0.05 and (f.size > size + 0.03).all() and self._is_furniture(f)
        ]
        for k in self.rng.permutation(len(fits)).tolist():
            face = fits[k]
            for _ in range(12):
                at = self.rng.uniform(-1.0, 1.0, 2) * (face.size / 2 - half - 0.012)
                if face.free(at, half):
                    face.taken.append((at, half))
                    return face.T_map_face @ transform_planar(float(at[0]), float(at[1]), 0.0)
        return None

    def on_support(self, family: str, *, inside: bool) -> None:
        """Try to put a thing on (or into) what stands already."""
        name, model = self.make(family)
        fits = [f for f in self.faces if f.inside == inside and f.clearance > model.extents[2] + 0.02]
        for k in self.rng.permutation(len(fits)).tolist():
            face = fits[k]
            turn = float(self.rng.normal(0.0, 0.12))
            turning = np.abs([[np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            half = turning @ model.extents[:2] / 2
            free = face.size / 2 - half - 0.012
            if (free <= 0.0).any():
                continue
            for _ in range(12):
                at = self.rng.uniform(-free, free)
                if face.free(at, half):
                    T = face.T_map_face @ transform_planar(float(at[0]), float(at[1]), turn)
                    heading = float(np.arctan2(T[1, 0], T[0, 0]))
                    T = _standing(model, float(T[0, 3]), float(T[1, 3]), heading, float(T[2, 3]))
                    positions = {} if inside else self._free_positions(model, T)
                    face.taken.append((at, half))
                    if positions:  # what stands before it would be in the door's way
                        front = at + transform_planar(0.0, 0.0, turn)[:2, :2] @ [0.0, -model.extents[1] / 2 - 0.15]
                        face.taken.append((front, np.array([half[0], 0.15])))
                    self.add(name, model, T, positions)
                    return

    def add(self, name: str, model: CadModel, T: Float64, positions: dict[str, float]) -> None:
        """Put a thing at its pose and offer its own faces."""
        self.placed.append(PlacedModel(name, model, T, positions))
        self.bounds.append(_bounds(model, T, positions))
        if T[2, 2] < np.cos(0.01) or (model.mass < 3.0 and model.semantic_class not in ("book", "box", "shelf")):
            return
        poses = model.part_poses(positions)
        for support in model.supports:
            inside = _enclosed(model, support)
            if inside and not _accessible(model, support, positions):
                continue
            T_map_face = T @ poses[support.part] @ transform(None, support.centre)
            self.faces.append(_Face(T_map_face, support.size, support.clearance, inside, []))

    def _opened(self, model: CadModel, T_map_model: Float64) -> dict[str, float]:
        """Some joints at rest where they are partly open, if the floor before the thing is free for it."""
        positions = self._drawn(model)
        if not positions:
            return {}
        low, high = model.mesh(positions).bounds
        front = -model.extents[1] / 2 - low[1] + 0.05
        T = T_map_model @ transform(None, np.array([(low[0] + high[0]) / 2, low[1] - 0.05 + front / 2, 0.0]))
        heading = float(np.arctan2(T[1, 0], T[0, 0])) - np.pi / 2
        strip = _Footprint(np.array([front, high[0] - low[0], 1.0]))
        return positions if self.space.put(strip, float(T[0, 3]), float(T[1, 3]), heading, gap=0.0) else {}

    def _free_positions(self, model: CadModel, T_map_model: Float64) -> dict[str, float]:
        """The same for what does not stand on the floor, if nothing is in the way."""
        positions = self._drawn(model)
        return positions if positions and self._clear(_bounds(model, T_map_model, positions), 0.0, skip=True) else {}

    def _drawn(self, model: CadModel) -> dict[str, float]:
        draws = self.rng.random((2, len(model.joints)))
        return {
            joint.name: float((0.3 + 0.5 * share) * joint.upper)
            for joint, chance, share in zip(model.joints, *draws, strict=True)
            if chance < OPENS and joint.kind != "continuous"
        }

    def _clear(self, bounds: Float64, margin: float, *, skip: bool = False) -> bool:
        """Whether an upright box of the map (2, 3) is free; `skip` leaves out what it stands on or before."""
        low, high = bounds[0] - margin, bounds[1] + margin
        if skip:
            low = low + [0.0, 0.0, 0.01]
        return not any((low < other[1]).all() and (high > other[0]).all() for other in self.bounds)

    def _before_wall(self, bounds: Float64) -> bool:
        """Whether an upright box of the map (2, 3) lies before no door and no window."""
        for number, holes in self.openings.items():
            start, along, inwards, _ = self._wall(number)
            corners = np.array([[x, y] for x in bounds[:, 0] for y in bounds[:, 1]]) - start
            s, off = corners @ along, corners @ inwards
            if off.min() > 0.3:
                continue
            for hole in holes:
                if s.max() > hole.start - 0.05 and s.min() < hole.end + 0.05 and bounds[1, 2] > hole.bottom - 0.05:
                    return False
        return True

    def _is_furniture(self, face: _Face) -> bool:
        """Whether a face carries more than a small thing."""
        return float(np.prod(face.size)) > 0.1


def _standing(model: CadModel, x: float, y: float, yaw: float, z: float) -> Float64:
    """T_map_model of a thing that stands upright at a height."""
    T = transform_planar(x, y, yaw)
    T[2, 3] = z + CLEARANCE + model.extents[2] / 2
    return T


def _bounds(model: CadModel, T: Float64, positions: Mapping[str, float] | None = None) -> Float64:
    """(2, 3) lowest and highest corner of a thing at a pose."""
    points = apply(T, model.mesh(positions).vertices)
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _enclosed(model: CadModel, support: CadSupport) -> bool:
    """Whether a face is the floor of a hollow."""
    return any(
        hollow.part == support.part
        and abs(hollow.centre[2] - hollow.extents[2] / 2 - support.centre[2]) < 1e-6
        and np.abs(hollow.centre[:2] - support.centre[:2]).max() < 1e-6
        for hollow in model.hollows
    )


def _accessible(model: CadModel, support: CadSupport, positions: Mapping[str, float]) -> bool:
    """Whether what is put on the floor of a hollow can be reached: its own drawer, or the door before it, is open."""
    x, z = support.centre[0], support.centre[2] + 0.02
    for joint in model.joints:
        ajar = positions.get(joint.name, 0.0) >= AJAR * joint.upper
        leaf = model.part(joint.child).mesh.bounds
        covers = leaf[0, 0] < x < leaf[1, 0] and leaf[0, 2] < z < leaf[1, 2] and leaf[1, 1] < support.centre[1]
        if (joint.child == support.part or covers) and not ajar:
            return False
    return True
