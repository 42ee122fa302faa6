"""Feeds the stages that need no robot from the frames of one sensor: localization, pre-segmentation, depth residuals.

Such recordings bring no map. The first frames make it: the surface that they saw, triangulated; later frames are
localized in it, compared with it, and segmented into what it explains and what it does not. Where they look past it, it
grows. Poses that the recording states place the frames of a camera; estimates start from the first one alone and are
compared with the others.
"""

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Bool,
    Float64,
    LidarScan,
    Localization,
    Presegmentation,
    RgbdFrame,
    StaticMap,
    Status,
)
from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.evaluation.closed_loop import Clock, Progress, StopSignal, peak_memory, set_threads
from simtrack.evaluation.metrics import Metric, Metrics, measured, quantile, ratio, unmeasured
from simtrack.evaluation.recorded_objects import ObjectStage
from simtrack.evaluation.residuals import Residuals, map_residuals
from simtrack.evaluation.run_config import versions
from simtrack.evaluation.run_folder import RunFolder, SensorTables
from simtrack.evaluation.trajectory import absolute_errors
from simtrack.geometry.meshes import Mesh, concatenate, transformed
from simtrack.geometry.transforms import apply
from simtrack.objects.export import write_ply
from simtrack.perception.localization.free import FreeConfig, FreeLocalizer
from simtrack.perception.localization.measurement import Measurement
from simtrack.perception.localization.surface import MapSurface
from simtrack.perception.mapping import ScanMeshConfig, mesh_of_depth, mesh_of_scan
from simtrack.perception.tracking.presegmentation import PresegmentationConfig, presegment_camera, presegment_lidar
from simtrack.raycast import RayBundle
from simtrack.recordings import PosedFrame, SensorLog

_TRUSTED = (Status.OK, Status.DEGRADED)
INLIER = 0.05
"""Metres from the map's plane within which a reading counts as explained."""


