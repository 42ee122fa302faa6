"""A small synthetic building with a driving VLP-16: what the localizer is tested in, without the simulator."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest

from simtrack.contracts import NANOSECONDS, LidarScan, Odometry, Room, StaticMap
from simtrack.geometry.transforms import exp_so3, inverse, transform, transform_planar
from simtrack.raycast import RayScene, TriangleMesh

ELEVATIONS = np.radians([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
T_BASE_LIDAR = transform(translation=(0.05, 0.0, 1.2))


@dataclass(frozen=True)
class Box:
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    movable: bool = False


def tessellate(boxes: list[Box], cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Outward-facing grid tessellation of boxes with shared vertices inside each face of a box."""
    vertices, faces, count = [], [], 0
    for box in boxes:
        low, high = np.array(box.low), np.array(box.high)
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            nu, nv = (max(1, int(np.ceil((high[k] - low[k]) / cell))) for k in (u, v))
            gu, gv = np.meshgrid(
                np.linspace(low[u], high[u], nu + 1), np.linspace(low[v], high[v], nv + 1), indexing="ij"
            )
            for side, value in ((0, low[axis]), (1, high[axis])):
                grid = np.empty((gu.size, 3))
                grid[:, axis], grid[:, u], grid[:, v] = value, gu.ravel(), gv.ravel()
                index = np.arange(gu.size).reshape(gu.shape) + count
                a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
                quads = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
                faces.append(quads if side else quads[:, ::-1])
                vertices.append(grid)
                count += len(grid)
    return np.concatenate(vertices), np.concatenate(faces)


def shell(x0: float, y0: float, x1: float, y1: float, height: float = 2.7) -> list[Box]:
    """Floor, ceiling and four outer walls of a rectangle."""
    w = 0.15
    return [
        Box((x0 - w, y0 - w, -0.2), (x1 + w, y1 + w, 0.0)),
        Box((x0 - w, y0 - w, height), (x1 + w, y1 + w, height + 0.2)),
        Box((x0 - w, y0 - w, 0), (x0, y1 + w, height)),
        Box((x1, y0 - w, 0), (x1 + w, y1 + w, height)),
        Box((x0, y0 - w, 0), (x1, y0, height)),
        Box((x0, y1, 0), (x1, y1 + w, height)),
    ]


def furniture(rng: np.random.Generator, x0: float, y0: float, x1: float, y1: float, count: int) -> list[Box]:
    """Cupboards, tables (as blocks) and the like along the walls of a room; every third was moved since the survey."""
    boxes = []
    for k in range(count):
        size = rng.uniform([0.4, 0.4, 0.6], [1.2, 0.8, 2.0])
        if rng.random() < 0.5:
            x = rng.uniform(x0 + 0.1, max(x0 + 0.2, x1 - size[0] - 0.1))
            y = y0 + 0.02 if rng.random() < 0.5 else y1 - size[1] - 0.02
        else:
            y = rng.uniform(y0 + 0.1, max(y0 + 0.2, y1 - size[1] - 0.1))
            x = x0 + 0.02 if rng.random() < 0.5 else x1 - size[0] - 0.02
        boxes.append(Box((x, y, 0.0), (x + size[0], y + size[1], size[2]), movable=k % 3 == 2))
    return boxes


