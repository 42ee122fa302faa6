"""Scene files: what is simulated, as a validated YAML document.

A scene is a folder with a ``scene.yaml``. Scenes are looked for by name in the folders of ``$SIMTRACK_SCENES``, in the
checkout's ``scenes/`` and in the installed package's data. Units are metres, radians and seconds throughout; whatever
is written as a pair ``[low, high]`` is drawn anew for each seed.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, PrivateAttr, model_validator
from pydantic_core import PydanticCustomError

from simtrack.errors import FileFormatError, UnknownNameError
from simtrack.paths import scene_roots
from simtrack.simulation.strict_file import Name, Range, Strict, Vector, read_document, validated

FILE_NAME = "scene.yaml"
MAX_INSTANCES = 200
PI = 3.141592653589793


class Pose(Strict):
    """A pose in the map."""

    xyz: Vector
    """Metres."""
    rpy: Vector = (0.0, 0.0, 0.0)
    """Radians: Rz(yaw) Ry(pitch) Rx(roll)."""


class Placement(Strict):
    """Where a thing stands, before physics has settled it. Give one of `on`, `pose` and `away`."""

    on: str | None = None
    """Name of a furniture part of the static world with a support face."""
    face: int = Field(default=0, ge=0)
    """Which of the part's support faces."""
    x: Range | None = None
    """Metres along the face's x from its centre; by default the whole face."""
    y: Range | None = None
    yaw: Range = (-PI, PI)
    """Radians."""
    separation: float = Field(default=0.03, ge=0.0, le=1.0)
    """Least free distance to everything else on the face, metres."""
    pose: Pose | None = None
    away: bool = False
    """Nowhere in the world: until a change of the scene brings it, or from one on."""

    @model_validator(mode="after")
    def _one_of(self) -> "Placement":
        if (self.on is not None) + (self.pose is not None) + self.away != 1:
            message = "give exactly one of 'on' (name of a support), 'pose' and 'away: true'"
            raise PydanticCustomError("placement", message, {})
        return self


class SceneObject(Strict):
    """One object of the scene."""

    model: Name
    """Name in the object catalogue."""
    name: Name | None = None
    """Unique in the scene; by default the model's name."""
    place: Placement

    @property
    def id(self) -> str:
        """The object's name in the scene."""
        return self.name or self.model


class Static(Strict):
    """What builds the static world; ``mjcf``: it is what is fixed in the scene's MJCF file."""

    builder: Literal["lab_room", "office_floor", "room", "mjcf"]
    config: dict[str, Any] = Field(default_factory=dict)
    """Fields of the builder's configuration."""
    seed: int | None = Field(default=None, ge=0)
    """Fixes the building; by default it follows the run's seed."""


class StartPose(Strict):
    """Start at a given place on the floor."""

    x: float
    y: float
    yaw: float = 0.0


class StartFacing(Strict):
    """Start in front of a piece of furniture, looking at it."""

    facing: str
    distance: Range = (1.1, 1.4)
    """Metres from the robot's centre to the front edge."""
    lateral: Range = (-0.1, 0.1)
    """Metres along the edge."""
    yaw: Range = (-0.05, 0.05)
    """Radians off the direction that faces it."""


class StartRoom(Strict):
    """Start anywhere on the free floor of a room."""

    room: str


class RobotSettings(Strict):
    """The robot at time 0."""

    start: StartPose | StartFacing | StartRoom
    torso: float = Field(default=0.15, ge=0.0, le=0.35)
    head_pan: float = Field(default=0.0, ge=-1.24, le=1.24)
    head_tilt: float = Field(default=-0.4, ge=-0.98, le=0.72)
    suction: bool = False
    """Whether the gripper has a suction cup that can hold an object."""


class Target(Strict):
    """Where the hand puts something: on a support, or into a container."""

    on: str | None = None
    face: int = Field(default=0, ge=0)
    x: Range | None = None
    y: Range | None = None
    into: Name | None = None
    """Name of an object of the scene that is open at the top."""

    @model_validator(mode="after")
    def _one_of(self) -> "Target":
        if (self.on is None) == (self.into is None):
            raise PydanticCustomError("target", "give either 'on' (name of a support) or 'into' (an object)", {})
        return self


