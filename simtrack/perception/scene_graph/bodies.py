"""Bodies, shapes at poses, and the arrays in which compiled code reads them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.boxes import OrientedBox
from simtrack.perception.scene_graph.kernels import World
from simtrack.perception.scene_graph.shapes import HeightField, Shape

if TYPE_CHECKING:
    from simtrack.perception.scene_graph.relations import RelationConfig


@dataclass(frozen=True, slots=True)
class Body:
    """A shape at a pose."""

    shape: Shape
    T_map: Float64
    """(4, 4), origin in the centre of the box."""

    @property
    def box(self) -> OrientedBox:
        """The body's oriented box."""
        return OrientedBox(self.T_map, self.shape.extents)


class BodyArrays:
    """Bodies in the arrays that the kernels read; rows (slots) are reused, arrays grow by doubling."""

    def __init__(self, shapes: Mapping[str, Shape], config: "RelationConfig", capacity: int = 16) -> None:
        self._config = config
        self._rows: dict[str, tuple[list[int], tuple[int, int]]] = {}
        self.shapes: dict[str, Shape] = {}
        self._fields: list[HeightField] = []
        self._stale = False
        self._free = list(range(capacity - 1, -1, -1))
        self.alive = np.zeros(capacity, dtype=np.bool_)
        self.world = _empty_world(capacity)
        for name, shape in shapes.items():
            self.declare(name, shape)

    def declare(self, kind: str, shape: Shape) -> None:
        """Make a shape known under a name."""
        first = len(self._fields)
        self._fields += [*shape.fields, *shape.supports]
        self._rows[kind] = (list(range(first, first + 6)), (first + 6, len(shape.supports)))
        self.shapes[kind] = shape
        self._stale = True

    def add(self, kind: str, T_map: Float64) -> int:
        """Put a body of a declared shape into a free slot."""
        self._refresh_fields()
        if not self._free:
            self._grow()
        slot = self._free.pop()
        shape, world = self.shapes[kind], self.world
        world.halves[slot] = 0.5 * np.asarray(shape.extents)
        world.radii[slot] = np.linalg.norm(world.halves[slot])
        world.reach[slot] = _reach(shape, self._config)
        world.layout[slot] = shape.layout
        world.interior_centres[slot] = 0.0 if shape.interior is None else shape.interior.centre
        world.interior_halves[slot] = 0.0 if shape.interior is None else 0.5 * shape.interior.extents
        world.fields[slot], world.supports[slot] = self._rows[kind]
        self.alive[slot] = True
        self.set_poses(np.array([slot]), np.asarray(T_map, dtype=float)[None])
        return slot

    def set_poses(self, slots: np.ndarray, T_map: Float64) -> Float64:
        """Move slots (S,) to poses (S, 4, 4); returns by how many metres the centres moved (S,)."""
        shift = np.sqrt(((T_map[:, :3, 3] - self.world.centres[slots]) ** 2).sum(axis=1))
        self.world.centres[slots] = T_map[:, :3, 3]
        self.world.rotations[slots] = T_map[:, :3, :3]
        return shift

    def remove(self, slot: int) -> None:
        """Free a slot."""
        self.alive[slot] = False
        self._free.append(slot)

    def _grow(self) -> None:
        old, size = self.world, len(self.alive)
        world = _empty_world(2 * size)
        for name in _PER_SLOT:
            getattr(world, name)[:size] = getattr(old, name)
        self.world = world._replace(**{name: getattr(old, name) for name in World._fields if name not in _PER_SLOT})
        self.alive = np.concatenate([self.alive, np.zeros(size, dtype=np.bool_)])
        self._free = list(range(2 * size - 1, size - 1, -1))

    def _refresh_fields(self) -> None:
        if not self._stale:
            return
        sizes = [field.heights.size for field in self._fields]
        starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        shapes = [(*f.heights.shape, s) for f, s in zip(self._fields, starts, strict=True)]
        self.world = self.world._replace(
            field_rotations=np.array([f.T_entity_field[:3, :3] for f in self._fields], dtype=float),
            field_origins=np.array([f.T_entity_field[:3, 3] for f in self._fields], dtype=float),
            field_sizes=np.array([f.size for f in self._fields], dtype=float),
            field_shapes=np.array(shapes, dtype=np.int32),
            field_ranges=np.array([_range(f.heights) for f in self._fields], dtype=float),
            heights=np.concatenate([np.ascontiguousarray(f.heights, dtype=float).ravel() for f in self._fields]),
        )
        self._stale = False


def _reach(shape: Shape, config: "RelationConfig") -> float:
    """Radius about a body's centre outside of which nothing is related to it in the live variant."""
    half = 0.5 * np.asarray(shape.extents, dtype=float)
    reach = float(np.linalg.norm(half)) + config.near_range + config.leave_margin
    for support in shape.supports:
        corner = np.linalg.norm(support.T_entity_field[:3, 3]) + 0.5 * np.linalg.norm(support.size)
        reach = max(reach, float(corner) + config.on_distance + config.leave_margin)
    if shape.layout:
        return reach
    if not config.projection:
        return np.inf
    for axis in range(3):
        far = half.copy()
        far[axis] *= 1.0 + 2.0 * config.projection_factor
        reach = max(reach, float(np.linalg.norm(far)) + config.leave_margin)
    return reach


def _range(heights: Float64) -> tuple[float, float, int]:
    """Lowest and highest height of a field, and the number of its cells where there is a surface."""
    surface = heights[heights > -np.inf]
    return (float(surface.min()), float(surface.max()), len(surface)) if len(surface) else (0.0, 0.0, 0)


_PER_SLOT: Mapping[str, tuple[type, tuple[int, ...]]] = {
    "centres": (np.float64, (3,)),
    "rotations": (np.float64, (3, 3)),
    "halves": (np.float64, (3,)),
    "interior_centres": (np.float64, (3,)),
    "interior_halves": (np.float64, (3,)),
    "layout": (np.bool_, ()),
    "reach": (np.float64, ()),
    "radii": (np.float64, ()),
    "fields": (np.int32, (6,)),
    "supports": (np.int32, (2,)),
}
"""Those arrays of `World` that have a row a slot: their type, and the shape of a row."""


def _empty_world(capacity: int) -> World:
    return World(
        **{name: np.zeros((capacity, *shape), dtype=kind) for name, (kind, shape) in _PER_SLOT.items()},
        field_rotations=np.zeros((0, 3, 3)),
        field_origins=np.zeros((0, 3)),
        field_sizes=np.zeros((0, 2)),
        field_shapes=np.zeros((0, 3), dtype=np.int32),
        field_ranges=np.zeros((0, 3)),
        heights=np.zeros(0),
    )
