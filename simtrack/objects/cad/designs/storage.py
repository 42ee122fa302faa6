"""Cabinets, fridges and microwave ovens of the catalogue: things with doors and drawers."""

import itertools

import numpy as np

from simtrack.objects.cad.builder import ModelBuilder, PartBuilder
from simtrack.objects.cad.designs.pieces import GAP, Span, bar, carcass, door, drawer, round_legs, square_legs
from simtrack.objects.cad.materials import (
    APPLIANCE,
    BLACK_STEEL,
    ELECTRONICS,
    GLASS,
    GREY_BOARD,
    OAK,
    PINE,
    STEEL,
    WALNUT,
    WHITE_BOARD,
)


def wardrobe() -> ModelBuilder:
    """Two tall doors, one shelf and a rail."""
    b = ModelBuilder("cabinet", "wardrobe with two doors and a rail")
    p, x, y, h = b.part(), 0.5, 0.28, 1.95
    carcass(p, (-x, x), (-y, y), (0.0, h), 0.02, OAK)
    p.block((-x + 0.02, -y, 1.65), (x - 0.02, y - 0.02, 1.67), OAK)
    bar(p, (-x + 0.01, 0.0, 1.55), (x - 0.01, 0.0, 1.55), 0.012, STEEL)
    b.hollow(p, (-x + 0.02, -y, 0.02), (x - 0.02, y - 0.02, 1.5))
    b.hollow(p, (-x + 0.02, -y, 1.67), (x - 0.02, y - 0.02, h - 0.02))
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    door(b, "left-door", (-x, 0.0), (0.01, h), -y, "left", OAK, grip=(0.95, 1.15))
    door(b, "right-door", (0.0, x), (0.01, h), -y, "right", OAK, grip=(0.95, 1.15))
    return b


def chest() -> ModelBuilder:
    """Four wide drawers one above the other."""
    b = ModelBuilder("cabinet", "chest of four drawers")
    p, x, y, h = b.part(), 0.4, 0.23, 0.86
    carcass(p, (-x, x), (-y, y), (0.0, h), 0.018, WHITE_BOARD)
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    pitch = (h - 0.036) / 4
    for k in range(4):
        low = 0.018 + k * pitch
        drawer(
            b,
            f"drawer{k + 1}",
            (-x + 0.018, x - 0.018),
            (low, low + pitch),
            (-y, y - 0.02),
            WHITE_BOARD,
            overlap=-0.001,
        )
    return b


def sideboard() -> ModelBuilder:
    """Low and long on thin legs: a door at each end, an open bay between them."""
    b = ModelBuilder("cabinet", "sideboard with two doors and an open bay")
    p, x, y, z, h = b.part(), 0.75, 0.2, 0.16, 0.7
    round_legs(p, (2 * x - 0.12, 2 * y - 0.06), z, 0.018, BLACK_STEEL)
    carcass(p, (-x, x), (-y, y), (z, h), 0.02, WALNUT)
    for left, right in ((-x + 0.02, -0.26), (0.26, x - 0.02)):
        b.hollow(p, (left, -y, z + 0.02), (right, y - 0.02, h - 0.02))
    for left, right in ((-0.26, -0.24), (0.24, 0.26)):
        p.block((left, -y, z + 0.02), (right, y - 0.02, h - 0.02), WALNUT)
    b.hollow(p, (-0.24, -y, z + 0.02), (0.24, y - 0.02, h - 0.02))
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    door(b, "left-door", (-x, -0.25), (z, h), -y, "left", WALNUT)
    door(b, "right-door", (0.25, x), (z, h), -y, "right", WALNUT)
    return b


