"""Frames of a robot's eye: each scene is a drive in closed loop, the robot's own perception steering it."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Agent,
    Command,
    Int32,
    JointState,
    LidarScan,
    MapEntity,
    Odometry,
    RgbdFrame,
)
from simtrack.datasets.annotate import Annotator, Owners
from simtrack.datasets.content import Placed
from simtrack.datasets.frame import Category, LabelledFrame, LidarLabels, SceneInfo, StuffCategory
from simtrack.datasets.randomness import random_of, seed_of
from simtrack.datasets.recipe import DriveViews, Recipe
from simtrack.datasets.relations import Relations
from simtrack.datasets.stages import FAR, category_of, depth_noise, map_entities, scene_of, stuff_categories
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
LOOSE = ("robot", "hand")
"""Classes of what moves and is no object."""


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
        self.categories = tuple(Category(k, model) for k, model in enumerate(models.values(), start=1))
        self._of_model = {category.model.name: category.id for category in self.categories}
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
        owners, things, segments = _owners(simulation), self._things(simulation), self._segments(simulation)
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
                        yield self._label(drive, frame, index, owners, things, segments)
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

    # -------------------------------------------------------------------------------------------------------- one frame

    def _label(
        self, drive: _Drive, frame: RgbdFrame, index: int, owners: Owners, things: list[Placed], segments: Int32
    ) -> LabelledFrame:
        simulation, truth = drive.simulation, drive.simulation.truth.at(frame.stamp)
        rays = simulation.truth.rays(frame.stamp).scene
        placed = tuple(replace(thing, T_map_object=truth.objects[thing.name].T_map_object) for thing in things)
        view = self._annotator.look(rays, owners, truth.T_map_camera)
        support = tuple(sorted(truth.contacts))
        scan, drive.scan = drive.scan, None
        assert frame.rgb is not None
        return LabelledFrame(
            scene=drive.scene,
            index=index,
            stamp=frame.stamp,
            intrinsics=frame.intrinsics,
            T_map_camera=truth.T_map_camera,
            rgb=frame.rgb,
            depth=frame.depth,
            clean_depth=view.depth,
            normals=view.normals,
            ids=view.ids,
            names=simulation.truth.names,
            segment_categories=segments,
            labels=self._annotator.annotate(placed, rays, truth.T_map_camera, view.ids, frame.depth),
            lidar=None if scan is None else _lidar_labels(simulation, scan),
            odometry=drive.odometry,
            T_map_base=truth.T_map_base,
            joints=simulation.truth.joint_positions(frame.stamp),
            support=support,
            relations=drive.relations.of(placed, drive.entities, support),
        )

    def _things(self, simulation: Simulation) -> list[Placed]:
        """Objects and clutter, wherever they are."""
        world, rays = simulation.world, simulation.truth.rays(0)
        instances = {thing.name: k for k, thing in enumerate(rays.moving, 0 if rays.fixed is None else 1)}
        things = []
        for name, model in world.objects.items():
            category = self._of_model[model.name] if world.is_catalogue(name) else None
            things.append(
                Placed(
                    instance=world.names.index(name),
                    ray_instance=instances[name],
                    name=name,
                    semantic_class=model.semantic_class,
                    category=category,
                    mesh=rays.scene.mesh(instances[name]),
                    T_map_object=np.eye(4),
                    scale=np.ones(3),
                    extents=model.extents,
                    keypoints=model.keypoints if category is not None else np.empty((0, 3)),
                )
            )
        return things

    # ------------------------------------------------------------------------------------------------------- categories

    def _all_stuff(self) -> dict[tuple[str, bool], StuffCategory]:
        """(class, whether instances are told apart) -> category; the same for every seed."""
        parts = [part for scene in self._scenes for part in build_static(scene, 0).parts]
        loose = {load_object(thing.model).semantic_class for scene in self._scenes for thing in scene.clutter}
        return stuff_categories({part.semantic_class for part in parts}, {*loose, *LOOSE}, len(self.categories))

    def _segments(self, simulation: Simulation) -> Int32:
        """(N,), category of each of the simulation's names."""
        world = simulation.world
        parts = {part.name: part.semantic_class for part in world.static.parts}
        categories = []
        for name in world.names:
            if name in world.objects and world.is_catalogue(name):
                categories.append(self._of_model[world.objects[name].name])
                continue
            loose = name in world.objects or name in LOOSE
            semantic_class = world.objects[name].semantic_class if name in world.objects else parts.get(name, name)
            categories.append(category_of(self._stuff, semantic_class, loose))
        return np.array(categories, np.int32)


def _owners(simulation: Simulation) -> Owners:
    """Ids of the simulation's ray instances: `World.names` by index."""
    rays, names = simulation.truth.rays(0), simulation.world.names
    first = 0 if rays.fixed is None else 1
    whole = {k: names.index(thing.name) for k, thing in enumerate(rays.moving, first)}
    return Owners(whole, {} if rays.fixed is None else {rays.fixed: rays.face_ids(rays.fixed)})


def _lidar_labels(simulation: Simulation, scan: LidarScan) -> LidarLabels:
    truth = simulation.truth
    return LidarLabels(scan, truth.at(scan.stamp).T_map_lidar, truth.lidar_ids(scan.stamp))
