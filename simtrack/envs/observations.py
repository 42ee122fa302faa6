"""What an agent sees as arrays of fixed size: objects with their uncertainty, relations, the robot, images; and back.

A slot is a row that one object keeps while it is believed. Truth comes in the same layout as belief, so that a policy
can be fed with either.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from gymnasium import spaces

from simtrack.contracts import (
    NANOSECONDS,
    Belief,
    CameraIntrinsics,
    JointEstimate,
    JointState,
    Localization,
    Presegmentation,
    RegionOfInterest,
    RgbdFrame,
    Status,
    Track,
    TrackStatus,
)
from simtrack.envs.actions import Outcome
from simtrack.evaluation.record import graph_name
from simtrack.geometry.kinematics import KinematicTree
from simtrack.geometry.transforms import (
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
    transform_planar,
    yaw_of,
)
from simtrack.objects.tiago import CAMERA, HEAD_PAN, HEAD_TILT, TORSO
from simtrack.perception.scene_graph import RELATIONS
from simtrack.perception.scene_graph.history import about

Arrays: TypeAlias = dict[str, np.ndarray]

MODES = ("state", "belief", "rgbd")
"""``state``: the truth; ``belief``: what the stack makes of its sensors; ``rgbd``: the robot's camera."""
PLACE = 200.0
"""Metres: bound of map coordinates."""
SPEED = 20.0
"""m/s and rad/s: bound of velocities."""
AGE = 600.0
"""Seconds: bound of ages."""
VARIANCE = 100.0
"""m^2 or rad^2: bound of the elements of covariances."""
OPEN = 7.0
"""Radians or metres: bound of the positions of doors and drawers."""
REGIONS = 12
"""Regions of unexplained measurements that are reported at most, the largest first."""
STATUSES = tuple(TrackStatus)
ANSWERS = (Status.OK, Status.AMBIGUOUS, Status.LOST)
"""Statuses of the localization that are told apart; any other counts as a predicted pose."""
OUTCOMES = tuple(Outcome)
JOINTS = (HEAD_PAN, HEAD_TILT, TORSO)


def _box(shape: tuple[int, ...], low: float, high: float, dtype: type = np.float32) -> spaces.Box:
    return spaces.Box(low, high, shape, dtype)


@dataclass(frozen=True, slots=True)
class Layout:
    """Sizes and names behind the arrays."""

    classes: tuple[str, ...]
    """Names of the object models, in the order of the one-hot rows."""
    slots: int
    """Objects that there is room for."""
    furniture: tuple[str, ...]
    """Names of the furniture that relations refer to, after the slots."""
    seconds: float
    """Longest episode."""
    intrinsics: CameraIntrinsics
    """Of the robot's camera."""
    depth_range: float
    """Metres: the largest depth that the camera reads."""
    macros: tuple[str, ...] = ()
    """What the arm can be asked for."""
    articulations: tuple[str, ...] = ()
    """Names of the map's doors and drawers."""

    def space(self, mode: str) -> spaces.Dict:
        """The space of one mode; finite bounds, metres, radians, row 0 on top."""
        if mode == "rgbd":
            size = self.intrinsics.height, self.intrinsics.width
            image = {"rgb": _box((*size, 3), 0, 255, np.uint8), "depth": _box(size, 0.0, self.depth_range)}
            return spaces.Dict({**image, **self._robot()})
        n, references = self.slots, self.slots + len(self.furniture)
        entries = {
            "mask": _box((n,), 0, 1, np.int8),
            "id": _box((n,), 0, 2**31 - 1, np.int32),
            "class": _box((n, len(self.classes)), 0, 1, np.int8),
            "position": _box((n, 3), -PLACE, PLACE),
            "rotation": _box((n, 4), -1.0, 1.0),
            "velocity": _box((n, 6), -SPEED, SPEED),
            "covariance": _box((n, 6, 6), -VARIANCE, VARIANCE),
            "status": _box((n, len(STATUSES)), 0, 1, np.int8),
            "age": _box((n,), 0.0, AGE),
            "visible": _box((n,), 0.0, 1.0),
            "moving": _box((n,), 0, 1, np.int8),
            "score": _box((n,), 0.0, 1.0),
            "relations": _box((n, references, len(RELATIONS)), 0, 1, np.int8),
            "unexplained": _box((1,), 0.0, 1.0),
            "regions": _box((REGIONS, 3), -PLACE, PLACE),
            "regions_size": _box((REGIONS, 3), 0.0, PLACE),
            "regions_mask": _box((REGIONS,), 0, 1, np.int8),
            "base": _box((4,), -PLACE, PLACE),
            "base_deviation": _box((3,), 0.0, np.sqrt(VARIANCE)),
            "localization": _box((len(ANSWERS) + 1,), 0, 1, np.int8),
        }
        if self.articulations:
            count = (len(self.articulations),)
            entries["articulation_position"] = _box(count, -OPEN, OPEN)
            entries["articulation_deviation"] = _box(count, 0.0, OPEN)
            entries["articulation_age"] = _box(count, 0.0, AGE)
            entries["articulation_seen"] = _box(count, 0, 1, np.int8)
        return spaces.Dict({**entries, **self._robot()})

    def _robot(self) -> dict[str, spaces.Space]:
        entries: dict[str, spaces.Space] = {
            "joints": _box((3,), -np.pi, np.pi),
            "speed": _box((2,), -SPEED, SPEED),
            "time": _box((1,), 0.0, self.seconds + 1.0),
        }
        if self.macros:
            entries["macro"] = _box((len(OUTCOMES),), 0, 1, np.int8)
            entries["holding"] = _box((len(self.classes),), 0, 1, np.int8)
        return entries


