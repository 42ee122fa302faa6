"""Recipes: what a data set consists of, as a validated YAML document.

A recipe is a file ``NAME.yaml``. Recipes are looked for by name in the folders of ``$SIMTRACK_GENERATORS``, in the
checkout's ``generators/`` and in the installed package's data. Units are metres, radians and seconds; whatever is
written as a pair ``[low, high]`` is drawn uniformly, anew for each scene or view. Paths are relative to the recipe.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, get_args

from pydantic import Field, PrivateAttr, field_validator, model_validator
from pydantic_core import PydanticCustomError

from simtrack.contracts import CameraIntrinsics
from simtrack.errors import FileFormatError, UnknownNameError
from simtrack.paths import generator_roots
from simtrack.simulation.strict_file import Name, Strict, read_document, validated

MAX_THINGS = 60
"""Targets or distractors in a scene."""
PI = 3.141592653589793

WriterName: TypeAlias = Literal["bop", "bop_webdataset", "coco", "yolo", "kitti", "tum", "dope", "mcap", "labels"]
"""Label and log formats."""
TextureKind: TypeAlias = Literal["plain", "noise", "checker", "stripes", "dots", "wood", "marble", "bricks", "gradient"]
"""Procedural textures."""
PrimitiveKind: TypeAlias = Literal["box", "cylinder", "cone", "prism", "sphere", "capsule", "bracket"]
"""Random shapes."""
WRITERS: tuple[WriterName, ...] = get_args(WriterName)
TEXTURES: tuple[TextureKind, ...] = get_args(TextureKind)
PRIMITIVES: tuple[PrimitiveKind, ...] = get_args(PrimitiveKind)

Count: TypeAlias = Annotated[int, Field(ge=0, le=MAX_THINGS)]
Share: TypeAlias = Annotated[float, Field(ge=0.0, le=1.0)]
Shares: TypeAlias = tuple[Share, Share]
Length: TypeAlias = Annotated[float, Field(gt=0.0, le=20.0)]
Lengths: TypeAlias = tuple[Length, Length]
Elevation: TypeAlias = Annotated[float, Field(ge=-PI / 2, le=PI / 2)]
Intensity: TypeAlias = Annotated[float, Field(ge=0.0, le=10.0)]


class TableSettings(Strict):
    """A table in the middle of a room."""

    depth: Lengths = (0.8, 1.2)
    width: Lengths = (1.2, 1.8)
    height: Lengths = (0.6, 0.9)


class RoomWorld(Strict):
    """A rectangular room whose surfaces carry random textures."""

    kind: Literal["room"]
    weight: float = Field(default=1.0, gt=0.0)
    """How often, relative to the other worlds."""
    depth: tuple[Annotated[float, Field(ge=2.0, le=30.0)], Annotated[float, Field(ge=2.0, le=30.0)]] = (3.5, 5.0)
    width: tuple[Annotated[float, Field(ge=2.0, le=30.0)], Annotated[float, Field(ge=2.0, le=30.0)]] = (3.5, 5.0)
    height: tuple[Annotated[float, Field(ge=2.0, le=10.0)], Annotated[float, Field(ge=2.0, le=10.0)]] = (2.4, 3.2)
    table: TableSettings | None = TableSettings()
    """None: things lie on the floor."""


class SceneWorld(Strict):
    """The building of a scene file."""

    kind: Literal["scene"]
    weight: float = Field(default=1.0, gt=0.0)
    scene: str
    """Name of a scene, see `simtrack scenes`, or the path of its folder relative to the recipe."""
    supports: tuple[str, ...] = Field(default=(), max_length=50)
    """Names of furniture to put things on, one of them a scene; empty: drives keep the scene file's own places."""
    textured: tuple[str, ...] = Field(default=(), max_length=50)
    """Semantic classes of parts that carry random textures instead of their own colours: ``floor``, ``wall``, ..."""


World: TypeAlias = Annotated[RoomWorld | SceneWorld, Field(discriminator="kind")]


class TargetSettings(Strict):
    """The labelled objects."""

    models: tuple[Name, ...] = Field(default=(), max_length=200)
    """Names in the object catalogue; their order gives the categories' ids."""
    folders: tuple[str, ...] = Field(default=(), max_length=50)
    """The user's objects: folders with an ``object.yaml``, or folders of such folders, relative to the recipe."""
    count: tuple[Count, Count] = (5, 10)
    """In a scene."""
    repeat: int = Field(default=2, ge=1, le=MAX_THINGS)
    """Most instances of one model in a scene."""


