"""A settled room as somebody with an RGB-D camera in their hands films it: frames, poses, and what every pixel is of.

Three rounds through the free middle of the room: across it, along the walls, and down at what stands there. Frames are
cast when they are asked for, from the room, the seed and their number alone.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType, TracebackType

import numba as nb
import numpy as np

from simtrack.contracts import NANOSECONDS, Float32, Float64, Int32, RgbdFrame, Uint8
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.transforms import transform
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.sensors.camera import KINECT_V2, XTION, CameraModel
from simtrack.sensors.depth_noise import apply_depth_noise, preset
from simtrack.simulation.building.rooms.physics import SettledRoom

SENSORS: Mapping[str, CameraModel] = MappingProxyType({"xtion": XTION, "kinect_v2": KINECT_V2})
"""Cameras by the name of their depth noise."""
MOST_FRAMES = 100_000
_ANGLES = 96
"""Directions from the middle of the room in which the way out is looked for."""
_LIGHT = np.array([0.36, 0.24, 0.9])
_GREY = (170, 170, 170)


@dataclass(frozen=True, slots=True)
class FilmConfig:
    """How a room is filmed."""

    frames: int = 300
    """Taken evenly from the whole of the walk."""
    seconds: float = 50.0
    """The walk takes so long: at 30 Hz, 1500 frames."""
    sensor: str = "xtion"
    """One of `SENSORS`."""
    noise: bool = True
    """Whether the depth has the sensor's noise; without it only what is out of range has no reading."""
    clearance: float = 0.4
    """Metres between the camera and the nearest surface, where the room allows."""
    shake: float = 0.012
    """Radians, standard deviation of what hands do not keep still; half as much in metres."""

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= MOST_FRAMES:
            raise InvalidValueError("FilmConfig.frames", self.frames, f"1 to {MOST_FRAMES}")
        if self.sensor not in SENSORS:
            raise UnknownNameError("sensor of a film", self.sensor, SENSORS)
        for name in ("seconds", "clearance"):
            if not 0.0 < getattr(self, name) < 1e6:
                raise InvalidValueError(f"FilmConfig.{name}", getattr(self, name), "a finite number > 0")
        if not 0.0 <= self.shake < 0.2:
            raise InvalidValueError("FilmConfig.shake", self.shake, "0 to 0.2 radians")


@dataclass(frozen=True, slots=True, eq=False)
class FilmFrame:
    """One frame and the truth about it."""

    frame: RgbdFrame
    """The camera is its own base."""
    T_map_camera: Float64
    """(4, 4)."""
    instances: Int32
    """(H, W), number of the entity in `SettledRoom.entities`, -1 = nothing."""
    depth: Float32
    """(H, W), metres along the optical axis without noise, 0 = nothing."""


class RoomFilm:
    """Frames of a room by number; a context manager, since it holds a ray scene."""

    def __init__(self, room: SettledRoom, config: FilmConfig | None = None, seed: int = 0) -> None:
        self.room, self.config, self.seed = room, config or FilmConfig(), seed
        self.camera = SENSORS[self.config.sensor]
        self._noise = preset(self.config.sensor)
        self._bundle = RayBundle.from_camera(self.camera.intrinsics)
        self._scene = RayScene()
        colors: list[Uint8] = []
        for number, entity in enumerate(room.entities):
            mesh = entity.mesh
            self._scene.add(TriangleMesh(mesh.vertices, mesh.faces, entity.name), instance=number)
            plain = np.tile(np.array(_GREY, np.uint8), (len(mesh.faces), 1))
            colors.append(plain if mesh.face_colors is None else mesh.face_colors)
        self._colors = np.concatenate(colors)
        self._first = np.cumsum([0, *map(len, colors)])[:-1]
        rng = np.random.default_rng([seed, room.plan.seed, 0x46696C6D])
        self.poses = _walk(room, self._scene, self.config, rng)
        """T_map_camera (4, 4) of every frame."""

    def __len__(self) -> int:
        return self.config.frames

    def __iter__(self) -> Iterator[FilmFrame]:
        return (self.at(number) for number in range(len(self)))

    def stamp(self, number: int) -> int:
        """Nanoseconds of a frame."""
        return round(number * self.config.seconds / self.config.frames * NANOSECONDS)

    def at(self, number: int) -> FilmFrame:
        """The frame of that number; IndexError if there is none."""
        T, K = self.poses[number], self.camera.intrinsics
        shape, reach = (K.height, K.width), self.camera.max_range
        hits = self._scene.cast(self._bundle, T, reach)
        depth = np.where(hits.hit, hits.distances, 0.0).astype(np.float32).reshape(shape)
        rays = np.ascontiguousarray(self._bundle.directions @ T[:3, :3].T.astype(np.float32))
        light = (_LIGHT / np.linalg.norm(_LIGHT)).astype(np.float32)
        rows = np.where(hits.hit, self._first[hits.instances] + hits.faces, -1)
        rgb = _shaded(rows, self._colors, hits.normals, hits.distances, rays, T[:3, 3].astype(np.float32), light)
        rng = np.random.default_rng([self.seed, self.room.plan.seed, number])
        if self.config.noise:
            normals = (hits.normals @ T[:3, :3].astype(np.float32)).reshape(*shape, 3)
            read = apply_depth_noise(depth, normals, K, self._noise, rng)
        else:
            read = np.where(depth >= self.camera.min_range, depth, np.float32(0.0))
        frame = RgbdFrame(self.stamp(number), read, rgb.reshape(*shape, 3), K, np.eye(4), number)
        return FilmFrame(frame, T, hits.instances.reshape(shape), depth)

    def close(self) -> None:
        """Release the ray scene."""
        self._scene.close()

    def __enter__(self) -> "RoomFilm":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _walk(room: SettledRoom, scene: RayScene, config: FilmConfig, rng: np.random.Generator) -> list[Float64]:
    """T_map_camera (4, 4) of every frame."""
    t = np.arange(config.frames) / config.frames
    rounds, start = 3.0, rng.uniform(0.0, 2.0 * np.pi)
    angle = start + 2.0 * np.pi * rounds * t
    low, high = room.plan.room.polygon.min(axis=0), room.plan.room.polygon.max(axis=0)
    middle = (low + high) / 2
    height = 1.45 + _wobble(t * config.seconds, 0.1, 0.12, rng)
    reach = _free_reach(scene, middle, (high - low) / 2, config, rng)
    radius = np.interp(angle % (2.0 * np.pi), np.linspace(0.0, 2.0 * np.pi, _ANGLES + 1), np.append(reach, reach[0]))
    eye = np.stack([middle[0] + radius * np.cos(angle), middle[1] + radius * np.sin(angle), height], axis=1)
    # Across the room, then past its middle, then along the walls and down; people turn smoothly from one to the next.
    heading = angle + np.interp(t, [0.0, 0.3, 0.38, 0.62, 0.7, 1.0], [2.9, 2.9, 2.1, 2.1, 1.3, 1.3])
    pitch = np.interp(t, [0.0, 0.3, 0.38, 0.62, 0.7, 1.0], [-0.42, -0.42, -0.3, -0.3, -0.62, -0.62])
    heading += _wobble(t * config.seconds, 0.12, 0.25, rng)
    pitch += _wobble(t * config.seconds, 0.15, 0.12, rng)
    roll = np.zeros(config.frames)
    for values, size in ((heading, 1.0), (pitch, 1.0), (roll, 1.0)):
        values += _wobble(t * config.seconds, 1.3, size * config.shake, rng)
    for axis in range(3):
        eye[:, axis] += _wobble(t * config.seconds, 1.3, 0.5 * config.shake, rng)
    return [_pose(*row) for row in zip(eye, heading, pitch, roll, strict=True)]


