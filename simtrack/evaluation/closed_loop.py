"""The closed loop: simulation -> perception stack -> agent -> simulation, measured on the way.

What counts into the speed: simulating, rendering, the stack, the agent; not the evaluation, which no robot does.
Frames of the first simulated second are left out: code is compiled and caches fill in it.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Agent,
    Belief,
    Command,
    Detector,
    Float64,
    JointState,
    RgbdFrame,
    SensorFrame,
    StaticMap,
)
from simtrack.evaluation.evaluator import Evaluator, pose_scorers, true_models
from simtrack.evaluation.foreign_stages import fault_metrics, foreign_stages, write_faults
from simtrack.evaluation.instrument.moments import MomentKeeper
from simtrack.evaluation.metrics import Metric, Metrics, measured, quantile, ratio, unmeasured
from simtrack.evaluation.process import Clock, StopSignal, peak_memory, set_threads
from simtrack.evaluation.record import RelationTimeline, RunRecord, graph_name
from simtrack.evaluation.run_config import FIXED_GAZE, ORACLE, RunConfig
from simtrack.evaluation.run_folder import EstimateTables, RunFolder, TruthTables
from simtrack.evaluation.start_up import warm_up
from simtrack.evaluation.tracking import TrackingEvaluator
from simtrack.geometry.kinematics import KinematicTree
from simtrack.objects import ObjectModel
from simtrack.perception.detection.loading import make_image_detector
from simtrack.perception.foreign import StageContext, Watch
from simtrack.perception.pipeline import PerceptionStack
from simtrack.perception.scene_graph.history import about
from simtrack.perception.tracking.tracker import ObjectTracker
from simtrack.simulation.agents import AgentContext, make_agent
from simtrack.simulation.oracles import OracleDetector, OracleLocalizer
from simtrack.simulation.randomness import stream
from simtrack.simulation.simulation import Simulation
from simtrack.simulation.survey_files import read_survey

if TYPE_CHECKING:
    from simtrack.recordings import McapWriter

SAVE_PERIOD = 5 * NANOSECONDS
"""Nanoseconds, simulated: metrics and graph are on disk at least this often."""
WARM_UP = NANOSECONDS
"""Nanoseconds, simulated, that do not count into the speed."""
UNHURRIED = 3600.0
"""Seconds of the wall clock that simtrack's own detectors have for an image: they end, and a machine that stands still
for a while must not change a run. Those of others have their guard."""


class Observer(Protocol):
    """Somebody who watches a run, such as a viewer."""

    def start(self, static_map: StaticMap, models: Mapping[str, ObjectModel], robot: KinematicTree) -> None:
        """The run begins."""
        ...

    def frame(self, frame: SensorFrame, belief: Belief | None) -> None:
        """One frame and what the stack believes after it, if it was a camera frame."""
        ...

    def close(self) -> None:
        """The run is over."""
        ...


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is."""

    what: str
    """Name of the agent that drives."""
    seconds: float
    """Simulated so far."""
    duration: float
    frames_per_second: float
    tracks: int | None
    """Objects believed now; None where none are tracked."""
    localization: str
    """Its status."""


@dataclass(frozen=True, slots=True)
class Loop:
    """A simulation with all that closes its loop."""

    simulation: Simulation
    stack: PerceptionStack
    agent: Agent
    start: Command
    """Held until the agent gives the first one."""
    watches: Sequence[Watch] = ()
    """Of the stages that are not simtrack's."""
    script: Sequence[Command] | None = None
    """Given instead of the agent's commands, one a camera period; the last one is held."""
    given: list[Command] = field(default_factory=list)
    """The commands so far, one a camera period."""

    def drive(
        self, seconds: float, clock: Clock, log: "McapWriter | None" = None
    ) -> Iterator[tuple[SensorFrame, Belief | None]]:
        """Run for so many simulated seconds; yields every frame as it arrives with what is believed after it.

        A log gets each frame before the stack does, so that the detector's answers follow their images.
        """
        command, joints = self.start, JointState(0, (), np.zeros(0))
        simulation, period = self.simulation, self.simulation.camera_period
        while simulation.now + period <= round(seconds * NANOSECONDS):
            want_rgb = self.stack.wants_image(simulation.now + period)
            if self.script:
                command = self.script[min(len(self.given), len(self.script) - 1)]
            self.given.append(command)
            with clock("simulation"):
                frames = simulation.advance(command, want_rgb=want_rgb)
            for frame in frames:
                if isinstance(frame, JointState):
                    joints = frame
                if log is not None:
                    log.write(frame, simulation.now)
                    if isinstance(frame, RgbdFrame):
                        log.write_labels(frame.stamp, self._labels(frame.stamp))
                with clock("stack"):
                    belief = self.stack.process(frame)
                if belief is not None:
                    with clock("agent"):
                        command = self.agent.act(belief, joints)
                yield frame, belief

    def _labels(self, stamp: int) -> dict[str, Float64]:
        """True poses in the map, for people who read the log: the stack never does."""
        truth = self.simulation.truth.at(stamp)
        return {"base": truth.T_map_base, **{name: thing.T_map_object for name, thing in truth.objects.items()}}