class PrimitiveSettings(Strict):
    """Shapes without a name, of random form and texture."""

    count: tuple[Count, Count] = (0, 0)
    kinds: tuple[PrimitiveKind, ...] = Field(default=PRIMITIVES, min_length=1)
    size: tuple[Annotated[float, Field(ge=0.005, le=2.0)], Annotated[float, Field(ge=0.005, le=2.0)]] = (0.03, 0.2)
    """Metres, of each side."""


class DistractorSettings(Strict):
    """Things that are seen and told apart, but that have no class to be learned."""

    models: tuple[Name, ...] = Field(default=(), max_length=200)
    folders: tuple[str, ...] = Field(default=(), max_length=50)
    count: tuple[Count, Count] = (0, 0)
    """Of `models` and `folders`, in a scene."""
    scale: tuple[Annotated[float, Field(ge=0.1, le=5.0)], Annotated[float, Field(ge=0.1, le=5.0)]] = (0.8, 1.2)
    primitives: PrimitiveSettings = PrimitiveSettings()


class DropPlacement(Strict):
    """Things fall from random poses onto a support and come to rest."""

    kind: Literal["drop"]
    area: tuple[Length, Length] | None = None
    """Metres along the support's x and y within which they fall; None: its whole face."""
    height: tuple[Annotated[float, Field(ge=0.0, le=3.0)], Annotated[float, Field(ge=0.0, le=3.0)]] = (0.02, 0.3)
    """Metres of free fall below the lowest of them; crowded ones start higher."""
    upright: Share = 0.0
    """Share that starts upright, with a random yaw; the others start in any orientation."""
    settle: float = Field(default=3.0, ge=0.5, le=20.0)
    """Seconds after which whatever still moves is stopped."""


class ArrangePlacement(Strict):
    """Things stand upright on a support, without touching one another."""

    kind: Literal["arrange"]
    area: tuple[Length, Length] | None = None
    separation: float = Field(default=0.02, ge=0.0, le=1.0)
    """Least free distance, metres."""
    settle: float = Field(default=1.0, ge=0.1, le=20.0)


Placement: TypeAlias = Annotated[DropPlacement | ArrangePlacement, Field(discriminator="kind")]


class LightSettings(Strict):
    """Light sources about the middle of the support."""

    count: tuple[Annotated[int, Field(ge=0, le=6)], Annotated[int, Field(ge=0, le=6)]] = (1, 3)
    distance: Lengths = (1.0, 1.8)
    elevation: tuple[Elevation, Elevation] = (0.3, 1.5)
    intensity: tuple[Intensity, Intensity] = (0.5, 1.2)
    """All lights together: what a white surface shows that faces them; 1 saturates."""
    color: Shares = (0.8, 1.0)
    """Of each channel; the strongest is scaled to 1."""
    ambient: Shares = (0.25, 0.6)
    directional: Share = 0.3
    """Share of lights that shine like the sun, from one direction everywhere."""
    radius: tuple[Annotated[float, Field(ge=0.0, le=1.0)], Annotated[float, Field(ge=0.0, le=1.0)]] = (0.02, 0.15)
    """Of a source, metres: how soft its shadows are."""


class MaterialSettings(Strict):
    """How surfaces look."""

    roughness: Shares = (0.2, 0.9)
    metallic: Shares = (0.0, 0.2)
    hue: Annotated[float, Field(ge=0.0, le=0.5)] = 0.02
    """Targets' colours: half width of a uniform shift of the hue, in turns."""
    saturation: Annotated[float, Field(ge=0.0, le=1.0)] = 0.15
    """... relative change of the saturation."""
    value: Annotated[float, Field(ge=0.0, le=1.0)] = 0.15
    """... relative change of the brightness."""
    recolor: Share = 0.5
    """Share of distractors whose colours are drawn anew."""


class TextureSettings(Strict):
    """Textures of rooms and primitives."""

    kinds: tuple[TextureKind, ...] = Field(default=TEXTURES, min_length=1)
    size: Literal[64, 128, 256, 512, 1024] = 256
    """Pixels a side."""
    tile: Lengths = (0.3, 1.5)
    """Metres that a texture covers before it repeats."""
    images: str | None = None
    """A folder of the user's own images (PNG, JPEG), relative to the recipe."""
    image_share: Share = 0.5
    """Share of textured surfaces that show one of `images`, if there are any."""


