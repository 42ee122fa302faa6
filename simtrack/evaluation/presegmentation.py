"""How well the pre-segmentation tells the known from the unknown, for camera and lidar alike.

Definitions
-----------
* *Modelled* things are those that the stack was given a model of: what the map holds where it was surveyed, the
  catalogue objects (tracked or not) and the robot itself. Everything else is *unknown*: clutter, people, furniture
  that was moved or brought in since the survey.
* `known_rejected`: share of valid measurements on modelled things that are removed.
* `unknown_recall`: share kept of the valid measurements on unknown things that lie further than 3 sigma of the sensor
  at that range + 2 cm from every modelled surface (the map's, and the catalogue objects' at their true poses).
* `reduction`: share of all valid measurements that are removed, the tracking paper's figure (86 % in its Fig. 3).
* `objects_found`: share of unknown objects, seen with at least 200 pixels for at least 1 s, that some unknown cluster
  covers with an intersection over union of at least 0.5 among valid measurements in some evaluated frame.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import NANOSECONDS, Bool, Float64, Int32, LidarScan, Presegmentation, RgbdFrame, StaticMap
from simtrack.evaluation.metrics import Metrics, ratio
from simtrack.geometry.transforms import apply, interpolate, transform

if TYPE_CHECKING:
    from simtrack.raycast import RayScene

MARGIN = 0.02
"""Metres added to 3 sigma."""
LIDAR_SIGMA = 0.01
"""Metres: VLP-16 range noise (typical accuracy +-3 cm is taken as three sigma)."""
MAX_QUERIES = 4000
"""Distances are measured for at most so many points of a frame, evenly strided."""
FOUND_PIXELS, FOUND_SECONDS, FOUND_IOU = 200, 1.0, 0.5


@dataclass(frozen=True, slots=True)
class Measurements:
    """Measurements of one frame with what they truly hit; all arrays share their leading shape."""

    valid: Bool
    points: Float64
    """(..., 3), map frame by the sensor's true pose; undefined where not valid."""
    sigma: Float64
    """Metres, the sensor's standard deviation at each measurement's range."""
    ids: Int32
    """Index of the thing that was truly hit, -1 = none."""


_NOWHERE = transform(np.eye(3), (0.0, 0.0, -1e3))


class ModelledSurfaces:
    """Distances from the surfaces that the stack has models of, objects at their true poses."""

    def __init__(self, static_map: StaticMap, objects: Mapping[str, tuple[Float64, Int32]]) -> None:
        """`objects`: name -> (vertices (V, 3) in the object frame, faces (F, 3)) of the catalogue objects."""
        self._static_map, self._objects = static_map, dict(objects)
        self._poses: dict[str, Float64] = {}
        self._scene: RayScene | None = None
        self._instances: dict[str, int] = {}

    def place(self, poses: Mapping[str, Float64]) -> None:
        """Set the objects' (4, 4) T_map_object; what has none is not there."""
        self._poses = {name: poses.get(name, _NOWHERE) for name in self._objects}

    def distances(self, points: Float64, limit: float) -> Float64:
        """(N,) metres from (N, 3) points in the map frame to the closest surface, inf beyond `limit`."""
        if self._scene is None:  # on first need: a run does not wait for it to start
            self._scene = self._built()
        self._scene.set_poses([self._instances[name] for name in self._poses], list(self._poses.values()))
        return np.asarray(self._scene.closest_points(points, limit).distances, dtype=float)

    def _built(self) -> "RayScene":
        from simtrack.raycast import RayScene, TriangleMesh

        scene = RayScene()
        if len(self._static_map.faces):
            scene.add(TriangleMesh(self._static_map.vertices, self._static_map.faces))
        for name, (vertices, faces) in self._objects.items():
            self._instances[name] = scene.add(TriangleMesh(vertices, faces))
        return scene

    def close(self) -> None:
        """Release the scene."""
        if self._scene is not None:
            self._scene.close()


def camera_measurements(frame: RgbdFrame, T_map_camera: Float64, ids: Int32) -> Measurements:
    """Depth pixels, (H, W), with the (H, W) ids of what the pixels truly show."""
    from simtrack.sensors.camera import unproject
    from simtrack.sensors.depth_noise import axial_sigma

    valid = np.isfinite(frame.depth) & (frame.depth > 0)
    depth = np.where(valid, frame.depth, 1.0).astype(np.float32)
    points = apply(T_map_camera, np.asarray(unproject(depth, frame.intrinsics), dtype=float))
    return Measurements(valid, points, np.asarray(axial_sigma(depth), dtype=float), ids)


