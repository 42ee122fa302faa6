"""Frames of a robot's eye: each scene is a drive in closed loop, the robot's own perception steering it."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Agent,
    Command,
    JointState,
    LidarScan,
    MapEntity,
    Odometry,
    RgbdFrame,
)
from simtrack.datasets.annotate import Annotator
from simtrack.datasets.frame import LabelledFrame, SceneInfo, StuffCategory
from simtrack.datasets.randomness import random_of, seed_of
from simtrack.datasets.recipe import DriveViews, Recipe
from simtrack.datasets.relations import Relations
from simtrack.datasets.simulated import SimulationLabels, stuff_of, target_categories
from simtrack.datasets.stages import FAR, depth_noise, map_entities, scene_of
from simtrack.errors import FileFormatError, UnknownNameError
from simtrack.objects import ObjectModel, load_object
from simtrack.perception.pipeline import PerceptionStack
from simtrack.sensors.camera import CameraModel
from simtrack.simulation.agents import AGENTS, AgentContext, make_agent
from simtrack.simulation.oracles import OracleDetector
from simtrack.simulation.scene_file import SceneFile
from simtrack.simulation.simulation import Simulation
from simtrack.simulation.world import build_static

CAMERA_RATE = 30.0
"""Images a second that the robot's camera takes; labelled ones are every n-th."""


@dataclass(slots=True)
class _Drive:
    """A simulation with all that closes its loop."""

    scene: int
    simulation: Simulation
    stack: PerceptionStack
    agent: Agent
    start: Command
    entities: list[MapEntity]
    relations: Relations = field(default_factory=Relations)
    odometry: Odometry | None = None
    scan: LidarScan | None = None
    """The last one that no frame carries yet."""


class Drives:
    """What `simtrack.datasets.generator.Generator` makes of recipes with views of kind ``drive``."""

    def __init__(self, recipe: Recipe, seed: int) -> None:
        """Read the scenes.

        Args:
            recipe: from `load_recipe`, with views of kind ``drive``.
            seed: of everything random.

        Raises:
            FileFormatError: what the recipe names does not exist or cannot be used.
        """
        assert isinstance(recipe.views, DriveViews)
        self._recipe, self._seed, self._views = recipe, seed, recipe.views
        noise = depth_noise(recipe)
        self._scenes = [self._scene(k) for k in range(len(recipe.worlds))]
        self._step = max(1, round(CAMERA_RATE / recipe.views.rate))
        self._camera = CameraModel(recipe.camera.intrinsics, CAMERA_RATE, noise.min_range, min(noise.max_range, 100.0))
        models: dict[str, ObjectModel] = {}
        for scene in self._scenes:
            models |= {thing.model: load_object(thing.model) for thing in scene.objects}
        self.categories = target_categories(list(models.values()))
        self._stuff = self._all_stuff()
        self.stuff = tuple(self._stuff.values())
        self._annotator = Annotator(recipe.camera.intrinsics, FAR)
        self._exits = ExitStack()
        self._open: _Drive | None = None

    @property
    def frames_per_scene(self) -> int:
        """Labelled images of a drive."""
        images = int(self._views.duration * NANOSECONDS) // self._camera.period
        return -(-images // self._step)

    def scenes(self, count: int) -> int:
        """Number of drives that hold at least `count` frames."""
        return -(-count // self.frames_per_scene)

    def scene_info(self, scene: int) -> SceneInfo:
        """What is known of a drive before it begins: the estimator's map and the robot's body."""
        simulation = self._drive(scene).simulation
        return SceneInfo(scene, self.frames_per_scene, simulation.static_map, simulation.robot)

    def frames(self, scene: int) -> Iterator[LabelledFrame]:
        """Drive; yields every n-th image with its labels and the scan that came last before it."""
        drive = self._drive(scene)
        command, joints, index = drive.start, JointState(0, (), np.zeros(0)), 0
        simulation, stack = drive.simulation, drive.stack
        labels = SimulationLabels(simulation, self.categories, self._stuff, self._annotator)
        for number in range(self._step * (self.frames_per_scene - 1) + 1):
            labelled = number % self._step == 0
            want_rgb = labelled or stack.wants_image(simulation.now + simulation.camera_period)
            for frame in simulation.advance(command, want_rgb=want_rgb):
                match frame:
                    case JointState():
                        joints = frame
                    case Odometry():
                        drive.odometry = frame
                    case LidarScan():
                        drive.scan = frame if self._views.lidar else None
                    case RgbdFrame() if labelled and frame.rgb is not None:
                        scan, drive.scan = drive.scan, None
                        yield labels.label(
                            frame, scene, index, scan=scan, odometry=drive.odometry, relations=drive.relations,
                            entities=drive.entities,
                        )  # fmt: skip
                        index += 1
                if (belief := stack.process(frame)) is not None:
                    command = drive.agent.act(belief, joints)
        self._close_drive()

    def close(self) -> None:
        """Release OpenGL and ray scenes; may be called twice."""
        self._close_drive()

    # -------------------------------------------------------------------------------------------------------- one drive

    def _scene(self, number: int) -> SceneFile:
        """The scene file of a world with the recipe's camera in it; raises FileFormatError for an unknown agent."""
        recipe, scene = self._recipe, scene_of(self._recipe, number)
        if (agent := self._views.agent or scene.agent or "explorer") not in AGENTS:
            raise FileFormatError(recipe.path, "views.agent", str(UnknownNameError("agent", agent, AGENTS)))
        camera = {"depth": recipe.camera.depth, "depth_noise": recipe.camera.depth_noise}
        sensors = scene.sensors.model_copy(update={**camera, "feed": {}, "calibration": {}})
        changed = scene.model_copy(update={"sensors": sensors, "agent": agent})
        changed._path = scene.path
        return changed

    def _drive(self, scene: int) -> _Drive:
        """The drive of a scene, made where it is not the open one."""
        if self._open is None or self._open.scene != scene:
            self._close_drive()
            self._open = self._begin(scene)
        return self._open

    def _begin(self, scene: int) -> _Drive:
        weights = np.array([world.weight for world in self._recipe.worlds])
        chosen = int(random_of(self._seed, "stage", scene).choice(len(weights), p=weights / weights.sum()))
        file, seed = self._scenes[chosen], seed_of(self._seed, "drive", scene)
        simulation = self._exits.enter_context(Simulation(file, seed, camera=self._camera))
        robot = file.robot
        start = Command(head_pan=robot.head_pan, head_tilt=robot.head_tilt, torso=robot.torso)
        intrinsics = simulation.camera.intrinsics
        rng = random_of(self._seed, "agent", scene)
        context = AgentContext(simulation.static_map, simulation.robot, intrinsics, start, rng)
        detector = OracleDetector(simulation.truth, simulation.models, seed)
        stack = PerceptionStack(
            simulation.static_map, simulation.models, simulation.robot, detector, T_map_base=simulation.start
        )
        self._exits.callback(stack.close)
        agent = make_agent(file.agent or "", context)
        return _Drive(scene, simulation, stack, agent, start, map_entities(simulation.world.static))

    def _close_drive(self) -> None:
        self._open = None
        self._exits.close()

    # ------------------------------------------------------------------------------------------------------- categories

    def _all_stuff(self) -> dict[tuple[str, bool], StuffCategory]:
        """(class, whether instances are told apart) -> category; the same for every seed."""
        parts = [part for scene in self._scenes for part in build_static(scene, 0).parts]
        clutter = {load_object(thing.model).semantic_class for scene in self._scenes for thing in scene.clutter}
        return stuff_of({part.semantic_class for part in parts}, clutter, len(self.categories))
