"""A small world of rooms, and the same world with everything live."""

from functools import cache

import numpy as np
import trimesh

from simtrack.benchmarks import rooms
from simtrack.contracts import CameraIntrinsics
from simtrack.geometry.transforms import transform_xyz_rpy
from simtrack.raycast import RayBundle, RayHits, RayScene, TriangleMesh
from simtrack.raycast.paging import PagedHits, PagedScene
from simtrack.sensors.lidar import VLP16

CAMERA = RayBundle.from_camera(CameraIntrinsics(40, 30, 30.0, 30.0, 19.5, 14.5))
_SHOTS = VLP16.shots(columns=120)
LIDAR = RayBundle.from_directions(_SHOTS.directions, _SHOTS.rings)
T_BASE_CAMERA = transform_xyz_rpy((0.1, 0.0, 1.25), (-np.pi / 2, 0.0, -np.pi / 2))


@cache
def shapes() -> tuple[TriangleMesh, ...]:
    ball, box = trimesh.creation.icosphere(subdivisions=2, radius=0.12), trimesh.creation.box((0.2, 0.15, 0.3))
    return tuple(TriangleMesh(m.vertices, m.faces) for m in (ball, box))


def world(count: int = 100, seed: int = 0) -> rooms.Rooms:
    return rooms.build(count, shapes(), seed)


class AllLive:
    """Everything in one scene: objects under their ids, closed portals after them."""

    def __init__(self, paged: PagedScene, use_fallback: bool = False) -> None:
        index = paged.index
        self.scene, self.paged = RayScene(use_fallback), paged
        self.panel = TriangleMesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
        numbers = np.arange(len(index))
        self.scene.add_many(
            [paged.meshes[model] for model in index.models(numbers)], index.poses(numbers), numbers.tolist()
        )
        self.panels = len(index) + 1000
        for portal in np.flatnonzero(~index.regions.is_open).tolist():
            self.set_open(portal, False)

    def set_open(self, portal: int, is_open: bool) -> None:
        if is_open:
            self.scene.remove(self.panels + portal)
        else:
            self.scene.add(self.panel, self.paged.regions.rectangle(portal), instance=self.panels + portal)

    def assert_same(self, paged: PagedHits, live: RayHits, coinciding: float = 2e-3) -> None:
        portals = paged.portals
        instances = np.where(portals >= 0, self.panels + portals, paged.objects)
        np.testing.assert_allclose(paged.distances, live.distances, rtol=3e-7)
        # Where faces meet or coincide, which one is hit first depends on what else there is, and with it the last bit.
        same = (instances == live.instances) & (paged.faces == live.faces)
        assert np.count_nonzero(~same) <= coinciding * len(same)
        np.testing.assert_array_equal(paged.distances[same], live.distances[same])
        np.testing.assert_array_equal(paged.normals[same], live.normals[same])
