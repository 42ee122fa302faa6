"""Soft shadows of area lights, from rays: what share of each light a pixel sees, and how much darker that makes it.

Every second pixel of every second row sends one ray to a point of the light, each of nine neighbours to another one;
where the nine disagree it sends four more. What neighbours on the same surface found is averaged and spread to all
pixels. Renderers light without shadows; their image is multiplied by the share of its light that remains.
"""

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Float64
from simtrack.datasets import shadow_kernels as kernels
from simtrack.datasets.annotate import View
from simtrack.datasets.content import Content, Light
from simtrack.raycast import RayScene

SKIN = 5e-4
"""Metres by which rays start above their surface."""
STRIDE = 2
"""Pixels between those that send rays."""
_STANDS_ON_LIGHT = 0.3
"""Metres around what a light points at within which a surface is no wall in between."""


def remaining_light(content: Content, view: View, T_map_camera: Float64, intrinsics: CameraIntrinsics) -> Float32:
    """(H, W, 3), share of the diffuse light that is left at each pixel once shadows are cast; 1 where nothing is.

    A light of radius 0 casts hard shadows. One that stands outside of the walls shines through them, as it does
    without shadows.

    Args:
        content: lights, and what throws shadows.
        view: what is seen, from `Annotator.look` at the same scene.
        T_map_camera: (4, 4), of the view.
        intrinsics: of the view.
    """
    camera = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
    pose = np.ascontiguousarray(T_map_camera, np.float64)
    points, normals = kernels.sources(view.depth, view.normals, STRIDE, camera, pose)
    if not content.lights:
        return np.ones((*view.depth.shape, 3), np.float32)
    lit = [_lit(content.rays, points, normals, light, _free_share(content, light)) for light in content.lights]
    lights = np.stack([_vector(light) for light in content.lights])
    ambient = np.asarray(content.ambient, np.float32)
    shares = kernels.remaining(points, normals, np.stack(lit), lights, ambient)
    return kernels.spread(shares, view.depth, view.normals, points, normals, STRIDE, camera, pose)


def _lit(rays: RayScene, points: Float32, normals: Float32, light: Light, share: float) -> Float32:
    """(h, w), share of a light that each source of rays sees."""
    across = _disc(light)
    lit = np.ones(points.shape[:2], np.float32)
    where, which = kernels.first_samples(points, normals, _vector(light))
    _see(rays, points, normals, where, which, light, across, share, lit, first=True)
    where, which = kernels.more_samples(lit, points, normals, _vector(light))
    if light.radius > 0.0 and len(where):
        _see(rays, points, normals, where, which, light, across, share, lit, first=False)
    return kernels.smoothed(lit, points, normals)


def _see(
    rays: RayScene, points: Float32, normals: Float32, where: np.ndarray, which: np.ndarray, light: Light,
    across: Float32, share: float, lit: Float32, first: bool,
) -> None:  # fmt: skip
    origins, directions = kernels.shadow_rays(points, normals, where, which, _vector(light), across, np.float32(SKIN))
    blocked = rays.occluded(origins, directions, share)
    kernels.gather(where, blocked, first, lit)


def _vector(light: Light) -> Float32:
    """(11,), a light for compiled code: position, direction, colour, whether it is directional, reach."""
    return np.array([*light.position, *light.direction, *light.color, light.directional, light.reach], np.float32)


def _disc(light: Light) -> Float32:
    """(9, 3), offsets of a light's sample points from its middle, metres, across its direction."""
    k = np.arange(9)
    # Equal areas, turned by the golden angle: H. Vogel, Mathematical Biosciences 44, 1979.
    radius, angle = light.radius * np.sqrt((k + 0.5) / 9), k * np.pi * (3.0 - np.sqrt(5.0))
    z = np.asarray(light.direction, float)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    offsets = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * np.cross(z, x)
    return (radius[:, None] * offsets).astype(np.float32)


def _free_share(content: Content, light: Light) -> float:
    """Share of the way from a surface to a light in which things can stand: short of a wall before the light."""
    way = float(light.reach) * np.asarray(light.direction, float)
    hits = content.rays.cast_rays(np.asarray(light.position, float)[None], way[None], max_distance=1.0)
    distance = float(hits.distances[0])
    loose = {thing.ray_instance for thing in content.things}
    if int(hits.instances[0]) in loose | {-1} or (1.0 - distance) * light.reach < _STANDS_ON_LIGHT:
        return 1.0 - 1e-3
    return 0.9 * (1.0 - distance)
