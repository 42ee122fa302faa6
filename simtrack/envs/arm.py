"""Where the arm can bring the suction cup: inverse kinematics by damped least squares."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
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
        self._links = [next(link for link in chain if link.joint is joints[name]) for name in ARM]
        self._low = np.array([joints[name].lower for name in ARM])
        self._high = np.array([joints[name].upper for name in ARM])

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
            q = np.clip(q, self._low, self._high)
        home = q.copy()
        for _ in range(config.iterations):
            pose, J = self._linearised(q, torso)
            if level and direction is not None:
                error, close = self._pose_error(pose, position, direction)
            else:
                error, close = self._error(pose, position, yaw, DOWN if direction is None else direction)
            if close:
                return dict(zip(ARM, q.tolist(), strict=True))
            if direction is not None and not level:  # turning about the cup's axis is free
                J[3:] -= np.outer(direction, direction @ J[3:])
            J = J[: len(error)]
            JJ = J @ J.T + config.damping**2 * np.eye(len(J))
            change = J.T @ np.linalg.solve(JJ, error)
            free = np.eye(len(q)) - J.T @ np.linalg.solve(JJ, J)
            change += config.posture * free @ (home - q)
            change *= min(1.0, config.step / max(float(np.abs(change).max()), 1e-9))
            q = np.clip(q + change, self._low, self._high)
        return None

    def _error(self, pose: Float64, position: Float64, yaw: float | None, direction: Float64) -> tuple[Float64, bool]:
        """What is missing: metres, tilt, and, if asked for, turn about z instead of its z; and whether it is little."""
        gap = position - pose[:3, 3]
        axis = pose[:3, 0]
        tilt = np.cross(axis, direction)
        ahead = float(axis @ direction)
        if ahead < 0.0:  # pointing the other way: any way round
            tilt = tilt / max(float(np.linalg.norm(tilt)), 1e-6)
        close = float(np.linalg.norm(gap)) < self.config.translation
        close &= ahead > 0.0 and float(np.linalg.norm(tilt)) < self.config.tilt
        if yaw is not None:
            turn = yaw - float(np.arctan2(pose[1, 1], pose[0, 1]))
            tilt[2] = float(np.arctan2(np.sin(turn), np.cos(turn)))
            close &= abs(tilt[2]) < 2.0 * self.config.tilt
        elif direction is DOWN:
            tilt = tilt[:2]
        return np.array([*gap, *tilt]), bool(close)

    def _pose_error(self, pose: Float64, position: Float64, direction: Float64) -> tuple[Float64, bool]:
        """What is missing to a pose that looks along a horizontal direction, z up: metres, rotation vector."""
        wanted = np.stack([direction, [-direction[1], direction[0], 0.0], [0.0, 0.0, 1.0]], axis=1)
        gap = position - pose[:3, 3]
        turn = 0.5 * np.cross(pose[:3, :3].T, wanted.T).sum(axis=0)
        if float(np.trace(pose[:3, :3].T @ wanted)) < 1.0:  # more than a right angle: any way round
            turn = turn / max(float(np.linalg.norm(turn)), 1e-6)
        near = float(np.linalg.norm(gap)) < self.config.translation
        close = near and float(np.linalg.norm(turn)) < self.config.tilt and float(pose[:3, 0] @ direction) > 0.0
        return np.array([*gap, *turn]), close

    def _linearised(self, q: Float64, torso: float) -> tuple[Float64, Float64]:
        """The cup's pose and its (6, 7) Jacobian: translation, then rotation, base frame."""
        poses = self._tree.forward({TORSO: torso, **dict(zip(ARM, q.tolist(), strict=True))})
        cup = poses[GRIPPER] @ transform(translation=(CUP[0], CUP[1], CUP[2]))
        J = np.empty((6, len(q)))
        for k, link in enumerate(self._links):
            assert link.joint is not None
            axis = poses[link.name][:3, :3] @ link.joint.axis
            J[:3, k] = np.cross(axis, cup[:3, 3] - poses[link.name][:3, 3])
            J[3:, k] = axis
        return cup, J
