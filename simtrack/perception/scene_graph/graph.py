"""The live scene graph: rooms, static map and believed objects, brought up to date frame by frame.

Only pairs in which something moved are evaluated again. What stands on or in a supporter that moves is carried along
until it is observed itself (see `motion`).
"""

from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from itertools import chain, compress
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import BELIEVED, Float64, MapEntity, Relation, Room, StaticMap, Status, Track
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.transforms import inverse, transform
from simtrack.objects.semantics import SEMANTIC_CLASSES
from simtrack.perception.scene_graph import kernels
from simtrack.perception.scene_graph.bodies import Body, BodyArrays
from simtrack.perception.scene_graph.facts import Entity, Layer, SceneFacts
from simtrack.perception.scene_graph.history import History
from simtrack.perception.scene_graph.motion import NONE, Motion, stacked
from simtrack.perception.scene_graph.pairs import PairTable
from simtrack.perception.scene_graph.relations import RELATIONS, RelationConfig
from simtrack.perception.scene_graph.rooms import RoomIndex
from simtrack.perception.scene_graph.shapes import ModelLike, Shape, map_entity_shape, model_shapes

if TYPE_CHECKING:
    from simtrack.perception.scene_graph.surfaces import Surfaces
    from simtrack.raycast import TriangleMesh
    from simtrack.raycast.distance import MeshDistance


