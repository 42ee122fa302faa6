"""Where things stand at time 0: drawn on support faces without overlap, by rejection sampling."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64, Room
from simtrack.errors import FileFormatError, InvalidValueError, UnknownNameError
from simtrack.geometry.transforms import apply, transform_planar, transform_xyz_rpy
from simtrack.objects import ObjectModel
from simtrack.simulation.building.parts import StaticPart, StaticWorld, room_at
from simtrack.simulation.scene_file import (
    Placement,
    SceneFile,
    StartFacing,
    StartPose,
    StartRoom,
)

TRIES = 400
"""Draws for one object before the face counts as full."""
RESTARTS = 20
"""New beginnings with all objects before placing counts as impossible."""
DROP = 0.002
"""Metres above the face from which an object settles."""
EDGE = 0.01
"""Metres that an object's outline keeps from the edge of its face."""
DEEP, SPARE = 30.0, 3.0
"""Metres below the floor at which things wait that are away, and between them."""
ROBOT_RADIUS = 0.32
"""Metres: the base with a margin."""


@dataclass(frozen=True, slots=True)
class Outline:
    """Rectangle on the floor plan: what a thing covers, seen from above."""

    x: float
    y: float
    yaw: float
    half: tuple[float, float]
    """Half side lengths along its own axes, metres."""
    bottom: float
    """Height of its underside, metres: things on different boards of a shelf do not disturb one another."""
    top: float

    def corners(self) -> Float64:
        """(4, 2), map frame."""
        signs = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * self.half
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return signs @ np.array([[c, s], [-s, c]]) + (self.x, self.y)


def separation(a: Outline, b: Outline) -> float:
    """Gap between two outlines, metres: a lower bound from separating axes, negative if they overlap.

    It is inf where one lies above the other.
    """
    if a.bottom >= b.top or b.bottom >= a.top:
        return float("inf")
    gap = -np.inf
    corners_a, corners_b = a.corners(), b.corners()
    for yaw in (a.yaw, a.yaw + np.pi / 2, b.yaw, b.yaw + np.pi / 2):
        axis = np.array([np.cos(yaw), np.sin(yaw)])
        along_a, along_b = corners_a @ axis, corners_b @ axis
        gap = max(gap, along_b.min() - along_a.max(), along_a.min() - along_b.max())
    return float(gap)


def outline(extents: Float64, T_map_object: Float64) -> Outline:
    """Outline of a box with side lengths `extents` (3,) at a pose: exact if upright, else of its bounding box."""
    R, t = T_map_object[:3, :3], T_map_object[:3, 3]
    height = float(np.abs(R[2]) @ extents) / 2
    if R[2, 2] > 0.99:
        yaw, half = float(np.arctan2(R[1, 0], R[0, 0])), (float(extents[0]) / 2, float(extents[1]) / 2)
    else:
        reach = np.abs(R[:2]) @ extents / 2
        yaw, half = 0.0, (float(reach[0]), float(reach[1]))
    return Outline(float(t[0]), float(t[1]), yaw, half, float(t[2]) - height, float(t[2]) + height)


@dataclass(frozen=True, slots=True)
class Area:
    """A rectangle on a support face from which places are drawn."""

    T_map_face: Float64
    """(4, 4), origin in the face's centre, z up."""
    x: tuple[float, float]
    """Metres along the face's x."""
    y: tuple[float, float]
    size: Float64
    """(2,), of the whole face, metres."""

    def draw(self, extents: Float64, yaw_range: tuple[float, float], rng: np.random.Generator) -> Float64 | None:
        """(4, 4) T_map_object of an upright box standing in the area, or None if this draw sticks out over the edge."""
        x, y, yaw = rng.uniform(*self.x), rng.uniform(*self.y), rng.uniform(*yaw_range)
        T_face_object = transform_planar(x, y, yaw)
        T_face_object[2, 3] = extents[2] / 2 + DROP
        reach = np.abs(T_face_object[:2, :2]) @ extents[:2] / 2
        if np.any(np.abs((x, y)) + reach > self.size / 2 - EDGE):
            return None
        return self.T_map_face @ T_face_object


def support_area(
    world: StaticWorld, on: str, face: int, x: tuple[float, float] | None, y: tuple[float, float] | None
) -> Area:
    """The part of a support face that a scene file names.

    Raises:
        UnknownNameError: no such part. InvalidValueError: the part has no such face.
    """
    parts = {part.name: part for part in world.parts if part.supports}
    if on not in parts:
        raise UnknownNameError("support", on, parts)
    supports = parts[on].supports
    if face >= len(supports):
        raise InvalidValueError("face", face, f"0 to {len(supports) - 1} for '{on}'")
    T_part_face, size = supports[face]
    half = np.asarray(size, dtype=float) / 2
    return Area(
        parts[on].T_map_part @ T_part_face,
        x or (-float(half[0]), float(half[0])),
        y or (-float(half[1]), float(half[1])),
        2 * half,
    )