@contextmanager
def closed(config: RunConfig, agent: str) -> Iterator[Loop]:
    """Simulation, stack and agent of a run, wired up; with a log of the feed if the configuration names a file."""
    with ExitStack() as exits:
        simulation = exits.enter_context(Simulation(config.scene, config.seed, renderer=config.renderer))
        if config.static_map is not None:
            simulation.use_map(read_survey(config.static_map))
        robot = config.scene.robot
        start = Command(head_pan=robot.head_pan, head_tilt=robot.head_tilt, torso=robot.torso)
        rng = stream(config.seed, "agent")
        context = AgentContext(simulation.static_map, simulation.robot, simulation.camera.intrinsics, start, rng)
        parts = StageContext(simulation.models, simulation.static_map, simulation.robot, simulation.start)
        foreign = exits.enter_context(foreign_stages(config, parts))
        stack = PerceptionStack(
            simulation.static_map,
            simulation.models,
            simulation.robot,
            foreign.detector or _own_detector(config, simulation),
            T_map_base=simulation.start,
            config=replace(config.stack, runner=replace(config.stack.runner, timeout=UNHURRIED)),
            localizer=OracleLocalizer(simulation.truth) if config.localizer == ORACLE else foreign.localizer,
            tracker=foreign.tracker,
            scene_graph=foreign.scene_graph,
        )
        exits.callback(stack.close)
        yield Loop(simulation, stack, make_agent(agent, context), start, foreign.watches, config.script)


def _own_detector(config: RunConfig, simulation: Simulation) -> Detector:
    name = config.detector_choice.name
    if name == ORACLE:
        offset = simulation.calibration.camera_time_offset
        return OracleDetector(simulation.truth, simulation.models, config.seed, config.oracle, offset)
    return make_image_detector(name, simulation.models)


