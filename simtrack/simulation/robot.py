"""The robot as bodies and actuators in MuJoCo, and the controllers that turn a `Command` into actuation."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Command, Float64
from simtrack.errors import UnknownNameError
from simtrack.geometry.kinematics import KinematicTree, Link
from simtrack.geometry.transforms import quaternion_from_rotation
from simtrack.objects.tiago import HEAD_PAN, HEAD_TILT, TORSO, TUCKED

if TYPE_CHECKING:
    import mujoco

PREFIX = "robot/"
BASE_JOINTS = (f"{PREFIX}x", f"{PREFIX}y", f"{PREFIX}yaw")

MAX_LINEAR, MAX_ANGULAR = 1.0, 1.0
"""m/s and rad/s (TIAGo's data sheet)."""
LINEAR_ACCELERATION, ANGULAR_ACCELERATION = 0.8, 1.5
"""m/s^2 and rad/s^2, typical limits of such a base."""
WHEEL_LAG = 0.08
"""Seconds: time constant with which the wheels follow the commanded speed."""
JOINT_ACCELERATION = {TORSO: 0.3, HEAD_PAN: 6.0, HEAD_TILT: 6.0}
"""m/s^2 or rad/s^2."""
STIFFNESS = {TORSO: (4.0e4, 2.5e3), HEAD_PAN: (250.0, 10.0), HEAD_TILT: (250.0, 10.0)}
"""Position gain and damping of the servos; those of the arm are `ARM_STIFFNESS`."""
ARM_STIFFNESS = (600.0, 40.0)
ARM_ACCELERATION, ARM_HASTE = 3.0, 0.5
"""rad/s^2, and share of the joints' largest speeds, with which the arm reaches: gentle enough for what it holds."""
BASE_GAIN = (3.0e4, 3.0e4, 3.0e3)
"""N/(m/s) and Nm/(rad/s): the drive holds its speed stiffly, up to `BASE_FORCE`."""
BASE_FORCE = (400.0, 400.0, 200.0)
"""N and Nm: beyond it the wheels slip, so that the robot cannot push a wall."""

COLLIDING = ("base", "column", "torso", "head", "arm_1", "arm_3", "arm_5", "gripper")
"""Links whose convex hulls make contact; the others lie inside or behind them."""


def add_robot(
    spec: "mujoco.MjSpec", tree: KinematicTree, add_visual, collision_bits: tuple[int, int], group: int
) -> None:
    """Attach the robot to the world: planar joints below the base, then the tree of its links.

    Args:
        spec: the world that is being composed.
        tree: the robot.
        add_visual: called with (body, link) to give a body the link's visible shape; returns the name of its mesh.
        collision_bits: contype and conaffinity of the colliding links.
        group: geom group of the collision shapes.
    """
    import mujoco

    bodies: dict[str, mujoco.MjsBody] = {}
    for link in tree.links:
        parent = bodies[link.parent] if link.parent else spec.worldbody
        body = parent.add_body(name=PREFIX + link.name, pos=link.T_parent_joint[:3, 3], gravcomp=1.0)
        body.quat = quaternion_from_rotation(link.T_parent_joint[:3, :3])
        bodies[link.name] = body
        _set_inertia(body, link)
        if not link.parent:
            _add_base_joints(spec, body)
        elif link.joint is not None and link.joint.kind != "fixed":
            _add_joint(spec, body, link)
        if len(link.faces):
            mesh = add_visual(body, link)
            if link.name in COLLIDING:
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, group=group, mass=0.0,
                    contype=collision_bits[0], conaffinity=collision_bits[1],
                )  # fmt: skip


def _set_inertia(body: "mujoco.MjsBody", link: Link) -> None:
    """Inertia of the box around the link's mesh: enough for servos that hold their setpoint."""
    box = np.ptp(link.vertices, axis=0) if len(link.vertices) else np.full(3, 0.05)
    centre = (link.vertices.min(axis=0) + link.vertices.max(axis=0)) / 2 if len(link.vertices) else np.zeros(3)
    body.explicitinertial = True
    body.mass = link.mass
    body.ipos = centre
    body.inertia = link.mass / 12.0 * (np.sum(box**2) - box**2) + 1e-5


def _add_base_joints(spec: "mujoco.MjSpec", body: "mujoco.MjsBody") -> None:
    import mujoco

    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    kinds = ((slide, (1, 0, 0)), (slide, (0, 1, 0)), (hinge, (0, 0, 1)))
    for name, (kind, axis), gain, force in zip(BASE_JOINTS, kinds, BASE_GAIN, BASE_FORCE, strict=True):
        body.add_joint(name=name, type=kind, axis=axis)
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_velocity(kv=gain)
        servo.forcelimited, servo.forcerange = True, (-force, force)


def _add_joint(spec: "mujoco.MjSpec", body: "mujoco.MjsBody", link: Link) -> None:
    import mujoco

    joint = link.joint
    assert joint is not None
    kind = mujoco.mjtJoint.mjJNT_HINGE if joint.kind == "revolute" else mujoco.mjtJoint.mjJNT_SLIDE
    body.add_joint(
        name=PREFIX + joint.name,
        type=kind,
        axis=joint.axis,
        armature=0.05,
        limited=True,
        range=(joint.lower, joint.upper),
    )
    stiffness, damping = STIFFNESS.get(joint.name, ARM_STIFFNESS)
    servo = spec.add_actuator(name=PREFIX + joint.name, target=PREFIX + joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=stiffness, kv=damping)