@dataclass(frozen=True, slots=True)
class Proprioception:
    """What the robot feels of itself."""

    joints: JointState
    """Encoders."""
    linear: float
    """m/s, by the wheels."""
    angular: float
    """rad/s, by the wheels."""
    macro: Outcome = Outcome.IDLE
    """Of the arm."""
    holding: str | None = None
    """Class of what the cup is believed to hold, as long as its vacuum holds."""


class Encoder:
    """Turns beliefs into the arrays of a layout; remembers which slot a track has."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self._slots: dict[int, int] = {}
        self._class = {name: k for k, name in enumerate(layout.classes)}
        self._status = {status: k for k, status in enumerate(STATUSES)}
        self._relation = {name: k for k, name in enumerate(RELATIONS)}
        self._furniture = {name: layout.slots + k for k, name in enumerate(layout.furniture)}
        self._unexplained = 0.0
        self._segmented: dict[str, int] = {}
        entries = layout.space("belief").items()
        self._shapes = [(key, box.shape, box.dtype) for key, box in entries if isinstance(box, spaces.Box)]

    def reset(self) -> None:
        """Forget which slot a track has."""
        self._slots.clear()
        self._segmented.clear()
        self._unexplained = 0.0

    def encode(self, belief: Belief, felt: Proprioception) -> Arrays:
        """Fresh arrays of the mode ``belief`` (or ``state``, if the belief is the truth)."""
        out: Arrays = {key: np.zeros(shape, dtype) for key, shape, dtype in self._shapes}
        kept = self._assign(belief.tracks)
        for slot, track in kept:
            self._write(out, slot, track, belief.stamp)
        for key, limit in (("position", PLACE), ("velocity", SPEED), ("covariance", VARIANCE)):
            np.clip(out[key], -limit, limit, out=out[key])
        self._relate(out, belief, kept)
        self._articulate(out, belief)
        self._look(out, belief)
        where = belief.localization
        x, y = where.T_map_base[:2, 3]
        yaw = yaw_of(where.T_map_base)
        out["base"][:] = np.clip((x, y, np.cos(yaw), np.sin(yaw)), -PLACE, PLACE)
        deviation = np.sqrt(np.maximum(np.diag(where.covariance)[[0, 1, 5]], 0.0))
        out["base_deviation"][:] = np.minimum(deviation, np.sqrt(VARIANCE))
        answer = ANSWERS.index(where.status) if where.status in ANSWERS else len(ANSWERS)
        out["localization"][answer] = 1
        out.update(encode_robot(felt, belief.stamp, self.layout))
        return out

    def _assign(self, tracks: Sequence[Track]) -> list[tuple[int, Track]]:
        """Slot of each track: its old one, else the first free one; believed ones first, what finds no room is left."""
        alive = {track.id for track in tracks}
        self._slots = {number: slot for number, slot in self._slots.items() if number in alive}
        free = sorted(set(range(self.layout.slots)) - set(self._slots.values()), reverse=True)
        for track in sorted(tracks, key=lambda t: (not t.believed, t.id)):
            if track.id not in self._slots and free and track.class_name in self._class:
                self._slots[track.id] = free.pop()
        return [(self._slots[track.id], track) for track in tracks if track.id in self._slots]

    def _write(self, out: Arrays, slot: int, track: Track, stamp: int) -> None:
        out["mask"][slot] = 1
        out["id"][slot] = track.id
        out["class"][slot, self._class[track.class_name]] = 1
        out["position"][slot] = track.T_map_object[:3, 3]
        out["rotation"][slot] = quaternion_from_rotation(track.T_map_object[:3, :3])
        out["velocity"][slot] = track.velocity
        out["covariance"][slot] = track.covariance
        out["status"][slot, self._status[track.status]] = 1
        out["age"][slot] = min(max(stamp - track.last_seen, 0) / NANOSECONDS, AGE)
        out["visible"][slot] = min(max(track.visible_fraction, 0.0), 1.0)
        out["moving"][slot] = track.moving
        out["score"][slot] = min(max(track.score, 0.0), 1.0)

    def _relate(self, out: Arrays, belief: Belief, kept: Sequence[tuple[int, Track]]) -> None:
        rows = {graph_name(track): slot for slot, track in kept}
        columns = rows | self._furniture
        for subject, row in rows.items():
            for relation in about(belief.relations, subject):
                if relation.reference in columns:
                    out["relations"][row, columns[relation.reference], self._relation[relation.name]] = 1

    def _articulate(self, out: Arrays, belief: Belief) -> None:
        if not self.layout.articulations:
            return
        joints = {joint.name: joint for joint in belief.joints}
        for k, name in enumerate(self.layout.articulations):
            joint = joints[name]
            out["articulation_position"][k] = np.clip(joint.position, -OPEN, OPEN)
            out["articulation_deviation"][k] = min(float(np.sqrt(joint.variance)), OPEN)
            if joint.last_seen is not None:
                out["articulation_seen"][k] = 1
                out["articulation_age"][k] = min(max(belief.stamp - joint.last_seen, 0) / NANOSECONDS, AGE)

    def _look(self, out: Arrays, belief: Belief) -> None:
        """What nothing explains; between segmented images the share of the last one holds."""
        if belief.camera is not None:
            self._unexplained = 1.0 - belief.camera.reduction
        out["unexplained"][0] = self._unexplained
        fresh = [seen for seen in (belief.camera, belief.lidar) if seen is not None and self._is_new(seen)]
        largest = sorted((region for seen in fresh for region in seen.regions), key=lambda r: -r.count)[:REGIONS]
        for k, region in enumerate(largest):
            out["regions"][k] = np.clip(region.centre, -PLACE, PLACE)
            out["regions_size"][k] = np.minimum(region.extents, PLACE)
            out["regions_mask"][k] = 1

    def _is_new(self, seen: Presegmentation) -> bool:
        """Whether this is the first step that sees a segmentation: a scan's answer stays until the next."""
        last, self._segmented[seen.sensor] = self._segmented.get(seen.sensor), seen.stamp
        return last != seen.stamp


