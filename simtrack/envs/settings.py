"""What can be asked of an environment, checked before anything is built."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from simtrack.contracts import CameraIntrinsics
from simtrack.envs.observations import MODES
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.objects import catalogue, load_object
from simtrack.sensors.camera import XTION, CameraModel
from simtrack.sensors.lidar import VLP16, LidarModel
from simtrack.simulation.oracles.detector import OracleDetectorConfig
from simtrack.simulation.rendering import RENDERERS
from simtrack.simulation.scene_file import SceneFile, parse_scene

CONTROL_HZ = 10
"""Steps a second of simulated time; the camera looks as often."""
CONTROL_NS = 1_000_000_000 // CONTROL_HZ
LIDAR_HZ = 5
"""Turns of the lidar a second, the slowest of a VLP-16: odometry leads on in between."""
ODOMETRY_NS = 40_000_000
"""Nanoseconds between readings of wheels and joints where a localizer needs them."""
DETECTORS = ("oracle",)
BELIEF_SIZE, IMAGE_SIZE = (160, 120), (84, 84)
"""Width and height of the robot's camera where a stack looks at it, and where only the agent does."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Arguments of an environment; wrong ones raise here."""

    observation: str | Sequence[str] = "belief"
    """One of `MODES`, or several of them."""
    objects: Sequence[str] | None = None
    """Names of objects of the scene, which stay where the scene puts them, or of models of the catalogue, which stand
    where the scene's first object may; the scene's own if None."""
    detector: str = "oracle"
    detector_errors: Mapping[str, float] = field(default_factory=dict)
    """Fields of `simtrack.simulation.oracles.detector.OracleDetectorConfig` that differ."""
    renderer: str = "embree"
    """What renders the robot's camera; ``mujoco`` needs OpenGL."""
    image_size: tuple[int, int] | None = None
    """Width and height of the robot's camera, pixels."""
    lidar_columns: int = 226
    """Firings of the 16 lasers in a turn; a VLP-16 has 1809."""
    slots: int = 16
    """Objects that an observation has room for."""
    seconds: float | None = None
    """Length of an episode; the task's own if None."""

    def __post_init__(self) -> None:
        for mode in self.modes:
            if mode not in MODES:
                raise UnknownNameError("observation mode", str(mode), MODES)
        if not self.modes or len(set(self.modes)) != len(self.modes):
            raise InvalidValueError("observation", self.observation, f"one or several of {', '.join(MODES)}, each once")
        if self.detector not in DETECTORS:
            raise UnknownNameError("detector", self.detector, DETECTORS)
        if self.renderer not in RENDERERS:
            raise UnknownNameError("renderer", self.renderer, RENDERERS)
        self.detector_config(1.0)
        width, height = self.size
        if not (8 <= width <= 1920 and 8 <= height <= 1080):
            raise InvalidValueError("image_size", self.image_size, "(width, height), 8 to 1920 by 8 to 1080 pixels")
        if not 16 <= self.lidar_columns <= VLP16.columns:
            raise InvalidValueError("lidar_columns", self.lidar_columns, f"16 to {VLP16.columns}")
        if not 1 <= self.slots <= 200:
            raise InvalidValueError("slots", self.slots, "1 to 200")
        if self.seconds is not None and not 0.1 <= self.seconds <= 3600.0:
            raise InvalidValueError("seconds", self.seconds, "0.1 to 3600")

    @property
    def modes(self) -> tuple[str, ...]:
        """The observation modes."""
        return (self.observation,) if isinstance(self.observation, str) else tuple(self.observation)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the robot's camera, pixels."""
        return self.image_size or (BELIEF_SIZE if "belief" in self.modes else IMAGE_SIZE)

    @property
    def camera(self) -> CameraModel:
        """The Xtion with fewer pixels, as fast as the control: its vertical field of view stays."""
        width, height = self.size
        focal = XTION.intrinsics.fy * height / XTION.intrinsics.height
        intrinsics = CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        return CameraModel(intrinsics, float(CONTROL_HZ), XTION.min_range, XTION.max_range, XTION.baseline)

    @property
    def lidar(self) -> LidarModel:
        """The VLP-16 with fewer firings a turn, one turn in two steps."""
        period = 1.0 / (LIDAR_HZ * self.lidar_columns)
        return LidarModel(rate_hz=float(LIDAR_HZ), firing_period=period)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors that the modes need."""
        sensors = ["proprioception"]
        if "belief" in self.modes:
            sensors += ["camera", "lidar"]
        elif "rgbd" in self.modes:
            sensors += ["camera"]
        return tuple(sensors)

    @property
    def proprioception(self) -> int:
        """Nanoseconds between readings of wheels and joints: a localizer wants some a step, an agent one."""
        return ODOMETRY_NS if "belief" in self.modes else CONTROL_NS

    def detector_config(self, scale: float) -> OracleDetectorConfig:
        """Errors of the oracle detector; sizes in pixels are multiplied by `scale`, as the images are."""
        default = OracleDetectorConfig()
        try:
            return OracleDetectorConfig(**{"min_size": default.min_size * scale, **dict(self.detector_errors)})
        except TypeError as error:
            known = OracleDetectorConfig.__dataclass_fields__
            unknown = sorted(set(self.detector_errors) - set(known))
            raise UnknownNameError("detector error", ", ".join(unknown), known) from error


def with_objects(scene: SceneFile, names: Sequence[str] | None) -> SceneFile:
    """The scene with exactly these objects; the hand leaves out what it would do with others.

    Raises:
        UnknownNameError: a name is neither an object of the scene nor a model of the catalogue.
        InvalidValueError: no object, or one that is named twice.
    """
    if names is None:
        return scene
    if not names or len(set(names)) != len(names):
        raise InvalidValueError("objects", list(names), "one or more names, each once")
    document: dict[str, Any] = scene.model_dump(mode="json", exclude_defaults=True)
    own = {thing.id: entry for thing, entry in zip(scene.objects, document.get("objects", []), strict=True)}
    models = catalogue()
    chosen = []
    for name in names:
        if name in own:
            chosen.append(own[name])
        elif name in models and own and load_object(name).trackable:
            place = next(iter(own.values()))["place"]
            chosen.append({"model": name, "place": {"on": place["on"], "face": place.get("face", 0)}})
        else:
            raise UnknownNameError("object", name, {*own, *(m for m in models if load_object(m).trackable)})
    document["objects"] = chosen
    if "hand" in document:
        clutter = {thing.id for thing in scene.clutter}
        script = [action for action in document["hand"]["script"] if _possible(action, {*names} | clutter)]
        document["hand"]["script"] = script or [{"do": "retreat"}]
    return parse_scene(document, scene.path)


def _possible(action: Mapping[str, Any], things: set[str]) -> bool:
    """Whether everything that an action of the hand names is there."""
    named = {action.get("object"), (action.get("to") or {}).get("into")} - {None}
    return named <= things


def fixed_building(scene: SceneFile) -> SceneFile:
    """The scene with a building that is the same for every seed: it is built once for all episodes."""
    if scene.static.seed is not None:
        return scene
    static = scene.static.model_copy(update={"seed": 0})
    return scene.model_copy(update={"static": static})


def furniture_of(scene: SceneFile) -> tuple[str, ...]:
    """Names of the furniture that a scene's objects stand on or are carried to, in alphabetical order."""
    names = {thing.place.on for thing in (*scene.objects, *scene.clutter)}
    for action in scene.hand.script if scene.hand is not None else ():
        if action.do == "carry":
            names.add(action.to.on)
    return tuple(sorted(name for name in names if name is not None))


def classes_of(scene: SceneFile) -> tuple[str, ...]:
    """Names of the models of a scene's objects, in alphabetical order; raises UnknownNameError."""
    return tuple(sorted({load_object(thing.model).name for thing in scene.objects}))


def articulations_of(scene: SceneFile) -> tuple[str, ...]:
    """Names of the doors and drawers of a scene's building, in its order."""
    if scene.static.builder != "mjcf":
        return ()
    from simtrack.simulation.mjcf_world import mjcf_building

    return tuple(moving.part.name for moving in mjcf_building(scene, supports=False).moving)


def pixel_scale(camera: CameraModel) -> float:
    """Size of a thing in an image of this camera over that in the Xtion's."""
    return float(np.divide(camera.intrinsics.fy, XTION.intrinsics.fy))