class Wait(Strict):
    """The hand stays where it is."""

    do: Literal["wait"]
    seconds: Range


class Carry(Strict):
    """The hand picks an object from above, carries it, puts it down gently and lets go."""

    do: Literal["carry"]
    object: Name
    to: Target
    height: Range = (0.12, 0.2)
    """Metres that the object is lifted."""
    speed: float = Field(default=0.4, gt=0.0, le=1.0)
    """Peak speed, m/s."""
    turn_rate: float = Field(default=PI / 2, ge=0.0, le=2 * PI)
    """Peak yaw rate, rad/s."""
    tilt: Range = (0.1, 0.5)
    """Largest tilt on the way, radians."""


class Push(Strict):
    """The hand pushes an object along its support by contact."""

    do: Literal["push"]
    object: Name
    distance: Range = (0.05, 0.15)
    speed: float = Field(default=0.15, gt=0.0, le=0.5)


class Retreat(Strict):
    """The hand goes back to its rest place."""

    do: Literal["retreat"]


Action: TypeAlias = Annotated[Wait | Carry | Push | Retreat, Field(discriminator="do")]


class HandSettings(Strict):
    """A scripted human hand; the script repeats, with new random targets, until the run ends."""

    rest: Vector
    """Where it rests between actions, map frame, metres: outside of the usual views."""
    script: tuple[Action, ...] = Field(min_length=1, max_length=200)


class Change(Strict):
    """While the robot looks elsewhere, somebody puts an object at another place, takes it away or brings it."""

    at: Range
    """Seconds: it happens as soon from then on as neither the object nor its new place is in view."""
    object: Name
    to: Placement


class SensorSettings(Strict):
    """Sensors: presets and deviations from them. Each mapping holds fields of the configuration that it names."""

    depth: str = "xtion"
    """Name of a preset of `simtrack.sensors.depth_noise`."""
    depth_noise: dict[str, Any] = Field(default_factory=dict)
    """Fields of `DepthNoiseConfig` that differ from the preset."""
    lidar_noise: dict[str, Any] = Field(default_factory=dict)
    """Fields of `LidarNoiseConfig`."""
    odometry: dict[str, Any] = Field(default_factory=dict)
    """Fields of `OdometryNoiseConfig`."""
    encoders: dict[str, Any] = Field(default_factory=dict)
    """Fields of `EncoderNoiseConfig`."""
    feed: dict[str, dict[str, float]] = Field(default_factory=dict)
    """Sensor (``camera``, ``lidar``, ``odometry``, ``joints``) -> fields of `FeedFaults`."""
    calibration: dict[str, Any] = Field(default_factory=dict)
    """Fields of `CalibrationFaults`."""


class SceneFile(Strict):
    """A whole scene."""

    name: Name
    description: str = ""
    duration: float = Field(default=20.0, gt=0.0, le=3600.0)
    """Seconds that a run takes unless told otherwise."""
    agent: str | None = None
    """Name of the agent that drives unless told otherwise."""
    static: Static
    mjcf: str | None = None
    """A user's MJCF file inside the scene's folder, attached to the world."""
    objects: tuple[SceneObject, ...] = Field(default=(), max_length=MAX_INSTANCES)
    """Objects that the tracker has models of."""
    clutter: tuple[SceneObject, ...] = Field(default=(), max_length=MAX_INSTANCES)
    """Things that it has no models of."""
    robot: RobotSettings
    hand: HandSettings | None = None
    changes: tuple[Change, ...] = Field(default=(), max_length=MAX_INSTANCES)
    """What happens unseen, each on its own."""
    sensors: SensorSettings = SensorSettings()
    survey: dict[str, Any] = Field(default_factory=dict)
    """Fields of `SurveyConfig`."""
    tracker_models: dict[str, Any] = Field(default_factory=dict)
    """Fields of `TrackerModelConfig`: how the tracker's models differ from the simulated bodies."""
    _path: Path = PrivateAttr(default=Path(FILE_NAME))

    @property
    def path(self) -> Path:
        """The file that it was read from."""
        return self._path

    @property
    def mjcf_path(self) -> Path | None:
        """The user's MJCF file, checked to lie inside the scene's folder."""
        return None if self.mjcf is None else self._path.parent / self.mjcf

    @model_validator(mode="after")
    def _references(self) -> "SceneFile":
        names = [thing.id for thing in (*self.objects, *self.clutter)]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            message = "object names must be unique, but {twice} occurs more than once; give them a 'name'"
            raise PydanticCustomError("unique", message, {"twice": ", ".join(twice)})
        said = [("hand.script", name) for name in self._script_names()]
        said += [("changes", change.object) for change in self.changes]
        for where, name in said:
            if name not in names:
                message = "{where} names the object '{name}'; the scene has: {names}"
                known = ", ".join(sorted(names))
                raise PydanticCustomError("reference", message, {"where": where, "name": name, "names": known})
        return self

    def _script_names(self) -> Iterator[str]:
        for action in self.hand.script if self.hand else ():
            if isinstance(action, Carry | Push):
                yield action.object
            if isinstance(action, Carry) and action.to.into is not None:
                yield action.to.into