def lidar_measurements(scan: LidarScan, start: Float64, end: Float64, ids: Int32, keys: int = 16) -> Measurements:
    """Lidar shots, (N,), with ids; `start` and `end` are the true (4, 4) T_map_lidar at the first and the last shot."""
    valid = np.isfinite(scan.ranges) & (scan.ranges > 0)
    local = scan.directions.astype(float) * np.where(valid, scan.ranges, 1.0)[:, None]
    duration = max(float(scan.times.max()), 1e-9) if scan.times.size else 1.0
    key = np.minimum((scan.times / duration * keys).astype(int), keys - 1)
    points = np.empty_like(local)
    for k in range(keys):
        points[key == k] = apply(interpolate(start, end, (k + 0.5) / keys), local[key == k])
    return Measurements(valid, points, np.full(valid.shape, LIDAR_SIGMA), ids)


class PresegmentationEvaluator:
    """Scores the pre-segmentation of one sensor."""

    def __init__(self, sensor: str, surfaces: ModelledSurfaces, modelled: Sequence[bool]) -> None:
        """`modelled`: for each id of the ground truth, whether the stack was given a model of the thing."""
        self._sensor = sensor
        self._surfaces = surfaces
        self._modelled = np.append(np.asarray(modelled, dtype=bool), False)
        self._exists = np.append(np.ones(len(modelled), dtype=bool), False)
        self._known = self._rejected = self._unknown = self._kept = self._removed = self._measured = 0

    def count(self, result: Presegmentation) -> None:
        """Take one result for `reduction`; needs no truth."""
        self._measured += result.valid
        self._removed += result.valid - int(np.count_nonzero(result.unknown))

    def observe(self, result: Presegmentation, truth: Measurements) -> None:
        """Score one result; the objects' true poses are to be set in the modelled surfaces before."""
        known = truth.valid & self._modelled[truth.ids]
        self._known += int(np.count_nonzero(known))
        self._rejected += int(np.count_nonzero(known & ~result.unknown))
        rows = np.flatnonzero(truth.valid & self._exists[truth.ids] & ~self._modelled[truth.ids])
        rows = rows[:: -(-len(rows) // MAX_QUERIES)] if len(rows) else rows
        if not len(rows):
            return
        apart = 3.0 * truth.sigma.reshape(-1)[rows] + MARGIN
        points = np.ascontiguousarray(truth.points.reshape(-1, 3)[rows])
        counted = self._surfaces.distances(points, float(apart.max())) > apart
        self._unknown += int(np.count_nonzero(counted))
        self._kept += int(np.count_nonzero(counted & result.unknown.reshape(-1)[rows]))

    def metrics(self) -> Metrics:
        """The sensor's ``presegmentation.*`` metrics."""
        name = f"presegmentation.{self._sensor}"
        return {
            f"{name}.known_rejected": ratio(self._rejected, self._known, "no modelled thing was measured"),
            f"{name}.unknown_recall": ratio(self._kept, self._unknown, "no unknown thing was measured"),
            f"{name}.reduction": ratio(self._removed, self._measured, "nothing was measured"),
        }


class ObjectsFoundEvaluator:
    """Which unknown objects some cluster of the camera's pre-segmentation covers."""

    def __init__(self, names: Sequence[str], unknown: Sequence[str]) -> None:
        """`names` of the ground truth by id; `unknown` are those of the objects without a model."""
        self._index = {name: names.index(name) for name in unknown if name in names}
        self._since: dict[str, int] = {}
        self._seen: set[str] = set()
        self.best: dict[str, float] = {}
        """Object -> best intersection over union so far."""

    def see(self, stamp: int, pixels: Mapping[str, int]) -> None:
        """Take the number of visible pixels of each object at one stamp."""
        for name in self._index:
            if pixels.get(name, 0) < FOUND_PIXELS:
                self._since.pop(name, None)
            elif stamp - self._since.setdefault(name, stamp) >= FOUND_SECONDS * NANOSECONDS:
                self._seen.add(name)

    def observe(self, result: Presegmentation, ids: Int32, valid: Bool) -> None:
        """Take the clusters of one frame with the true ids, all (H, W)."""
        sizes = np.bincount(result.labels[valid].ravel(), minlength=1)
        for name, index in self._index.items():
            covered = result.labels[(ids == index) & valid]
            if covered.size < FOUND_PIXELS:
                continue
            overlap = np.bincount(covered, minlength=len(sizes))
            overlap[0] = 0
            iou = overlap / (sizes + covered.size - overlap)
            self.best[name] = max(self.best.get(name, 0.0), float(iou.max()))

    def metrics(self) -> Metrics:
        """`presegmentation.objects_found`."""
        found = sum(self.best.get(name, 0.0) >= FOUND_IOU for name in self._seen)
        missing = f"no unknown object was seen with {FOUND_PIXELS} pixels for {FOUND_SECONDS:g} s"
        return {"presegmentation.objects_found": ratio(found, len(self._seen), missing)}
