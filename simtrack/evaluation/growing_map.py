"""The map that a recording without one makes of itself: the surface that its frames saw, as a mesh that grows."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from simtrack.contracts import Bool, Float64, LidarScan, Presegmentation, RgbdFrame, StaticMap
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh, concatenate, transformed
from simtrack.geometry.transforms import apply
from simtrack.objects.export import write_ply
from simtrack.perception.localization.surface import MapSurface
from simtrack.perception.mapping import ScanMeshConfig, mesh_of_depth, mesh_of_scan
from simtrack.perception.tracking.presegmentation import PresegmentationConfig, presegment_camera, presegment_lidar
from simtrack.raycast import RayBundle


@dataclass(frozen=True, slots=True)
class GrowingMapConfig:
    """Settings of `GrowingMap`."""

    mesh: ScanMeshConfig = field(default_factory=ScanMeshConfig)
    presegmentation: PresegmentationConfig = field(default_factory=PresegmentationConfig)
    noise: float = 0.01
    """Metres, standard deviation of a mesh of merged readings."""
    grow_below: float = 0.7
    """The map grows by what a frame sees beyond it if it covers a smaller share of the frame's readings."""
    beyond: float = 0.25
    """Metres from the map at which a lidar's return lies beyond it."""
    max_faces: int = 2_000_000
    """The map grows no further."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.grow_below <= 1.0:
            raise InvalidValueError("GrowingMapConfig.grow_below", self.grow_below, "0 to 1")
        if not (self.noise > 0.0 and self.beyond > 0.0):
            raise InvalidValueError("GrowingMapConfig.noise, beyond", (self.noise, self.beyond), "> 0 metres")


class GrowingMap:
    """A mesh map in the frame of the poses that it is given."""

    def __init__(self, config: GrowingMapConfig) -> None:
        self._config = config
        self._mesh = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
        self._surface: MapSurface | None = None
        self.frames = 0
        """Frames that it was made of."""

    @property
    def faces(self) -> int:
        """Number of triangles."""
        return len(self._mesh.faces)

    @property
    def surface(self) -> MapSurface:
        """For localization, made anew when the map has grown; there must be a face."""
        if self._surface is None:
            vertices = self._mesh.vertices.astype(np.float32)
            self._surface = MapSurface(StaticMap(vertices, self._mesh.faces, noise=self._config.noise))
        return self._surface

    def add(self, frame: RgbdFrame | LidarScan, T_map_sensor: Float64, keep: Bool | None = None) -> bool:
        """Add the surface that a frame saw, of all of its readings or of some; returns whether it saw any."""
        mesh = self._config.mesh
        seen = mesh_of_depth(frame, mesh, keep) if isinstance(frame, RgbdFrame) else mesh_of_scan(frame, mesh, keep)
        if not len(seen.faces):
            return False
        self._mesh = concatenate([self._mesh, transformed(seen, T_map_sensor)])
        self._surface = None
        self.frames += 1
        return True

    def grow(self, frame: RgbdFrame | LidarScan, T_map_sensor: Float64, covered: float) -> None:
        """Add what a frame saw beyond the map, if the map covers too small a share of it."""
        if covered < self._config.grow_below and self.faces < self._config.max_faces:
            self.add(frame, T_map_sensor, self._beyond(frame, T_map_sensor))

    def _beyond(self, frame: RgbdFrame | LidarScan, T: Float64) -> Bool:
        """(H, W) or (N,), True where a frame taken at the pose `T` looks past the map."""
        scene = self.surface.scene
        if isinstance(frame, RgbdFrame):
            hits = scene.cast(RayBundle.from_camera(frame.intrinsics), T)
            return ~np.isfinite(hits.distances).reshape(frame.depth.shape)
        returned = np.isfinite(frame.ranges)
        points = np.where(returned, frame.ranges, 0.0)[:, None] * frame.directions
        return returned & ~np.isfinite(scene.closest_points(apply(T, points), self._config.beyond).distances)

    def presegment(self, frame: RgbdFrame | LidarScan, T_map_sensor: Float64) -> Presegmentation:
        """What of a frame the map does not explain."""
        scene, config = self.surface.scene, self._config.presegmentation
        if isinstance(frame, RgbdFrame):
            return presegment_camera(frame, T_map_sensor, scene, config=config)
        return presegment_lidar(frame, lambda stamp: T_map_sensor, scene, config=config)

    def save(self, path: Path) -> None:
        """Write it as PLY, metres, for looking at it."""
        write_ply(path, self._mesh)
