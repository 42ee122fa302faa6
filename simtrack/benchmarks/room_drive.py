"""Driving through worlds of rooms with a camera and a lidar: paged with an object tracker, or with everything live."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from simtrack.benchmarks import office, rooms
from simtrack.benchmarks.harness import Timing
from simtrack.contracts import Float64
from simtrack.geometry.transforms import exp_so3, inverse, transform, transform_planar, transform_xyz_rpy
from simtrack.perception.tracking.registration import Registration, TrackedModel
from simtrack.raycast import RayBundle, RayHits, RayScene, TriangleMesh
from simtrack.raycast.paging import PagedHits, PagedScene, PagingConfig
from simtrack.sensors.lidar import VLP16

CAMERA_RANGE = 10.0
"""Metres along the optical axis."""
T_BASE_CAMERA = transform_xyz_rpy((0.0, 0.0, 1.25), (np.deg2rad(-108.0), 0.0, np.deg2rad(-90.0)))
"""Looks ahead and 18 degrees down."""
_PAN, _PAN_FRAMES = np.deg2rad(70.0), 60
"""The camera looks to and fro by this angle, once in so many frames."""
T_BASE_LIDAR = transform_xyz_rpy((0.0, 0.0, 1.1))
PARTS = "paging", "camera", "lidar", "registration"
"""Of a frame."""
_TRACKED, _PIXELS = 10, 60
"""Objects that are registered at most, and pixels that one must fill."""
_PANEL = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True, eq=False)
class Sensor:
    """Rays and where they start; `out` is used again in every cast."""

    bundle: RayBundle
    T_base_sensor: Float64
    reach: float
    """Farthest hit in multiples of the rays' directions."""

    @cached_property
    def out(self) -> RayHits:
        """Where hits are written."""
        return RayHits.empty(len(self.bundle))


def sensors() -> tuple[Sensor, Sensor]:
    """Camera and lidar."""
    camera = Sensor(office.pinhole(), T_BASE_CAMERA, CAMERA_RANGE)
    return camera, Sensor(office.vlp16(), T_BASE_LIDAR, VLP16.max_range)


def mounted(pair: tuple[Sensor, Sensor], T_map_base: Float64, number: int) -> tuple[Float64, Float64]:
    """(4, 4) T_map_camera and T_map_lidar in a frame of a drive; the camera looks to and fro."""
    pan = transform_planar(0.0, 0.0, _PAN * np.sin(2.0 * np.pi * number / _PAN_FRAMES))
    return T_map_base @ pan @ pair[0].T_base_sensor, T_map_base @ pair[1].T_base_sensor