def bookcase() -> ModelBuilder:
    """Open shelves over a cupboard."""
    b = ModelBuilder("cabinet", "bookcase with a cupboard below")
    p, x, y, h = b.part(), 0.4, 0.16, 1.8
    carcass(p, (-x, x), (-y, y), (0.0, h), 0.018, PINE)
    shelves = (0.6, 0.98, 1.36)
    for z in shelves:
        p.block((-x + 0.018, -y, z), (x - 0.018, y - 0.018, z + 0.018), PINE)
    b.hollow(p, (-x + 0.018, -y, 0.018), (x - 0.018, y - 0.018, 0.6))
    for low, high in zip(shelves, (*shelves[1:], h - 0.018), strict=True):
        b.hollow(p, (-x + 0.018, -y, low + 0.018), (x - 0.018, y - 0.018, high))
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    door(b, "left-door", (-x, 0.0), (0.0, 0.61), -y, "left", PINE, thickness=0.016)
    door(b, "right-door", (0.0, x), (0.0, 0.61), -y, "right", PINE, thickness=0.016)
    return b


def night_stand() -> ModelBuilder:
    """One drawer over an open bay on four legs."""
    b = ModelBuilder("cabinet", "night stand with a drawer and a bay")
    p, x, y, h = b.part(), 0.23, 0.2, 0.55
    square_legs(p, (2 * x, 2 * y), 0.15, 0.03, OAK)
    carcass(p, (-x, x), (-y, y), (0.15, h), 0.016, OAK)
    p.block((-x + 0.016, -y, 0.37), (x - 0.016, y - 0.016, 0.386), OAK)
    b.hollow(p, (-x + 0.016, -y, 0.166), (x - 0.016, y - 0.016, 0.37))
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    drawer(b, "drawer", (-x + 0.016, x - 0.016), (0.386, h - 0.016), (-y, y - 0.02), OAK)
    return b


def filing() -> ModelBuilder:
    """Steel, three high drawers."""
    b = ModelBuilder("cabinet", "steel filing cabinet with three drawers")
    steel = STEEL.painted((150, 156, 160))
    p, x, y, h = b.part(), 0.21, 0.3, 1.02
    carcass(p, (-x, x), (-y, y), (0.0, h), 0.012, steel)
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    pitch = (h - 0.024) / 3
    for k in range(3):
        low = 0.012 + k * pitch
        drawer(
            b, f"drawer{k + 1}", (-x + 0.012, x - 0.012), (low, low + pitch), (-y, y - 0.02), GREY_BOARD, overlap=-0.001
        )
    return b


def vitrine() -> ModelBuilder:
    """Tall and narrow with one glazed door."""
    b = ModelBuilder("cabinet", "display cabinet with a glazed door")
    p, x, y, h = b.part(), 0.3, 0.2, 1.6
    carcass(p, (-x, x), (-y, y), (0.06, h), 0.02, WALNUT)
    p.block((-x + 0.03, -y + 0.04, 0.0), (x - 0.03, y - 0.02, 0.06), WALNUT)
    levels = (0.08, 0.46, 0.84, 1.22)
    for z in levels[1:]:
        p.block((-x + 0.02, -y + 0.01, z - 0.01), (x - 0.02, y - 0.02, z), GLASS)
    for low, high in zip(levels, (*levels[1:], h - 0.01), strict=True):
        b.hollow(p, (-x + 0.02, -y + 0.01, low), (x - 0.02, y - 0.02, high - 0.01))
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    door(b, "door", (-x, x), (0.06, h), -y, "right", WALNUT, thickness=0.024, window=GLASS, grip=(0.75, 0.9))
    return b


def locker() -> ModelBuilder:
    """Two steel compartments one above the other, a door each."""
    b = ModelBuilder("cabinet", "steel locker with two doors one above the other")
    steel = STEEL.painted((92, 120, 150))
    p, x, y, h = b.part(), 0.2, 0.24, 1.7
    carcass(p, (-x, x), (-y, y), (0.08, h), 0.012, steel)
    p.block((-x + 0.02, -y + 0.02, 0.0), (x - 0.02, y, 0.08), steel)
    p.block((-x + 0.012, -y, 0.88), (x - 0.012, y - 0.012, 0.892), steel)
    b.hollow(p, (-x + 0.012, -y, 0.092), (x - 0.012, y - 0.012, 0.88))
    b.hollow(p, (-x + 0.012, -y, 0.892), (x - 0.012, y - 0.012, h - 0.012))
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    door(b, "lower-door", (-x, x), (0.08, 0.886), -y, "left", steel, thickness=0.012)
    door(b, "upper-door", (-x, x), (0.886, h), -y, "left", steel, thickness=0.012)
    return b


