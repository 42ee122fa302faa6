"""Feeds the stages that need no robot from the frames of one sensor: localization, pre-segmentation, depth residuals.

Such recordings bring no map. The first frame makes it: the surface that it saw, triangulated; later frames are
localized in it, compared with it, and segmented into what it explains and what not. Where they look past it, it grows.
Poses that the recording states are where its frames are compared with the map. Estimates start from the first of them
alone, and anew where the sensor is said to have moved too far at once or where the localizer has lost it.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64, Localization, RgbdFrame, Status
from simtrack.errors import FileFormatError
from simtrack.evaluation.closed_loop import Progress
from simtrack.evaluation.growing_map import GrowingMap, GrowingMapConfig
from simtrack.evaluation.metrics import Metric, Metrics, measured, quantile, ratio, unmeasured
from simtrack.evaluation.process import Clock, StopSignal, peak_memory, set_threads
from simtrack.evaluation.recorded_objects import ObjectStage
from simtrack.evaluation.residuals import Residuals, map_residuals
from simtrack.evaluation.run_config import versions
from simtrack.evaluation.run_folder import RunFolder, SensorTables
from simtrack.evaluation.trajectory import absolute_errors
from simtrack.perception.localization.free import FreeConfig, FreeLocalizer
from simtrack.perception.localization.measurement import Measurement
from simtrack.recordings import PosedFrame, SensorLog

INLIER = 0.05
"""Metres from the map's plane within which a reading counts as explained."""
TRUSTED = (Status.OK, Status.DEGRADED)
"""Statuses of poses that count as estimates."""


