"""What a static world is made of: labelled parts with exact meshes, collision boxes and support faces, in rooms."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from simtrack.contracts import Float64, Room
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.meshes import Mesh, concatenate, transformed
from simtrack.geometry.transforms import apply

Box: TypeAlias = tuple[Float64, Float64]
"""(T_part_box (4, 4), full side lengths (3,) in metres)."""

Support: TypeAlias = tuple[Float64, Float64]
"""(T_part_face (4, 4) with origin in the face's centre and z up, size (2,) in metres along the face's x and y)."""

Survey: TypeAlias = Literal["as-is", "movable", "omitted"]
Group: TypeAlias = Literal["structure", "furniture", "clutter"]


@dataclass(frozen=True, slots=True, eq=False)
class StaticPart:
    """One labelled piece of a building, fixed for the whole simulation.

    The part frame has its origin in the centre of the part's box, x to its front, y to its left, z up: the frame that
    `simtrack.contracts.MapEntity` uses.
    """

    name: str
    """Unique in its world, e.g. ``workbench`` or ``office3/chair1``."""
    semantic_class: str
    """e.g. ``workbench``, ``shelf``, ``wall``, ``floor``."""
    mesh: Mesh
    """Part frame, metres: exactly what every renderer and ray caster shows. Walls, floors and ceilings are open sheets
    whose normals point to the free side; everything else is made of closed pieces."""
    T_map_part: Float64
    """(4, 4)."""
    extents: Float64
    """(3,), full side lengths of the box along the part's own axes, metres; a flat sheet has a zero among them."""
    supports: tuple[Support, ...] = ()
    """Horizontal faces that things can stand on."""
    room: str = ""
    """Name of the room it stands in, or empty."""
    survey: Survey = "as-is"
    """``as-is``: surveyed where it stands; ``movable``: may have been moved or brought in since; ``omitted``: too
    small for a survey."""
    collision: tuple[Box, ...] = ()
    """Solid boxes in the part frame, for contacts."""
    group: Group = "furniture"

    def __post_init__(self) -> None:
        if not self.name:
            raise InvalidValueError("StaticPart.name", self.name, "a name that is unique in the world")
        if np.shape(self.T_map_part) != (4, 4) or np.shape(self.extents) != (3,):
            raise InvalidValueError(
                f"StaticPart '{self.name}'",
                (np.shape(self.T_map_part), np.shape(self.extents)),
                "T_map_part of shape (4, 4) and extents of shape (3,)",
            )

    def footprint(self) -> Float64:
        """(4, 2) corners of the part's box seen from above, counter-clockwise, map frame."""
        x, y = self.extents[:2] / 2
        return apply(self.T_map_part, np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]))[:, :2]


@dataclass(frozen=True, slots=True, eq=False)
class MovingPart:
    """A piece that a joint lets move against the building: a door, a drawer."""

    part: StaticPart
    """As it stands with the joint at 0."""
    joint: str
    """Name of its joint in the compiled world."""
    body: str
    """Name of its body there."""
    kind: Literal["revolute", "prismatic"]
    anchor: Float64
    """(3,), a point of the axis, map frame."""
    axis: Float64
    """(3,), unit vector, map frame."""
    lower: float
    """Radians or metres."""
    upper: float


@dataclass(frozen=True, eq=False)
class StaticWorld:
    """A building as it really is: the simulator's truth. Estimators get a `StaticMap` from a survey of it instead."""

    parts: tuple[StaticPart, ...]
    rooms: tuple[Room, ...] = ()
    moving: tuple[MovingPart, ...] = ()

    def __post_init__(self) -> None:
        names = [part.name for part in self.solid]
        repeated = sorted({name for name in names if names.count(name) > 1}) if len(set(names)) < len(names) else []
        if repeated:
            raise InvalidValueError("StaticWorld.parts", repeated, "parts with names of their own")

    @cached_property
    def solid(self) -> tuple[StaticPart, ...]:
        """All parts, those that joints move with their joints at 0."""
        return (*self.parts, *(moving.part for moving in self.moving))

    @cached_property
    def triangles(self) -> int:
        """Number of triangles of all parts."""
        return sum(len(part.mesh.faces) for part in self.parts)

    @cached_property
    def area(self) -> float:
        """Floor area of all rooms, square metres."""
        return sum(polygon_area(room.polygon) for room in self.rooms)

    def part(self, name: str) -> StaticPart:
        """Part of that name.

        Raises:
            UnknownNameError: no part is called so; lists those that exist.
        """
        for part in self.parts:
            if part.name == name:
                return part
        raise UnknownNameError("static part", name, (part.name for part in self.parts))

    def mesh(self) -> Mesh:
        """All parts as one mesh in the map frame, in the order of the parts."""
        return concatenate([transformed(part.mesh, part.T_map_part) for part in self.parts])


def polygon_area(polygon: Float64) -> float:
    """Signed area of a (K, 2) polygon in square metres, positive if counter-clockwise."""
    x, y = np.asarray(polygon, dtype=float).T
    return float(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def room_at(rooms: Sequence[Room], x: float, y: float) -> Room | None:
    """The first room whose polygon contains a point of the map, or None."""
    for room in rooms:
        start, end = room.polygon, np.roll(room.polygon, -1, axis=0)
        crosses = (start[:, 1] > y) != (end[:, 1] > y)
        rise = np.where(crosses, end[:, 1] - start[:, 1], 1.0)
        left_of = x < start[:, 0] + (y - start[:, 1]) / rise * (end[:, 0] - start[:, 0])
        if np.count_nonzero(crosses & left_of) % 2:
            return room
    return None