def wall_unit() -> ModelBuilder:
    """Hangs on a wall: one door before a glass shelf."""
    b = ModelBuilder("cabinet", "wall unit with one door and a glass shelf")
    p, x, y, h = b.part(), 0.26, 0.16, 0.6
    carcass(p, (-x, x), (-y, y), (0.0, h), 0.016, GREY_BOARD)
    p.block((-x + 0.016, -y + 0.03, 0.3), (x - 0.016, y - 0.016, 0.306), GLASS)
    b.hollow(p, (-x + 0.016, -y, 0.016), (x - 0.016, y - 0.016, 0.3))
    b.hollow(p, (-x + 0.016, -y + 0.03, 0.306), (x - 0.016, y - 0.016, h - 0.016))
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    door(b, "door", (-x, x), (0.0, h), -y, "left", WHITE_BOARD, grip=(0.05, 0.2))
    return b


def wall_pair() -> ModelBuilder:
    """Hangs on a wall: two doors before one hollow."""
    b = ModelBuilder("cabinet", "wall cupboard with two doors")
    p, x, y, h = b.part(), 0.4, 0.17, 0.55
    carcass(p, (-x, x), (-y, y), (0.0, h), 0.018, OAK)
    b.hollow(p, (-x + 0.018, -y, 0.018), (x - 0.018, y - 0.018, h - 0.018))
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    door(b, "left-door", (-x, 0.0), (0.0, h), -y, "left", OAK, grip=(0.05, 0.2))
    door(b, "right-door", (0.0, x), (0.0, h), -y, "right", OAK, grip=(0.05, 0.2))
    return b


def base_unit() -> ModelBuilder:
    """Stands under a worktop: one door as high as the unit before a shelf, sides down to the floor."""
    b = ModelBuilder("cabinet", "base unit with one door and a shelf")
    p, x, y, h = b.part(), 0.3, 0.28, 0.87
    for left in (-x, x - 0.018):
        p.block((left, -y + 0.05, 0.0), (left + 0.018, y, 0.1), GREY_BOARD)
    _shelved(b, p, x, y, (0.1, h), 0.48)
    door(b, "door", (-x, x), (0.1, h), -y, "right", GREY_BOARD, thickness=0.018, grip=(0.6, 0.75))
    return b


def base_pair() -> ModelBuilder:
    """Stands under a worktop: two doors before a shelf, on a closed plinth."""
    b = ModelBuilder("cabinet", "base unit with two doors and a shelf")
    p, x, y, h = b.part(), 0.5, 0.28, 0.9
    p.block((-x + 0.01, -y + 0.04, 0.0), (x - 0.01, y, 0.12), WHITE_BOARD)
    _shelved(b, p, x, y, (0.12, h), 0.52)
    door(b, "left-door", (-x, 0.0), (0.12, h), -y, "left", OAK, thickness=0.018, grip=(0.65, 0.8))
    door(b, "right-door", (0.0, x), (0.12, h), -y, "right", OAK, thickness=0.018, grip=(0.65, 0.8))
    return b


def _shelved(b: ModelBuilder, p: PartBuilder, x: float, y: float, z: Span, shelf: float) -> None:
    """A carcass of boards with one shelf, things to stand on it, below it and on top."""
    low, high, wall = *z, 0.018
    carcass(p, (-x, x), (-y, y), z, wall, WHITE_BOARD)
    p.block((-x + wall, -y + 0.02, shelf), (x - wall, y - wall, shelf + wall), WHITE_BOARD)
    b.hollow(p, (-x + wall, -y, low + wall), (x - wall, y - wall, shelf))
    b.hollow(p, (-x + wall, -y + 0.02, shelf + wall), (x - wall, y - wall, high - wall))
    b.support(p, (0.0, 0.0, high), (2 * x, 2 * y))


# ------------------------------------------------------------------------------------------------------------ fridges


