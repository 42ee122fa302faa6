"""The world, the robot's sensors and what is made of them, one control step at a time."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numba
import numpy as np

from simtrack.contracts import Belief, Command, DetectionResult, JointState, Odometry, RgbdFrame, SensorFrame
from simtrack.envs.actions import Request
from simtrack.envs.macros import Manipulator
from simtrack.envs.observations import Proprioception
from simtrack.envs.requests import begin
from simtrack.envs.resolution import noise_in_small_images, stack_config
from simtrack.envs.settings import Settings, pixel_scale
from simtrack.envs.truth import IdealPerception, true_belief
from simtrack.perception.localization import MeshLocalizer
from simtrack.perception.pipeline import PerceptionStack
from simtrack.perception.stack_config import StackConfig
from simtrack.sensors.depth_noise import PRESETS
from simtrack.simulation.ground_truth import Truth
from simtrack.simulation.oracles import OracleDetector
from simtrack.simulation.scene_file import SceneFile
from simtrack.simulation.simulation import Simulation

BUILDING_SEED = 0
"""Decides what belongs to the building and not to an episode: the survey, and how the tracker's models are off."""
KEY = 20_000_000
"""Nanoseconds between the states that are remembered: all sensors look at multiples of it."""
SCAN_KEY = 50_000_000
"""Nanoseconds between the moments of a lidar's turn: at 1 m/s^2 a straight line between them errs by 0.3 mm."""
SERVO = 10_000_000
"""Nanoseconds between the setpoints of robot and hand."""
MEMORY = 2_000_000_000
"""Nanoseconds of the past that are kept."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What there is to know after a step."""

    truth: Truth
    belief: Belief
    """What the robot believes: the stack's answer, or that of ideal perception where no stack runs."""
    state: Belief | None
    """The truth in the same shape, where it is observed."""
    felt: Proprioception
    image: RgbdFrame | None
    """The camera's image, where there is one."""
    feed: tuple[SensorFrame | DetectionResult, ...] = ()
    """What arrived since the last step: sensor frames, and the detector's answers after the images they belong to."""
    holding: str | None = None
    """Name of the object that the gripper truly holds."""


