"""How a world begins: things are put where a seed says, and physics brings them to rest."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import FileFormatError
from simtrack.geometry.kinematics import KinematicTree
from simtrack.geometry.transforms import quaternion_from_rotation
from simtrack.objects.tiago import TUCKED
from simtrack.simulation.placement import place_objects, start_pose
from simtrack.simulation.randomness import stream
from simtrack.simulation.robot import RobotController
from simtrack.simulation.scene_file import SceneFile
from simtrack.simulation.world import TIMESTEP_NS, World

if TYPE_CHECKING:
    import mujoco

NUDGE = 1e-3
"""m/s downwards with which a thing begins to settle: what has a speed is awake."""
SETTLE_SECONDS = 1.5
"""How long physics lets things come to rest before time 0."""


def put(world: World, data: "mujoco.MjData", name: str, T_map_object: Float64, *, floating: bool = False) -> None:
    """Put an object somewhere else, at rest.

    Args:
        world: that it belongs to.
        data: the state that changes.
        name: of the object.
        T_map_object: (4, 4), where it is put.
        floating: without weight, until it is put somewhere again.
    """
    joint, body = world.model.joint(f"object/{name}"), world.bodies[name]
    at, speed = int(joint.qposadr[0]), int(joint.dofadr[0])
    data.qpos[at : at + 3] = T_map_object[:3, 3]
    data.qpos[at + 3 : at + 7] = quaternion_from_rotation(T_map_object[:3, :3])
    data.qvel[speed : speed + 6] = 0.0
    data.xfrc_applied[body] = 0.0
    if floating:
        data.xfrc_applied[body, :3] = -world.model.body_mass[body] * world.model.opt.gravity
    else:
        data.qvel[speed + 2] = -NUDGE


def rearrange(world: World, seed: int) -> None:
    """Begin anew in the same building: places and start are drawn from `seed`, then everything settles.

    The model stays as it was compiled, so that this takes a fraction of the time of `build_world`; the building, which
    the model holds, stays that of the seed that the world was built with.

    Raises:
        FileFormatError: there is no room for the things of the scene, or one does not rest where it is put.
    """
    start = start_pose(world.scene, world.static, stream(seed, "start"))
    poses = place_objects(world.scene, world.static, dict(world.objects), stream(seed, "placement"))
    world.seed = seed
    settle(world, poses, start)


def standing(scene: SceneFile, model: "mujoco.MjModel", robot: KinematicTree) -> RobotController:
    """A controller that holds the robot at rest in the posture that the scene asks for."""
    joints = {
        "torso_lift_joint": scene.robot.torso,
        "head_1_joint": scene.robot.head_pan,
        "head_2_joint": scene.robot.head_tilt,
    }
    return RobotController(model, robot, {**TUCKED, **joints}, TIMESTEP_NS * 1e-9)


def settle(world: World, poses: Mapping[str, Float64], start: tuple[float, float, float]) -> None:
    """Put things and robot there, let physics bring everything to rest, and check that it rests where it was put.

    Args:
        world: whose `data` and `controller` begin anew.
        poses: object name -> (4, 4) T_map_object.
        start: x, y, yaw of the base.

    Raises:
        FileFormatError: a thing does not rest where it is put.
    """
    import mujoco

    scene, model, data = world.scene, world.model, world.data
    mujoco.mj_resetData(model, data)
    away = {thing.id for thing in (*scene.objects, *scene.clutter) if thing.place.away}
    for name, T in poses.items():
        put(world, data, name, T, floating=name in away)
    data.qvel[:] = 0.0
    world.controller = controller = standing(scene, model, world.robot)
    controller.place(data, *start)
    mujoco.mj_step(model, data, nstep=round(SETTLE_SECONDS / (TIMESTEP_NS * 1e-9)))
    controller.place(data, *start)
    data.qvel[:] = 0.0
    data.time = 0.0
    flags, sleep = int(model.opt.enableflags), int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    model.opt.enableflags = flags & ~sleep  # awake at time 0: what sleeps has no contacts to be told of
    mujoco.mj_forward(model, data)
    model.opt.enableflags = flags

    things = {thing.id: f"objects.{k}" for k, thing in enumerate(scene.objects)}
    things |= {thing.id: f"clutter.{k}" for k, thing in enumerate(scene.clutter)}
    for name in poses:
        moved = float(np.linalg.norm(data.xpos[world.bodies[name]] - poses[name][:3, 3]))
        if not moved < 0.05:
            reason = f"'{name}' does not rest where it is put: it moved by {moved:.2f} m while settling"
            raise FileFormatError(scene.path, f"{things[name]}.place", reason)
