"""A bench with objects, seen by a depth camera, for the tracking tests."""

from collections.abc import Mapping

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Float64, RgbdFrame
from simtrack.geometry.transforms import inverse, look_at, perturb, transform_xyz_rpy
from simtrack.objects import ObjectModel, load_object
from simtrack.perception.tracking.registration import Registration, RegistrationConfig
from simtrack.perception.tracking.target import tracked_model
from simtrack.raycast import RayBundle, RayScene, TriangleMesh

INTRINSICS = CameraIntrinsics(320, 240, 288.5, 288.5, 159.5, 119.5)
BENCH = 0.85
T_MAP_CAMERA = look_at(np.array([0.0, -1.0, 1.35]), np.array([0.0, 0.1, BENCH]))
COVARIANCE = 1e-8 * np.eye(6)
INSTANCE = 1


class BenchWorld:
    """True bodies on a bench top before a wall."""

    def __init__(self) -> None:
        self.scene = RayScene()
        for a, u, v in (
            ((-1.0, -0.4, BENCH), (2.0, 0, 0), (0, 1.0, 0)),
            ((-3.0, 1.5, 0.0), (6.0, 0, 0), (0, 0, 3.0)),
        ):
            corners = np.array([a, np.add(a, u), np.add(np.add(a, u), v), np.add(a, v)], float)
            self.scene.add(TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]])))

    def add(self, model: ObjectModel, T_map_object: Float64) -> int:
        return self.scene.add(TriangleMesh(model.mesh.vertices, model.mesh.faces), T_map_object)

    def depth(self, T_map_camera: Float64 = T_MAP_CAMERA) -> Float32:
        bundle = RayBundle.from_camera(INTRINSICS)
        d = self.scene.cast(bundle, T_map_camera).distances.reshape(bundle.shape)
        return np.where(np.isfinite(d), d, 0.0).astype(np.float32)

    def frame(self, stamp: int, depth: Float32 | None = None) -> RgbdFrame:
        return RgbdFrame(stamp, self.depth() if depth is None else depth, None, INTRINSICS, np.eye(4))


def on_bench(model: ObjectModel, x: float, y: float, yaw: float) -> Float64:
    return transform_xyz_rpy((x, y, BENCH + 0.5 * float(model.extents[2])), (0.0, 0.0, yaw))


def in_camera(T_map_object: Float64) -> Float64:
    return inverse(T_MAP_CAMERA) @ T_map_object


def displaced(T: Float64, metres: float, degrees: float, rng: np.random.Generator) -> Float64:
    shift, axis = rng.standard_normal(3), rng.standard_normal(3)
    xi = np.concatenate([metres * shift / np.linalg.norm(shift), np.deg2rad(degrees) * axis / np.linalg.norm(axis)])
    return perturb(T, xi)


def register(
    name: str, depth: Float32, T_start: Float64, config: RegistrationConfig | None = None, fixed: Mapping | None = None
):
    registration = Registration(config)
    registration.add(INSTANCE, tracked_model(load_object(name)))
    try:
        return registration.register(depth, INTRINSICS, {INSTANCE: T_start}, fixed)[INSTANCE]
    finally:
        registration.close()
