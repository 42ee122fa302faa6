"""Feeds the perception stack from a recording and writes down what it believes."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64, SensorFrame
from simtrack.errors import FileFormatError
from simtrack.evaluation.closed_loop import Observer, Progress
from simtrack.evaluation.metrics import Metric, Metrics, measured, quantile, ratio
from simtrack.evaluation.process import Clock, StopSignal, peak_memory, set_threads
from simtrack.evaluation.run_config import versions
from simtrack.evaluation.run_folder import EstimateTables, RunFolder
from simtrack.geometry.transforms import is_rigid
from simtrack.perception.pipeline import PerceptionStack
from simtrack.perception.stack_config import StackConfig
from simtrack.recordings import RecordedDetector, open_recording


class Replay:
    """One replay. Files are those of a run as far as they need no truth; ``tracks.csv`` and ``estimates.csv`` of a
    run and of the replay of its log are equal byte by byte.
    """

    def __init__(
        self,
        recording: Path,
        out: Path,
        overwrite: bool = False,
        threads: int | None = None,
        on_progress: Callable[[Progress], None] = lambda progress: None,
        observers: Sequence[Observer] = (),
        config: StackConfig | None = None,
    ) -> None:
        """`recording`: MCAP file; `out`: folder for the results."""
        self._recording, self._out, self._overwrite, self._threads = recording, out, overwrite, threads
        self._on_progress, self._observers, self._config = on_progress, observers, config or StackConfig()

    def run(self) -> bool:
        """Replay to the end, or until Ctrl-C or a kill; returns whether it was stopped.

        Raises:
            FileFormatError: the recording cannot be used.
            OutputExistsError: the folder exists and may not be overwritten.
        """
        set_threads(self._threads)
        recording = open_recording(self._recording)
        if recording.static_map is None or recording.robot is None:
            raise FileFormatError(self._recording, "attachments", "no map or no robot is recorded to replay with")
        start = start_pose(recording.metadata, self._recording)
        with ExitStack() as exits:
            stop = exits.enter_context(StopSignal())
            folder = RunFolder(self._out, self._overwrite)
            origin = {"recording": str(self._recording), "metadata": dict(recording.metadata), "versions": versions()}
            folder.write_config(origin)
            folder.write_map(recording.static_map)
            tables = exits.enter_context(EstimateTables(folder.path))
            stack = PerceptionStack(
                recording.static_map,
                recording.models,
                recording.robot,
                RecordedDetector(recording),
                T_map_base=start,
                config=self._config,
            )
            exits.callback(stack.close)
            for observer in self._observers:
                observer.start(recording.static_map, recording.models, recording.robot)
                exits.callback(observer.close)
            metrics = self._follow(recording.sensor_frames(), stack, tables, stop)
            metrics["run.partial"] = measured(stop.asked or not recording.complete, "1")
            folder.write_metrics(metrics)
            folder.write_graph(stack.graph.to_json())
        return stop.asked

    def _follow(
        self, frames: Iterator[SensorFrame], stack: PerceptionStack, tables: EstimateTables, stop: StopSignal
    ) -> Metrics:
        clock, stages = Clock(), defaultdict[str, list[float]](list)
        last, images = -1, 0
        for frame in frames:
            with clock("stack"):
                belief = stack.process(frame)
            if belief is not None and belief.stamp > last:
                last, images = belief.stamp, images + 1
                tables.add(belief)
                for stage, seconds in belief.stage_seconds.items():
                    stages[stage].append(seconds)
                rate = images / clock.loop
                tracks = sum(track.believed for track in belief.tracks)
                status = belief.localization.status.value
                self._on_progress(Progress("replay", last / NANOSECONDS, 0.0, rate, tracks, status))
            for observer in self._observers:
                observer.frame(frame, belief)
            if stop.asked:
                break
        missing = "the recording holds no images"
        rate = ratio(images, clock.loop, missing)
        metrics: Metrics = {"speed.frames_per_second": Metric(rate.value, "Hz", rate.reason)}
        for stage, seconds in sorted(stages.items()):
            metrics[f"speed.stage.{stage}.median"] = quantile(seconds, 0.5, "s", missing)
        metrics |= {"speed.peak_memory": peak_memory(), "run.images": measured(images, "1")}
        return metrics


def start_pose(metadata: Mapping[str, object], path: Path) -> Float64 | None:
    """The pose that the operator stated for the robot's start, None if the recording has none."""
    stated = metadata.get("T_map_base")
    if stated is None:
        return None
    try:
        T = np.array(stated, dtype=float).reshape(4, 4)
    except (TypeError, ValueError) as error:
        raise FileFormatError(path, "metadata.T_map_base", "expected the 16 numbers of a rigid transform") from error
    if not is_rigid(T):
        raise FileFormatError(path, "metadata.T_map_base", "not a rigid transform")
    return T
