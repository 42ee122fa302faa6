"""Bullet: each component of a tree as a multibody of its own."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import SimtrackError
from simtrack.geometry.transforms import inverse, quaternion_from_rotation, rotation_from_quaternion, transform
from simtrack.perception.reconstruction.body_tree import Body, BodyTree, Component, collision_points
from simtrack.perception.reconstruction.files import write_meshes
from simtrack.perception.reconstruction.urdf import write_urdf
from simtrack.plausibility.boxes import near_pairs
from simtrack.plausibility.engine import Proximity

STEP = 1.0 / 240.0
MARGIN = 0.001
"""Metres by which Bullet thickens convex meshes and cylinders of a URDF."""
IMAGE = (800, 600)


class EngineError(SimtrackError):
    """The engine refused the scene."""


@dataclass(frozen=True, slots=True)
class _Multibody:
    number: int
    component: Component
    links: dict[str, int]
    """Body name -> link index; -1 for the base."""
    joints: dict[str, int]
    """Name of a joint that moves -> joint index."""
    T_root_inertial: Float64


class PybulletEngine:
    """A tree loaded into Bullet (DIRECT); one process may hold several."""

    name = "pybullet"
    margin = MARGIN

    def __init__(self, tree: BodyTree, folder: Path) -> None:
        """Load a tree; its components' files are written to `folder`."""
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        self.tree = tree
        self.version = str(pybullet.getAPIVersion())
        self._client: Any = BulletClient(pybullet.DIRECT)
        self._client.setGravity(0.0, 0.0, -9.81)
        self._client.setPhysicsEngineParameter(fixedTimeStep=STEP, numSolverIterations=100, numSubSteps=2)
        self._multibodies = [self._load(part, folder / str(k)) for k, part in enumerate(tree.components)]
        self._margins = {body.name: MARGIN if _thickened(body) else 0.0 for body in tree.bodies}
        self.reset()

    def _load(self, component: Component, folder: Path) -> _Multibody:
        root = component.bodies[0]
        part = BodyTree(component.name, (replace(root, joint=None), *component.bodies[1:]))
        folder.mkdir(parents=True)
        path = folder / "component.urdf"
        write_urdf(part, write_meshes(part, folder), path)
        client = self._client
        try:
            number = client.loadURDF(str(path), useFixedBase=component.static, flags=client.URDF_USE_INERTIA_FROM_FILE)
        except Exception as error:  # pybullet.error, which is no class of its own module's stubs
            raise EngineError(f"pybullet cannot load the component of '{component.name}': {error}") from error
        links, joints = {root.name: -1}, {}
        for index in range(client.getNumJoints(number)):
            info = client.getJointInfo(number, index)
            body = self.tree.by_name[info[12].decode()]
            links[body.name] = index
            if body.joint is not None and body.joint.moves:
                joints[body.joint.name] = index
        dynamics = client.getDynamicsInfo(number, -1)
        multibody = _Multibody(number, component, links, joints, _pose(dynamics[3], dynamics[4]))
        for name, index in links.items():
            body = self.tree.by_name[name]
            # Bullet multiplies the coefficients of the two bodies, and damps motion in air by default.
            client.changeDynamics(
                number, index, lateralFriction=math.sqrt(body.friction), linearDamping=0.0, angularDamping=0.0
            )
            if body.joint is not None and body.joint.moves:
                client.changeDynamics(number, index, jointDamping=body.joint.damping)
        return multibody

    def reset(self) -> None:
        """Put everything where the description has it, at rest."""
        self.place({})

    def place(self, positions: Mapping[str, float]) -> None:
        """Reset, then move joints (rad or m) and all that hangs on them, also freely, without simulating."""
        poses = self.tree.forward(positions)
        for multibody in self._multibodies:
            T = poses[multibody.component.name] @ multibody.T_root_inertial
            wxyz = quaternion_from_rotation(T[:3, :3])
            self._client.resetBasePositionAndOrientation(multibody.number, T[:3, 3], [*wxyz[1:], wxyz[0]])
            self._client.resetBaseVelocity(multibody.number, [0.0] * 3, [0.0] * 3)
            for name, index in multibody.joints.items():
                joint = self.tree.joints[name].joint
                assert joint is not None
                self._client.resetJointState(multibody.number, index, positions.get(name, 0.0), 0.0)
                self._client.setJointMotorControl2(
                    multibody.number, index, self._client.VELOCITY_CONTROL, targetVelocity=0.0, force=joint.friction
                )

    def step(self, duration: float) -> None:
        """Simulate for so many seconds."""
        for _ in range(max(1, round(duration / STEP))):
            self._client.stepSimulation()

    def poses(self) -> dict[str, Float64]:
        """Body name -> (4, 4) T_scene_body."""
        out: dict[str, Float64] = {}
        for multibody in self._multibodies:
            T_scene_inertial = _pose(*self._client.getBasePositionAndOrientation(multibody.number))
            out[multibody.component.name] = T_scene_inertial @ inverse(multibody.T_root_inertial)
            indices = [(name, index) for name, index in multibody.links.items() if index >= 0]
            if indices:
                states = self._client.getLinkStates(
                    multibody.number, [index for _, index in indices], computeForwardKinematics=True
                )
                out |= {name: _pose(state[4], state[5]) for (name, _), state in zip(indices, states, strict=True)}
        return out

    def proximities(self, limit: float, bodies: Collection[str] | None = None) -> list[Proximity]:
        """Pairs of bodies nearer than `limit` metres, one of them in `bodies` (all if None), nearest point each."""
        rows = [
            (name, multibody.number, index)
            for multibody in self._multibodies
            for name, index in multibody.links.items()
            if self.tree.by_name[name].collision
        ]
        if len(rows) < 2:
            return []
        reach = limit + 2.0 * MARGIN
        self._client.performCollisionDetection()
        corners = np.array([self._client.getAABB(number, index) for _, number, index in rows])
        chosen = np.array([bodies is None or name in bodies for name, _, _ in rows])
        out = []
        for i, j in near_pairs(corners[:, 0], corners[:, 1], reach, chosen):
            (a, number_a, link_a), (b, number_b, link_b) = rows[i], rows[j]
            points = self._client.getClosestPoints(number_a, number_b, reach, link_a, link_b)
            if not points:
                continue
            nearest = min(points, key=lambda point: point[8])
            distance = nearest[8] + self._margins[a] + self._margins[b]
            if distance <= limit:
                out.append(Proximity(a, b, distance, nearest[7][2]))
        return out

    def picture(self, path: Path) -> bool:
        """Write an image of the scene as it is."""
        import cv2

        centre, distance = _view(self.tree, self.poses())
        client, (width, height) = self._client, IMAGE
        view = client.computeViewMatrixFromYawPitchRoll(centre.tolist(), distance, 35.0, -30.0, 0.0, 2)
        projection = client.computeProjectionMatrixFOV(50.0, width / height, 0.02 * distance, 20.0 * distance)
        image = client.getCameraImage(width, height, view, projection, renderer=client.ER_TINY_RENDERER)
        bgr = np.asarray(image[2], np.uint8).reshape(height, width, 4)[:, :, 2::-1]
        return cv2.imwrite(str(path), np.ascontiguousarray(bgr))

    def close(self) -> None:
        """Disconnect."""
        self._client.disconnect()


def _thickened(body: Body) -> bool:
    return any(shape.kind in ("convex", "cylinder") for shape in body.collision)


def _pose(position: Any, xyzw: Any) -> Float64:
    return transform(rotation_from_quaternion(np.array([xyzw[3], *xyzw[:3]])), np.asarray(position, float))


def _view(tree: BodyTree, poses: Mapping[str, Float64]) -> tuple[Float64, float]:
    """What a picture looks at: the centre of all that is not larger than a room, and how far away it stands."""
    clouds = [collision_points([body], poses) for body in tree.bodies if body.collision]
    small = [cloud for cloud in clouds if np.ptp(cloud, axis=0).max() < 15.0] or clouds
    if not small:
        return np.zeros(3), 2.0
    points = np.concatenate(small)
    low, high = points.min(axis=0), points.max(axis=0)
    return 0.5 * (low + high), max(0.3, 1.1 * float(np.linalg.norm(high - low)))
