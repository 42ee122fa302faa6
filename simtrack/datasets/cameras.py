"""Where cameras stand: on a shell about some of the targets, with a free view of them."""

from collections.abc import Sequence

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64
from simtrack.datasets.content import Placed
from simtrack.datasets.physics import PlacementError
from simtrack.datasets.recipe import ShellViews
from simtrack.geometry.transforms import look_at, transform
from simtrack.raycast import RayBundle, RayScene

TRIES = 200
"""Draws for one camera."""
STRIDE = 32
"""Pixels between the rays that look for things too near to the camera."""


class CameraShell:
    """Draws camera poses as a recipe says."""

    def __init__(self, views: ShellViews, intrinsics: CameraIntrinsics) -> None:
        self._views, self._intrinsics = views, intrinsics
        self._probe = RayBundle.from_camera(intrinsics, STRIDE)

    def draw(self, things: Sequence[Placed], rays: RayScene, fallback: Float64, rng: np.random.Generator) -> Float64:
        """(4, 4) T_map_camera from which at least one of the targets that it looks at is seen.

        Args:
            things: of the scene.
            rays: the scene.
            fallback: (3,), what to look at in a scene without targets.
            rng: decides.

        Raises:
            PlacementError: none was found.
        """
        targets = [thing for thing in things if thing.category is not None]
        points = np.array([thing.T_map_object[:3, 3] for thing in targets]).reshape(-1, 3)
        numbers = np.array([thing.ray_instance for thing in targets], np.int32)
        for _ in range(TRIES):
            chosen = self._chosen(len(targets), rng)
            middle = points[chosen].mean(axis=0) if len(chosen) else fallback
            T_map_camera = self._pose(middle, rng)
            if self._clear(rays, T_map_camera) and self._sees(rays, T_map_camera, points[chosen], numbers[chosen]):
                return T_map_camera
        wanted = ", ".join(thing.name for thing in targets) or "the support"
        raise PlacementError(
            f"no camera on the shell has a free view of any of {wanted} in {TRIES} tries; allowed: other distances or "
            "elevations, less clearance, more room about the support"
        )

    def _chosen(self, count: int, rng: np.random.Generator) -> np.ndarray:
        low, high = (min(bound, count) for bound in self._views.look_at)
        return rng.permutation(count)[: int(rng.integers(low, high + 1))] if count else np.empty(0, np.int64)

    def _pose(self, middle: Float64, rng: np.random.Generator) -> Float64:
        views, camera = self._views, self._intrinsics
        azimuth, distance = rng.uniform(-np.pi, np.pi), rng.uniform(*views.distance)
        # Even on the sphere: the sine of the elevation is uniform.
        elevation = np.arcsin(rng.uniform(*np.sin(views.elevation)))
        roll, offset = rng.uniform(*views.roll), rng.uniform(-views.offset, views.offset, 2)
        around = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        T = look_at(middle + distance * around, middle)
        c, s = np.cos(roll), np.sin(roll)
        T = T @ transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
        # Turning by these angles moves the middle of what is looked at by the offset.
        pan, tilt = np.arctan(offset * (camera.width / camera.fx, camera.height / camera.fy))
        turn_y = np.array([[np.cos(pan), 0.0, np.sin(pan)], [0.0, 1.0, 0.0], [-np.sin(pan), 0.0, np.cos(pan)]])
        turn_x = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(tilt), -np.sin(tilt)], [0.0, np.sin(tilt), np.cos(tilt)]])
        return T @ transform(turn_y @ turn_x)

    def _clear(self, rays: RayScene, T_map_camera: Float64) -> bool:
        hits = rays.cast(self._probe, T_map_camera, self._views.clearance)
        return not hits.hit.any()

    @staticmethod
    def _sees(rays: RayScene, T_map_camera: Float64, points: Float64, numbers: np.ndarray) -> bool:
        if not len(points):
            return True
        eyes = np.broadcast_to(T_map_camera[:3, 3], points.shape)
        return bool((rays.cast_rays(eyes, points - eyes).instances == numbers).any())
