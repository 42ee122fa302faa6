"""The robot's own body in its own measurements, predicted by ray casting from its joint states."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Bool, Float32, LidarScan, RgbdFrame
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
    tolerance: float = 0.005
    """m that a link may have moved before it is placed anew: encoders tremble, and `margin` covers that."""

    def __post_init__(self) -> None:
        if not (self.margin >= 0.0 and self.relative >= 0.0 and self.tolerance >= 0.0):
            values = self.margin, self.relative, self.tolerance
            raise InvalidValueError("SelfFilterConfig.margin, relative, tolerance", values, ">= 0")
        if self.edge < 0 or self.stride < 1:
            raise InvalidValueError("SelfFilterConfig.edge, stride", (self.edge, self.stride), "edge >= 0, stride >= 1")


class _Turn:
    """The shots of a lidar's turn, which are the same every time, and where they meet the body."""

    def __init__(self, scan: LidarScan) -> None:
        self.directions, self.rings = scan.directions.copy(), scan.rings.copy()
        self.bundle = RayBundle.from_directions(self.directions, groups=self.rings)
        self.order = np.argsort(self.rings, kind="stable")
        self.T_base_lidar = np.eye(4)
        self.body: Float32 | None = None
        """(N,), metres to the body, silhouette widened; None where it has to be cast."""

    def same_shots(self, scan: LidarScan) -> bool:
        return np.array_equal(self.directions, scan.directions) and np.array_equal(self.rings, scan.rings)

    def nearest_in_ring(self, distances: Float32) -> Float32:
        """Minimum over each shot and its neighbours in the same ring; rings are taken to be in order of time."""
        line = distances[self.order]
        padded = np.concatenate([line[:1], line, line[-1:]])
        out = np.empty_like(distances)
        out[self.order] = np.minimum(np.minimum(padded[:-2], line), padded[2:])
        return out


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
        bodies = [link for link in robot.links if len(link.faces)]
        self._links = {
            link.name: self._scene.add(TriangleMesh(link.vertices, link.faces, source=f"link {link.name}"))
            for link in bodies
        }
        self._reach = np.array([float(np.linalg.norm(link.vertices, axis=1).max()) for link in bodies])
        self._turn: _Turn | None = None
        self._placed = np.full((len(self._links), 4, 4), np.nan)
        """Where the links were placed, base frame."""
        self._posture: tuple[tuple[str, float], ...] | None = None

    def lidar_mask(self, scan: LidarScan, positions: Mapping[str, float]) -> Bool:
        """(N,), True where a shot hit the robot.

        Args:
            scan: one turn; the body turns with the sensor, so no de-skewing is needed.
            positions: joint name -> rad or m.
        """
        self._place(positions)
        if self._turn is None or not self._turn.same_shots(scan):
            self._turn = _Turn(scan)
        turn = self._turn
        if turn.body is None or not np.array_equal(turn.T_base_lidar, scan.T_base_lidar):
            turn.T_base_lidar = scan.T_base_lidar.copy()
            hits = self._scene.cast(turn.bundle, scan.T_base_lidar, max_distance=3.0, min_distance=0.06)
            turn.body = hits.distances
            for _ in range(self.config.edge):
                turn.body = turn.nearest_in_ring(turn.body)
        return self._own(scan.ranges, turn.body)

    def camera_mask(self, frame: RgbdFrame, positions: Mapping[str, float]) -> Bool:
        """(H, W), True where a pixel shows the robot; pixels without reading are False.

        Args:
            frame: the image, of which depth and T_base_camera are used.
            positions: joint name -> rad or m.
        """
        body = self._coarse_depth(frame, positions)
        if np.isinf(body).all():  # mostly the camera looks elsewhere
            return np.zeros(frame.depth.shape, np.bool_)
        return self._own(frame.depth, self._widened(body, frame.depth.shape)) & (frame.depth > 0)

    def camera_depth(self, frame: RgbdFrame, positions: Mapping[str, float]) -> Float32:
        """(H, W) predicted depth of the body in metres, inf where none is seen; silhouette widened."""
        return self._widened(self._coarse_depth(frame, positions), frame.depth.shape)

    def _coarse_depth(self, frame: RgbdFrame, positions: Mapping[str, float]) -> Float32:
        """Depth of the body in every `stride`-th pixel, metres, inf where none is seen."""
        self._place(positions)
        bundle = RayBundle.from_camera(frame.intrinsics, stride=self.config.stride)
        depth = self._scene.cast(bundle, frame.T_base_camera, max_distance=3.0, min_distance=0.05).distances
        return depth.reshape(bundle.shape)

    def _widened(self, coarse: Float32, shape: tuple[int, ...]) -> Float32:
        """A coarse image at full resolution, its silhouette widened."""
        stride = self.config.stride
        for _ in range(-(-self.config.edge // stride)):
            coarse = _nearest_around(coarse)
        return np.repeat(np.repeat(coarse, stride, axis=0), stride, axis=1)[: shape[0], : shape[1]]

    def _place(self, positions: Mapping[str, float]) -> None:
        posture = tuple(sorted((name, float(value)) for name, value in positions.items()))
        if posture == self._posture:
            return
        self._posture = posture
        T_base_link = self.robot.forward(positions)
        poses = np.array([T_base_link[name] for name in self._links]).reshape(-1, 4, 4)
        change = np.square(poses - self._placed)
        turned, shifted = change[:, :3, :3].sum(axis=(1, 2)), change[:, :3, 3].sum(axis=1)
        # Some point of a link may be so far from where it was placed; of one that was not yet, nothing is known.
        near = np.sqrt(turned) * self._reach + np.sqrt(shifted) <= self.config.tolerance
        moved = np.flatnonzero(~near)
        if len(moved):
            links = list(self._links.values())
            self._scene.set_poses([links[k] for k in moved], poses[moved])
            self._placed[moved] = poses[moved]
            if self._turn is not None:
                self._turn.body = None

    def _own(self, measured: np.ndarray, body: np.ndarray) -> Bool:
        margin = self.config.margin + self.config.relative * np.where(np.isfinite(body), body, 0.0)
        return np.isfinite(body) & np.isfinite(measured) & (measured > body - margin)


def _nearest_around(image: np.ndarray) -> np.ndarray:
    """Minimum over the eight neighbours and the pixel itself."""
    padded = np.pad(image, 1, mode="edge")
    rows = np.minimum(np.minimum(padded[:-2], padded[1:-1]), padded[2:])
    return np.minimum(np.minimum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])
