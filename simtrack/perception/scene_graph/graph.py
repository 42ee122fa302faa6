"""The live scene graph: rooms, static map and believed objects, brought up to date frame by frame.

Only pairs in which something moved are evaluated again. What stands on or in a supporter that moves is carried along
until it is observed itself: T_supporter_child = T_map_supporter^-1 T_map_child is kept from when the child was last
seen, and T_map_child = T_map_supporter T_supporter_child since then: the tracking paper's T_m^c = T_m^t T_t^c (III.D).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from simtrack.contracts import Float64, MapEntity, Relation, Room, StaticMap, Status, Track
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.transforms import angle_between, inverse, transform
from simtrack.objects.semantics import SEMANTIC_CLASSES
from simtrack.perception.scene_graph import kernels
from simtrack.perception.scene_graph.facts import Entity, Layer, SceneFacts
from simtrack.perception.scene_graph.history import History
from simtrack.perception.scene_graph.relations import (
    RELATIONS,
    Body,
    BodyArrays,
    RelationConfig,
    room_margins,
)
from simtrack.perception.scene_graph.shapes import ModelLike, Shape, map_entity_shape, model_shape

_NONE, _HELD = -1, -2
"""Supporter slots: none; gone while it carried the child, which stays where it was carried to."""


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
        self._model_shapes = {name: model_shape(model) for name, model in models.items()}
        self._arrays = BodyArrays({f"model:{name}": shape for name, shape in self._model_shapes.items()}, rules)
        capacity = len(self._arrays.alive)
        self._bits = np.zeros((capacity, capacity), dtype=np.uint16)
        self._T = np.tile(np.eye(4), (capacity, 1, 1))
        self._T_evaluated = self._T.copy()
        self._T_seen = self._T.copy()
        self._T_supporter_seen = self._T.copy()
        self._supporter_seen = np.full(capacity, _NONE)
        self._parent = np.full(capacity, _NONE)
        self._carried = np.zeros(capacity, dtype=np.bool_)
        self._names: dict[int, str] = {}
        self._slots: dict[str, int] = {}
        self._tracks: dict[tuple[str, int], int] = {}
        self._rests_on: dict[int, set[int]] = {}
        self._stands_on: dict[int, set[int]] = {}
        self._room: dict[int, str] = {}
        self._static: dict[int, MapEntity] = {}
        self._table: dict[str, Entity] | None = None
        if static_map is not None:
            self._add_static_map(static_map)

    # --------------------------------------------------------------------------------------------------------- update

    def update(self, stamp: int, tracks: Sequence[Track]) -> frozenset[Relation]:
        """Bring the graph up to date with the tracks of one frame and return the relations that hold.

        Only believed tracks enter; tracks that are not in `tracks` any more leave. A track whose pose is not finite
        keeps its last one (status DEGRADED). A `stamp` (nanoseconds) that is not newer changes nothing (status STALE).

        Raises:
            UnknownNameError: a track's class is none of the models.
        """
        if stamp <= self.stamp:
            self.status = Status.STALE
            return self.relations
        believed = [track for track in tracks if track.believed]
        poses = np.array([track.T_map_object for track in believed], dtype=float).reshape(-1, 4, 4)
        finite = np.all(np.isfinite(poses), axis=(1, 2))
        self.status = Status.OK if finite.all() else Status.DEGRADED
        self._require_models(believed)
        self.stamp = stamp
        self._table = None

        self._retire(stamp, {(track.class_name, track.id) for track in believed})
        fresh, slots, observed = self._admit(believed, poses, finite)
        self._place(slots, poses[finite], observed)
        moved = self._find_moved(fresh)
        if len(moved):
            self._relate(stamp, moved)
        self._remember(slots[observed])
        return self.relations

    def _require_models(self, tracks: Sequence[Track]) -> None:
        for track in tracks:
            if track.class_name not in self._model_shapes:
                raise UnknownNameError("object model", track.class_name, self._model_shapes)

    def _retire(self, stamp: int, keys: set[tuple[str, int]]) -> None:
        """Take out the tracks that are no longer believed."""
        for key in [key for key in self._tracks if key not in keys]:
            slot = self._tracks.pop(key)
            gone = np.nonzero(self._bits[slot] | self._bits[:, slot])[0]
            rows = [(a, b, self._bits[a, b], 0) for o in gone for a, b in ((slot, o), (o, slot)) if self._bits[a, b]]
            self._apply(stamp, np.array(rows, dtype=np.int64).reshape(-1, 4))
            self._bits[slot, :] = self._bits[:, slot] = 0
            self._enter_room(stamp, slot, "")
            children = np.nonzero(self._supporter_seen == slot)[0]
            self._supporter_seen[children] = np.where(self._carried[children], _HELD, _NONE)
            self._supporter_seen[slot] = self._parent[slot] = _NONE
            self._carried[slot] = False
            self._arrays.remove(slot)
            del self._slots[self._names.pop(slot)]

    def _admit(
        self, tracks: Sequence[Track], poses: Float64, finite: np.ndarray
    ) -> tuple[list[int], np.ndarray, np.ndarray]:
        """Slots of the tracks with a finite pose; which slots are new, and which tracks were observed in this frame."""
        fresh: list[int] = []
        slots: list[int] = []
        observed: list[bool] = []
        for track, pose, usable in zip(tracks, poses, finite, strict=True):
            if not usable:
                continue
            key = (track.class_name, track.id)
            slot = self._tracks.get(key)
            seen = track.last_seen >= track.stamp
            if slot is None:
                name, model = f"{track.class_name}-{track.id}", track.class_name
                slot = self._add(name, f"model:{model}", pose)
                self._tracks[key] = slot
                self.known[name] = (model, self.models[model], Layer.OBJECT)
                fresh.append(slot)
            slots.append(slot)
            observed.append(seen)
        return fresh, np.array(slots, dtype=np.int64), np.array(observed, dtype=np.bool_)

    def _place(self, slots: np.ndarray, poses: Float64, observed: np.ndarray) -> None:
        """Take the tracks' poses, and those of supporters that moved for what could not be seen."""
        held = ~observed & (self._supporter_seen[slots] == _HELD)
        self._T[slots[~held]] = poses[~held]
        self._carried[slots] = held
        pending = {int(slot) for slot in slots[~observed & (self._supporter_seen[slots] >= 0)]}
        while pending:
            self._carry(pending.pop(), pending)

    def _carry(self, slot: int, pending: set[int]) -> None:
        """Move a child with its supporter, the supporter first if it is a carried child itself."""
        supporter = int(self._supporter_seen[slot])
        if supporter in pending:
            pending.remove(supporter)
            self._carry(supporter, pending)
        T_now, T_then = self._T[supporter], self._T_supporter_seen[slot]
        shift = float(np.linalg.norm(T_now[:3, 3] - T_then[:3, 3]))
        turn = angle_between(T_now[:3, :3], T_then[:3, :3])
        if shift > self.config.carry_translation or turn > self.config.carry_rotation:
            self._T[slot] = T_now @ inverse(T_then) @ self._T_seen[slot]
            self._carried[slot] = True

    def _find_moved(self, fresh: Sequence[int]) -> np.ndarray:
        """Slots whose pose differs from the one last evaluated by more than the tolerance."""
        slots = np.fromiter(self._tracks.values(), dtype=np.int64, count=len(self._tracks))
        change = self._T[slots, :3] - self._T_evaluated[slots, :3]
        shifted = (change[:, :, 3] ** 2).sum(axis=1) > self.config.move_translation**2
        # |R - S|^2 = 8 sin^2(angle / 2) in the Frobenius norm.
        turned = (change[:, :, :3] ** 2).sum(axis=(1, 2)) > 8.0 * np.sin(0.5 * self.config.move_rotation) ** 2
        return slots[shifted | turned | np.isin(slots, fresh)]

    def _relate(self, stamp: int, moved: np.ndarray) -> None:
        """Evaluate the pairs of the slots that moved."""
        self._T_evaluated[moved] = self._T[moved]
        self._arrays.set_poses(moved, self._T[moved])
        flags = np.zeros(len(self._arrays.alive), dtype=np.bool_)
        flags[moved] = True
        slots = np.nonzero(self._arrays.alive)[0]
        parameters = self.relation_config.parameters()
        changes = kernels.update_pairs(self._arrays.world, slots, flags, self._bits, parameters)
        self._apply(stamp, changes)
        self._assign_rooms(stamp, moved)

    def _remember(self, observed: np.ndarray) -> None:
        """Keep how observed children lie to their supporters."""
        parents = self._parent[observed]
        self._T_seen[observed] = self._T[observed]
        self._supporter_seen[observed] = parents
        standing = parents >= 0
        self._T_supporter_seen[observed[standing]] = self._T[parents[standing]]

    # ------------------------------------------------------------------------------------------------------ relations

    def _apply(self, stamp: int, changes: np.ndarray) -> None:
        """Write changed masks, rows of (subject, reference, old, new), to the history and the support tree."""
        restless: set[int] = set()
        unsettled: set[int] = set()
        for a, b, old, new in changes.tolist():
            difference = old ^ new
            if difference >> kernels.ON & 1:
                self._rests_on[a].symmetric_difference_update({b})
                restless.add(a)
            if difference >> kernels.IN & 1:
                unsettled.add(a)
            for r in range(1, kernels.COUNT):
                if difference >> r & 1:
                    self._write(stamp, Relation(self._names[a], RELATIONS[r], self._names[b]), bool(new >> r & 1))
        if restless:
            # What stands on something that came to stand on something else may be affected, too.
            restless |= {a for a, below in self._rests_on.items() if not below.isdisjoint(restless)}
        for a in restless:
            self._settle(stamp, a)
        for a in restless | unsettled:
            self._parent[a] = self._find_parent(a)

    def _settle(self, stamp: int, slot: int) -> None:
        """Publish `on` for the direct supporters: not for what only lies within reach below one of them."""
        below = self._rests_on[slot]
        direct = {b for b in below if not any(b in self._rests_on[c] for c in below if c != b)}
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
        holding = self._stands_on[slot] or set(np.nonzero(self._bits[slot] >> kernels.IN & 1)[0].tolist())
        holding = {b for b in holding if not self._descends(b, slot)}
        if not holding:
            return _NONE
        if current in holding:
            return current
        return min(holding, key=lambda b: (kernels.clearance(world, slot, b), float(world.radii[b]), b))

    def _descends(self, slot: int, ancestor: int) -> bool:
        while slot >= 0:
            if slot == ancestor:
                return True
            slot = int(self._parent[slot])
        return False

    def _assign_rooms(self, stamp: int, slots: np.ndarray) -> None:
        if not self.rooms or not len(slots):
            return
        rooms = list(self.rooms.values())
        points = self._T[slots, :3, 3]
        margins = np.stack([_room_margins(points, room) for room in rooms], axis=1)
        for row, slot in enumerate(slots.tolist()):
            if slot in self._static and self._static[slot].room in self.rooms:
                continue
            current = self._room.get(slot, "")
            best = int(np.argmax(margins[row]))
            stays = [i for i, room in enumerate(rooms) if room.name == current]
            if stays and margins[row, stays[0]] >= -self.relation_config.leave_margin:
                continue
            self._enter_room(stamp, slot, rooms[best].name if margins[row, best] >= 0.0 else "")

    def _enter_room(self, stamp: int, slot: int, room: str) -> None:
        current = self._room.get(slot, "")
        if current != room:
            if current:
                self.recorded.end(stamp, Relation(self._names[slot], "in", current))
            if room:
                self.recorded.begin(stamp, Relation(self._names[slot], "in", room))
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
        slot = self._slots[child]
        supporter = int(self._supporter_seen[slot])
        if supporter < 0:
            return None
        return self._T[supporter] @ inverse(self._T_supporter_seen[slot]) @ self._T_seen[slot]

    def body(self, name: str) -> Body:
        """Shape and pose of a static entity or an object."""
        if name in self._slots:
            return Body(self._shape(name), self._T[self._slots[name]].copy())
        return super().body(name)

    def _entity(self, slot: int) -> Entity:
        name = self._names[slot]
        class_name, semantic_class, layer = self.known[name]
        parent, room = int(self._parent[slot]), self._room.get(slot, "")
        T_map = self._T[slot].copy()
        if parent >= 0:
            T_parent_entity = inverse(self._T[parent]) @ T_map
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
            carried=bool(self._carried[slot]),
        )

    def _shape(self, name: str) -> Shape:
        class_name, _, layer = self.known[name]
        return self._model_shapes[class_name] if layer is Layer.OBJECT else self._shapes[name]

    def _bodies(self) -> tuple[BodyArrays, dict[str, int]]:
        return self._arrays, self._slots

    def _add(self, name: str, kind: str, T_map: Float64) -> int:
        slot = self._arrays.add(kind, T_map)
        if slot >= len(self._bits):
            self._grow(len(self._arrays.alive))
        self._T[slot] = self._T_evaluated[slot] = T_map
        self._names[slot], self._slots[name] = name, slot
        self._rests_on[slot], self._stands_on[slot] = set(), set()
        self._room[slot] = ""
        return slot

    def _grow(self, capacity: int) -> None:
        old = len(self._bits)
        bits = np.zeros((capacity, capacity), dtype=np.uint16)
        bits[:old, :old] = self._bits
        self._bits = bits
        for attribute in ("_T", "_T_evaluated", "_T_seen", "_T_supporter_seen"):
            grown = np.tile(np.eye(4), (capacity, 1, 1))
            grown[:old] = getattr(self, attribute)
            setattr(self, attribute, grown)
        nothing = np.full(capacity - old, _NONE)
        self._supporter_seen = np.concatenate([self._supporter_seen, nothing])
        self._parent = np.concatenate([self._parent, nothing])
        self._carried = np.concatenate([self._carried, np.zeros(capacity - old, dtype=np.bool_)])

    def _add_static_map(self, static_map: StaticMap) -> None:
        """Enter rooms and map entities and relate them once; their relations hold from stamp 0."""
        rules = self.relation_config
        names = [room.name for room in static_map.rooms] + [entity.name for entity in static_map.entities]
        for name in names:
            if names.count(name) > 1:
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
                self._enter_room(0, slot, entity.room)
        slots = np.array(sorted(self._static), dtype=np.int64)
        if len(slots):
            self._relate(0, slots)


def _room_margins(points: Float64, room: Room) -> Float64:
    """(N,) metres from the walls, -inf above or below the room."""
    level = (points[:, 2] >= room.floor - 0.5) & (points[:, 2] <= room.floor + room.height)
    return np.where(level, room_margins(points, room), -np.inf)


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