class Loop:
    """Simulation and perception of an environment; built once, begun anew for every episode.

    Only what the settings ask for is simulated: without images and beliefs there is no camera, no lidar, no stack.
    """

    def __init__(self, scene: SceneFile, settings: Settings) -> None:
        """Build the world; raises SimtrackError for a scene that cannot be built."""
        self._settings = settings
        camera = settings.camera
        scene = _with_noise(scene, pixel_scale(camera))
        self.simulation = Simulation(
            scene, BUILDING_SEED, settings.renderer, camera, settings.lidar,
            sensors=settings.sensors, sleep=True, memory=MEMORY, proprioception=settings.proprioception,
            scan_key=SCAN_KEY, servo=SERVO, key=KEY, threads=False,
        )  # fmt: skip
        self.manipulator = Manipulator(self.simulation) if scene.robot.suction else None
        """Arm and cup, where there is one."""
        self.colours = "rgbd" in settings.modes
        """Whether images have colour; the oracle does not look at it."""
        self._ideal = IdealPerception(self.simulation, camera)
        self._stack: PerceptionStack | None = None
        self._felt = Proprioception(JointState(0, (), np.zeros(0)), 0.0, 0.0)
        self._image: RgbdFrame | None = None
        self._belief: Belief | None = None
        self._feed: list[SensorFrame | DetectionResult] = []

    @property
    def has_stack(self) -> bool:
        """Whether a stack makes the beliefs."""
        return "belief" in self._settings.modes

    def restart(self, seed: int) -> None:
        """Begin an episode; everything random is drawn from `seed`."""
        if self.manipulator is not None:
            self.manipulator.reset()  # first: what the cup holds does not come to rest as other things do
        self.simulation.restart(seed)
        self._ideal.reset()
        self._belief = self._image = None
        if self.has_stack:
            old, self._stack = self._stack, self._make_stack(seed)
            if old is not None:
                if isinstance(old.localizer, MeshLocalizer) and isinstance(self._stack.localizer, MeshLocalizer):
                    self._stack.localizer.share_search_map(old.localizer)
                old.close()
            self._stack.on_detection = self._feed.append

    def _make_stack(self, seed: int) -> PerceptionStack:
        simulation = self.simulation
        errors = self._settings.detector_config(pixel_scale(simulation.camera))
        return PerceptionStack(
            simulation.static_map,
            simulation.models,
            simulation.robot,
            OracleDetector(
                simulation.truth, simulation.models, seed, errors, simulation.calibration.camera_time_offset
            ),
            T_map_base=simulation.start,
            config=_without_threads(stack_config(pixel_scale(simulation.camera))),
        )

    @property
    def busy(self) -> bool:
        """Whether the arm is at work."""
        return self.manipulator is not None and self.manipulator.busy

    def step(self, command: Command, request: Request | None = None) -> Snapshot:
        """Run for one control step under a command; what the arm is asked for begins if it is not at work."""
        with _one_thread():
            return self._step(command, request)

    def _step(self, command: Command, request: Request | None) -> Snapshot:
        simulation = self.simulation
        if self.manipulator is not None:
            if request is not None and not self.manipulator.busy and self._belief is not None:
                begin(self.manipulator, request, self._belief, simulation.models, simulation.static_map)
            self.manipulator.step(None if self._belief is None else self._belief.localization.T_map_base)
            if self.manipulator.busy:
                command = replace(command, linear=self.manipulator.drive, angular=0.0)
        self._feed.clear()
        joints, linear, angular = self._felt.joints, self._felt.linear, self._felt.angular
        for frame in simulation.advance(command, want_rgb=self.colours):
            self._feed.append(frame)
            if isinstance(frame, JointState):
                joints = frame
            elif isinstance(frame, Odometry):
                linear, angular = frame.linear, frame.angular
            elif isinstance(frame, RgbdFrame):
                self._image = frame
            if self._stack is not None:
                self._belief = self._stack.process(frame) or self._belief
        self._felt = Proprioception(joints, linear, angular)
        return self._snapshot()

    def _snapshot(self) -> Snapshot:
        truth = self.simulation.truth.at(self.simulation.now)
        state = belief = None
        if self._stack is None or "state" in self._settings.modes:
            visible = self._ideal.visible(truth)
            state = true_belief(truth, visible) if "state" in self._settings.modes else None
            belief = self._ideal.process(truth, visible) if self._stack is None else None
        belief = self._belief = belief or self._belief
        assert belief is not None
        felt, holding = self._felt, None
        if self.manipulator is not None:
            held, holding = self.manipulator.held, self.manipulator.cup.holding
            felt = replace(felt, macro=self.manipulator.outcome, holding=held.class_name if held is not None else None)
        return Snapshot(truth, belief, state, felt, self._image, tuple(self._feed), holding)

    def _end_stack(self) -> None:
        if self._stack is not None:
            self._stack.close()
            self._stack = None

    def close(self) -> None:
        """Release everything; may be called twice."""
        self._end_stack()
        self.simulation.close()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compiled kernels keep to the calling thread, as the stack does: others would wait busily for their next turn."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


def _without_threads(config: StackConfig) -> StackConfig:
    """The same settings for one processor: environments are many, and none has more."""
    return replace(config, threads=False, tracker=replace(config.tracker, threads=False))


def _with_noise(scene: SceneFile, scale: float) -> SceneFile:
    """The scene with its depth noise as it looks in images `scale` times as large; what the scene says stays."""
    sensors = scene.sensors
    if sensors.depth not in PRESETS:  # which the simulation will refuse
        return scene
    noise = {**noise_in_small_images(sensors.depth, scale), **sensors.depth_noise}
    return scene.model_copy(update={"sensors": sensors.model_copy(update={"depth_noise": noise})})
