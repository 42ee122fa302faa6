"""A settled room as a static world: what a robot drives through, surveys and looks at."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import box_mesh, concatenate, transformed
from simtrack.geometry.transforms import inverse, transform
from simtrack.simulation.building.parts import StaticPart, StaticWorld, Support
from simtrack.simulation.building.rooms.fittings import Cleat
from simtrack.simulation.building.rooms.physics import RoomEntity, settled_room
from simtrack.simulation.building.rooms.plan import ALL_KINDS, RoomKind

SMALL = 0.6
"""Metres: what is smaller along all sides is clutter and too small for a survey."""


@dataclass(frozen=True, slots=True)
class RoomConfig:
    """Which room is built."""

    kind: RoomKind | Literal["any"] = "any"
    """One of `ALL_KINDS`, or ``any``: drawn from the seed."""

    def __post_init__(self) -> None:
        if self.kind not in (*ALL_KINDS, "any"):
            raise InvalidValueError("RoomConfig.kind", self.kind, f"any, {', '.join(ALL_KINDS)}")


def room_world(seed: int, config: RoomConfig | None = None) -> StaticWorld:
    """The room of a seed at rest, everything in it fixed where it came to rest.

    Args:
        seed: of the room.
        config: its kind.
    """
    config = RoomConfig() if config is None else config
    kind = None if config.kind == "any" else config.kind
    room = settled_room(seed, kind)
    things = [entity for entity in room.entities if entity.placed is not None]
    cleats = [_cleat_part(cleat) for cleat in room.plan.cleats]
    return StaticWorld((*room.plan.shell, *cleats, *(_part(entity) for entity in things)), (room.plan.room,))


def _cleat_part(cleat: Cleat) -> StaticPart:
    """Rail and lip as a fixed part."""
    mesh = concatenate([transformed(box_mesh(size), T) for T, size in cleat.boxes])
    T_map_part = cleat.boxes[0][0].copy()
    T_map_part[:3, 3] = mesh.bounds.mean(axis=0)
    local = transformed(mesh, inverse(T_map_part))
    return StaticPart(
        name=f"{cleat.thing}-cleat",
        semantic_class="wall",
        mesh=local,
        T_map_part=T_map_part,
        extents=local.extents,
        room="room",
        survey="omitted",
        collision=tuple((inverse(T_map_part) @ T, size) for T, size in cleat.boxes),
        group="structure",
    )


def _part(entity: RoomEntity) -> StaticPart:
    """An entity as a fixed part: x of a part is its front, -y that of a model."""
    assert entity.placed is not None
    model, T_map_model = entity.placed.model, entity.placed.T_map_model
    mesh, poses = model.mesh(entity.placed.positions), model.part_poses(entity.placed.positions)
    low, high = mesh.bounds
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    T_model_part = transform(turn, (low + high) / 2)
    T_part_model = inverse(T_model_part)
    collision = []
    for part in model.parts:
        for convex in part.convex:
            a, b = convex.bounds
            collision.append((T_part_model @ poses[part.name] @ transform(None, (a + b) / 2), b - a))
    small = bool((high - low).max() < SMALL)
    return StaticPart(
        name=entity.name,
        semantic_class=entity.semantic_class,
        mesh=transformed(mesh, T_part_model),
        T_map_part=T_map_model @ T_model_part,
        extents=(high - low)[[1, 0, 2]],
        supports=tuple(_support(T_part_model @ poses[s.part], s.centre, s.size) for s in model.supports),
        room="room",
        survey="omitted" if small else "as-is",
        collision=tuple(collision),
        group="clutter" if small else "furniture",
    )


def _support(T_part_here: Float64, centre: Float64, size: Float64) -> Support:
    return T_part_here @ transform(None, centre), size
