"""Faults of a sensor feed and of its calibration, for testing what a stack survives."""

import heapq
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from simtrack.contracts import Float64, JointState, LidarScan, Odometry, RgbdFrame, SensorFrame
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import perturb

SENSORS: Mapping[str, type] = MappingProxyType(
    {"camera": RgbdFrame, "lidar": LidarScan, "odometry": Odometry, "joints": JointState}
)
"""Names by which faults address the sensors, and the frames they send."""


@dataclass(frozen=True, slots=True)
class FeedFaults:
    """Faults of one sensor's feed."""

    drop: float = 0.0
    """Probability that a frame never arrives."""
    late: float = 0.0
    """Probability that a frame arrives `delay` later than it should."""
    delay: float = 0.1
    """Seconds."""
    duplicate: float = 0.0
    """Probability that a frame arrives a second time, `delay` after the first."""

    def __post_init__(self) -> None:
        for name in ("drop", "late", "duplicate"):
            if not 0 <= getattr(self, name) <= 1:
                raise InvalidValueError(name, getattr(self, name), "a probability, 0..1")
        if not 0 <= self.delay < np.inf:
            raise InvalidValueError("delay", self.delay, ">= 0 seconds")


@dataclass(frozen=True, slots=True)
class CalibrationFaults:
    """How far what the robot believes of its sensors is from what they are."""

    camera: tuple[float, ...] = (0.0,) * 6
    """Perturbation xi of the believed T_base_camera: metres, then rotation vector in radians (left, base frame)."""
    lidar: tuple[float, ...] = (0.0,) * 6
    """Likewise of T_base_lidar."""
    camera_time_offset: float = 0.0
    """Seconds added to the stamps of camera frames."""
    lidar_time_offset: float = 0.0
    """Seconds added to the stamps of scans."""
    lidar_mirrored: bool = False
    """Scans name their lasers from the top instead of from the bottom: what is above the horizon is reported below."""
    encoder_bias: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """Joint name -> constant error of its encoder, rad or m."""

    def __post_init__(self) -> None:
        for name in ("camera", "lidar"):
            xi = getattr(self, name)
            if len(xi) != 6 or not np.isfinite(xi).all():
                raise InvalidValueError(name, xi, "six finite numbers: metres, then radians")
        for name in ("camera_time_offset", "lidar_time_offset"):
            if not np.isfinite(getattr(self, name)):
                raise InvalidValueError(name, getattr(self, name), "finite seconds")
        if not all(np.isfinite(v) for v in self.encoder_bias.values()):
            raise InvalidValueError("encoder_bias", dict(self.encoder_bias), "finite numbers")

    def believed_camera(self, T_base_camera: Float64) -> Float64:
        """(4, 4) T_base_camera as the robot believes it."""
        return perturb(T_base_camera, np.array(self.camera))

    def believed_lidar(self, T_base_lidar: Float64) -> Float64:
        """(4, 4) T_base_lidar as the robot believes it."""
        return perturb(T_base_lidar, np.array(self.lidar))

    def apply(self, frame: SensorFrame) -> SensorFrame:
        """The frame as a robot with this calibration would have it.

        Encoder bias goes on joint states; a camera pose that was computed from joints is not changed by it here.
        """
        if isinstance(frame, RgbdFrame):
            stamp = frame.stamp + round(1e9 * self.camera_time_offset)
            return replace(frame, stamp=stamp, T_base_camera=self.believed_camera(frame.T_base_camera))
        if isinstance(frame, LidarScan):
            stamp = frame.stamp + round(1e9 * self.lidar_time_offset)
            frame = replace(frame, stamp=stamp, T_base_lidar=self.believed_lidar(frame.T_base_lidar))
            return _mirrored(frame) if self.lidar_mirrored else frame
        if isinstance(frame, JointState) and self.encoder_bias:
            bias = np.array([self.encoder_bias.get(name, 0.0) for name in frame.names])
            return replace(frame, positions=frame.positions + bias)
        return frame


def _mirrored(scan: LidarScan) -> LidarScan:
    """A scan whose lasers are taken for each other, by elevation."""
    directions = scan.directions * np.array([1.0, 1.0, -1.0], np.float32)
    rings = scan.rings.max(initial=0) - scan.rings
    return replace(scan, directions=directions, rings=rings.astype(np.uint8))


class FaultyFeed:
    """Maps the frames that sensors send to the frames that arrive, in arrival order."""

    def __init__(self, faults: Mapping[str, FeedFaults], rng: np.random.Generator) -> None:
        """Create the feed.

        Args:
            faults: by sensor: ``camera``, ``lidar``, ``odometry``, ``joints``; sensors not named have none.
            rng: three numbers are drawn a frame of a sensor with faults, whatever happens to the frame.

        Raises:
            InvalidValueError: an unknown sensor.
        """
        unknown = sorted(set(faults) - set(SENSORS))
        if unknown:
            raise InvalidValueError("faults", unknown, f"sensors {', '.join(SENSORS)}")
        self._faults = {SENSORS[name]: fault for name, fault in faults.items()}
        self._rng = rng
        self._queue: list[tuple[int, int, SensorFrame]] = []
        self._count = 0

    def send(self, frame: SensorFrame, arrival: int) -> None:
        """Take a frame that would arrive at `arrival` (nanoseconds)."""
        fault = self._faults.get(type(frame))
        if fault is None:
            self._push(arrival, frame)
            return
        drop, late, twice = self._rng.random(3)
        if drop < fault.drop:
            return
        delay = round(1e9 * fault.delay)
        arrival += delay if late < fault.late else 0
        self._push(arrival, frame)
        if twice < fault.duplicate:
            self._push(arrival + delay, frame)

    def receive(self, now: int) -> list[SensorFrame]:
        """All frames that have arrived by `now` (nanoseconds) and were not received before, in arrival order."""
        frames: list[SensorFrame] = []
        while self._queue and self._queue[0][0] <= now:
            frames.append(heapq.heappop(self._queue)[2])
        return frames

    def _push(self, arrival: int, frame: SensorFrame) -> None:
        heapq.heappush(self._queue, (arrival, self._count, frame))
        self._count += 1


def apply_feed_faults(
    frames: Iterable[SensorFrame], faults: Mapping[str, FeedFaults], rng: np.random.Generator
) -> list[SensorFrame]:
    """A whole recording, sent at its stamps, as it would arrive."""
    feed = FaultyFeed(faults, rng)
    last = 0
    for frame in frames:
        feed.send(frame, frame.stamp)
        last = max(last, frame.stamp)
    longest = max((fault.delay for fault in faults.values()), default=0.0)
    return feed.receive(last + 2 * round(1e9 * longest) + 2)