def encode_robot(felt: Proprioception, stamp: int, layout: Layout) -> Arrays:
    """Arrays of what the robot feels of itself."""
    positions = dict(zip(felt.joints.names, felt.joints.positions.tolist(), strict=True))
    joints = np.array([positions.get(name, 0.0) for name in JOINTS], np.float32)
    speed = np.clip(np.array([felt.linear, felt.angular], np.float32), -SPEED, SPEED)
    out: Arrays = {
        "joints": np.clip(joints, -np.float32(np.pi), np.float32(np.pi)),
        "speed": speed,
        "time": np.array([stamp / NANOSECONDS], np.float32),
    }
    if layout.macros:
        out["macro"] = np.array([felt.macro is outcome for outcome in OUTCOMES], np.int8)
        out["holding"] = np.array([felt.holding == name for name in layout.classes], np.int8)
    return out


def encode_image(frame: RgbdFrame, layout: Layout) -> Arrays:
    """Arrays of the mode ``rgbd``, without the robot's."""
    assert frame.rgb is not None
    depth = np.minimum(frame.depth, np.float32(layout.depth_range)).astype(np.float32)
    return {"rgb": frame.rgb.copy(), "depth": depth}


def decode(arrays: Arrays, layout: Layout, robot: KinematicTree) -> tuple[Belief, JointState]:
    """The belief that an observation of the modes ``belief`` or ``state`` stands for, as agents read it.

    What the arrays do not hold (images, the measurements behind a region, relations) is empty.
    """
    stamp = round(float(arrays["time"][0]) * NANOSECONDS)
    x, y, c, s = arrays["base"].astype(float)
    T_map_base = transform_planar(x, y, float(np.arctan2(s, c)))
    answer = int(np.argmax(arrays["localization"]))
    deviation = arrays["base_deviation"].astype(float)
    covariance = np.diag(np.square([deviation[0], deviation[1], 0.0, 0.0, 0.0, deviation[2]]))
    status = ANSWERS[answer] if answer < len(ANSWERS) else Status.NO_DATA
    joints = JointState(stamp, JOINTS, arrays["joints"].astype(float))
    T_map_camera = T_map_base @ robot.pose(CAMERA, dict(zip(JOINTS, joints.positions.tolist(), strict=True)))
    tracks = tuple(_track(arrays, int(slot), layout, stamp, T_map_camera) for slot in np.flatnonzero(arrays["mask"]))
    localization = Localization(stamp, T_map_base, covariance, status)
    seen = _regions(arrays, stamp)
    doors = tuple(_joint(arrays, k, name, stamp) for k, name in enumerate(layout.articulations))
    return Belief(stamp, localization, T_map_camera, tracks, seen, None, frozenset(), joints=doors), joints