@dataclass(frozen=True, slots=True)
class SensorReplayConfig:
    """Settings of `SensorReplay`."""

    map: GrowingMapConfig = field(default_factory=GrowingMapConfig)
    localizer: FreeConfig = field(default_factory=FreeConfig)


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
            FileFormatError: no frame can be used (nothing is written), or a later one cannot be read (the results of
                those before it are kept).
            OutputExistsError: the folder exists and may not be overwritten.
        """
        set_threads(self._threads)
        frames = iter(self._log.read())
        first, grown = self._begin(frames)
        with ExitStack() as exits:
            stop = exits.enter_context(StopSignal())
            folder = RunFolder(self._out, self._overwrite)
            origin = {"recording": str(self._log.path), "format": self._log.format}
            folder.write_config(origin | {"settings": _plain(asdict(self._config)), "versions": versions()})
            tables = exits.enter_context(SensorTables(folder.path))
            stages = _Stages(self._log, first, grown, self._config.localizer, tables)
            exits.callback(stages.close)
            finished = False
            try:
                for entry in frames:
                    if stop.asked:
                        break
                    stages.take(entry)
                    self._on_progress(stages.progress())
                finished = not stop.asked
            finally:
                metrics = stages.metrics() | {"run.partial": measured(not finished, "1")}
                folder.write_metrics(metrics)
                grown.save(folder.path / "map.ply")
        return metrics, stop.asked

    def _begin(self, frames: Iterable[PosedFrame]) -> tuple[PosedFrame, GrowingMap]:
        """The first frame that sees a surface (from a stated pose, if the recording states any), and its map."""
        grown, posed = GrowingMap(self._config.map), self._log.posed
        for entry in frames:
            if (entry.T_map_sensor is not None or not posed) and grown.add(entry.frame, _start(entry)):
                return entry, grown
        reason = f"no frame of this {self._log.format} sees a surface" + (" from a stated pose" if posed else "")
        raise FileFormatError(self._log.path, "", reason + "; a map is made of one")


class _Stages:
    """What later frames are found to be in the map of the first one."""

    def __init__(
        self, log: SensorLog, first: PosedFrame, grown: GrowingMap, config: FreeConfig, tables: SensorTables
    ) -> None:
        self._camera, self._noise, self._map, self._tables = log.sensor == "camera", log.noise, grown, tables
        self._first = self._last = first.frame.stamp
        self._stated = None if first.T_map_sensor is None else (first.frame.stamp, first.T_map_sensor)
        self._status = "map"
        self._localizer = FreeLocalizer(grown.surface, first.frame.stamp, _start(first), config)
        self._clock, self._counts = Clock(), Counter[str](frames=1)
        self._located, self._placed, self._along = Residuals(), Residuals(), Residuals()
        self._errors: list[tuple[float, float]] = []
        self._objects = ObjectStage(log.models) if log.models else None
        self._take_objects(first, _start(first))
        tables.add(first.frame.stamp, "map", _start(first), {"map_faces": grown.faces})

    def close(self) -> None:
        """Release memory outside of Python."""
        if self._objects is not None:
            self._objects.close()

    def take(self, entry: PosedFrame) -> None:
        """Take the next frame."""
        frame, stated = entry.frame, entry.T_map_sensor
        self._last = frame.stamp
        self._counts["frames"] += 1
        with self._clock("stack"):
            shots = self._localizer.measure(frame, self._noise)
            if self._has_jumped(stated):
                assert stated is not None
                self._localizer.restart(frame.stamp, stated)
                T, self._status, row, placed = stated, "jump", {}, True
            else:
                found = self._localizer.update(shots)
                T, self._status, placed = found.T_map_base, found.status.value, found.status in TRUSTED
                row = self._judge(found, shots, stated)
                if stated is not None and found.status is Status.LOST:
                    self._localizer.restart(frame.stamp, stated, before=self._stated)
            here = T if stated is None else stated
            if stated is not None or placed:
                row |= self._compare(entry, shots, here)
                self._take_objects(entry, here)
        self._stated = (frame.stamp, stated) if stated is not None else self._stated
        self._tables.add(frame.stamp, self._status, T, row | {"map_faces": self._map.faces})

    def _has_jumped(self, stated: Float64 | None) -> bool:
        """Whether the sensor is said to have moved further since the last stated pose than a localizer can follow."""
        return stated is not None and self._stated is not None and not self._localizer.follows(self._stated[1], stated)

    def _judge(self, found: Localization, shots: Measurement, stated: Float64 | None) -> dict[str, float]:
        """The estimate beside the map, and beside the stated pose."""
        trusted = found.status in TRUSTED
        self._counts.update(located=trusted, tried=1)
        if not trusted:
            return {}
        planes = map_residuals(shots, found.T_map_base, self._map.surface.scene).planes
        self._located.add(planes)
        row = {"residual_median": _quantile(planes, 0.5), "residual_p95": _quantile(planes, 0.95)}
        if stated is not None:
            translation, rotation = absolute_errors([found.T_map_base], [stated])
            self._errors.append((float(translation[0]), float(rotation[0])))
            row |= {"translation_error": float(translation[0]), "rotation_error": float(rotation[0])}
        return row

    def _compare(self, entry: PosedFrame, shots: Measurement, T: Float64) -> dict[str, float]:
        """What of a frame taken at the pose `T` the map covers and explains, and what is left; the map may grow."""
        residuals = map_residuals(shots, T, self._map.surface.scene)
        count, covered = len(residuals.covered), int(np.count_nonzero(residuals.covered))
        explained = int(np.count_nonzero(residuals.planes <= INLIER))
        self._placed.add(residuals.planes)
        self._along.add(residuals.along)
        segmented = self._map.presegment(entry.frame, T)
        self._counts.update(
            compared=1, readings=count, covered=covered, explained=explained, valid=segmented.valid,
            unknown=int(np.count_nonzero(segmented.unknown)), regions=len(segmented.regions),
        )  # fmt: skip
        if count:
            self._map.grow(entry.frame, T, covered / count)
            self._localizer.surface = self._map.surface
        return {
            "readings": count, "covered": covered / max(count, 1), "explained": explained / max(count, 1),
            "difference_median": _quantile(np.abs(residuals.along), 0.5), "unknown": 1.0 - segmented.reduction,
            "regions": len(segmented.regions),
        }  # fmt: skip

    def _take_objects(self, entry: PosedFrame, T: Float64) -> None:
        if self._objects is not None and isinstance(entry.frame, RgbdFrame):
            self._objects.take(entry.frame, T, entry.labels)

    # ------------------------------------------------------------------------------------------------------- results

    def progress(self) -> Progress:
        """How far it is."""
        seconds = (self._last - self._first) / NANOSECONDS
        return Progress("replay", seconds, 0.0, self._rate().value or 0.0, None, self._status)

    def metrics(self) -> Metrics:
        """What was measured so far."""
        counts, nothing = self._counts, "no frame after the one that made the map"
        untried = "no frame near the one before it" if counts["compared"] else nothing
        translation, rotation = np.array(self._errors, dtype=float).reshape(-1, 2).T
        unstated = "the recording states no pose of a located frame"
        result: Metrics = {
            "localization.located": ratio(counts["located"], counts["tried"], untried),
            "localization.residual.median": self._located.quantile(0.5),
            "localization.residual.p95": self._located.quantile(0.95),
            "localization.translation_error.median": quantile(translation, 0.5, "m", unstated),
            "localization.translation_error.p95": quantile(translation, 0.95, "m", unstated),
            "localization.rotation_error.median": quantile(rotation, 0.5, "rad", unstated),
            "localization.rotation_error.p95": quantile(rotation, 0.95, "rad", unstated),
            "map.residual.median": self._placed.quantile(0.5),
            "map.residual.p95": self._placed.quantile(0.95),
            "map.covered": ratio(counts["covered"], counts["readings"], nothing),
            "map.explained": ratio(counts["explained"], counts["readings"], nothing),
            "map.faces": measured(self._map.faces, "1"),
            "map.frames": measured(self._map.frames, "1"),
            "presegmentation.unknown": ratio(counts["unknown"], counts["valid"], nothing),
            "presegmentation.regions": ratio(counts["regions"], counts["compared"], nothing),
            "run.frames": measured(counts["frames"], "1"),
            "speed.frames_per_second": self._rate(),
            "speed.peak_memory": peak_memory(),
        }
        if self._camera:
            result["depth.difference.median"] = self._along.quantile(0.5)
            result["depth.difference.p95"] = self._along.quantile(0.95)
        return result if self._objects is None else result | self._objects.metrics()

    def _rate(self) -> Metric:
        seconds = self._clock.total["stack"]
        return measured((self._counts["frames"] - 1) / seconds, "Hz") if seconds else unmeasured("Hz", "one frame")


def _start(entry: PosedFrame) -> Float64:
    """(4, 4) T_map_sensor of the first frame: the map's frame is the recording's, or else the sensor's own."""
    return np.eye(4) if entry.T_map_sensor is None else entry.T_map_sensor


def _quantile(values: Float64, share: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, share)) if len(finite) else float("nan")


def _plain(value: object) -> object:
    """Settings as YAML has them."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (tuple, list)) else value
