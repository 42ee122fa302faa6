"""Pictures of the robot at work, from a camera that follows it; drawn with rays, so that they need no OpenGL."""

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64, Uint8
from simtrack.geometry.transforms import look_at
from simtrack.raycast import RayBundle, RayHits
from simtrack.simulation.ground_truth import Truth
from simtrack.simulation.rendering import ray_image

if TYPE_CHECKING:
    from simtrack.simulation.simulation import Simulation

Place: TypeAlias = tuple[float, float, float]

SIZE = (640, 480)
"""Width and height of a picture, pixels."""
INTRINSICS = CameraIntrinsics(*SIZE, 400.0, 400.0, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
WALL = 0.12
"""Metres that the camera keeps from what stands between it and the robot."""


class View:
    """A camera that follows the robot, and comes nearer where a wall is in the way."""

    def __init__(self, simulation: "Simulation", eye: Place, focus: Place) -> None:
        """`eye` and `focus`: where it stands and what it looks at, base frame, metres."""
        self._eye, self._focus = np.array(eye), np.array(focus)
        self._truth = simulation.truth
        self._bundle = RayBundle.from_camera(INTRINSICS)
        self._hits = RayHits.empty(len(self._bundle))

    def picture(self, truth: Truth) -> Uint8:
        """(480, 640, 3) picture of the moment, a fresh array."""
        rays = self._truth.rays(truth.stamp)
        return ray_image(rays, self._bundle, self.pose(truth), (SIZE[1], SIZE[0]), self._hits)

    def pose(self, truth: Truth) -> Float64:
        """(4, 4) T_map_camera for the moment."""
        T = truth.T_map_base
        target = T[:3, :3] @ self._focus + T[:3, 3]
        head = truth.T_map_camera[:3, 3] + np.array([0.0, 0.0, 0.3])
        wanted = T[:3, :3] @ self._eye + T[:3, 3]
        way = wanted - head
        distance = float(np.linalg.norm(way))
        hits = self._truth.rays(truth.stamp).scene.cast_rays(head[None], (way / distance)[None], max_distance=distance)
        free = min(float(hits.distances[0]) - WALL, distance)
        return look_at(head + max(free, 0.05) / distance * way, target)