class RobotController:
    """Follows commands as the real machine does: limited speeds and accelerations, no sideways motion."""

    def __init__(self, model: "mujoco.MjModel", tree: KinematicTree, start: dict[str, float], timestep: float) -> None:
        self.tree = tree
        self.timestep = timestep
        self.joint_names = tuple(joint.name for joint in tree.joints)
        names = [*BASE_JOINTS, *(PREFIX + name for name in self.joint_names)]
        self._qpos = np.array([model.joint(name).qposadr[0] for name in names])
        self._dof = np.array([model.joint(name).dofadr[0] for name in names])
        self._actuator = np.array([model.actuator(name).id for name in names])
        self._limits = {joint.name: (joint.lower, joint.upper, joint.max_velocity) for joint in tree.joints}
        self._setpoint = {name: float(start.get(name, TUCKED.get(name, 0.0))) for name in self.joint_names}
        self._rate = dict.fromkeys(JOINT_ACCELERATION, 0.0)
        self._reaching: dict[str, float] = {}
        self.linear = 0.0
        """Speed of the wheels over ground if they do not slip, m/s."""
        self.angular = 0.0

    @property
    def setpoints(self) -> dict[str, float]:
        """Where the servos are asked to be now, radians or metres."""
        return dict(self._setpoint)

    def reach(self, targets: Mapping[str, float]) -> None:
        """Let joints of the arm go to targets (radians), each as fast as it may; they hold until other ones come.

        Raises:
            UnknownNameError: a name is no joint of the arm.
        """
        arm = [name for name in self.joint_names if name.startswith("arm_")]
        if unknown := sorted(set(targets) - set(arm)):
            raise UnknownNameError("joint of the arm", unknown[0], arm)
        for name, target in targets.items():
            lower, upper, _ = self._limits[name]
            self._reaching[name] = min(max(float(target), lower), upper)
            self._rate.setdefault(name, 0.0)

    def place(self, data: "mujoco.MjData", x: float, y: float, yaw: float) -> None:
        """Put the robot there at rest, with its joints at their setpoints."""
        data.qpos[self._qpos] = (x, y, yaw, *self._setpoint.values())
        data.qvel[self._dof] = 0.0
        self._write(data)

    def carry(self, data: "mujoco.MjData", x: float, y: float, yaw: float) -> None:
        """Put the robot there at rest, whatever it was doing; its joints stay as they are."""
        data.qpos[self._qpos[:3]] = x, y, yaw
        data.qvel[self._dof[:3]] = 0.0
        self.linear = self.angular = 0.0
        self._write(data)

    def base(self, qpos: Float64) -> tuple[float, float, float]:
        """x, y, yaw of the base in the map, from a full (nq,) position vector."""
        x, y, yaw = qpos[self._qpos[:3]]
        return float(x), float(y), float(yaw)

    def joint_positions(self, qpos: Float64) -> Float64:
        """(J,) true joint positions, in the order of `joint_names`."""
        return qpos[self._qpos[3:]].copy()

    def step(self, data: "mujoco.MjData", command: Command) -> None:
        """Set the actuators for one physics step."""
        dt = self.timestep
        linear = min(max(float(command.linear), -MAX_LINEAR), MAX_LINEAR)
        angular = min(max(float(command.angular), -MAX_ANGULAR), MAX_ANGULAR)
        self.linear = _lagged(self.linear, linear, LINEAR_ACCELERATION, dt)
        self.angular = _lagged(self.angular, angular, ANGULAR_ACCELERATION, dt)
        for name, target in ((TORSO, command.torso), (HEAD_PAN, command.head_pan), (HEAD_TILT, command.head_tilt)):
            lower, upper, speed = self._limits[name]
            self._setpoint[name], self._rate[name] = _profiled(
                self._setpoint[name], self._rate[name], min(max(target, lower), upper), speed,
                JOINT_ACCELERATION[name], dt,
            )  # fmt: skip
        for name, target in self._reaching.items():
            self._setpoint[name], self._rate[name] = _profiled(
                self._setpoint[name], self._rate[name], target, self._limits[name][2] * ARM_HASTE, ARM_ACCELERATION, dt
            )
        self._write(data)

    def _write(self, data: "mujoco.MjData") -> None:
        yaw = float(data.qpos[self._qpos[2]])
        speeds = (self.linear * math.cos(yaw), self.linear * math.sin(yaw), self.angular)
        data.ctrl[self._actuator] = (*speeds, *self._setpoint.values())


def _lagged(value: float, target: float, acceleration: float, dt: float) -> float:
    """First-order lag towards the target, with limited acceleration."""
    change = (target - value) * dt / WHEEL_LAG
    return value + min(max(change, -acceleration * dt), acceleration * dt)


def _profiled(
    position: float, rate: float, target: float, max_rate: float, acceleration: float, dt: float
) -> tuple[float, float]:
    """Next setpoint and rate of a trapezoidal profile that comes to rest at the target."""
    error = target - position
    if error == 0.0 == rate:
        return position, rate
    # The braking parabola, started one step early so that the discrete profile does not overshoot.
    brake = math.sqrt(2.0 * acceleration * abs(error) + (0.5 * acceleration * dt) ** 2) - 0.5 * acceleration * dt
    wanted = math.copysign(min(max_rate, brake, abs(error) / dt), error)
    rate += min(max(wanted - rate, -acceleration * dt), acceleration * dt)
    return position + rate * dt, rate