@dataclass(slots=True)
class ClosedLoopRun:
    """One run: drives, measures, writes its folder, and leaves a record for the report."""

    config: RunConfig
    on_progress: Callable[[Progress], None] = lambda progress: None
    observers: Sequence[Observer] = ()
    started: float | None = None
    """Seconds on the clock of `time.monotonic` from which the start-up counts; None: from `run` on."""
    _start_up: float | None = None
    """Seconds until the first image had been taken in."""
    _clock: Clock = field(default_factory=Clock)
    _stages: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    _timeline: RelationTimeline = field(default_factory=RelationTimeline)
    _moments: MomentKeeper = field(default_factory=MomentKeeper)
    _images: int = 0
    _steady_from: tuple[int, float, float] | None = None
    """Images, seconds of the loop and of the evaluation at the end of the warm-up."""
    _partial: bool = True
    commands: Sequence[Command] = ()
    """What was commanded, one entry a camera period; after `run`."""
    _gain: Metric = field(default_factory=lambda: unmeasured("1", "the fixed gaze was not run for comparison"))

    def run(self) -> RunRecord:
        """Run to the end, or until Ctrl-C or a kill: then the record and the metrics say that they are partial.

        Raises:
            OutputExistsError: the folder exists and may not be overwritten.
            SimtrackError: something in the scene cannot be used.
        """
        config = self.config
        self.started = time.monotonic() if self.started is None else self.started
        set_threads(config.threads)
        folder = RunFolder(config.out, config.overwrite)  # before anything that takes long
        with ExitStack() as exits:
            exits.enter_context(ThreadPoolExecutor(1)).submit(warm_up, opengl=config.renderer == "mujoco")
            stop = exits.enter_context(StopSignal())
            folder.write_config(config.resolved())
            estimates = exits.enter_context(EstimateTables(folder.path))
            classes = [thing.model for thing in config.scene.objects]
            truths = exits.enter_context(TruthTables(folder.path, config.scene.name, classes))
            loop = exits.enter_context(closed(config, config.agent_name))
            folder.write_map(loop.simulation.static_map)
            log = exits.enter_context(open_log(config, loop)) if config.log is not None else None
            evaluator = exits.enter_context(Evaluator(loop.simulation, config.stack, config.seconds))
            for observer in self.observers:
                observer.start(loop.simulation.static_map, loop.simulation.models, loop.simulation.robot)
                exits.callback(observer.close)
            for frame, belief in self._watched(loop, evaluator, folder, log, stop):
                with self._clock("evaluation"):
                    objects = evaluator.observe(frame, belief)
                    if belief is not None and evaluator.advanced:
                        estimates.add(belief)
                        image, tracker = len(evaluator.trajectory.stamps) - 1, loop.stack.tracker
                        truths.add(image, belief, evaluator.trajectory.true[-1], objects)
                        if isinstance(tracker, ObjectTracker):
                            self._moments.see(image, tracker.trace, objects)
                        self._remember(belief)
            if config.compare_gaze and not stop.asked:
                self._compare(evaluator, stop)
            self._partial, self.commands = stop.asked, tuple(loop.given)
            record = self._record(loop, evaluator)
            folder.write_metrics(record.metrics)
            self._moments.save(folder.path)
            if loop.watches:
                write_faults(folder.path / "faults.csv", [fault for watch in loop.watches for fault in watch.faults])
            if evaluator.changes is not None:
                folder.write_changes(evaluator.changes.noticed())
            folder.write_graph(loop.stack.graph.to_json())
        return record

    def _watched(
        self, loop: Loop, evaluator: Evaluator, folder: RunFolder, log: "McapWriter | None", stop: StopSignal
    ) -> Iterator[tuple[SensorFrame, Belief | None]]:
        """The frames of the loop until it ends or is stopped; shows them to observers and saves between them."""
        saved = -SAVE_PERIOD
        for frame, belief in loop.drive(self.config.seconds, self._clock, log):
            if isinstance(frame, RgbdFrame):
                self._images += 1
                if self._start_up is None and self.started is not None:
                    self._start_up = time.monotonic() - self.started
                if self._steady_from is None and frame.stamp >= WARM_UP:
                    self._steady_from = self._images, self._clock.loop, self._clock.total["evaluation"]
            yield frame, belief
            for observer in self.observers:
                observer.frame(frame, belief)
            if loop.simulation.now - saved >= SAVE_PERIOD:
                saved = loop.simulation.now
                folder.write_metrics(self._metrics(evaluator, loop.watches))
                folder.write_graph(loop.stack.graph.to_json())
                self._moments.save(folder.path)
            if stop.asked:
                return

    def _remember(self, belief: Belief) -> None:
        tracked = {graph_name(track) for track in belief.tracks}
        held = frozenset(relation for name in tracked for relation in about(belief.relations, name))
        self._timeline.observe(belief.stamp, held)
        for stage, seconds in belief.stage_seconds.items():
            self._stages[stage].append(seconds)
        self.on_progress(self._progress(self.config.agent_name, belief))

    def _progress(self, agent: str, belief: Belief) -> Progress:
        spent = self._clock.loop
        return Progress(
            what=agent,
            seconds=belief.stamp / NANOSECONDS,
            duration=self.config.seconds,
            frames_per_second=self._images / spent if spent else 0.0,
            tracks=sum(track.believed for track in belief.tracks),
            localization=belief.localization.status.value,
        )

    def _compare(self, evaluator: Evaluator, stop: StopSignal) -> None:
        """Run the fixed gaze on the same seed, as far as `world.known_share` needs it."""
        if self.config.agent_name == FIXED_GAZE:
            self._gain = unmeasured("1", "this is the fixed gaze itself")
            return
        with closed(self.config, FIXED_GAZE) as loop:
            other = TrackingEvaluator(pose_scorers(true_models(loop.simulation)))
            last = -1
            for _, belief in loop.drive(self.config.seconds, Clock()):
                if stop.asked:
                    self._gain = unmeasured("1", "the comparison with the fixed gaze was stopped")
                    return
                if belief is not None and belief.stamp > last:
                    last = belief.stamp
                    other.observe(belief.tracks, loop.simulation.truth.at(last), {})
                    self.on_progress(self._progress(FIXED_GAZE, belief))
        ours, theirs = (t.metrics()["world.known_share"].value for t in (evaluator.tracking, other))
        if ours is not None and theirs is not None:
            self._gain = measured(ours - theirs, "1")

    # ---------------------------------------------------------------------------------------------------------- results

    def _metrics(self, evaluator: Evaluator, watches: Sequence[Watch]) -> Metrics:
        stamps = evaluator.trajectory.stamps
        return {
            **evaluator.metrics(),
            **self._speed(),
            **fault_metrics(watches),
            "loop.gaze_gain": self._gain,
            "run.partial": measured(self._partial, "1"),
            "run.images": measured(self._images, "1"),
            "run.simulated_time": measured(stamps[-1] / NANOSECONDS if stamps else 0.0, "s"),
        }

    def _speed(self) -> Metrics:
        images, seconds, evaluated = self._steady_from or (0, 0.0, 0.0)
        spent, apart = self._clock.loop - seconds, self._clock.total["evaluation"] - evaluated
        missing = "the run was too short"
        rate = ratio(self._images - images, spent, missing) if self._images > images else unmeasured("Hz", missing)
        metrics: Metrics = {"speed.frames_per_second": Metric(rate.value, "Hz", rate.reason)}
        metrics["speed.start_up"] = Metric(self._start_up, "s", "" if self._start_up is not None else missing)
        stages = self.stage_seconds()
        for stage in sorted(stages):
            metrics[f"speed.stage.{stage}.median"] = quantile(stages[stage], 0.5, "s", missing)
        metrics["speed.evaluation_share"] = ratio(apart, spent + apart, missing)
        metrics["speed.peak_memory"] = peak_memory()
        return metrics

    def stage_seconds(self) -> dict[str, list[float]]:
        """Wall time of each stage, one entry a frame in which it worked."""
        return {**self._stages, "simulation": self._clock.seconds["simulation"], "agent": self._clock.seconds["agent"]}

    def _record(self, loop: Loop, evaluator: Evaluator) -> RunRecord:
        trajectory, tracking, album = evaluator.trajectory, evaluator.tracking, evaluator.album
        return RunRecord(
            scene=self.config.scene.name,
            seed=self.config.seed,
            static_map=loop.simulation.static_map,
            meshes={name: model.visual for name, model in loop.simulation.models.items()},
            config=self.config.resolved(),
            start=0,
            end=trajectory.stamps[-1] if trajectory.stamps else 0,
            partial=self._partial,
            metrics=self._metrics(evaluator, loop.watches),
            stamps=trajectory.stamps,
            estimated=trajectory.estimated,
            true=trajectory.true,
            object_frames=tracking.frames,
            switches=tracking.switches,
            false_tracks=tracking.false_tracks,
            floor=evaluator.floor.samples,
            stage_seconds=self.stage_seconds(),
            key_frames=album.key_frames,
            worst=album.worst,
            query_frame=album.query_frame,
            camera=album.camera,
            lidar=album.lidar,
            believed_relations=self._timeline.intervals(),
        )


@contextmanager
def open_log(config: RunConfig, loop: Loop) -> "Iterator[McapWriter]":
    """An MCAP log with all that a replay needs; the stack's detections go into it as they are answered."""
    from simtrack.recordings import McapWriter

    assert config.log is not None
    simulation = loop.simulation
    metadata = {"scene": config.scene.name, "seed": config.seed, "T_map_base": simulation.start.ravel().tolist()}
    with McapWriter(
        config.log,
        static_map=simulation.static_map,
        models=simulation.models,
        robot=simulation.robot,
        metadata=metadata,
        overwrite=config.overwrite,
    ) as log:
        loop.stack.on_detection = log.write
        yield log
