"""Where the arm can bring the suction cup: inverse kinematics by damped least squares."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.envs.arm_kernels import (
    DOWNWARDS,
    FIXED,
    LEVELLED,
    POINTING,
    PRISMATIC,
    REVOLUTE,
    TURNED,
    solve,
)
from simtrack.geometry.kinematics import Joint, KinematicTree
from simtrack.geometry.transforms import transform
from simtrack.objects.tiago import GRIPPER, TORSO, TUCKED
from simtrack.simulation.suction import CUP

SHOULDER = 0.138
"""Metres from the base's centre to the arm's first axis, along x."""
ARM = tuple(f"arm_{k}_joint" for k in range(1, 8))
READY: Mapping[str, float] = {
    "arm_1_joint": 0.0, "arm_2_joint": -1.05, "arm_3_joint": 0.0, "arm_4_joint": 1.5, "arm_5_joint": 0.0,
    "arm_6_joint": 1.12, "arm_7_joint": 0.0,
}  # fmt: skip
"""Posture before the chest, above tables, with the cup pointing down: the search for joint angles begins here."""
LEVEL: Mapping[str, float] = {
    "arm_1_joint": 0.0, "arm_2_joint": -0.7, "arm_3_joint": 0.0, "arm_4_joint": 1.6, "arm_5_joint": 0.0,
    "arm_6_joint": -0.9, "arm_7_joint": 0.0,
}  # fmt: skip
"""Posture before the chest with the cup pointing forward, the elbow up: the search begins here if the cup shall not
point down."""
KINDS = {"fixed": FIXED, "revolute": REVOLUTE, "prismatic": PRISMATIC}
DOWN = np.array([0.0, 0.0, -1.0])
RAISED: Mapping[str, float] = {**READY, "arm_2_joint": -1.08, "arm_4_joint": 1.1, "arm_6_joint": 1.3}
"""The same 11 cm higher, with the cup tilted by 15 degrees: things are carried over others."""
UPWARDS = ("arm_2_joint", "arm_4_joint", "arm_6_joint")
"""Joints that lead from `READY` to `RAISED`."""
ASIDE: Mapping[str, float] = {**RAISED, "arm_1_joint": -1.57}
"""The same beside the robot: on the way from the tucked posture, over the edge of a table."""


@dataclass(frozen=True, slots=True)
class IkConfig:
    """How joint angles are sought."""

    iterations: int = 60
    damping: float = 0.03
    """Of the least squares: large where the arm is stretched."""
    translation: float = 5e-4
    """Metres: near enough."""
    tilt: float = np.deg2rad(1.0)
    """Radians off the wanted direction: near enough."""
    step: float = 0.25
    """Largest change of a joint an iteration, radians."""
    posture: float = 0.02
    """How strongly free motion is drawn to the posture that the search began with."""


class ArmKinematics:
    """The arm of a robot, from its own description."""

    def __init__(self, robot: KinematicTree, config: IkConfig | None = None) -> None:
        self.config = config or IkConfig()
        links = {link.name: link for link in robot.links}
        chain, name = [], GRIPPER
        while links[name].parent:
            chain.append(links[name])
            name = links[name].parent
        self._tree = KinematicTree((links[name], *reversed(chain)))
        joints: dict[str, Joint] = {joint.name: joint for joint in self._tree.joints}
        self._limits = np.array([[joints[name].lower for name in ARM], [joints[name].upper for name in ARM]])
        moved = self._tree.links[1:]
        values = {name: number for number, name in enumerate((*ARM, TORSO))}
        own = [link.joint for link in moved]
        self._chain = (
            np.array([link.T_parent_joint for link in moved]),
            np.array([KINDS[joint.kind] if joint is not None else FIXED for joint in own], np.int32),
            np.array([joint.axis if joint is not None else (0.0, 0.0, 1.0) for joint in own]),
            np.array([values.get(joint.name, -1) if joint is not None else -1 for joint in own], np.int32),
            transform(translation=(CUP[0], CUP[1], CUP[2])),
        )

    def cup(self, joints: Mapping[str, float]) -> Float64:
        """(4, 4) T_base_cup: origin in the cup's rim, x in the direction of sucking."""
        return self._tree.forward(joints)[GRIPPER] @ transform(translation=(CUP[0], CUP[1], CUP[2]))

    def solve(
        self,
        position: Float64,
        torso: float,
        start: Mapping[str, float] | None = None,
        yaw: float | None = None,
        direction: Float64 | None = None,
        level: bool = False,
    ) -> dict[str, float] | None:
        """Joint angles that bring the cup to a place, pointing straight down or in another direction.

        Args:
            position: (3,), of the rim, base frame, metres.
            torso: lift, metres.
            start: joint angles, radians, to begin with; the answer is one near them. `READY` or `LEVEL` if None.
            yaw: heading of the cup's y axis about the vertical, radians, base frame; any if None. Only if it points
                down.
            direction: (3,), unit vector in which the cup sucks, base frame; down if None.
            level: with a direction that is horizontal: the cup's z axis shall point up.

        Returns:
            Joint name -> radians, or None if the place is out of reach.
        """
        config = self.config
        fresh = start is None or start is READY
        start = (READY if direction is None else LEVEL) if start is None else start
        q = np.array([start.get(name, TUCKED[name]) for name in ARM])
        if fresh:  # turned towards the place, which is where most answers lie
            q[0] = np.arctan2(position[1], position[0] - SHOULDER)
            wrist = 0.0 if yaw is None else q[0] + np.pi / 2 - yaw  # the cup's y axis points to the left in READY
            q[6] = np.arctan2(np.sin(wrist), np.cos(wrist))
            q = np.clip(q, *self._limits)
        if direction is None:
            mode, direction = DOWNWARDS if yaw is None else TURNED, DOWN
        else:
            mode = LEVELLED if level else POINTING
        settings = np.array([config.damping, config.translation, config.tilt, config.step, config.posture])
        found, q = solve(
            *self._chain, q, torso, self._limits, np.asarray(position, float), np.asarray(direction, float),
            0.0 if yaw is None else yaw, mode, config.iterations, settings,
        )  # fmt: skip
        return dict(zip(ARM, q.tolist(), strict=True)) if found else None