def fridge(
    description: str,
    size: tuple[float, float, float],
    splits: tuple[float, ...],
    *,
    hinge: str = "right",
    french: bool = False,
    feet: float = 0.03,
    bottom_drawer: bool = False,
    window: bool = False,
    shelves: int = 3,
    color: tuple[int, int, int] = (232, 234, 236),
    wall: float = 0.05,
) -> ModelBuilder:
    """A fridge of (width, depth, height); `splits` are the heights between its compartments, each with its door."""
    b = ModelBuilder("fridge", description)
    body, leaf = APPLIANCE.painted(color), 0.05
    p, x, y0, y1, h = b.part(), size[0] / 2, -size[1] / 2 + leaf + GAP, size[1] / 2, size[2]
    square_legs(p, (size[0] - 0.06, y1 - y0 - 0.06), feet + 0.005, 0.04, BLACK_STEEL)
    carcass(p, (-x, x), (y0, y1), (feet, h), wall, body)
    for z in splits:
        p.block((-x + wall, y0, z - 0.02), (x - wall, y1 - wall, z + 0.02), body)
    b.support(p, (0.0, (y0 + y1) / 2, h), (size[0], y1 - y0))
    bounds = list(zip((feet, *splits), (*splits, h), strict=True))
    for k, (z0, z1) in enumerate(bounds):
        low = z0 + (wall if k == 0 else 0.02)
        high = z1 - (wall if k == len(bounds) - 1 else 0.02)
        if bottom_drawer and k == 0:
            drawer(b, "drawer", (-x + wall, x - wall), (low, high), (y0, y1 - wall), body, front=leaf, overlap=0.016)
            continue
        count = max(1, round((high - low) / 0.35)) if high - low > 0.5 else 1
        levels = np.linspace(low, high, min(count, shelves) + 1).tolist()
        for z in levels[1:-1]:
            p.block((-x + wall, y0 + 0.06, z - 0.008), (x - wall, y1 - wall, z), GLASS)
        for below, above in itertools.pairwise(levels):
            b.hollow(p, (-x + wall, y0 + 0.06, below), (x - wall, y1 - wall, above - 0.008))
        pane = GLASS if window and k == len(bounds) - 1 else None
        tag = "door" if len(bounds) == 1 else f"door{k + 1}"
        if french and k == len(bounds) - 1:
            door(b, f"{tag}-left", (-x, 0.0), (z0, z1), y0, "left", body, thickness=leaf, friction=1.0, window=pane)
            door(b, f"{tag}-right", (0.0, x), (z0, z1), y0, "right", body, thickness=leaf, friction=1.0, window=pane)
        else:
            side = "left" if hinge == "left" else "right"
            door(b, tag, (-x, x), (z0, z1), y0, side, body, thickness=leaf, friction=1.0, window=pane)
    return b


def single_door() -> ModelBuilder:
    """One door from the feet to the top."""
    return fridge("tall fridge with one door", (0.6, 0.65, 1.75), (), shelves=5)


def freezer_below() -> ModelBuilder:
    """Two doors, the freezer below."""
    return fridge("fridge over freezer", (0.6, 0.66, 1.9), (0.72,))


def freezer_above() -> ModelBuilder:
    """Two doors, the freezer above, hinged on the left."""
    return fridge("freezer over fridge", (0.55, 0.6, 1.5), (1.05,), hinge="left", color=(214, 216, 220))


def french_doors() -> ModelBuilder:
    """Two doors side by side over a drawer."""
    return fridge(
        "French-door fridge over a freezer drawer",
        (0.9, 0.75, 1.78),
        (0.62,),
        french=True,
        bottom_drawer=True,
        color=(176, 180, 184),
    )


def side_by_side() -> ModelBuilder:
    """Two tall doors side by side."""
    return fridge("side-by-side fridge", (0.92, 0.72, 1.8), (), french=True, shelves=5, color=(160, 164, 170))


def under_counter() -> ModelBuilder:
    """As high as a worktop."""
    return fridge("under-counter fridge", (0.55, 0.58, 0.85), (), hinge="left", shelves=2)


def mini_bar() -> ModelBuilder:
    """A cube for a hotel room."""
    return fridge("small cube fridge", (0.45, 0.45, 0.5), (), shelves=1, feet=0.015, color=(52, 54, 58), wall=0.04)


