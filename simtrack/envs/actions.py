"""What an agent does: speeds of base, head and torso, each between -1 and 1, and how they become commands."""

from dataclasses import dataclass, replace

import numpy as np

from simtrack.contracts import Command, Float32
from simtrack.objects.tiago import HEAD_PAN, HEAD_TILT, TORSO, tiago

AXES: dict[str, float] = {"linear": 0.9, "angular": 1.0, "pan": 2.0, "tilt": 2.0, "torso": 0.07}
"""Axis of an action -> its speed at 1: m/s forward, rad/s to the left, rad/s of the head to the left and up, m/s up."""

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


def vector(moves: dict[str, float]) -> Float32:
    """(5,) action with the given axes, the others 0."""
    return np.array([moves.get(axis, 0.0) for axis in AXES], np.float32)


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

    def apply(self, action: Float32) -> Command:
        """The command of an action (5,) in the order of `AXES`; what is beyond -1 or 1 counts as -1 or 1."""
        speeds = np.clip(np.asarray(action, dtype=float), -1.0, 1.0) * list(AXES.values())
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
