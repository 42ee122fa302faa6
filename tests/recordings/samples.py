"""A small room as its sensors would see it, and recordings of it in the formats that others use."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Float64
from simtrack.geometry.meshes import Mesh, box_mesh, concatenate, transformed
from simtrack.geometry.transforms import (
    exp_so3,
    look_at,
    perturb,
    quaternion_from_rotation,
    transform,
)
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.sensors.lidar import VLP16, LidarShots

CAMERA = CameraIntrinsics(320, 240, 280.0, 280.0, 159.5, 119.5)
LIDAR_START = transform(exp_so3(np.array([0.1, 0.5, 0.0])), (0.2, -0.3, 1.2))
"""Tilted: level, it would see nothing but upright walls in so small a room, and not its own height."""


def furnished_room() -> Mesh:
    """4 x 5 x 3 m, floor at z = 0, with a cupboard and a crate; faces inwards."""
    walls = box_mesh((4.0, 5.0, 3.0))
    inwards = Mesh(walls.vertices + [0.0, 0.0, 1.5], walls.faces[:, ::-1])
    cupboard = transformed(box_mesh((0.6, 1.2, 1.8)), transform(None, (1.6, 0.7, 0.9)))
    crate = transformed(box_mesh((0.5, 0.4, 0.5)), transform(exp_so3(np.array([0, 0, 0.5])), (-0.9, 1.5, 0.25)))
    return concatenate([inwards, cupboard, crate])


class World:
    """Meshes that rays are cast at."""

    def __init__(self, *meshes: Mesh) -> None:
        self.scene = RayScene()
        for mesh in meshes or (furnished_room(),):
            self.scene.add(TriangleMesh(mesh.vertices.astype(np.float32), mesh.faces))

    def depth(self, T_map_camera: Float64, intrinsics: CameraIntrinsics = CAMERA) -> Float32:
        hits = self.scene.cast(RayBundle.from_camera(intrinsics), T_map_camera)
        depth = np.where(np.isfinite(hits.distances), hits.distances, 0.0).astype(np.float32)
        return depth.reshape(intrinsics.height, intrinsics.width)

    def ranges(self, shots: LidarShots, T_map_lidar: Float64) -> Float32:
        directions = shots.directions @ T_map_lidar[:3, :3].T.astype(np.float32)
        origins = np.tile(T_map_lidar[:3, 3].astype(np.float32), (len(shots), 1))
        return self.scene.cast_rays(origins, directions.astype(np.float32)).distances

    def points(self, T_map_lidar: Float64, columns: int = 900) -> Float64:
        """Returns of one turn from a place at rest, lidar frame."""
        shots = VLP16.shots(columns=columns)
        return (self.ranges(shots, T_map_lidar)[:, None] * shots.directions).astype(np.float64)


def camera_path(count: int) -> list[Float64]:
    """T_map_camera of a hand-held camera that looks at the crate and the cupboard."""
    poses, start = [], look_at(np.array([-0.2, -1.6, 1.4]), np.array([0.3, 1.5, 0.6]))
    for k in range(count):
        poses.append(perturb(start, k * np.array([0.02, 0.012, -0.004, 0.004, -0.003, 0.008])))
    return poses


def lidar_path(count: int) -> list[Float64]:
    return [perturb(LIDAR_START, k * np.array([0.08, 0.05, 0.01, 0.004, 0.006, 0.03])) for k in range(count)]


# ------------------------------------------------------------------------------------------------------- RGB-D folders


def write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def units(depth: Float32, unit: float) -> np.ndarray:
    return np.round(depth / unit).astype(np.uint16)


def colour(number: int, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W, 3) RGB that is different in each channel and frame."""
    image = np.zeros((*shape, 3), np.uint8)
    image[:, :, 0], image[:, :, 1], image[:, :, 2] = 10 + number, 100, np.arange(shape[1])
    return image


def write_tum(folder: Path, depths: Sequence[Float32], poses: Sequence[Float64], period: float = 0.1) -> Path:
    """Colour and poses lag a little behind the depth images, as in the benchmark."""
    lines: dict[str, list[str]] = {"depth.txt": ["# depth"], "rgb.txt": ["# rgb"], "groundtruth.txt": ["# truth"]}
    for k, (depth, T) in enumerate(zip(depths, poses, strict=True)):
        stamp = 1305031102.5 + k * period
        write_png(folder / "depth" / f"{k}.png", units(depth, 1 / 5000))
        write_png(folder / "rgb" / f"{k}.png", colour(k, depth.shape)[:, :, ::-1])
        lines["depth.txt"].append(f"{stamp:.6f} depth/{k}.png")
        lines["rgb.txt"].append(f"{stamp + 0.004:.6f} rgb/{k}.png")
        w, *xyz = quaternion_from_rotation(T[:3, :3])
        lines["groundtruth.txt"].append(" ".join(f"{v:.9f}" for v in (stamp, *T[:3, 3], *xyz, w)))
    for name, rows in lines.items():
        (folder / name).write_text("\n".join(rows) + "\n")
    write_camera(folder)
    return folder


def write_camera(folder: Path) -> None:
    (folder / "camera.json").write_text(json.dumps({n: getattr(CAMERA, n) for n in ("fx", "fy", "cx", "cy")}))


def write_seven_scenes(folder: Path, depths: Sequence[Float32], poses: Sequence[Float64]) -> Path:
    for k, (depth, T) in enumerate(zip(depths, poses, strict=True)):
        image = units(depth, 0.001)
        image[image == 0] = 65535
        write_png(folder / f"frame-{k:06d}.depth.png", image)
        write_png(folder / f"frame-{k:06d}.color.png", colour(k, depth.shape)[:, :, ::-1])
        (folder / f"frame-{k:06d}.pose.txt").write_text("\n".join("\t ".join(f"{v:.7e}" for v in row) for row in T))
    write_camera(folder)
    return folder