def scene_names() -> dict[str, Path]:
    """Name -> folder of every scene that can be found; a name found twice belongs to the earlier folder."""
    found: dict[str, Path] = {}
    for folder in scene_roots():
        for file in sorted(folder.glob(f"*/{FILE_NAME}")):
            found.setdefault(file.parent.name, file.parent)
    return found


def load_scene(name_or_path: str | Path) -> SceneFile:
    """Read a scene by name, or by the path of its folder, YAML or MJCF file; ``NAME:SEED`` fixes the building's seed.

    Raises `UnknownNameError` with the known scenes, `FileFormatError` with file, field and what is allowed.
    """
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return read_scene(path)
    if path.suffix == ".xml" and path.is_file():
        from simtrack.simulation.mjcf_world import mjcf_scene

        return mjcf_scene(path)
    if path.suffix in (".yaml", ".yml", ".xml"):
        raise FileFormatError(path, "", "no such file")
    if len(path.parts) > 1 and (path / FILE_NAME).is_file():
        return read_scene(path / FILE_NAME)
    known = scene_names()
    name, colon, seed = str(name_or_path).partition(":")
    if name not in known or (colon and not (seed.isascii() and seed.isdecimal() and len(seed) < 10)):
        raise UnknownNameError("scene", str(name_or_path), known, "or NAME:SEED with one of these and a whole number")
    scene = read_scene(known[name] / FILE_NAME)
    return scene if not colon else with_building_seed(scene, int(seed))


def surveyed_by(scene: SceneFile, method: str) -> SceneFile:
    """The scene, its map made by a method of `simtrack.simulation.survey.SurveyConfig`."""
    changed = scene.model_copy(update={"survey": {**scene.survey, "method": method}})
    changed._path = scene.path
    return changed


def with_building_seed(scene: SceneFile, seed: int) -> SceneFile:
    """The same scene with the building of a fixed seed."""
    fixed = scene.model_copy(update={"static": scene.static.model_copy(update={"seed": seed})})
    fixed._path = scene.path
    return fixed


def read_scene(path: Path) -> SceneFile:
    """Read and validate one scene file; raises `FileFormatError`."""
    return parse_scene(read_document(path), path)


def parse_scene(document: Any, path: Path) -> SceneFile:
    """Validate a scene given as plain data, as if read from `path`; raises `FileFormatError`."""
    scene = validated(SceneFile, document, path, "scene")
    scene._path = path.resolve()
    _check_inside(scene)
    return scene


def _check_inside(scene: SceneFile) -> None:
    """Refuse a user file that is missing or lies outside of the scene's folder (symbolic links resolved)."""
    if scene.mjcf is None:
        return
    folder = scene.path.parent
    target = (folder / scene.mjcf).resolve()
    if not target.is_relative_to(folder):
        raise FileFormatError(scene.path, "mjcf", f"'{scene.mjcf}' leads out of the scene's folder {folder}")
    if not target.is_file():
        raise FileFormatError(scene.path, "mjcf", f"there is no file '{scene.mjcf}' in {folder}")
