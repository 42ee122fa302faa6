"""``simtrack bench realtime``: a recorded feed against the wall clock, as a robot's drivers would deliver it.

The workbench is run once and recorded: RGB-D at 30 Hz, lidar at 10 Hz, odometry, joints, and the oracle's detections
with their latency. Then the feed is played: a frame arrives when the clock reaches its stamp. Scans and odometry wait
for the stack; of images that arrived while it was busy only the newest is taken, the others are dropped. The stack
waits for no work beside the frames (`StackConfig.live`). Latency runs from an image's arrival to the belief about it.
Another process unpacks the log ahead, as a robot's drivers are others: its work is not the stack's, but takes its share
of the machine.
"""

import gc
import statistics
import sys
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from simtrack.benchmarks.feed import Feed
from simtrack.benchmarks.harness import Benchmark, Options, resident
from simtrack.contracts import NANOSECONDS, LidarScan, RgbdFrame, SensorFrame
from simtrack.perception.localization.measurement import scan_end
from simtrack.perception.pipeline import PerceptionStack
from simtrack.perception.stack_config import StackConfig
from simtrack.recordings import Recording

SWITCH_INTERVAL = 2e-4
"""Seconds after which a thread gives the interpreter to another one that waits for it: what is done beside the frames
shall not keep the frames waiting (Python's own 5 ms are a sixth of a frame's time)."""
WARM_UP = 2.0
"""Seconds of the feed that do not count: kernels are loaded, objects are born."""


@dataclass
class Play:
    """How one play of the feed went."""

    processed: int = 0
    dropped: int = 0
    latencies: list[float] = field(default_factory=list)
    """Seconds, of every processed image after the warm-up."""
    cpu: float = 0.0
    """CPU seconds of the stack's process after the warm-up."""
    memory: list[int] = field(default_factory=list)
    """Resident bytes, once a second."""

    @property
    def drop_share(self) -> float:
        """Share of images that were dropped."""
        return self.dropped / max(self.processed + self.dropped, 1)

    def latency(self, share: float) -> float:
        """Quantile of the latencies, seconds."""
        return float(np.quantile(self.latencies, share)) if self.latencies else float("nan")


def run(options: Options) -> Benchmark:
    """Measure; see the module."""
    from simtrack.recordings import open_recording

    result = Benchmark("realtime")
    duration, plays = (4.0, 1) if options.quick else (60.0, 3)
    with TemporaryDirectory(prefix="simtrack-") as folder:
        log = Path(folder) / "feed.mcap"
        _record(log, duration, options)
        tried = []
        for number in range(plays):
            options.say(f"playing {duration:g} s, {number + 1} of {plays}")
            tried.append(play(open_recording(log)))
            gc.collect()
    best = min(tried, key=lambda p: (p.drop_share, p.latency(0.95)))
    _report(result, best, tried)
    return result


def _record(log: Path, duration: float, options: Options) -> None:
    from simtrack.evaluation.closed_loop import ClosedLoopRun
    from simtrack.evaluation.run_config import ORACLE, RunConfig
    from simtrack.simulation.scene_file import load_scene

    options.say(f"recording {duration:g} s of the workbench; this takes a few times as long")
    config = RunConfig(
        scene=load_scene("workbench"), out=log.parent / "run", duration=duration, seed=options.seed, log=log,
        threads=options.threads, detector=ORACLE,
    )  # fmt: skip
    ClosedLoopRun(config).run()


def play(recording: Recording) -> Play:
    """Feed a new stack from a recording at the pace of its stamps."""
    from simtrack.evaluation.replay import start_pose
    from simtrack.recordings import RecordedDetector

    assert recording.static_map is not None and recording.robot is not None
    stack = PerceptionStack(
        recording.static_map, recording.models, recording.robot, RecordedDetector(recording),
        T_map_base=start_pose(recording.metadata, recording.path), config=StackConfig.live(),
    )  # fmt: skip
    interval = sys.getswitchinterval()
    try:
        sys.setswitchinterval(SWITCH_INTERVAL)
        gc.collect()
        gc.freeze()  # what is loaded by now stays: looking through it again takes longer than a frame lasts
        with Feed(recording.path) as feed:
            return _play(stack, feed)
    finally:
        sys.setswitchinterval(interval)
        gc.unfreeze()
        stack.close()


def _play(stack: PerceptionStack, feed: Feed) -> Play:
    outcome = Play()
    waiting: deque[SensorFrame] = deque()
    ahead = feed.take()
    if ahead is None:
        return outcome
    first = _arrival(ahead)
    begin = time.perf_counter()
    cpu_begin: float | None = None
    while ahead is not None or waiting:
        now = first + round((time.perf_counter() - begin) * NANOSECONDS)
        while ahead is not None and _arrival(ahead) <= now:  # all that has arrived meanwhile
            waiting.append(ahead)
            ahead = feed.take()
        if not waiting:
            assert ahead is not None
            time.sleep(max(0.0, (_arrival(ahead) - now) / NANOSECONDS))
            continue
        frame = waiting.popleft()
        counts = frame.stamp - first > WARM_UP * NANOSECONDS
        if counts and cpu_begin is None:
            cpu_begin = time.process_time()
        if isinstance(frame, RgbdFrame) and any(isinstance(other, RgbdFrame) for other in waiting):
            outcome.dropped += counts
            continue
        stack.process(frame)
        if isinstance(frame, RgbdFrame) and counts:
            outcome.processed += 1
            arrived = begin + (frame.stamp - first) / NANOSECONDS
            outcome.latencies.append(time.perf_counter() - arrived)
            if outcome.processed % 30 == 1:
                outcome.memory.append(resident())
    outcome.cpu = time.process_time() - (cpu_begin or 0.0)
    return outcome


def _arrival(frame: SensorFrame) -> int:
    """Nanoseconds: a scan is complete with its last shot."""
    return scan_end(frame) if isinstance(frame, LidarScan) else frame.stamp


def _report(result: Benchmark, best: Play, tried: list[Play]) -> None:
    images = best.processed + best.dropped
    result.add("images", value=float(images))
    result.add("processed", value=float(best.processed))
    result.add("dropped", value=100.0 * best.drop_share, unit="%", asked=1.0)
    result.add("latency, median", value=1e3 * best.latency(0.5), unit="ms")
    result.add("latency, p95", value=1e3 * best.latency(0.95), unit="ms", asked=66.0)
    result.add("latency, p99", value=1e3 * best.latency(0.99), unit="ms")
    result.add("CPU an image", value=1e3 * best.cpu / max(images, 1), unit="ms")
    if len(best.memory) >= 4:
        half = len(best.memory) // 2
        early, late = statistics.median(best.memory[:half]), statistics.median(best.memory[half:])
        result.add("memory, second half to first", value=late / early, unit="x", asked=1.05)
    for number, other in enumerate(tried):
        result.add(f"play {number + 1}: dropped", value=100.0 * other.drop_share, unit="%")
        result.add(f"play {number + 1}: latency, p95", value=1e3 * other.latency(0.95), unit="ms")
    result.series["latency"] = best.latencies
    result.plots["latency.png"] = lambda path: _plot(best, path)


def _plot(best: Play, path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.plot([1e3 * value for value in best.latencies], linewidth=0.8)
    axes.axhline(66.0, color="0.5", linestyle="--", linewidth=0.8)
    axes.set(xlabel="image", ylabel="latency, ms")
    figure.savefig(path, dpi=120)
