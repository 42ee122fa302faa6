"""Shows a run in rerun, live or as a file: images, what is unknown, tracked models, lidar, path, map.

Needs the extra ``viz``. Entities are named as simtrack's frames: everything below ``map`` is in the map frame.
"""

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import NANOSECONDS, Belief, Float64, LidarScan, RgbdFrame, SensorFrame, StaticMap, Track
from simtrack.errors import InvalidValueError, SimtrackError
from simtrack.geometry.kinematics import KinematicTree
from simtrack.geometry.transforms import apply
from simtrack.perception.localization.measurement import scan_end
from simtrack.report.colors import class_colors

if TYPE_CHECKING:
    from rerun import Mesh3D, RecordingStream

    from simtrack.evaluation.instrument.examination import Examination
    from simtrack.objects import ObjectModel

MAP_COLOR, ROBOT_COLOR = (150, 158, 168), (70, 130, 200)
DEPTH_STRIDE = 2
"""Pixels between logged depth readings: a quarter of the data."""


class RerunLog:
    """Watches a run (see `simtrack.evaluation.closed_loop.Observer`)."""

    def __init__(self, view: bool = False, path: Path | None = None) -> None:
        """`view`: start the viewer; `path`: save to this file.

        Raises:
            SimtrackError: rerun is not installed.
            InvalidValueError: the file cannot be written.
        """
        try:
            import rerun
        except ImportError as error:
            raise SimtrackError(
                "--view and --rrd need rerun, which is not installed; install the extra: pip install 'simtrack[viz]'"
            ) from error
        self._rr = rerun
        self._stream: RecordingStream = rerun.RecordingStream("simtrack")
        if path is not None:
            if not path.parent.is_dir():
                raise InvalidValueError("rrd", str(path), "a file in a folder that exists")
            self._stream.save(path)
        elif view:
            self._stream.spawn()
        if view and path is not None:
            raise InvalidValueError("view and rrd", str(path), "one of them at a time")
        self._path: list[Float64] = []
        self._known: set[str] = set()
        self._scans: list[LidarScan] = []
        """Not shown yet: what is believed of them comes later."""
        self._poses: deque[tuple[int, Float64]] = deque(maxlen=16)
        self._models: Mapping[str, ObjectModel] = {}
        self._colors: Mapping[str, str] = {}

    def start(self, static_map: StaticMap, models: "Mapping[str, ObjectModel]", robot: KinematicTree) -> None:
        """Log what does not change: map and robot."""
        rr, log = self._rr, self._stream.log
        self._models, self._colors = models, class_colors(models)
        log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        log(
            "map/static",
            rr.Mesh3D(
                vertex_positions=static_map.vertices, triangle_indices=static_map.faces, albedo_factor=[*MAP_COLOR, 110]
            ),
            static=True,
        )
        for name, T in robot.forward({}).items():
            link = next(link for link in robot.links if link.name == name)
            if len(link.faces):
                log(f"map/base/{name}", self._mesh(apply(T, link.vertices), link.faces, ROBOT_COLOR), static=True)

    def frame(self, frame: SensorFrame, belief: Belief | None) -> None:
        """Log one frame and the belief after it."""
        if isinstance(frame, LidarScan):
            self._scans = [*self._scans[-7:], frame]
        if belief is None or not isinstance(frame, RgbdFrame):
            return
        rr, stream = self._rr, self._stream
        stream.set_time("simulated", duration=belief.stamp / NANOSECONDS)
        self._log_camera(frame, belief)
        self._pose("map/base", belief.localization.T_map_base)
        self._path.append(belief.localization.T_map_base[:3, 3])
        stream.log("map/path", rr.LineStrips3D([np.array(self._path)], colors=[[80, 160, 255]], radii=0.01))
        self._log_tracks(belief.tracks)
        self._log_scan(belief)
        for stage, seconds in belief.stage_seconds.items():
            stream.log(f"time/{stage}", rr.Scalars(1e3 * seconds))

    def _log_camera(self, frame: RgbdFrame, belief: Belief) -> None:
        rr, log, K = self._rr, self._stream.log, frame.intrinsics
        self._pose("map/camera", belief.T_map_camera)
        pinhole = rr.Pinhole(
            image_from_camera=K.matrix, width=K.width, height=K.height, camera_xyz=rr.ViewCoordinates.RDF
        )
        log("map/camera/image", pinhole)
        if frame.rgb is not None:
            log("map/camera/image/rgb", rr.Image(frame.rgb).compress(jpeg_quality=85))
        millimetres = np.nan_to_num(1000.0 * frame.depth).clip(0, 65535).astype(np.uint16)
        coarse = millimetres[::DEPTH_STRIDE, ::DEPTH_STRIDE]
        log("depth", rr.DepthImage(coarse, meter=1000.0))
        if belief.camera is not None:  # of an earlier image
            self._stream.set_time("simulated", duration=belief.camera.stamp / NANOSECONDS)
            log("map/camera/image/unknown", rr.SegmentationImage(belief.camera.unknown.astype(np.uint8)))
            self._stream.set_time("simulated", duration=belief.stamp / NANOSECONDS)

    def _log_tracks(self, tracks: tuple[Track, ...]) -> None:
        rr, log = self._rr, self._stream.log
        shown: set[str] = set()
        for track in tracks:
            if not track.believed or track.class_name not in self._models:
                continue
            entity = f"map/tracks/{track.class_name}-{track.id}"
            shown.add(entity)
            if entity not in self._known:
                visual = self._models[track.class_name].visual
                color = tuple(int(self._colors[track.class_name][k : k + 2], 16) for k in (1, 3, 5))
                log(entity, self._mesh(visual.vertices, visual.faces, color))
            self._pose(entity, track.T_map_object)
        for entity in self._known - shown:
            log(entity, rr.Clear(recursive=True))
        self._known = shown

    def _log_scan(self, belief: Belief) -> None:
        result = belief.lidar
        self._poses.append((belief.stamp, belief.localization.T_map_base))
        scan = next((s for s in self._scans if result is not None and s.stamp == result.stamp), None)
        if scan is None or result is None:
            return
        self._scans = [s for s in self._scans if s.stamp > scan.stamp]
        end = scan_end(scan)
        T_map_base = min(self._poses, key=lambda pose: abs(pose[0] - end))[1]
        valid = np.isfinite(scan.ranges) & (scan.ranges > 0)
        points = scan.directions[valid].astype(float) * scan.ranges[valid, None]
        colors = np.where(result.unknown[valid, None], (255, 59, 48), (138, 148, 160)).astype(np.uint8)
        in_map = apply(T_map_base @ scan.T_base_lidar, points)
        self._stream.log("map/lidar", self._rr.Points3D(in_map, colors=colors, radii=0.012))

    def _pose(self, entity: str, T: Float64) -> None:
        self._stream.log(entity, self._rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))

    def _mesh(self, vertices: np.ndarray, faces: np.ndarray, color: tuple[int, ...]) -> "Mesh3D":
        return self._rr.Mesh3D(vertex_positions=vertices, triangle_indices=faces, albedo_factor=[*color, 255])

    def close(self) -> None:
        """Write out what is still on its way."""
        self._stream.flush()
        self._stream.disconnect()