class ShellViews(Strict):
    """Cameras on a spherical shell about some of the targets, looking at them."""

    kind: Literal["shell"]
    distance: Lengths = (0.6, 1.3)
    elevation: tuple[Elevation, Elevation] = (0.15, 1.5)
    roll: tuple[Annotated[float, Field(ge=-PI, le=PI)], Annotated[float, Field(ge=-PI, le=PI)]] = (-0.3, 0.3)
    look_at: tuple[Annotated[int, Field(ge=1, le=MAX_THINGS)], Annotated[int, Field(ge=1, le=MAX_THINGS)]] = (1, 4)
    """Number of targets whose middle the camera looks at."""
    offset: Annotated[float, Field(ge=0.0, le=0.9)] = 0.2
    """Half width of a uniform shift of that point in the image, in shares of its size."""
    clearance: float = Field(default=0.3, ge=0.05, le=5.0)
    """Metres along the optical axis: nothing in view is nearer."""


class DriveViews(Strict):
    """The eye of a robot that drives through a scene as its file has it, its own perception closing the loop.

    The depth camera is the recipe's, and no sensor's feed or calibration has faults; all else is the scene file's.
    """

    kind: Literal["drive"]
    duration: float = Field(default=20.0, ge=0.1, le=3600.0)
    """Seconds of a drive; a scene is one drive."""
    rate: float = Field(default=10.0, gt=0.0, le=30.0)
    """Labelled images a second; rounded to every n-th one of the camera."""
    agent: str | None = None
    """Who drives; None: the scene file's own choice."""
    lidar: bool = True


Views: TypeAlias = Annotated[ShellViews | DriveViews, Field(discriminator="kind")]


class CameraSettings(Strict):
    """The camera: centred, square pixels, pixel centres at integer indices."""

    width: int = Field(default=640, ge=32, le=4096)
    height: int = Field(default=480, ge=32, le=4096)
    focal: float = Field(default=577.0, gt=10.0, le=20000.0)
    """Pixels."""
    depth: str = "xtion"
    """Name of a preset of `simtrack.sensors.depth_noise`."""
    depth_noise: dict[str, Any] = Field(default_factory=dict)
    """Fields of `DepthNoiseConfig` that differ from the preset."""

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """As the frames carry them."""
        cx, cy = (self.width - 1) / 2, (self.height - 1) / 2
        return CameraIntrinsics(self.width, self.height, self.focal, self.focal, cx, cy)


class EffectSettings(Strict):
    """More realism in colour images; all off by default."""

    soft_shadows: bool = False
    antialiasing: int = Field(default=1, ge=1, le=4)
    """Samples a side of a pixel at edges; 1 = off."""
    exposure: tuple[Annotated[float, Field(ge=-3, le=3)], Annotated[float, Field(ge=-3, le=3)]] = (0.0, 0.0)
    """Stops."""
    white_balance: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    """Half width of a uniform relative error of the gains of red and of blue."""
    motion_blur: tuple[Annotated[float, Field(ge=0, le=50)], Annotated[float, Field(ge=0, le=50)]] = (0.0, 0.0)
    """Pixels that the image moves while the shutter is open."""
    bayer_noise: bool = False
    """Photon and read noise on a Bayer pattern, demosaiced."""


class Counts(Strict):
    """How much."""

    frames: int = Field(default=1000, ge=1, le=100_000_000)
    """Images, unless the command says otherwise."""
    views_per_scene: int = Field(default=25, ge=1, le=10_000)
    """Images of one settled scene; drives make as many as duration and rate give."""


