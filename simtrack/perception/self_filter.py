"""The robot's own body in its own measurements, predicted by ray casting from its joint states."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Bool, CameraIntrinsics, Float32, LidarScan, RgbdFrame
from simtrack.errors import InvalidValueError
from simtrack.geometry.kinematics import KinematicTree
from simtrack.raycast import RayBundle, RayScene, TriangleMesh


@dataclass(frozen=True, slots=True)
class SelfFilterConfig:
    """How close to the predicted body a measurement counts as the body."""

    margin: float = 0.03
    """m in front of the predicted surface: calibration, encoders, sensor noise."""
    relative: float = 0.02
    """Of the range, added to `margin`."""
    edge: int = 2
    """Pixels by which the predicted silhouette is widened in images; the shots next to it in scans likewise."""
    stride: int = 2
    """Every how many-th pixel of an image is cast; the silhouette is widened accordingly."""

    def __post_init__(self) -> None:
        if not (self.margin >= 0.0 and self.relative >= 0.0):
            raise InvalidValueError("SelfFilterConfig.margin, relative", (self.margin, self.relative), ">= 0")
        if self.edge < 0 or self.stride < 1:
            raise InvalidValueError("SelfFilterConfig.edge, stride", (self.edge, self.stride), "edge >= 0, stride >= 1")


class SelfFilter:
    """Tells which measurements hit the robot itself.

    A measured range at the predicted surface of the body, or behind it (where nothing else can be seen), is the body;
    one clearly in front of it is something between sensor and body, and is kept.
    """

    def __init__(self, robot: KinematicTree, config: SelfFilterConfig | None = None) -> None:
        """Put the robot's links into a ray-cast scene, in the base frame.

        Args:
            robot: links with meshes.
            config: settings, the defaults if None.

        Raises:
            MeshError: a link's mesh is broken.
        """
        self.robot = robot
        self.config = config or SelfFilterConfig()
        self._scene = RayScene()
        self._links = {
            link.name: self._scene.add(TriangleMesh(link.vertices, link.faces, source=f"link {link.name}"))
            for link in robot.links
            if len(link.faces)
        }
        self._bundles: dict[tuple[CameraIntrinsics, int], RayBundle] = {}
        self._lidar_bundle: tuple[Float32, RayBundle] | None = None
        self._posture: tuple[tuple[str, float], ...] | None = None

    def lidar_mask(self, scan: LidarScan, positions: Mapping[str, float]) -> Bool:
        """(N,), True where a shot hit the robot.

        Args:
            scan: one turn; the body turns with the sensor, so no de-skewing is needed.
            positions: joint name -> rad or m.
        """
        self._place(positions)
        if self._lidar_bundle is None or not np.array_equal(self._lidar_bundle[0], scan.directions):
            bundle = RayBundle.from_directions(scan.directions, groups=scan.rings)
            self._lidar_bundle = (scan.directions.copy(), bundle)
        body = self._scene.cast(self._lidar_bundle[1], scan.T_base_lidar, max_distance=3.0, min_distance=0.06).distances
        for _ in range(self.config.edge):
            body = _nearest_in_ring(body, scan.rings)
        return self._own(scan.ranges, body)

    def camera_mask(self, frame: RgbdFrame, positions: Mapping[str, float]) -> Bool:
        """(H, W), True where a pixel shows the robot; pixels without reading are False.

        Args:
            frame: the image, of which depth and T_base_camera are used.
            positions: joint name -> rad or m.
        """
        return self._own(frame.depth, self.camera_depth(frame, positions)) & (frame.depth > 0)

    def camera_depth(self, frame: RgbdFrame, positions: Mapping[str, float]) -> Float32:
        """(H, W) predicted depth of the body in metres, inf where none is seen; silhouette widened."""
        self._place(positions)
        stride = self.config.stride
        key = (frame.intrinsics, stride)
        if key not in self._bundles:
            self._bundles[key] = RayBundle.from_camera(frame.intrinsics, stride=stride)
        bundle = self._bundles[key]
        depth = self._scene.cast(bundle, frame.T_base_camera, max_distance=3.0, min_distance=0.05).distances
        coarse = depth.reshape(bundle.shape)
        for _ in range(-(-self.config.edge // stride)):
            coarse = _nearest_around(coarse)
        height, width = frame.depth.shape
        return np.repeat(np.repeat(coarse, stride, axis=0), stride, axis=1)[:height, :width]

    def _place(self, positions: Mapping[str, float]) -> None:
        posture = tuple(sorted((name, float(value)) for name, value in positions.items()))
        if posture == self._posture:
            return
        for name, T_base_link in self.robot.forward(positions).items():
            if name in self._links:
                self._scene.set_pose(self._links[name], T_base_link)
        self._posture = posture

    def _own(self, measured: np.ndarray, body: np.ndarray) -> Bool:
        margin = self.config.margin + self.config.relative * np.where(np.isfinite(body), body, 0.0)
        return np.isfinite(body) & np.isfinite(measured) & (measured > body - margin)


def _nearest_around(image: np.ndarray) -> np.ndarray:
    """Minimum over the eight neighbours and the pixel itself."""
    padded = np.pad(image, 1, mode="edge")
    rows = np.minimum(np.minimum(padded[:-2], padded[1:-1]), padded[2:])
    return np.minimum(np.minimum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])


def _nearest_in_ring(distances: Float32, rings: np.ndarray) -> Float32:
    """Minimum over each shot and its neighbours in the same ring; rings are taken to be in order of time."""
    order = np.argsort(rings, kind="stable")
    line = distances[order]
    padded = np.concatenate([line[:1], line, line[-1:]])
    out = np.empty_like(distances)
    out[order] = np.minimum(np.minimum(padded[:-2], line), padded[2:])
    return out
