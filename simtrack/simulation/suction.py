"""A suction cup in the gripper: it holds what it truly touches, by a constraint, and never moves anything by itself."""

from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import inverse, quaternion_from_rotation, transform
from simtrack.objects.tiago import GRIPPER
from simtrack.simulation.robot import PREFIX
from simtrack.simulation.world import body_pose

if TYPE_CHECKING:
    from simtrack.simulation.simulation import Simulation

CUP = np.array([0.165, 0.0, 0.0])
"""(3,), middle of the cup's rim in the gripper's frame, just before the finger tips, metres; it sucks along x."""
RIM = 0.006
"""Radius of the cup, metres."""
SEAL = 0.008
"""Metres before the rim within which a surface closes the cup: it is soft."""
LEAK = 0.008
"""Largest difference between the distances at the rim, metres: a steeper surface leaves a gap."""
SWIVEL = np.deg2rad(65.0)
"""Radians off a surface's normal that the cup's ball joint gives way by, where what it holds hangs on a joint of its
own; beyond it the cup comes off."""


class SuctionCup:
    """The cup of a simulated robot.

    Raises:
        InvalidValueError: the scene's robot has none (``robot.suction``).
    """

    def __init__(self, simulation: "Simulation") -> None:
        if not simulation.scene.robot.suction:
            raise InvalidValueError("robot.suction", False, "true in the scene file, for a gripper with a cup")
        self._simulation = simulation
        self._body = simulation.world.model.body(PREFIX + GRIPPER).id
        angles = np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False)
        ring = np.stack([np.zeros(6), RIM * np.cos(angles), RIM * np.sin(angles)], axis=1)
        self._points = np.concatenate([CUP[None], CUP + ring])
        world = simulation.world
        self._moving = {moving.part.name: world.model.body(moving.body).id for moving in world.static.moving}
        self._normal = np.zeros(3)
        """(3,), of the surface that is held, inwards, in the frame of its body."""
        self.holding: str | None = None
        """Name of the object, door or drawer that it holds."""

    def reset(self) -> None:
        """Forget what was held: the world is about to begin anew."""
        if self.holding is not None:
            self._may_sleep(self.holding, True)
        self.holding = None

    @property
    def pose(self) -> Float64:
        """(4, 4) T_map_cup as it truly is now: origin in the middle of the rim, x in the direction of sucking."""
        T_map_gripper = body_pose(self._simulation.state(self._simulation.now), self._body)
        return T_map_gripper @ transform(translation=(CUP[0], CUP[1], CUP[2]))

    def touching(self) -> str | None:
        """Name of the object, door or drawer whose true surface closes the cup now; None if there is none."""
        simulation = self._simulation
        T = body_pose(simulation.state(simulation.now), self._body)
        back = np.array([SEAL, 0.0, 0.0])
        origins = (self._points - back) @ T[:3, :3].T + T[:3, 3]
        directions = np.broadcast_to(T[:3, 0], origins.shape)
        rays = simulation.truth.rays(simulation.now)
        hits = rays.scene.cast_rays(origins, directions, max_distance=2.0 * SEAL)
        ids = rays.ids(hits)
        names = {simulation.world.names[k] if k >= 0 else "" for k in ids.tolist()}
        if len(names) != 1 or not hits.hit.all() or np.ptp(hits.distances) > LEAK:
            return None
        (name,) = names
        return name if name in simulation.world.objects or name in self._moving else None

    def close(self) -> str | None:
        """Suck: holds the object that is touched, as it is now; its name, or None if nothing closes the cup."""
        name = self.touching()
        if name is None or self.holding is not None:
            return self.holding
        world = self._simulation.world
        tie, data = world.model.equality(f"suction/{name}").id, world.data
        T = inverse(body_pose(data, self._body)) @ body_pose(data, self._held_body(name))
        if name in self._moving:
            world.model.eq_data[tie, 0:3] = CUP
            world.model.eq_data[tie, 3:6] = inverse(T)[:3, :3] @ CUP + inverse(T)[:3, 3]
            self._normal = inverse(T)[:3, 0].copy()
        else:
            world.model.eq_data[tie, 0:3] = 0.0
            world.model.eq_data[tie, 3:6] = T[:3, 3]
            world.model.eq_data[tie, 6:10] = quaternion_from_rotation(T[:3, :3])
        data.eq_active[tie] = 1
        self._may_sleep(name, False)
        self.holding = name
        return name

    def check(self) -> str | None:
        """What is still held: a cup that is tilted too far against a door comes off."""
        if self.holding in self._moving:
            data = self._simulation.world.data
            axis = body_pose(data, self._body)[:3, 0]
            normal = body_pose(data, self._moving[self.holding])[:3, :3] @ self._normal
            if float(axis @ normal) < np.cos(SWIVEL):
                self.open()
        return self.holding

    def open(self) -> None:
        """Let go."""
        if self.holding is not None:
            world = self._simulation.world
            world.data.eq_active[world.model.equality(f"suction/{self.holding}").id] = 0
            self._may_sleep(self.holding, True)
            self.holding = None

    def _may_sleep(self, name: str, may: bool) -> None:
        """Leave a thing out of the physics while it rests, or not: what is held still would not fall when let go."""
        import mujoco

        world, policy = self._simulation.world, mujoco.mjtSleepPolicy
        tree = world.model.body_treeid[self._held_body(name)]
        world.model.tree_sleep_policy[tree] = policy.mjSLEEP_AUTO_ALLOWED if may else policy.mjSLEEP_NEVER

    def _held_body(self, name: str) -> int:
        return self._moving[name] if name in self._moving else self._simulation.world.bodies[name]
