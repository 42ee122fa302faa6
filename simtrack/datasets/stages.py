"""Where a scene of a data set takes place: a random room, or the building of a scene file."""

from collections.abc import Mapping, Set
from dataclasses import dataclass, replace

import numpy as np

from simtrack.contracts import MapEntity, Room
from simtrack.datasets.frame import StuffCategory
from simtrack.datasets.recipe import ArrangePlacement, DropPlacement, Recipe, RoomWorld, SceneWorld
from simtrack.errors import FileFormatError, SimtrackError
from simtrack.sensors.depth_noise import PRESETS, DepthNoiseConfig
from simtrack.simulation.building import furniture
from simtrack.simulation.building.parts import StaticPart, StaticWorld
from simtrack.simulation.building.shell import room_shell
from simtrack.simulation.placement import Area, support_area
from simtrack.simulation.scene_file import SceneFile, load_scene
from simtrack.simulation.world import build_static, configured

EDGE = 0.4
"""Metres: longest triangle edge on the walls of a random room."""
SHEET = 0.001
"""Metres: thickness of walls and floors in relations."""
FAR = 10.0
"""Metres beyond which clean depth shows nothing."""
OTHER = "other"
"""Stuff category of classes that only some seeds have."""
FLOOR_MARGIN = 0.3
"""Metres that things on a room's floor keep from its walls."""


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """A static world and where in it things are put."""

    static: StaticWorld
    support: str
    """Name of the part that carries them."""
    area: Area
    textured: frozenset[str]
    """Names of parts that carry random textures."""


def scene_of(recipe: Recipe, number: int) -> SceneFile:
    """The scene file of a recipe's world; raises FileFormatError if it cannot be used."""
    world = recipe.worlds[number]
    assert isinstance(world, SceneWorld)
    beside = recipe.beside(world.scene)
    try:
        return load_scene(beside if beside.is_dir() else world.scene)
    except SimtrackError as error:
        raise FileFormatError(recipe.path, f"worlds.{number}.scene", str(error)) from error


def depth_noise(recipe: Recipe) -> DepthNoiseConfig:
    """The depth camera's errors; raises FileFormatError for fields and values that they do not take."""
    base = PRESETS[recipe.camera.depth]
    return configured(DepthNoiseConfig, recipe.camera.depth_noise, recipe, "camera.depth_noise", base)


def build_stage(recipe: Recipe, number: int, scene: SceneFile | None, rng: np.random.Generator) -> Stage:
    """Build a world of a recipe.

    Args:
        recipe: whose world.
        number: which of its worlds.
        scene: the scene file of a world that has one, see `scene_of`.
        rng: decides what the recipe leaves open.

    Raises:
        FileFormatError: a support that does not exist; lists those that do.
    """
    world = recipe.worlds[number]
    if isinstance(world, RoomWorld):
        static, support = _room(world, rng)
        textured = frozenset(part.name for part in static.parts)
    else:
        assert scene is not None
        static = build_static(scene, int(rng.integers(2**31)))
        support = world.supports[int(rng.integers(len(world.supports)))]
        textured = frozenset(part.name for part in static.parts if part.semantic_class in world.textured)
    try:
        area = support_area(static, support, 0, None, None)
    except SimtrackError as error:
        raise FileFormatError(recipe.path, f"worlds.{number}.supports", str(error)) from error
    return Stage(static, support, _within(area, recipe.placement), textured)


def _within(area: Area, placement: DropPlacement | ArrangePlacement) -> Area:
    """The part of a face that a recipe's placement names, about its middle."""
    if placement.area is None:
        return area
    half = np.minimum(np.array(placement.area) / 2, area.size / 2)
    x, y = ((-float(side), float(side)) for side in half)
    return Area(area.T_map_face, x, y, area.size)


def _room(world: RoomWorld, rng: np.random.Generator) -> tuple[StaticWorld, str]:
    """A room about the map's origin, and the name of what things are put on: its table or its floor."""
    depth, width, height = (float(rng.uniform(*sides)) for sides in (world.depth, world.width, world.height))
    corners = np.array([[-depth, -width], [depth, -width], [depth, width], [-depth, width]]) / 2
    room = Room("room", corners, 0.0, height)
    parts = [piece.part(EDGE) for piece in room_shell(room, {}, (furniture.GREY, furniture.GREY))]
    if world.table is not None:
        x, y, z = (float(rng.uniform(*side)) for side in (world.table.depth, world.table.width, world.table.height))
        table = furniture.table(min(x, depth - 1.0), min(y, width - 1.0), z)
        parts.append(table.placed("table", 0.0, 0.0, 0.0, room="room"))
        return StaticWorld(tuple(parts), (room,)), "table"
    face = np.eye(4), np.array([depth, width]) - 2 * FLOOR_MARGIN
    return StaticWorld(tuple(_with_support(part, face) for part in parts), (room,)), "room/floor"


def _with_support(part: StaticPart, face: tuple[np.ndarray, np.ndarray]) -> StaticPart:
    """The room's only piece of floor as something to stand on; other parts as they are."""
    return replace(part, supports=(face,)) if part.semantic_class == "floor" else part


# ----------------------------------------------------------------------------------------------------------- categories


def stuff_categories(static: Set[str], loose: Set[str], taken: int) -> dict[tuple[str, bool], StuffCategory]:
    """(semantic class, whether its instances are told apart) -> category, numbered after the `taken` ones."""
    keys = [(name, False) for name in (*sorted(static - {OTHER}), OTHER)] + [(name, True) for name in sorted(loose)]
    return {
        (name, thing): StuffCategory(number, f"loose-{name}" if thing and name in static else name, thing)
        for number, (name, thing) in enumerate(keys, start=taken + 1)
    }


def category_of(stuff: Mapping[tuple[str, bool], StuffCategory], semantic_class: str, loose: bool) -> int:
    """Id of the category of a class, or of `OTHER`."""
    return stuff.get((semantic_class, loose), stuff[OTHER, False]).id


def map_entities(static: StaticWorld) -> list[MapEntity]:
    """A building's parts as relations know them; walls and floors are sheets, of no thickness otherwise."""
    return [
        MapEntity(
            part.name,
            part.semantic_class,
            part.T_map_part,
            np.maximum(part.extents, SHEET),
            part.room,
            part.supports,
        )
        for part in static.parts
    ]