@dataclass(frozen=True, slots=True)
class SceneGraphConfig:
    """Settings of `SceneGraph`."""

    relations: RelationConfig = field(default_factory=RelationConfig)
    """Definitions of the relations."""
    move_translation: float = 0.001
    """Metres: smaller motions since the last evaluation leave an object's relations as they are."""
    move_rotation: float = float(np.radians(0.2))
    """Radians, likewise."""
    carry_translation: float = 0.005
    """Metres: motion of a supporter, since its unseen child was last seen, from which the child is carried along.
    Smaller ones may be the jitter of the supporter's estimate."""
    carry_rotation: float = float(np.radians(1.5))
    """Radians, likewise."""

    def __post_init__(self) -> None:
        for name in ("move_translation", "move_rotation", "carry_translation", "carry_rotation"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InvalidValueError(f"SceneGraphConfig.{name}", getattr(self, name), "a finite number >= 0")


class SceneGraph(SceneFacts):
    """Scene graph of a static map and of tracked objects.

    Args:
        static_map: entities and rooms; None for a graph of objects alone.
        models: object models by name, as `Track.class_name` gives it.
        config: settings.
        parents: background taxonomy, semantic class -> direct superclasses; None for that of `simtrack.objects`.
    """

    def __init__(
        self,
        static_map: StaticMap | None,
        models: Mapping[str, ModelLike],
        config: SceneGraphConfig | None = None,
        *,
        parents: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self.config = config or SceneGraphConfig()
        rules = self.config.relations
        super().__init__(
            stamp=-1,
            entities={},
            shapes={},
            rooms=static_map.rooms if static_map else (),
            history=History(),
            config=rules,
            parents=SEMANTIC_CLASSES if parents is None else parents,
            models={name: model.semantic_class for name, model in models.items()},
        )
        self.status = Status.OK
        """How the last update fared: DEGRADED if a track's pose was not finite, STALE if its stamp was not newer."""
        self._model_shapes = model_shapes(models)
        self._arrays = BodyArrays({f"model:{name}": shape for name, shape in self._model_shapes.items()}, rules)
        capacity = len(self._arrays.alive)
        self._pairs = PairTable()
        self._parameters = rules.parameters()
        self._motion = Motion(
            capacity,
            move=(self.config.move_translation, self.config.move_rotation),
            carry=(self.config.carry_translation, self.config.carry_rotation),
        )
        self._parent = np.full(capacity, NONE)
        self._names: dict[int, str] = {}
        self._slots: dict[str, int] = {}
        self._tracked = np.zeros(capacity, dtype=np.bool_)
        self._tracks: dict[str, dict[int, int]] = {name: {} for name in models}
        self._keys: dict[int, tuple[str, int]] = {}
        self._last_keys: tuple[list[str], list[int]] = [], []
        """Classes and numbers of the tracks of the last frame; their slots need not be looked up again."""
        self._last_slots = np.zeros(0, dtype=np.int64)
        self._near_below: dict[int, set[int]] = {}
        self._near_above: dict[int, set[int]] = {}
        self._inside: dict[int, set[int]] = {}
        self._stands_on: dict[int, set[int]] = {}
        self._room_index = RoomIndex(list(self.rooms.values()))
        self._room_names = list(self.rooms)
        self._room = np.full(capacity, NONE)
        self._static: dict[int, MapEntity] = {}
        self._table: dict[str, Entity] | None = None
        self._sources = static_map, models
        self._surfaces: Surfaces | None = None
        if static_map is not None:
            self._add_static_map(static_map)

    # --------------------------------------------------------------------------------------------------------- update

    def update(self, stamp: int, tracks: Sequence[Track]) -> Set[Relation]:
        """Bring the graph up to date with the tracks of one frame and return the relations that hold.

        Only believed tracks enter; tracks that are not in `tracks` any more leave. A track whose pose is not finite
        keeps its last one (status DEGRADED). A `stamp` (nanoseconds) that is not newer changes nothing (status STALE).

        Raises:
            UnknownNameError: a track's class is none of the models.
        """
        if stamp <= self.stamp:
            self.status = Status.STALE
            return self.relations
        believed = [track for track in tracks if track.status in BELIEVED]
        keys = [track.class_name for track in believed], [track.id for track in believed]
        poses = stacked([track.T_map_object for track in believed])
        observed = np.array([track.last_seen >= track.stamp for track in believed], dtype=np.bool_)
        same = keys == self._last_keys
        slots = self._last_slots if same else self._find(keys)
        self.stamp = stamp
        self.status = Status.OK
        self._table = None
        self._last_keys = [], []

        if not same:
            self._retire(stamp, slots)
        if not np.isfinite(poses).all():
            self.status = Status.DEGRADED
            finite = np.all(np.isfinite(poses.reshape(-1, 16)), axis=1)
            believed = list(compress(believed, finite))
            slots, poses, observed = slots[finite], poses[finite], observed[finite]
        if not same:
            self._admit(believed, slots, poses)
        self._relate(stamp, self._motion.place(slots, poses, observed))
        self._motion.remember(slots, observed, self._parent)
        if self.status is Status.OK:
            self._last_keys, self._last_slots = keys, slots
        return self.relations

    def _find(self, keys: tuple[list[str], list[int]]) -> np.ndarray:
        """Slots of tracks given by their classes and numbers, NONE for new ones."""
        try:
            found = [self._tracks[name].get(number, NONE) for name, number in zip(*keys, strict=True)]
        except KeyError as error:
            raise UnknownNameError("object model", str(error.args[0]), self._tracks) from None
        return np.array(found, dtype=np.int64)

    def _retire(self, stamp: int, slots: np.ndarray) -> None:
        """Take out the tracks that are not among those in `slots` any more."""
        gone = np.setdiff1d(np.nonzero(self._tracked)[0], slots)
        if not len(gone):
            return
        self._apply(stamp, self._pairs.drop(self._arrays.world, np.nonzero(self._arrays.alive)[0], gone))
        self._motion.leave(gone)
        self._tracked[gone] = False
        for slot in gone.tolist():
            self._enter_room(stamp, slot, NONE)
            self._parent[slot] = NONE
            self._arrays.remove(slot)
            class_name, number = self._keys.pop(slot)
            del self._tracks[class_name][number]
            del self._slots[self._names.pop(slot)]

    def _admit(self, tracks: Sequence[Track], slots: np.ndarray, poses: Float64) -> None:
        """Give the new ones among the tracks a slot."""
        for row in np.nonzero(slots == NONE)[0].tolist():
            class_name, number = tracks[row].class_name, tracks[row].id
            if number not in self._tracks[class_name]:
                name = f"{class_name}-{number}"
                slot = self._add(name, f"model:{class_name}", poses[row])
                self._tracks[class_name][number] = slot
                self._keys[slot] = class_name, number
                self._tracked[slot] = True
                self.known[name] = (class_name, self.models[class_name], Layer.OBJECT)
            slots[row] = self._tracks[class_name][number]

    def _relate(self, stamp: int, moved: np.ndarray) -> None:
        """Evaluate the pairs of the slots that moved."""
        if not len(moved):
            return
        world, alive = self._arrays.world, self._arrays.alive
        shift = self._arrays.set_poses(moved, self._motion.T[moved])
        self._motion.evaluated(moved)
        self._apply(stamp, self._pairs.update(world, np.nonzero(alive)[0], moved, shift, self._parameters))
        self._assign_rooms(stamp, moved)

    # ------------------------------------------------------------------------------------------------------ relations

    def _apply(self, stamp: int, changes: np.ndarray) -> None:
        """Write changed masks, rows of (subject, reference, old, new), to the history and the support tree."""
        restless: set[int] = set()
        unsettled: set[int] = set()
        for a, b, old, new in changes.tolist():
            difference = old ^ new
            if difference >> kernels.ON & 1:
                self._near_below[a] ^= {b}
                self._near_above[b] ^= {a}
                restless.add(a)
            if difference >> kernels.IN & 1:
                self._inside[a] ^= {b}
                unsettled.add(a)
            for r in range(1, kernels.COUNT):
                if difference >> r & 1:
                    self._write(stamp, Relation(self._names[a], RELATIONS[r], self._names[b]), bool(new >> r & 1))
        # What stands on something that came to stand on something else may be affected, too.
        restless = restless.union(*(self._near_above[a] for a in restless))
        for a in restless:
            self._settle(stamp, a)
        for a in restless | unsettled:
            self._parent[a] = self._find_parent(a)

    def _settle(self, stamp: int, slot: int) -> None:
        """Publish `on` for the direct supporters: not for what only lies within reach below one of them."""
        below = self._near_below[slot]
        direct = {b for b in below if not any(b in self._near_below[c] for c in below if c != b)}
        for other in direct ^ self._stands_on[slot]:
            self._write(stamp, Relation(self._names[slot], "on", self._names[other]), other in direct)
        self._stands_on[slot] = direct

    def _write(self, stamp: int, relation: Relation, holds: bool) -> None:
        if holds:
            self.recorded.begin(stamp, relation)
        else:
            self.recorded.end(stamp, relation)

    def _find_parent(self, slot: int) -> int:
        """The supporter with the least gap, else the innermost container, else none; the present one is preferred."""
        world, current = self._arrays.world, int(self._parent[slot])
        holding = self._stands_on[slot] or self._inside[slot]
        holding = {b for b in holding if not self._descends(b, slot)}
        if not holding:
            return NONE
        if current in holding:
            return current
        if len(holding) == 1:
            return holding.pop()
        return min(holding, key=lambda b: (kernels.clearance(world, slot, b), float(world.radii[b]), b))

    def _descends(self, slot: int, ancestor: int) -> bool:
        while slot >= 0:
            if slot == ancestor:
                return True
            slot = int(self._parent[slot])
        return False

    def _assign_rooms(self, stamp: int, slots: np.ndarray) -> None:
        if not self.rooms:
            return
        current = self._room[slots]
        leave_margin = self.relation_config.leave_margin
        rooms = self._room_index.assign(self._motion.T[slots, :3, 3], current, leave_margin)
        for row in np.nonzero(rooms != current)[0].tolist():
            slot, room = int(slots[row]), int(rooms[row])
            if slot not in self._static or self._static[slot].room not in self.rooms:
                self._enter_room(stamp, slot, room)

    def _enter_room(self, stamp: int, slot: int, room: int) -> None:
        current = int(self._room[slot])
        if current != room:
            if current != NONE:
                self.recorded.end(stamp, Relation(self._names[slot], "in", self._room_names[current]))
            if room != NONE:
                self.recorded.begin(stamp, Relation(self._names[slot], "in", self._room_names[room]))
        self._room[slot] = room

    # ------------------------------------------------------------------------------------------------------- entities

    @property
    def entities(self) -> Mapping[str, Entity]:
        """Entities that exist now, by name: rooms, static map, objects."""
        if self._table is None:
            rooms = (_room_entity(room) for room in self.rooms.values())
            self._table = {e.name: e for e in chain(rooms, (self._entity(slot) for slot in self._names))}
        return self._table

    def carried_pose(self, child: str) -> Float64 | None:
        """(4, 4) pose that an object has if it moves with what it stood on or in when last seen; None if on nothing."""
        if child not in self._slots:
            raise UnknownNameError("object", child, self._slots)
        return self._motion.carried_pose(self._slots[child])

    def mesh_distance(self, a: str, b: str, max_distance: float = np.inf, *, depth: bool = False) -> "MeshDistance":
        """Distance of the surfaces of two entities at their current poses; `distance` is that of their boxes.

        Surfaces are those of the models and, for static entities, what the survey shows within their boxes. They are
        made at the first question that needs them.

        Args:
            a: name of an object or a static entity.
            b: likewise.
            max_distance: metres; what is farther apart is not looked for.
            depth: measure how deep surfaces that cross are in one another.

        Raises:
            UnknownNameError: one of them does not exist now, or is a room.
        """
        from simtrack.raycast.distance import mesh_distance

        T_a, T_b = self.body(a).T_map, self.body(b).T_map
        return mesh_distance(self._surface(a), T_a, self._surface(b), T_b, max_distance, depth=depth)

    def _surface(self, name: str) -> "TriangleMesh":
        from simtrack.perception.scene_graph.surfaces import Surfaces

        if self._surfaces is None:
            self._surfaces = Surfaces(*self._sources)
        class_name, _, layer = self.known[name]
        return self._surfaces.of_model(class_name) if layer is Layer.OBJECT else self._surfaces.of_entity(name)

    def body(self, name: str) -> Body:
        """Shape and pose of a static entity or an object."""
        if name in self._slots:
            return Body(self._shape(name), self._motion.T[self._slots[name]].copy())
        return super().body(name)

    def _entity(self, slot: int) -> Entity:
        name = self._names[slot]
        class_name, semantic_class, layer = self.known[name]
        parent, room = int(self._parent[slot]), self._room_name(slot)
        T_map = self._motion.T[slot].copy()
        if parent >= 0:
            T_parent_entity = inverse(self._motion.T[parent]) @ T_map
        elif room:
            T_parent_entity = inverse(_room_entity(self.rooms[room]).T_map) @ T_map
        else:
            T_parent_entity = T_map
        return Entity(
            name=name,
            layer=layer,
            class_name=class_name,
            semantic_class=semantic_class,
            T_map=T_map,
            extents=np.asarray(self._shape(name).extents, dtype=float),
            room=room,
            parent=self._names[parent] if parent >= 0 else room,
            T_parent_entity=T_parent_entity,
            carried=bool(self._motion.carried[slot]),
        )

    def _room_name(self, slot: int) -> str:
        return self._room_names[self._room[slot]] if self._room[slot] != NONE else ""

    def _shape(self, name: str) -> Shape:
        class_name, _, layer = self.known[name]
        return self._model_shapes[class_name] if layer is Layer.OBJECT else self._shapes[name]

    def _bodies(self) -> tuple[BodyArrays, dict[str, int]]:
        return self._arrays, self._slots

    def _add(self, name: str, kind: str, T_map: Float64) -> int:
        slot = self._arrays.add(kind, T_map)
        capacity = len(self._arrays.alive)
        if slot >= len(self._parent):
            self._motion.grow(capacity)
            more = capacity - len(self._parent)
            self._parent = np.concatenate([self._parent, np.full(more, NONE)])
            self._room = np.concatenate([self._room, np.full(more, NONE)])
            self._tracked = np.concatenate([self._tracked, np.zeros(more, dtype=np.bool_)])
        self._motion.enter(slot, T_map)
        self._names[slot], self._slots[name] = name, slot
        self._near_below[slot], self._near_above[slot] = set(), set()
        self._inside[slot], self._stands_on[slot] = set(), set()
        self._room[slot] = NONE
        return slot

    def _add_static_map(self, static_map: StaticMap) -> None:
        """Enter rooms and map entities and relate them once; their relations hold from stamp 0."""
        rules = self.relation_config
        names = Counter(thing.name for thing in (*static_map.rooms, *static_map.entities))
        for name, count in names.items():
            if count > 1:
                raise InvalidValueError("StaticMap names", name, "names that are unique among rooms and entities")
        for room in static_map.rooms:
            self.known[room.name] = ("room", "room", Layer.ROOM)
        for entity in static_map.entities:
            self._shapes[entity.name] = map_entity_shape(entity, rules.container_classes, rules.layout_classes)
            self._arrays.declare(f"map:{entity.name}", self._shapes[entity.name])
        for entity in static_map.entities:
            slot = self._add(entity.name, f"map:{entity.name}", np.asarray(entity.T_map_entity, dtype=float))
            self.known[entity.name] = (entity.semantic_class, entity.semantic_class, Layer.STATIC)
            self._static[slot] = entity
            if entity.room in self.rooms:
                self._enter_room(0, slot, self._room_names.index(entity.room))
        self._relate(0, np.array(sorted(self._static), dtype=np.int64))


def _room_entity(room: Room) -> Entity:
    polygon = np.asarray(room.polygon, dtype=float)
    lower, upper = polygon.min(axis=0), polygon.max(axis=0)
    T_map = transform(None, (*(0.5 * (lower + upper)), room.floor + 0.5 * room.height))
    return Entity(
        name=room.name,
        layer=Layer.ROOM,
        class_name="room",
        semantic_class="room",
        T_map=T_map,
        extents=np.array([*(upper - lower), room.height]),
        room="",
        parent="",
        T_parent_entity=T_map,
    )