def log_examination(found: "Examination", models: "Mapping[str, ObjectModel]", path: Path) -> None:
    """Write one frame done again for rerun: measured points with their residuals, models at all poses, camera frame.

    Raises:
        SimtrackError: rerun is not installed.
        InvalidValueError: the file cannot be written.
    """
    log = RerunLog(path=path)
    rr, stream, moment = log._rr, log._stream, found.moment
    K = moment.intrinsics
    v, u = np.nonzero(moment.depth > 0.0)
    z = moment.depth[v, u]
    points = np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=1)
    off = np.nan_to_num(np.clip(found.residuals[v, u] / 0.01, -1.0, 1.0))
    paint = np.stack([255 * (1 - np.maximum(off, 0)), 255 * (1 - np.abs(off)), 255 * (1 + np.minimum(off, 0))], axis=1)
    stream.log("camera", rr.ViewCoordinates.RDF, static=True)
    stream.log("camera/measured", rr.Points3D(points, colors=paint.astype(np.uint8), radii=0.001), static=True)
    shown = [("true", (35, 197, 82), o.class_name, o.name, o.T_camera_object) for o in moment.objects]
    shown += [("predicted", (154, 164, 178), moment.classes[k], str(k), T) for k, T in moment.predicted.items()]
    shown += [
        ("registered", (255, 159, 28), o.true.class_name, str(o.true.track), o.result.T_camera_object)
        for o in found.objects
        if o.result is not None
    ]
    shown += [("detected", (224, 86, 122), name, str(k), T) for k, (name, _, T) in enumerate(moment.hypotheses)]
    for kind, color, class_name, name, T in shown:
        if class_name in models:
            visual = models[class_name].visual
            stream.log(f"camera/{kind}/{class_name}-{name}", log._mesh(apply(T, visual.vertices), visual.faces, color),
                       static=True)  # fmt: skip
    log.close()
