"""The common measure of machines: what the plain library needs for one pinhole scan of the benchmark's scene.

Absolute times are asked for a machine on which `embreex`'s ``run`` needs 58 ms for it; on another one they scale with
what it needs there, measured in the same run.
"""

import time
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from simtrack.benchmarks.harness import rest
from simtrack.benchmarks.office import CAMERA, Office, office
from simtrack.contracts import Float32
from simtrack.sensors.camera import pixel_rays

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene

REFERENCE = 0.058
"""Seconds of CPU of the scan on the machine that absolute figures are asked for."""


def scaled(asked: float, measured: float) -> float:
    """What is asked here, in the unit of `asked`, if `asked` holds where the yardstick is `REFERENCE` seconds."""
    return asked * measured / REFERENCE


def yardstick(say: Callable[[str], None] = lambda _: None) -> float:
    """Median CPU seconds of `embreex`'s ``run`` for 640x480 rays with normals and ids, one thread.

    Each call measures anew, because shared machines change their pace.
    """
    say("measuring the yardstick: embreex, 640x480 rays with normals")
    scene, rays = _prepared()
    rest()
    times = []
    for _ in range(8):
        start = time.process_time()
        scene.run(*rays, output=True)
        times.append(time.process_time() - start)
    return float(np.median(times[1:]))


@cache
def _prepared() -> tuple["EmbreeScene", tuple[Float32, Float32]]:
    world = office()
    return embreex_scene(world), camera_rays(world)


def embreex_scene(world: Office) -> "EmbreeScene":
    """All meshes in one `embreex` scene with default settings, one geometry each."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    for mesh in world.posed():
        TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces)
    return scene


def camera_rays(world: Office) -> tuple[Float32, Float32]:
    """Origins and directions (307,200, 3) of the camera's rays, map frame, row by row."""
    T = world.T_map_camera.astype(np.float32)
    directions = np.ascontiguousarray(pixel_rays(CAMERA).reshape(-1, 3) @ T[:3, :3].T)
    return np.ascontiguousarray(np.broadcast_to(T[:3, 3], directions.shape)), directions
