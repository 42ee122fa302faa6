"""Random sensor feeds, and equality to the bit."""

from dataclasses import fields, is_dataclass

import numpy as np

from simtrack.contracts import (
    CameraIntrinsics,
    Detection,
    DetectionResult,
    JointState,
    LidarScan,
    Odometry,
    RgbdFrame,
    SensorFrame,
    Status,
)
from simtrack.geometry.transforms import exp_so3, transform

Entry = SensorFrame | DetectionResult


def same(a: object, b: object) -> bool:
    """Equality to the bit, types and shapes included, NaN equal to itself."""
    if is_dataclass(a) and is_dataclass(b) and not isinstance(a, type) and not isinstance(b, type):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, (tuple, list)) and isinstance(b, (tuple, list)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, dict) and isinstance(b, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    return type(a) is type(b) and (a == b or (a != a and b != b))


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return transform(exp_so3(rng.normal(size=3)), tuple(rng.normal(size=3)))


def rgbd_frame(
    rng: np.random.Generator, stamp: int, *, color: bool = True, size: tuple[int, int] = (6, 8)
) -> RgbdFrame:
    height, width = size
    depth = rng.uniform(0.4, 4.0, size).astype(np.float32)
    depth[rng.random(size) < 0.2] = 0.0
    depth.flat[0] = np.nan
    return RgbdFrame(
        stamp=stamp,
        depth=depth,
        rgb=rng.integers(0, 256, (height, width, 3), dtype=np.uint8) if color else None,
        intrinsics=CameraIntrinsics(width, height, 525.1, 525.3, (width - 1) / 2, (height - 1) / 2 + 0.1),
        T_base_camera=random_pose(rng),
        sequence=int(rng.integers(0, 2**40)),
    )


def lidar_scan(rng: np.random.Generator, stamp: int, shots: int = 32) -> LidarScan:
    directions = rng.normal(size=(shots, 3))
    ranges = rng.uniform(0.5, 100.0, shots).astype(np.float32)
    ranges[rng.random(shots) < 0.3] = np.inf
    return LidarScan(
        stamp=stamp,
        directions=(directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32),
        ranges=ranges,
        times=np.linspace(0.0, 0.1, shots, dtype=np.float32),
        rings=rng.integers(0, 16, shots).astype(np.uint8),
        intensities=rng.uniform(0.0, 255.0, shots).astype(np.float32),
        T_base_lidar=random_pose(rng),
        sequence=7,
    )


def odometry(rng: np.random.Generator, stamp: int) -> Odometry:
    return Odometry(stamp, random_pose(rng), float(rng.normal()), float(rng.normal()))


def joint_state(rng: np.random.Generator, stamp: int) -> JointState:
    return JointState(stamp, ("torso_lift_joint", "head_1_joint", "pläne"), rng.normal(size=3))


def detection_result(rng: np.random.Generator, stamp: int, count: int = 2) -> DetectionResult:
    detections = tuple(
        Detection(
            class_name=f"relay{index}",
            keypoints=rng.uniform(-50, 700, (9, 2)),
            keypoint_sigma=rng.uniform(0.1, 9.0, 9),
            box=rng.uniform(0, 640, 4),
            score=float(rng.random()),
        )
        for index in range(count)
    )
    return DetectionResult(
        stamp, stamp + 150_000_001, detections, Status.DEGRADED if count else Status.NO_DATA, stamp + 2 * 10**8
    )


def feed(rng: np.random.Generator, frames: int, size: tuple[int, int] = (6, 8)) -> list[Entry]:
    """Frames of every kind in an order of arrival that is not that of their stamps."""
    out: list[Entry] = []
    for index in range(frames):
        stamp = 1_000_000_007 + index * 33_333_333
        out += [joint_state(rng, stamp - 5), odometry(rng, stamp - 2)]
        if index % 3 == 2:
            out.append(lidar_scan(rng, stamp - 100_000_000))
        out.append(rgbd_frame(rng, stamp, color=index % 2 == 0, size=size))
        if index % 2 == 0:
            out.append(detection_result(rng, stamp, count=index % 3))
    out.insert(5, out[2])  # late and a duplicate
    return out