class Recipe(Strict):
    """A whole recipe."""

    name: Name
    description: str = Field(default="", max_length=2000)
    renderer: Literal["mujoco", "pyrender"] = "mujoco"
    split: Literal["train", "val", "test"] = "train"
    val_share: Annotated[float, Field(ge=0.0, le=0.5)] = 0.1
    """Share of scenes that formats with a split of their own put into validation."""
    counts: Counts = Counts()
    worlds: tuple[World, ...] = Field(min_length=1, max_length=20)
    """One of them is drawn for each scene."""
    targets: TargetSettings = TargetSettings()
    distractors: DistractorSettings = DistractorSettings()
    placement: Placement = DropPlacement(kind="drop")
    lights: LightSettings = LightSettings()
    materials: MaterialSettings = MaterialSettings()
    textures: TextureSettings = TextureSettings()
    views: Views = ShellViews(kind="shell")
    camera: CameraSettings = CameraSettings()
    effects: EffectSettings = EffectSettings()
    writers: dict[WriterName, dict[str, Any]] = Field(default={"bop": {}}, min_length=1)
    """Format -> options of its writer; a list of formats takes their defaults."""
    _path: Path = PrivateAttr(default=Path("recipe.yaml"))

    @property
    def path(self) -> Path:
        """The file that it was read from."""
        return self._path

    def beside(self, relative: str) -> Path:
        """A path that the recipe gives relative to its own folder."""
        return (self._path.parent / Path(relative).expanduser()).resolve()

    def canonical(self) -> str:
        """The recipe as YAML with every default spelled out: equal recipes give equal text."""
        import yaml

        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, allow_unicode=True)

    @field_validator("writers", mode="before")
    @classmethod
    def _with_defaults(cls, value: Any) -> Any:
        names = isinstance(value, list) and all(isinstance(name, str) for name in value)
        return {name: {} for name in value} if names else value

    @model_validator(mode="after")
    def _coherent(self) -> "Recipe":
        def refuse(message: str) -> None:
            raise PydanticCustomError("recipe", message, {})  # type: ignore[arg-type]

        if isinstance(self.views, DriveViews):
            if any(world.kind != "scene" for world in self.worlds):
                refuse("views of kind 'drive' need worlds of kind 'scene'")
            shown = ("targets", "distractors", "placement", "lights", "materials", "textures", "effects")
            if set(shown) & self.model_fields_set:
                refuse("views of kind 'drive' show a scene file as it is; leave out " + ", ".join(shown))
            if self.renderer != "mujoco":
                refuse("views of kind 'drive' are rendered by 'mujoco'")
        else:
            if not (self.targets.models or self.targets.folders):
                refuse("targets need at least one of 'models' and 'folders'")
            if any(isinstance(world, SceneWorld) and not world.supports for world in self.worlds):
                refuse("worlds of kind 'scene' need 'supports': names of furniture to put things on")
        if self.distractors.count[1] and not (self.distractors.models or self.distractors.folders):
            refuse("distractors.count is above 0, but there are neither distractors.models nor .folders")
        return self


def recipe_names() -> dict[str, Path]:
    """Name -> file of every recipe that can be found; a name found twice belongs to the earlier folder."""
    found: dict[str, Path] = {}
    for folder in generator_roots():
        for file in sorted(folder.glob("*.yaml")):
            found.setdefault(file.stem, file)
    return found


def load_recipe(name_or_path: str | Path) -> Recipe:
    """Read a recipe by name, or by the path of its YAML file.

    Raises `UnknownNameError` with the known recipes, `FileFormatError` with file, field and what is allowed.
    """
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return read_recipe(path)
    known = recipe_names()
    if str(name_or_path) not in known:
        raise UnknownNameError("recipe", str(name_or_path), known)
    return read_recipe(known[str(name_or_path)])


def read_recipe(path: Path) -> Recipe:
    """Read and validate one recipe file; raises `FileFormatError`."""
    return parse_recipe(read_document(path), path)


def parse_recipe(document: Any, path: Path) -> Recipe:
    """Validate a recipe given as plain data, as if read from `path`; raises `FileFormatError`."""
    recipe = validated(Recipe, document, path, "recipe")
    recipe._path = path.resolve()
    _check_names(recipe)
    return recipe


def _check_names(recipe: Recipe) -> None:
    """Refuse presets, folders and writers' options that do not exist, before anything is made."""
    from simtrack.datasets.writers import WRITERS as FACTORIES
    from simtrack.sensors.depth_noise import PRESETS

    if recipe.camera.depth not in PRESETS:
        reason = f"unknown preset '{recipe.camera.depth}'; allowed: {', '.join(sorted(PRESETS))}"
        raise FileFormatError(recipe.path, "camera.depth", reason)
    folders = {f"targets.folders.{k}": folder for k, folder in enumerate(recipe.targets.folders)}
    folders |= {f"distractors.folders.{k}": folder for k, folder in enumerate(recipe.distractors.folders)}
    if recipe.textures.images is not None:
        folders["textures.images"] = recipe.textures.images
    for field, folder in folders.items():
        if not recipe.beside(folder).is_dir():
            raise FileFormatError(recipe.path, field, f"there is no folder {recipe.beside(folder)}")
    for name, options in recipe.writers.items():
        try:
            validated(FACTORIES[name].options, options, recipe.path, f"writer {name}'s options")
        except FileFormatError as error:
            raise FileFormatError(recipe.path, f"writers.{name}.{error.field}".rstrip("."), error.reason) from error