@dataclass
class World:
    """Truth, the map that was surveyed of it, and a robot that drives in it."""

    boxes: list[Box]
    rooms: tuple[Room, ...]
    static_map: StaticMap
    scene: RayScene = field(default_factory=RayScene)
    range_noise: float = 0.008

    def __post_init__(self) -> None:
        vertices, faces = tessellate(self.boxes, 100.0)
        self.scene.add(TriangleMesh(vertices, faces))

    def scan(
        self,
        pose: Callable[[float], np.ndarray],
        t0: float,
        rng: np.random.Generator,
        *,
        moving: bool = True,
        sequence: int = 0,
    ) -> LidarScan:
        """One turn of a VLP-16 at 10 Hz from time `t0` in seconds; every shot from its own pose."""
        columns = 1808
        times = (np.arange(columns)[:, None] * 55.296e-6 + np.arange(16) * 2.304e-6).ravel()
        azimuth = -2 * np.pi * 10.0 * times
        elevation = np.tile(ELEVATIONS, columns)
        directions = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1
        )
        knots = np.linspace(0.0, 0.1, 41)
        poses = np.stack([pose(t0 + (t if moving else knots[-1])) for t in knots])
        which = np.minimum((times / 0.1 * 40).astype(int), 39)
        share = times / 0.1 * 40 - which
        t_base = poses[which, :3, 3] * (1 - share)[:, None] + poses[which + 1, :3, 3] * share[:, None]
        yaw = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
        yaw = yaw[which] * (1 - share) + yaw[which + 1] * share
        c, s = np.cos(yaw), np.sin(yaw)

        def turn(v: np.ndarray) -> np.ndarray:
            return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]], 1)

        mount = np.broadcast_to(T_BASE_LIDAR[:3, 3], directions.shape)
        hits = self.scene.cast_rays(t_base + turn(mount), turn(directions @ T_BASE_LIDAR[:3, :3].T))
        ranges = hits.distances.astype(np.float64)
        ranges += self.range_noise * rng.standard_normal(len(ranges))
        ranges[(ranges > 100.0) | (ranges < 0.4)] = np.inf
        return LidarScan(
            stamp=round(t0 * NANOSECONDS),
            directions=directions.astype(np.float32),
            ranges=ranges.astype(np.float32),
            times=times.astype(np.float32),
            rings=np.tile(np.argsort(np.argsort(ELEVATIONS)), columns).astype(np.uint8),
            intensities=np.zeros(len(ranges), np.float32),
            T_base_lidar=T_BASE_LIDAR,
            sequence=sequence,
        )


def make_world(
    boxes: list[Box], rooms: tuple[Room, ...], rng: np.random.Generator, noise: float = 0.005, cell: float = 0.25
) -> World:
    """World with its survey: another tessellation, noise, and what is movable displaced."""
    surveyed = []
    for box in boxes:
        shift = np.append(rng.uniform(-0.4, 0.4, 2), 0.0) if box.movable and noise > 0 else np.zeros(3)
        low, high = (tuple(float(x) for x in np.array(corner) + shift) for corner in (box.low, box.high))
        surveyed.append(Box(low, high, box.movable))  # type: ignore[arg-type]
    vertices, faces = tessellate(surveyed, cell)
    vertices = vertices + noise * rng.standard_normal(vertices.shape)
    static_map = StaticMap(vertices.astype(np.float32), faces.astype(np.int32), rooms=rooms, noise=max(noise, 1e-5))
    return World(boxes, rooms, static_map)


def room(name: str, x0: float, y0: float, x1: float, y1: float) -> Room:
    return Room(name, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), 0.0, 2.7)


def lab(rng: np.random.Generator, noise: float = 0.005) -> World:
    """One furnished room of 6 x 5 m."""
    boxes = shell(0, 0, 6, 5) + furniture(rng, 0, 0, 6, 5, 9)
    return make_world(boxes, (room("lab", 0, 0, 6, 5),), rng, noise)


def corridor(rng: np.random.Generator, length: float = 300.0, noise: float = 0.005) -> World:
    """A straight bare corridor, 2 m wide, whose ends are out of the lidar's reach."""
    return make_world(shell(0, 0, length, 2), (room("corridor", 0, 0, length, 2),), rng, noise, cell=0.5)


def office(rng: np.random.Generator, noise: float = 0.005) -> World:
    """A corridor of 24 m with four furnished rooms of different sizes on each side, doors open."""
    boxes = shell(0, 0, 24, 12)
    rooms = [room("corridor", 0, 5, 24, 7)]
    for side, (y0, y1, wall) in enumerate(((0.0, 5.0, 4.9), (7.0, 12.0, 7.0))):
        cuts = np.array([0.0, *(np.array([5.0, 11.0, 18.0]) + rng.uniform(-1.5, 1.5, 3)), 24.0])
        for k, (a, b) in enumerate(pairwise(cuts)):
            if k:
                boxes.append(Box((a - 0.05, y0, 0), (a + 0.05, y1, 2.7)))
            door = rng.uniform(a + 0.6, b - 1.6)
            boxes += [Box((a, wall, 0), (door, wall + 0.1, 2.7)), Box((door + 0.95, wall, 0), (b, wall + 0.1, 2.7))]
            boxes.append(Box((door, wall, 2.1), (door + 0.95, wall + 0.1, 2.7)))
            boxes += furniture(rng, a + 0.05, y0, b - 0.05, y1, 5)
            rooms.append(room(f"office{side}{k}", a, y0, b, y1))
    return make_world(boxes, tuple(rooms), rng, noise)


