"""What an agent does, each number between -1 and 1: speeds of base, head and torso, and what the gripper shall do."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from simtrack.contracts import Command, Float32, Float64
from simtrack.objects.tiago import HEAD_PAN, HEAD_TILT, TORSO, tiago

AXES: dict[str, float] = {"linear": 0.9, "angular": 1.0, "pan": 2.0, "tilt": 2.0, "torso": 0.07}
"""Axis of an action -> its speed at 1: m/s forward, rad/s to the left, rad/s of the head to the left and up, m/s up."""

MACROS = ("grasp", "place", "articulate", "take", "insert")
"""What an arm can be asked for: to grasp from above and place, to open and close doors and drawers, to take from the
front and insert. Each that a task knows has an axis; the largest that is above `TRIGGER` begins."""
WHERE: dict[str, tuple[float, float]] = {
    "x": (0.2, 1.2), "y": (-0.7, 0.7), "z": (0.2, 1.4), "heading": (-np.pi, np.pi),
}  # fmt: skip
"""Axis -> what -1 and 1 stand for: a place in the base frame, metres, and a heading about the vertical, radians (where
something is articulated: its joint's position, radians or metres)."""
TRIGGER = 0.5


class Outcome(StrEnum):
    """How a macro fared."""

    IDLE = "idle"
    BUSY = "busy"
    DONE = "done"
    NO_SPOT = "no-spot"
    """The object has no flat spot on top."""
    OUT_OF_REACH = "out-of-reach"
    MISSED = "missed"
    """The cup came down where the object is believed to be, and touched nothing."""
    UNKNOWN = "unknown"
    """Nothing is believed to be where something shall be grasped."""
    FULL = "full"
    """The cup holds something already."""
    EMPTY = "empty"
    """There is nothing in the cup to be placed."""
    SLIPPED = "slipped"
    """What was held came off on the way."""


MOVES: dict[str, dict[str, float]] = {
    "stay": {},
    "forward": {"linear": 0.6},
    "backward": {"linear": -0.4},
    "turn left": {"angular": 0.7},
    "turn right": {"angular": -0.7},
    "look left": {"pan": 0.6},
    "look right": {"pan": -0.6},
    "look up": {"tilt": 0.5},
    "look down": {"tilt": -0.5},
    "torso up": {"torso": 1.0},
    "torso down": {"torso": -1.0},
}
"""Name of a discrete action -> the axes that it moves; all others stay still."""


def axes(macros: Sequence[str] = ()) -> tuple[str, ...]:
    """Names of the numbers of an action: speeds, and for an arm that can be asked for something what and where."""
    return (*AXES, *macros, *WHERE) if macros else tuple(AXES)


def vector(moves: dict[str, float], macros: Sequence[str] = ()) -> Float32:
    """(A,) action with the given axes, the others 0."""
    return np.array([moves.get(axis, 0.0) for axis in axes(macros)], np.float32)


@dataclass(frozen=True, slots=True)
class Request:
    """What the gripper is asked to do."""

    macro: str
    """One of `MACROS`."""
    position: Float64
    """(3,), base frame, metres: of the believed object that shall be grasped, or where its origin shall be put; near
    the door that shall move."""
    heading: float = 0.0
    """Radians, base frame: that which an object shall have where it is put. Of a door or drawer: the position that its
    joint shall have, radians or metres."""

    def action(self, macros: Sequence[str]) -> Float32:
        """(A,) the action that asks for it, of a task with these macros; what is out of range is cut off."""
        values = dict(zip(WHERE, (*self.position.tolist(), self.heading), strict=True))
        values["heading"] = float(np.arctan2(np.sin(self.heading), np.cos(self.heading)))
        scaled = {name: 2.0 * (values[name] - low) / (high - low) - 1.0 for name, (low, high) in WHERE.items()}
        return np.clip(vector({self.macro: 1.0, **scaled}, macros), -1.0, 1.0)


def request_of(action: Float32, macros: Sequence[str]) -> Request | None:
    """What an action (A,) of a task with these macros asks the arm for, if anything."""
    values = dict(zip(axes(macros), np.clip(np.asarray(action, dtype=float), -1.0, 1.0).tolist(), strict=True))
    wanted = {macro: values[macro] for macro in macros if values[macro] > TRIGGER}
    if not wanted:
        return None
    *position, heading = (low + (values[name] + 1.0) / 2.0 * (high - low) for name, (low, high) in WHERE.items())
    return Request(max(wanted, key=lambda macro: wanted[macro]), np.array(position), heading)


@dataclass(frozen=True, slots=True)
class _Limits:
    """Range of a joint, rad or m."""

    low: float
    high: float

    def moved(self, target: float, by: float) -> float:
        return float(np.clip(target + by, self.low, self.high))


class Steering:
    """Turns actions into commands: base speeds are held, head and torso speeds move the targets of their servos."""

    def __init__(self, start: Command, seconds: float) -> None:
        """`start`: posture at the beginning; `seconds`: how long each action holds."""
        joints = {joint.name: _Limits(joint.lower, joint.upper) for joint in tiago().joints}
        self._pan, self._tilt, self._torso = joints[HEAD_PAN], joints[HEAD_TILT], joints[TORSO]
        self.start, self.seconds = replace(start, linear=0.0, angular=0.0), seconds
        self.command = self.start
        """The last one that was given."""

    def reset(self) -> None:
        """Begin anew with the posture of the start."""
        self.command = self.start

    def apply(self, action: Float32, busy: bool = False) -> Command:
        """The command of an action (A,) that begins with `AXES`; what is beyond -1 or 1 counts as -1 or 1.

        While the arm is `busy`, base and torso stay where they are.
        """
        speeds = np.clip(np.asarray(action, dtype=float)[: len(AXES)], -1.0, 1.0) * list(AXES.values())
        if busy:
            speeds[[0, 1, 4]] = 0.0
        linear, angular, pan, tilt, torso = speeds.tolist()
        last, step = self.command, self.seconds
        self.command = Command(
            linear, angular, self._pan.moved(last.head_pan, pan * step), self._tilt.moved(last.head_tilt, tilt * step),
            self._torso.moved(last.torso, torso * step),
        )  # fmt: skip
        return self.command

    def towards(self, wanted: Command) -> Float32:
        """(5,) the action that comes closest to a command."""
        last, step = self.command, self.seconds
        speeds = (
            wanted.linear, wanted.angular, (wanted.head_pan - last.head_pan) / step,
            (wanted.head_tilt - last.head_tilt) / step, (wanted.torso - last.torso) / step,
        )  # fmt: skip
        return np.clip(np.array(speeds) / list(AXES.values()), -1.0, 1.0).astype(np.float32)