@dataclass(eq=False)
class PagedDrive:
    """A drive through a paged world, and what its frames took."""

    world: rooms.Rooms
    models: Sequence[TrackedModel]
    """Of the objects, in the order of the world's meshes."""
    poses: Float64
    """(F, 4, 4) T_map_base."""
    cpu: list[list[float]] = field(default_factory=list)
    """Seconds of the `PARTS` of every frame."""
    wall: list[float] = field(default_factory=list)
    """Seconds of every frame."""
    live: list[int] = field(default_factory=list)
    """Live instances, frame by frame."""
    tracked: list[int] = field(default_factory=list)
    """Objects that were registered, frame by frame."""
    loaded: int = 0
    """Instances that paging loaded on the way."""

    def __post_init__(self) -> None:
        self.scene = PagedScene(self.world.index, self.world.meshes, PagingConfig(reach=VLP16.max_range))
        self.scene.require((self.poses[0] @ T_BASE_LIDAR)[:3, 3], self.scene.config.reach, self.scene.config.ahead)
        self._registration = Registration()
        self._instances: dict[int, int] = {}

    @property
    def frame(self) -> Timing:
        """Medians of whole frames."""
        return Timing(float(np.median(self.frames)), float(np.median(self.wall)), len(self.wall))

    @property
    def frames(self) -> Float64:
        """(F,) CPU seconds of every frame."""
        return np.sum(self.cpu, axis=1)

    def step(self, number: int, pair: tuple[Sensor, Sensor], keep: bool = True) -> None:
        """Go through one frame; `keep` its times."""
        camera, lidar = pair
        T_map_camera, T_map_lidar = mounted(pair, self.poses[number], number)
        wall, cpu = -time.perf_counter(), [time.process_time()]
        loaded = self.scene.update(T_map_lidar[:3, 3]).loaded
        cpu.append(time.process_time())
        seen = self.scene.cast(camera.bundle, T_map_camera, camera.reach, out=camera.out)
        cpu.append(time.process_time())
        self.scene.cast(lidar.bundle, T_map_lidar, lidar.reach, out=lidar.out)
        cpu.append(time.process_time())
        wall += time.perf_counter()
        # What a detector and the sensor would contribute is not timed.
        visible = self._visible(seen)
        believed = {n: self._believed(n, T_map_camera) for n in visible}
        depth = np.where(seen.hit, seen.distances, np.float32(0.0)).reshape(camera.bundle.shape)
        wall, start = wall - time.perf_counter(), time.process_time()
        self._track(visible)
        self._registration.register(depth, office.CAMERA, {self._instances[n]: T for n, T in believed.items()})
        cpu.append(cpu[-1] + time.process_time() - start)
        wall += time.perf_counter()
        if keep:
            self.cpu.append(np.diff(cpu).tolist())
            self.wall.append(wall)
            self.live.append(self.scene.live_instances)
            self.tracked.append(len(visible))
            self.loaded += loaded

    def close(self) -> None:
        """Release the scenes; the world stays."""
        self.scene.close()
        self._registration.close()

    def _visible(self, seen: PagedHits) -> list[int]:
        """The objects that fill the most pixels."""
        counts = np.bincount(seen.hits.instances + 1, minlength=2)[1:]
        owners = seen.owners[: len(counts)]
        counts = np.where((owners >= 0) & (owners < self.world.objects), counts, 0)
        order = np.argsort(-counts, kind="stable")[:_TRACKED]
        return owners[order[counts[order] >= _PIXELS]].tolist()

    def _believed(self, number: int, T_map_camera: Float64) -> Float64:
        """T_camera_object as a track predicts it: millimetres and fractions of a degree off."""
        rng = np.random.default_rng(number)
        T = inverse(T_map_camera) @ self.scene.index.pose(number)
        turn, shift = rng.normal(scale=0.005, size=3), rng.normal(scale=0.002, size=3)
        return transform(exp_so3(turn) @ T[:3, :3], T[:3, 3] + shift)

    def _track(self, visible: Sequence[int]) -> None:
        """Let the registration's scene hold the visible objects."""
        for number in [n for n in self._instances if n not in visible]:
            self._registration.remove(self._instances.pop(number))
        free = [i for i in range(_TRACKED) if i not in self._instances.values()]
        for number in visible:
            if number not in self._instances:
                self._instances[number] = free.pop()
                model = int(self.scene.index.models([number])[0])
                self._registration.add(self._instances[number], self.models[model])


class AllLive:
    """A whole world in one scene: objects and structure under their ids, then the panels of the closed doors."""

    def __init__(self, world: rooms.Rooms) -> None:
        index = world.index
        self.scene, self.world = RayScene(), world
        numbers, panel = np.arange(len(index)), TriangleMesh(*_PANEL)
        closed = np.flatnonzero(~index.regions.is_open).tolist()
        meshes = [world.meshes[model] for model in index.models(numbers).tolist()]
        self.scene.add_many(meshes, index.poses(numbers), numbers.tolist())
        panels = np.array([index.regions.rectangle(portal) for portal in closed])
        self.scene.add_many([panel] * len(closed), panels, range(len(index), len(index) + len(closed)))
        self.scene.commit()

    @staticmethod
    def size(world: rooms.Rooms) -> int:
        """Instances that a world takes."""
        return len(world.index) + int(np.count_nonzero(~world.index.regions.is_open))

    def cast(self, pair: tuple[Sensor, Sensor], T_map_base: Float64, number: int) -> list[RayHits]:
        """What camera and lidar meet in a frame of a drive."""
        poses = mounted(pair, T_map_base, number)
        return [self.scene.cast(s.bundle, T, s.reach, out=s.out) for s, T in zip(pair, poses, strict=True)]

    def differing(self, paged: PagedHits, live: RayHits) -> tuple[int, int]:
        """Rays that met another object, or farther off than 1e-6 of the distance; and others that met another face.

        On an edge, which of its faces is met first, and the last bit of the distance, depends on what else there is.
        """
        panels = len(self.world.index) + np.cumsum(~self.world.index.regions.is_open) - 1
        instances = np.where(paged.portals >= 0, panels[paged.portals], paged.objects)
        same = (instances == live.instances) & np.isclose(paged.distances, live.distances, 1e-6, 0.0)
        same_face = (paged.faces == live.faces) & (paged.normals == live.normals).all(axis=1)
        return int(np.count_nonzero(~same)), int(np.count_nonzero(same & ~same_face))