@dataclass(frozen=True, slots=True)
class SensorReplayConfig:
    """Settings of `SensorReplay`."""

    mesh: ScanMeshConfig = field(default_factory=ScanMeshConfig)
    localizer: FreeConfig = field(default_factory=FreeConfig)
    presegmentation: PresegmentationConfig = field(default_factory=PresegmentationConfig)
    map_noise: float = 0.01
    """Metres, standard deviation of a mesh of merged readings."""
    grow_below: float = 0.7
    """The map grows by what a frame sees beyond it if it covers a smaller share of the frame's readings."""
    max_faces: int = 2_000_000
    """The map grows no further."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.grow_below <= 1.0:
            raise InvalidValueError("SensorReplayConfig.grow_below", self.grow_below, "0 to 1")


class SensorReplay:
    """One replay of a `SensorLog`. Writes ``estimates.csv``, ``frames.csv``, ``metrics.json`` and ``map.ply``."""

    def __init__(
        self,
        log: SensorLog,
        out: Path,
        overwrite: bool = False,
        threads: int | None = None,
        on_progress: Callable[[Progress], None] = lambda progress: None,
        config: SensorReplayConfig | None = None,
    ) -> None:
        """`out`: folder for the results."""
        self._log, self._out, self._overwrite, self._threads = log, out, overwrite, threads
        self._on_progress, self._config = on_progress, config or SensorReplayConfig()

    def run(self) -> tuple[Metrics, bool]:
        """Replay to the end, or until Ctrl-C or a kill; returns the metrics, and whether it was stopped.

        Raises:
            FileFormatError: a frame cannot be read, or there are none; results of what came before it are kept.
            OutputExistsError: the folder exists and may not be overwritten.
        """
        set_threads(self._threads)
        with ExitStack() as exits:
            stop = exits.enter_context(StopSignal())
            folder = RunFolder(self._out, self._overwrite)
            origin = {"recording": str(self._log.path), "format": self._log.format}
            folder.write_config(origin | {"settings": _plain(asdict(self._config)), "versions": versions()})
            stages = _Stages(self._log, self._config, exits.enter_context(SensorTables(folder.path)))
            exits.callback(stages.close)
            finished = False
            try:
                for entry in self._log.read():
                    stages.take(entry)
                    self._on_progress(stages.progress())
                    if stop.asked:
                        break
                if not stages.frames:
                    raise FileFormatError(self._log.path, "", f"holds no frame of a {self._log.format}")
                finished = not stop.asked
            finally:
                metrics = stages.metrics() | {"run.partial": measured(not finished, "1")}
                folder.write_metrics(metrics)
                stages.save_map(folder.path / "map.ply")
        return metrics, stop.asked


class _Stages:
    """The map that grows, and what later frames are found to be in it."""

    def __init__(self, log: SensorLog, config: SensorReplayConfig, tables: SensorTables) -> None:
        self._log, self._config, self._tables = log, config, tables
        self._clock = Clock()
        self._mesh = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
        self._localizer: FreeLocalizer | None = None
        self._stamps: tuple[int, int] | None = None
        self._status = ""
        self.frames = self._grown = 0
        self._counts: Counter[str] = Counter()
        self._located, self._placed, self._along = Residuals(), Residuals(), Residuals()
        self._errors: list[tuple[float, float]] = []
        self._objects = ObjectStage(log.models) if log.models else None

    def close(self) -> None:
        """Release memory outside of Python."""
        if self._objects is not None:
            self._objects.close()

    def take(self, entry: PosedFrame) -> None:
        """Take the next frame."""
        frame, stated = entry.frame, entry.T_map_sensor
        self._stamps = (self._stamps or (frame.stamp, 0))[0], frame.stamp
        self.frames += 1
        with self._clock("stack"):
            if self._localizer is None:
                T, self._status, row = np.eye(4) if stated is None else stated, "map", {}
                self._grow(frame, T, None)
                self._localizer = FreeLocalizer(self._surface(), frame.stamp, T, self._config.localizer)
            else:
                shots = self._localizer.measure(frame, self._log.noise)
                found = self._localizer.update(shots)
                T, self._status = found.T_map_base, found.status.value
                row = self._judge(found, shots, stated)
                if stated is not None or found.status in _TRUSTED:
                    row |= self._compare(frame, shots, T if stated is None else stated)
            if self._objects is not None and isinstance(frame, RgbdFrame):
                self._objects.take(frame, T if stated is None else stated, entry.labels)
        self._tables.add(frame.stamp, self._status, T, row | {"map_faces": len(self._mesh.faces)})

    def _judge(self, found: Localization, shots: Measurement, stated: Float64 | None) -> dict[str, float]:
        """The estimate beside the map, and beside the stated pose."""
        assert self._localizer is not None
        trusted = found.status in _TRUSTED
        self._counts.update(located=trusted, tried=1)
        if not trusted:
            return {}
        residuals = map_residuals(shots, found.T_map_base, self._localizer.surface.scene)
        self._located.add(residuals.planes)
        row = {"residual_median": _quantile(residuals.planes, 0.5), "residual_p95": _quantile(residuals.planes, 0.95)}
        if stated is not None:
            translation, rotation = absolute_errors([found.T_map_base], [stated])
            self._errors.append((float(translation[0]), float(rotation[0])))
            row |= {"translation_error": float(translation[0]), "rotation_error": float(rotation[0])}
        return row

    def _compare(self, frame: RgbdFrame | LidarScan, shots: Measurement, T: Float64) -> dict[str, float]:
        """What of a frame taken at the pose `T` the map covers and explains, and what is left; the map may grow."""
        assert self._localizer is not None
        residuals = map_residuals(shots, T, self._localizer.surface.scene)
        covered = residuals.covered
        explained = int(np.count_nonzero(residuals.planes <= INLIER))
        self._placed.add(residuals.planes)
        self._along.add(residuals.along)
        segmented = self._presegment(frame, T)
        self._counts.update(
            readings=len(covered), covered=int(np.count_nonzero(covered)), explained=explained, valid=segmented.valid,
            unknown=int(np.count_nonzero(segmented.unknown)), regions=len(segmented.regions),
        )  # fmt: skip
        share = float(covered.mean()) if len(covered) else 1.0
        if share < self._config.grow_below and len(self._mesh.faces) < self._config.max_faces:
            self._grow(frame, T, self._uncovered(frame, T))
            self._localizer.surface = self._surface()
        return {
            "readings": len(covered), "covered": share, "explained": explained / max(len(covered), 1),
            "difference_median": _quantile(np.abs(residuals.along), 0.5), "unknown": 1.0 - segmented.reduction,
            "regions": len(segmented.regions),
        }  # fmt: skip

    def _presegment(self, frame: RgbdFrame | LidarScan, T: Float64) -> Presegmentation:
        assert self._localizer is not None
        scene, config = self._localizer.surface.scene, self._config.presegmentation
        if isinstance(frame, RgbdFrame):
            return presegment_camera(frame, T, scene, config=config)
        return presegment_lidar(frame, lambda stamp: T, scene, config=config)

    # ------------------------------------------------------------------------------------------------------- the map

    def _grow(self, frame: RgbdFrame | LidarScan, T: Float64, keep: Bool | None) -> None:
        """Add the surface that a frame saw from the pose `T`, of all readings or of some."""
        mesh = self._config.mesh
        seen = mesh_of_depth(frame, mesh, keep) if isinstance(frame, RgbdFrame) else mesh_of_scan(frame, mesh, keep)
        self._mesh = concatenate([self._mesh, transformed(seen, T)])
        self._grown += 1
        if not len(self._mesh.faces):
            raise FileFormatError(
                self._log.path, f"frame {self.frames - 1}", "sees no surface that a map could be made of"
            )

    def _uncovered(self, frame: RgbdFrame | LidarScan, T: Float64) -> Bool:
        """(H, W) or (N,), True where a frame taken at the pose `T` looks past the map."""
        assert self._localizer is not None
        scene = self._localizer.surface.scene
        if isinstance(frame, RgbdFrame):
            hits = scene.cast(RayBundle.from_camera(frame.intrinsics), T)
            return ~np.isfinite(hits.distances).reshape(frame.depth.shape)
        returned = np.isfinite(frame.ranges)
        points = np.where(returned, frame.ranges, 0.0)[:, None] * frame.directions
        return returned & ~np.isfinite(scene.closest_points(apply(T, points), 5 * INLIER).distances)

    def _surface(self) -> MapSurface:
        vertices = self._mesh.vertices.astype(np.float32)
        return MapSurface(StaticMap(vertices, self._mesh.faces, noise=self._config.map_noise))

    def save_map(self, path: Path) -> None:
        """Write the map as PLY, for looking at it."""
        if len(self._mesh.faces):
            write_ply(path, self._mesh)

    # ------------------------------------------------------------------------------------------------------- results

    def progress(self) -> Progress:
        """How far it is."""
        first, last = self._stamps or (0, 0)
        seconds, rate = (last - first) / NANOSECONDS, self.frames / max(self._clock.total["stack"], 1e-9)
        return Progress("replay", seconds, 0.0, rate, None, self._status)

    def metrics(self) -> Metrics:
        """What was measured so far."""
        counts, nothing = self._counts, "no frame after those that made the map"
        translation, rotation = np.array(self._errors, dtype=float).reshape(-1, 2).T
        unstated = "the recording states no poses of located frames"
        camera = self._log.sensor == "camera"
        result: Metrics = {
            "localization.located": ratio(counts["located"], counts["tried"], nothing),
            "localization.residual.median": self._located.quantile(0.5),
            "localization.residual.p95": self._located.quantile(0.95),
            "localization.translation_error.median": quantile(translation, 0.5, "m", unstated),
            "localization.translation_error.max": quantile(translation, 1.0, "m", unstated),
            "localization.rotation_error.median": quantile(rotation, 0.5, "rad", unstated),
            "map.residual.median": self._placed.quantile(0.5),
            "map.residual.p95": self._placed.quantile(0.95),
            "map.covered": ratio(counts["covered"], counts["readings"], nothing),
            "map.explained": ratio(counts["explained"], counts["readings"], nothing),
            "map.faces": measured(len(self._mesh.faces), "1"),
            "map.frames": measured(self._grown, "1"),
            "presegmentation.unknown": ratio(counts["unknown"], counts["valid"], nothing),
            "presegmentation.regions": ratio(counts["regions"], counts["tried"], nothing),
            "run.frames": measured(self.frames, "1"),
            "speed.frames_per_second": _rate(self.frames, self._clock.total["stack"]),
            "speed.peak_memory": peak_memory(),
        }
        if camera:
            result["depth.difference.median"] = self._along.quantile(0.5)
            result["depth.difference.p95"] = self._along.quantile(0.95)
        if self._objects is not None:
            result |= self._objects.metrics()
        return result


def _rate(count: int, seconds: float) -> Metric:
    return measured(count / seconds, "Hz") if seconds else unmeasured("Hz", "no frame was read")


def _quantile(values: Float64, share: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, share)) if len(finite) else float("nan")


def _plain(value: object) -> object:
    """Settings as YAML has them."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (tuple, list)) else value