def place_objects(
    scene: SceneFile, world: StaticWorld, models: dict[str, ObjectModel], rng: np.random.Generator
) -> dict[str, Float64]:
    """Draw a pose (4, 4) for each object and clutter item, keeping to separations and faces.

    Args:
        scene: what to place.
        world: its supports.
        models: object name -> model.
        rng: decides.

    Raises:
        FileFormatError: a support that does not exist, or no room for an object after many tries.
    """
    things = [(f"objects.{k}", thing) for k, thing in enumerate(scene.objects)]
    things += [(f"clutter.{k}", thing) for k, thing in enumerate(scene.clutter)]
    areas: dict[str, Area | None] = {}
    for where, thing in things:
        try:
            areas[thing.id] = place_area(world, thing.place)
        except (UnknownNameError, InvalidValueError) as error:
            raise FileFormatError(scene.path, f"{where}.place", str(error)) from error
    # Large things first: they are the hardest to fit.
    ordered = sorted(things, key=lambda item: -float(np.prod(models[item[1].id].extents[:2])))
    stuck = ""
    for _ in range(RESTARTS):
        placed: dict[str, Float64] = {}
        for where, thing in ordered:
            if thing.place.away:
                placed[thing.id] = out_of_the_world(list(models).index(thing.id))
                continue
            others = [outline(models[name].extents, T) for name, T in placed.items()]
            pose = draw_place(thing.place, areas[thing.id], models[thing.id], others, rng)
            if pose is None:
                stuck = f"{where} ({thing.id})"
                break
            placed[thing.id] = pose
        else:
            return {thing.id: placed[thing.id] for _, thing in things}
    raise FileFormatError(
        scene.path, stuck, "found no free place; enlarge its region, lower its separation or remove other objects"
    )


def place_area(world: StaticWorld, place: Placement) -> Area | None:
    """The part of a support face on which a thing may be put; None if it is not put onto one.

    Raises:
        UnknownNameError, InvalidValueError: see `support_area`.
    """
    return support_area(world, place.on, place.face, place.x, place.y) if place.on else None


def out_of_the_world(number: int) -> Float64:
    """(4, 4) pose at which the thing of a number waits while it is away: far below the floor, and far from others."""
    return transform_xyz_rpy((SPARE * number, 0.0, -DEEP), (0.0, 0.0, 0.0))


def draw_place(
    place: Placement, area: Area | None, model: ObjectModel, others: Sequence[Outline], rng: np.random.Generator
) -> Float64 | None:
    """(4, 4) T_map_object of a thing that is not away, free of all others; None if none was found."""
    if place.pose is not None:
        return transform_xyz_rpy(place.pose.xyz, place.pose.rpy)
    assert area is not None
    for _ in range(TRIES):
        pose = area.draw(model.extents, place.yaw, rng)
        if pose is not None and is_free(outline(model.extents, pose), others, place.separation):
            return pose
    return None


def is_free(candidate: Outline, others: Sequence[Outline], gap: float) -> bool:
    """Whether the candidate keeps a gap (metres) from all others."""
    return all(separation(candidate, other) >= gap for other in others)


# ------------------------------------------------------------------------------------------------------------ the robot


def start_pose(scene: SceneFile, world: StaticWorld, rng: np.random.Generator) -> tuple[float, float, float]:
    """x, y, yaw of the base at time 0; raises FileFormatError if it is not free or names something unknown."""
    start = scene.robot.start
    if isinstance(start, StartPose):
        pose = (start.x, start.y, start.yaw)
    elif isinstance(start, StartFacing):
        pose = _facing(scene, start, world, rng)
    else:
        pose = _in_room(scene, start, world, rng)
    blocker = blocking(world.solid, pose[0], pose[1])
    if blocker is not None:
        raise FileFormatError(scene.path, "robot.start", f"the robot would stand in '{blocker}'")
    return pose


def _facing(
    scene: SceneFile, start: StartFacing, world: StaticWorld, rng: np.random.Generator
) -> tuple[float, float, float]:
    try:
        part = world.part(start.facing)
    except UnknownNameError as error:
        raise FileFormatError(scene.path, "robot.start.facing", str(error)) from error
    front = part.T_map_part[:2, 0]
    pose = (0.0, 0.0, 0.0)
    for _ in range(TRIES):
        x = part.extents[0] / 2 + rng.uniform(*start.distance)
        position = apply(part.T_map_part, np.array([[x, rng.uniform(*start.lateral), 0.0]]))[0]
        yaw = float(np.arctan2(-front[1], -front[0]) + rng.uniform(*start.yaw))
        pose = (float(position[0]), float(position[1]), yaw)
        if blocking(world.solid, pose[0], pose[1]) is None:
            break
    return pose


def _in_room(
    scene: SceneFile, start: StartRoom, world: StaticWorld, rng: np.random.Generator
) -> tuple[float, float, float]:
    rooms: dict[str, Room] = {room.name: room for room in world.rooms}
    if start.room not in rooms:
        raise FileFormatError(scene.path, "robot.start.room", str(UnknownNameError("room", start.room, rooms)))
    room = rooms[start.room]
    low, high = room.polygon.min(axis=0), room.polygon.max(axis=0)
    for _ in range(50 * TRIES):
        x, y = (float(value) for value in rng.uniform(low, high))
        if room_at([room], x, y) is not None and blocking(world.solid, x, y) is None:
            return x, y, float(rng.uniform(-np.pi, np.pi))
    raise FileFormatError(scene.path, "robot.start.room", f"found no free floor in room '{start.room}'")


def blocking(parts: Sequence[StaticPart], x: float, y: float) -> str | None:
    """Name of a part whose solid boxes would touch the robot at (x, y), or None."""
    for part in parts:
        for T_part_box, extents in part.collision:
            T = part.T_map_part @ T_part_box
            reach_z = float(np.abs(T[2, :3]) @ extents) / 2
            if T[2, 3] + reach_z < 0.02 or T[2, 3] - reach_z > 1.3:
                continue
            gap = np.abs(T[:3, :3].T @ (np.array([x, y, T[2, 3]]) - T[:3, 3])) - np.asarray(extents) / 2
            gap[np.argmax(np.abs(T[2, :3]))] = 0.0  # the axis that points up
            if float(np.linalg.norm(np.maximum(gap, 0.0))) < ROBOT_RADIUS:
                return part.name
    return None