def two_rooms(rng: np.random.Generator) -> World:
    """Two rooms that are the same to the millimetre."""
    boxes: list[Box] = []
    inside = furniture(rng, 0, 0, 4, 3, 5)
    for x in (0.0, 6.0):
        boxes += shell(x, 0, x + 4, 3)
        for box in inside:
            low, high = (tuple(np.add(corner, (x, 0, 0))) for corner in (box.low, box.high))
            boxes.append(Box(low, high))
    return make_world(boxes, (room("left", 0, 0, 4, 3), room("right", 6, 0, 10, 3)), rng)


@dataclass
class Drive:
    """A differential drive with commanded speeds, and the wheel odometry that it reports."""

    start: np.ndarray
    speeds: Callable[[float], tuple[float, float]]
    duration: float
    odometry_noise: float = 0.02
    step: float = 0.005

    def __post_init__(self) -> None:
        poses = [np.array(self.start, dtype=float)]
        self._twists = []
        for k in range(int(np.ceil(self.duration / self.step)) + 1):
            v, w = self.speeds(k * self.step)
            motion = transform_planar(v * self.step, 0.0, 0.0)
            motion[:3, :3] = exp_so3(np.array([0, 0, w * self.step]))
            half = transform(exp_so3(np.array([0, 0, w * self.step / 2])))
            poses.append(poses[-1] @ transform(half[:3, :3]) @ transform_planar(v * self.step, 0, 0) @ half)
            self._twists.append((v, w))
        self._poses = np.stack(poses)

    def pose(self, time: float) -> np.ndarray:
        k = min(max(int(time / self.step), 0), len(self._poses) - 2)
        share = time / self.step - k
        a, b = self._poses[k], self._poses[k + 1]
        yaw = np.arctan2(a[1, 0], a[0, 0])
        turn = np.arctan2(*(np.linalg.inv(a) @ b)[[1, 0], [0, 0]])
        xyz = a[:3, 3] + share * (b[:3, 3] - a[:3, 3])
        return transform_planar(xyz[0], xyz[1], yaw + share * turn)

    def odometry(self, rng: np.random.Generator, rate: float = 50.0) -> Iterator[Odometry]:
        """Readings with noise proportional to the motion, and a scale error."""
        T, last = np.eye(4), self.pose(0.0)
        scale = 1.0 + self.odometry_noise * rng.standard_normal(2) * 0.3
        for k in range(int(self.duration * rate) + 1):
            now = self.pose(k / rate)
            motion = inverse(last) @ now
            length, angle = motion[0, 3], np.arctan2(motion[1, 0], motion[0, 0])
            noisy = 1.0 + self.odometry_noise * rng.standard_normal(2) * 3.0
            length, angle = length * scale[0] * noisy[0], angle * scale[1] * noisy[1]
            T = T @ transform_planar(length * np.cos(angle / 2), length * np.sin(angle / 2), angle)
            last = now
            v, w = self._twists[min(int(k / rate / self.step), len(self._twists) - 1)]
            yield Odometry(round(k / rate * NANOSECONDS), T, v, w)


@pytest.fixture(scope="session")
def lab_world() -> World:
    return lab(np.random.default_rng(3))


@pytest.fixture(scope="session")
def exact_lab() -> World:
    world = lab(np.random.default_rng(3), noise=0.0)
    world.range_noise = 0.0
    return world


@pytest.fixture(scope="session")
def office_world() -> World:
    return office(np.random.default_rng(5))


@pytest.fixture(scope="session")
def corridor_world() -> World:
    return corridor(np.random.default_rng(7))


@pytest.fixture(scope="session")
def two_rooms_world() -> World:
    return two_rooms(np.random.default_rng(9))


@pytest.fixture(scope="session")
def make_drive() -> type[Drive]:
    return Drive