def showcase() -> ModelBuilder:
    """A bottle cooler with a window in its door."""
    return fridge("bottle cooler with a glass door", (0.6, 0.6, 1.3), (), window=True, shelves=4, color=(60, 62, 66))


# -------------------------------------------------------------------------------------------------------- microwaves


def microwave(
    description: str,
    size: tuple[float, float, float],
    *,
    panel: float = 0.1,
    drop_down: bool = False,
    color: tuple[int, int, int] = (46, 48, 52),
    feet: float = 0.012,
) -> ModelBuilder:
    """A microwave oven of (width, depth, height) whose controls take `panel` metres on the right (0: on top)."""
    b = ModelBuilder("microwave", description)
    metal, leaf, wall = ELECTRONICS.painted(color), 0.025, 0.018
    p, x, y0, y1, h = b.part(), size[0] / 2, -size[1] / 2 + leaf + GAP, size[1] / 2, size[2]
    square_legs(p, (size[0] - 0.04, y1 - y0 - 0.04), feet + 0.002, 0.025, BLACK_STEEL)
    right = x - max(panel, wall)
    carcass(p, (-x, right + wall), (y0, y1), (feet, h), wall, metal)
    if panel > wall:
        p.block((right + wall, y0, feet), (x, y1, h), metal)
    inside = ((-x + wall, y0, feet + wall), (right, y1 - wall, h - wall))
    b.hollow(p, *inside)
    b.support(p, (0.0, (y0 + y1) / 2, h), (size[0], y1 - y0))
    glass = ELECTRONICS.painted((20, 22, 26))
    if drop_down:
        door_leaf = b.part("door")
        door_leaf.block((-x + GAP, y0 - GAP - leaf, feet + 0.004), (x - GAP, y0 - GAP, h - 0.004), glass)
        b.handle(door_leaf, (-x + 0.06, y0 - leaf - 0.033, h - 0.05), (x - 0.06, y0 - leaf - GAP, h - 0.035), STEEL)
        # On the front edge and not quite level: neither the leaf nor its handle reaches what the oven stands on.
        hinge = (0.0, y0 - GAP - leaf, feet + 0.004)
        b.joint("revolute", door_leaf, hinge, (1.0, 0.0, 0.0), (0.0, 1.4), 0.6)
    else:
        grip = (feet + 0.2 * h, 0.8 * h)
        door(b, "door", (-x, right + wall), (feet, h), y0, "left", glass, thickness=leaf, friction=0.2, grip=grip)
    return b


MICROWAVES = {
    "countertop": lambda: microwave("microwave with controls on its right", (0.48, 0.36, 0.28)),
    "wide": lambda: microwave("wide microwave in steel", (0.55, 0.45, 0.32), panel=0.13, color=(170, 174, 178)),
    "compact": lambda: microwave("compact white microwave", (0.44, 0.33, 0.25), panel=0.08, color=(230, 230, 228)),
    "built_in": lambda: microwave("flush microwave without side controls", (0.59, 0.4, 0.38), panel=0.0, feet=0.004),
    "drop_down": lambda: microwave("microwave whose door folds down", (0.5, 0.42, 0.36), panel=0.0, drop_down=True),
    "oven": lambda: microwave(
        "toaster oven with a fold-down door", (0.42, 0.34, 0.24), panel=0.0, drop_down=True, color=(176, 180, 182)
    ),
    "tall": lambda: microwave("tall microwave", (0.46, 0.4, 0.36), panel=0.07, color=(88, 28, 30)),
    "flat": lambda: microwave("flat microwave with high feet", (0.52, 0.38, 0.24), panel=0.12, feet=0.025),
}
"""Name -> design."""

CABINETS = (
    wardrobe,
    chest,
    sideboard,
    bookcase,
    night_stand,
    filing,
    vitrine,
    locker,
    wall_unit,
    wall_pair,
    base_unit,
    base_pair,
)
FRIDGES = (
    single_door,
    freezer_below,
    freezer_above,
    french_doors,
    side_by_side,
    under_counter,
    mini_bar,
    showcase,
)