def _pose(eye: Float64, heading: float, pitch: float, roll: float) -> Float64:
    forward = np.array([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    return transform(np.stack([c * right + s * down, c * down - s * right, forward], axis=1), eye)


def _wobble(seconds: Float64, rate: float, size: float, rng: np.random.Generator) -> Float64:
    """A smooth random function of time with standard deviation `size`, frequencies about `rate` hertz."""
    rates, phases = rate * rng.uniform(0.6, 1.6, 6), rng.uniform(0.0, 2.0 * np.pi, 6)
    return size * np.sqrt(2.0 / 6.0) * np.sin(2.0 * np.pi * rates * seconds[:, None] + phases).sum(axis=1)


def _free_reach(
    scene: RayScene, middle: Float64, half: Float64, config: FilmConfig, rng: np.random.Generator
) -> Float64:
    """(_ANGLES,) metres from the middle up to which a camera has its clearance, smooth over the angle."""
    angles = 2.0 * np.pi * np.arange(_ANGLES) / _ANGLES
    ellipse = half[0] * half[1] / np.hypot(half[1] * np.cos(angles), half[0] * np.sin(angles))
    shares = np.linspace(0.0, rng.uniform(0.5, 0.65), 24)
    r = ellipse[:, None] * shares
    flat = middle + np.stack([r * np.cos(angles[:, None]), r * np.sin(angles[:, None])], axis=2)
    points = np.concatenate([flat, np.full((*r.shape, 1), 1.45)], axis=2).reshape(-1, 3)
    clear = scene.closest_points(points, 2.0 * config.clearance).distances.reshape(r.shape) > config.clearance
    clear[:, 0] = True
    last = np.argmin(np.concatenate([clear, np.zeros((_ANGLES, 1), bool)], axis=1), axis=1) - 1
    reach = r[np.arange(_ANGLES), last]
    # The smallest around, then the mean over less than that: smooth, and nowhere more than is free.
    width = 5
    around = np.stack([np.roll(reach, k) for k in range(-width, width + 1)])
    lowest = around.min(axis=0)
    return np.stack([np.roll(lowest, k) for k in range(-width, width + 1)]).mean(axis=0)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _shaded(rows, colors, normals, distances, rays, eye, light):
    """(N, 3) uint8: colours of the faces (row -1: black) under a light, with a blotchy pattern fixed to the surface."""
    out = np.zeros((len(rows), 3), np.uint8)
    for i in range(len(rows)):
        if rows[i] < 0:
            continue
        lit = normals[i, 0] * light[0] + normals[i, 1] * light[1] + normals[i, 2] * light[2]
        facing = normals[i, 0] * rays[i, 0] + normals[i, 1] * rays[i, 1] + normals[i, 2] * rays[i, 2]
        lit = -lit if facing > 0.0 else lit
        shade = np.float32(0.62) + np.float32(0.38) * lit
        mixed = np.uint32(2166136261)
        for axis in range(3):
            cell = np.int64(np.floor((eye[axis] + distances[i] * rays[i, axis]) * 25.0))
            mixed = np.uint32((mixed ^ np.uint32(cell & 0xFFFFFFFF)) * np.uint32(16777619))
        mixed ^= mixed >> np.uint32(13)
        shade *= np.float32(0.9) + np.float32(0.2) * np.float32(mixed & np.uint32(255)) / np.float32(255.0)
        for channel in range(3):
            out[i, channel] = np.uint8(min(max(shade * colors[rows[i], channel], 0.0), 255.0))
    return out