def write_open3d(folder: Path, depths: Sequence[Float32], poses: Sequence[Float64]) -> Path:
    rows = []
    for k, (depth, T) in enumerate(zip(depths, poses, strict=True)):
        write_png(folder / "depth" / f"{k:05d}.png", units(depth, 0.001))
        write_png(folder / "color" / f"{k:05d}.png", colour(k, depth.shape)[:, :, ::-1])
        rows += [f"{k} {k} {k + 1}", *(" ".join(map(repr, row)) for row in T.tolist())]
    (folder / "trajectory.log").write_text("\n".join(rows) + "\n")
    matrix = CAMERA.matrix.T.ravel().tolist()
    (folder / "camera_intrinsic.json").write_text(json.dumps({"width": 320, "height": 240, "intrinsic_matrix": matrix}))
    return folder


# ------------------------------------------------------------------------------------------------------------- clouds


def write_kitti(folder: Path, clouds: Sequence[Float64], poses: Sequence[Float64]) -> Path:
    """With a camera that looks ahead, as in the odometry benchmark."""
    (folder / "velodyne").mkdir(parents=True)
    T_camera_lidar = transform(np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], float), (0.1, -0.05, -0.2))
    first = poses[0]
    rows = []
    for k, (points, T) in enumerate(zip(clouds, poses, strict=True)):
        values = np.column_stack([points, np.full(len(points), 0.5)]).astype("<f4")
        (folder / "velodyne" / f"{k:06d}.bin").write_bytes(values.tobytes())
        T_first = np.linalg.inv(first) @ T
        rows.append(T_camera_lidar @ T_first @ np.linalg.inv(T_camera_lidar))
    (folder / "poses.txt").write_text("\n".join(" ".join(f"{v:.12e}" for v in T[:3].ravel()) for T in rows) + "\n")
    (folder / "times.txt").write_text("\n".join(f"{0.1 * k:.6e}" for k in range(len(rows))) + "\n")
    tr = " ".join(f"{v:.12e}" for v in T_camera_lidar[:3].ravel())
    (folder / "calib.txt").write_text(f"P0: {' '.join(['0'] * 12)}\nTr: {tr}\n")
    return folder


def write_ply_points(path: Path, points: Float64, order: str = "<") -> None:
    kind = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    header = f"ply\nformat {kind} 1.0\ncomment made here\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "property uchar intensity\nend_header\n"
    if order:
        rows = np.zeros(len(points), [(axis, order + "f4") for axis in "xyz"] + [("intensity", "u1")])
        rows["x"], rows["y"], rows["z"], rows["intensity"] = *points.T, 77
        body = rows.tobytes()
    else:
        body = "\n".join(f"{x:.6f} {y:.6f} {z:.6f} 77" for x, y, z in points).encode() + b"\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header.encode() + body)


# ------------------------------------------------------------------------------------------------------------- VLP-16


def vlp16_packets(ranges: Float32, azimuth: float = 0.0, stamp: int = 3_599_990_000) -> list[bytes]:
    """Data packets of firings of 16 lasers at 10 turns a second; `stamp` microseconds past the hour."""
    firings = ranges.reshape(-1, 16)
    firings = firings[: len(firings) // 24 * 24]
    packets, per_firing = [], 360.0 * 10.0 * 55.296e-6
    for k in range(0, len(firings), 24):
        data = b""
        for block in range(12):
            first = k + 2 * block
            angle = round(100 * (azimuth + per_firing * first)) % 36000
            data += struct.pack("<HH", 0xEEFF, angle)
            for distance in firings[first : first + 2].ravel():
                data += struct.pack("<HB", round(distance / 0.002) if np.isfinite(distance) else 0, 99)
        microseconds = round(stamp + 55.296 * k) % 3_600_000_000
        packets.append(data + struct.pack("<IBB", microseconds, 0x37, 0x22))
    return packets


def udp(payload: bytes, vlan: bool = False) -> bytes:
    """An Ethernet frame with one datagram."""
    ip = struct.pack(">BBHHHBBH8x", 0x45, 0, 28 + len(payload), 0, 0, 64, 17, 0)
    tag = struct.pack(">HH", 0x8100, 5) if vlan else b""
    return bytes(12) + tag + b"\x08\x00" + ip + struct.pack(">HHHH", 2368, 2368, 8 + len(payload), 0) + payload


def pcap(packets: Sequence[bytes], order: str = "<", nanoseconds: bool = False, start: float = 1.7e9) -> bytes:
    """A capture of Ethernet frames 1.327 ms apart."""
    data = struct.pack(order + "IHHiIII", 0xA1B23C4D if nanoseconds else 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    for k, packet in enumerate(packets):
        moment = start + 0.001327 * k
        fraction = round((moment % 1.0) * (1e9 if nanoseconds else 1e6))
        data += struct.pack(order + "IIII", int(moment), fraction, len(packet), len(packet)) + packet
    return data


def beam_ranges(world: World, shots: LidarShots, T_map_lidar: Float64) -> Float32:
    """What a real VLP-16 reports from a place at rest: its beams leave it up to 11.2 mm above or below its centre."""
    from simtrack.recordings.velodyne import BEAM_HEIGHTS

    origins = np.zeros((len(shots), 3))
    origins[:, 2] = np.tile(np.asarray(BEAM_HEIGHTS) / 1000.0, len(shots) // 16)
    origins = origins @ T_map_lidar[:3, :3].T + T_map_lidar[:3, 3]
    directions = shots.directions @ T_map_lidar[:3, :3].T
    return world.scene.cast_rays(origins.astype(np.float32), directions.astype(np.float32)).distances