def _joint(arrays: Arrays, k: int, name: str, stamp: int) -> JointEstimate:
    seen = bool(arrays["articulation_seen"][k])
    last = stamp - round(float(arrays["articulation_age"][k]) * NANOSECONDS) if seen else None
    status = TrackStatus.TENTATIVE if last is None else TrackStatus.CONFIRMED
    variance = float(arrays["articulation_deviation"][k]) ** 2
    return JointEstimate(name, stamp, float(arrays["articulation_position"][k]), variance, 0.0, last, status)


def _regions(arrays: Arrays, stamp: int) -> Presegmentation | None:
    """The unexplained regions of one step; None if none is reported."""
    found = np.flatnonzero(arrays["regions_mask"])
    if not len(found):
        return None
    centres, sizes = arrays["regions"].astype(float), arrays["regions_size"].astype(float)
    regions = tuple(RegionOfInterest(stamp, np.zeros(4), centres[k], sizes[k], 0, "camera") for k in found)
    nothing = np.zeros(0, bool)
    return Presegmentation(stamp, nothing, 0, nothing.astype(np.int32), regions, "camera")


def _track(arrays: Arrays, slot: int, layout: Layout, stamp: int, T_map_camera: np.ndarray) -> Track:
    T = transform(
        rotation_from_quaternion(arrays["rotation"][slot].astype(float)), arrays["position"][slot].astype(float)
    )
    return Track(
        id=int(arrays["id"][slot]),
        class_name=layout.classes[int(np.argmax(arrays["class"][slot]))],
        status=STATUSES[int(np.argmax(arrays["status"][slot]))],
        stamp=stamp,
        T_map_object=T,
        covariance=arrays["covariance"][slot].astype(float),
        T_camera_object=inverse(T_map_camera) @ T,
        velocity=arrays["velocity"][slot].astype(float),
        last_seen=stamp - round(float(arrays["age"][slot]) * NANOSECONDS),
        visible_fraction=float(arrays["visible"][slot]),
        moving=bool(arrays["moving"][slot]),
        residual=0.0,
        score=float(arrays["score"][slot]),
    )
