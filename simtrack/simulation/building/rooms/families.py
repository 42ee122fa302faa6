"""Parametric families of what stands in rooms: drawn anew for every room, of constructions the CAD catalogue lacks.

Legs are outside of tops or L-shaped, boards overlap, doors slide in from proportions that are drawn at random.
"""

import itertools
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from simtrack.objects.cad.builder import ModelBuilder
from simtrack.objects.cad.designs.pieces import SIGNS, bar, carcass, door, drawer
from simtrack.objects.cad.designs.vessels import vessel
from simtrack.objects.cad.materials import (
    APPLIANCE,
    BLACK_STEEL,
    CARD,
    CERAMIC,
    CLAY,
    ELECTRONICS,
    FOAM,
    GREY_BOARD,
    LEAF,
    MATTRESS,
    OAK,
    PAPER,
    PINE,
    PLASTIC,
    SCREEN,
    SHELL,
    SOIL,
    STEEL,
    TEXTILE,
    WALNUT,
    WHITE_BOARD,
    Material,
)
from simtrack.objects.shapes import box, cylinder, rounded_plate
from simtrack.simulation.building.rooms.fittings import board, picture, wall_cabinet, wall_shelf

Family = Callable[[np.random.Generator], ModelBuilder]
WOODS = (OAK, PINE, WALNUT, WHITE_BOARD)


def _one_of(rng: np.random.Generator, materials: tuple[Material, ...]) -> Material:
    return materials[int(rng.integers(len(materials)))]


def _tinted(rng: np.random.Generator, material: Material) -> Material:
    r, g, b = (int(v) for v in rng.integers(40, 215, 3))
    return material.painted((r, g, b))


def bed(rng: np.random.Generator) -> ModelBuilder:
    """Boards on edge down to the floor on all sides, the mattress sunk between them; two rails as a headboard."""
    b, wood = ModelBuilder("bed", "bed of boards on edge"), _one_of(rng, WOODS)
    p, width, length, rim = b.part(), rng.uniform(0.95, 1.7), rng.uniform(1.95, 2.15), rng.uniform(0.26, 0.36)
    x, y, top = width / 2 + 0.03, length / 2 + 0.03, rim + rng.uniform(0.06, 0.12)
    for s in (-1, 1):
        p.block((s * x, -y, 0.0), (s * (x - 0.028), y, rim), wood)
        p.block((-x + 0.028, s * y, 0.0), (x - 0.028, s * (y - 0.028), rim), wood)
        p.block((s * (0.7 * x), y, 0.0), (s * (0.7 * x - 0.06), y + 0.03, 0.95), wood)
    for z in (0.55, 0.78):
        p.block((-x, y, z), (x, y + 0.022, z + 0.14), wood)
    p.block((-x + 0.03, -y + 0.03, 0.12), (x - 0.03, y - 0.03, 0.14), wood)
    p.add(rounded_plate((width, length, top - 0.14), 0.06, chamfer=0.02).at(z=0.14), MATTRESS)
    p.add(rounded_plate((0.8 * width, 0.34, 0.1), 0.09, chamfer=0.04).at(y=length / 2 - 0.22, z=top - 0.004), MATTRESS)
    b.support(p, (0.0, -0.25, top), (width - 0.15, length - 0.75))
    return b


def table(rng: np.random.Generator) -> ModelBuilder:
    """Two A-frames joined by a low stretcher carry a plate with rounded corners."""
    b, wood = ModelBuilder("table", "table on two A-frames"), _one_of(rng, WOODS)
    p, width, depth, h = b.part(), rng.uniform(1.1, 1.75), rng.uniform(0.65, 0.85), rng.uniform(0.7, 0.77)
    at = 0.36 * width
    for s in (-1, 1):
        for t in (-1, 1):
            p.beam((s * at, t * 0.42 * depth, 0.002), (s * at, t * 0.08 * depth, h - 0.028), 0.05, wood)
        p.block((s * at - 0.025, -0.3 * depth, 0.2), (s * at + 0.025, 0.3 * depth, 0.25), wood)
        p.block((s * at - 0.035, -0.4 * depth, h - 0.06), (s * at + 0.035, 0.4 * depth, h - 0.026), wood)
    p.block((-at, -0.015, 0.205), (at, 0.015, 0.245), wood)
    p.add(rounded_plate((width, depth, 0.027), 0.07).at(z=h - 0.027), wood)
    b.support(p, (0.0, 0.0, h), (width - 0.1, depth - 0.1))
    return b


def chair(rng: np.random.Generator) -> ModelBuilder:
    """Round seat board on splayed turned legs, spindles under a top rail."""
    b, wood = ModelBuilder("chair", "spindle-back chair"), _one_of(rng, WOODS)
    p, r, seat = b.part(), rng.uniform(0.2, 0.235), rng.uniform(0.43, 0.48)
    back = seat + rng.uniform(0.34, 0.48)
    for sx, sy in SIGNS:
        bar(p, (sx * (r + 0.01), sy * (r + 0.01), 0.016), (sx * 0.55 * r, sy * 0.55 * r, seat - 0.03), 0.016, wood)
    p.add(cylinder(r, 0.035, segments=24).at(z=seat - 0.035), wood)
    for k in range(5):
        x = (k - 2) * 0.32 * r
        bar(
            p, (x, float(np.sqrt(max(0.72 * r * r - x * x, 0.0))), seat - 0.01), (1.25 * x, r + 0.03, back), 0.008, wood
        )
    p.block((-1.05 * r, r + 0.015, back - 0.03), (1.05 * r, r + 0.045, back + 0.045), wood)
    b.support(p, (0.0, -0.03, seat), (1.1 * r, 1.0 * r))
    return b


def sofa(rng: np.random.Generator) -> ModelBuilder:
    """A tray of boards on two runners holds loose cushions; the arms are open frames."""
    b, wood, cloth = ModelBuilder("sofa", "sofa of cushions in a tray"), _one_of(rng, WOODS), _tinted(rng, FOAM)
    p, seats = b.part(), int(rng.integers(2, 4))
    x, y, z = seats * rng.uniform(0.29, 0.35), rng.uniform(0.4, 0.46), rng.uniform(0.2, 0.26)
    for s in (-1, 1):
        p.block((s * 0.6 * x - 0.03, -y + 0.05, 0.0), (s * 0.6 * x + 0.03, y - 0.05, z), wood)
        p.block((s * x, -y, z), (s * (x + 0.04), -y + 0.05, z + 0.34), wood)
        p.block((s * x, y - 0.05, z), (s * (x + 0.04), y, z + 0.34), wood)
        p.block((s * x, -y, z + 0.34), (s * (x + 0.04), y, z + 0.37), wood)
    p.block((-x - 0.04, -y, z - 0.04), (x + 0.04, y, z), wood)
    p.block((-x, y - 0.03, z), (x, y, z + 0.42), wood)
    pitch = 2 * x / seats
    for k in range(seats):
        at = -x + pitch * (k + 0.5)
        p.add(rounded_plate((pitch - 0.01, 2 * y - 0.2, 0.16), 0.05, chamfer=0.025).at(at, -0.08, z - 0.001), cloth)
        p.add(rounded_plate((pitch - 0.02, 0.15, 0.4), 0.06, chamfer=0.02).at(at, y - 0.1, z + 0.1), cloth)
        b.support(p, (at, -0.12, z + 0.159), (pitch - 0.15, 2 * y - 0.4))
    return b


def cabinet(rng: np.random.Generator) -> ModelBuilder:
    """Drawers beside a door under one top that overhangs, on two skids."""
    b, wood = ModelBuilder("cabinet", "cabinet with drawers beside a door"), _one_of(rng, (*WOODS, GREY_BOARD))
    p, x, y, h = b.part(), rng.uniform(0.42, 0.62), rng.uniform(0.2, 0.27), rng.uniform(0.72, 1.1)
    split, wall, z = rng.uniform(-0.1, 0.1), 0.019, 0.07
    for s in (-1, 1):
        p.block((s * (x - 0.05), -y + 0.02, 0.0), (s * (x - 0.1), y - 0.02, z), wood)
    carcass(p, (-x, x), (-y, y), (z, h), wall, wood)
    p.block((split - wall / 2, -y, z + wall), (split + wall / 2, y - wall, h - wall), wood)
    p.block((-x - 0.02, -y - 0.03, h), (x + 0.02, y, h + 0.025), wood)
    b.support(p, (0.0, -0.01, h + 0.025), (2 * x, 2 * y))
    count = int(rng.integers(2, 5))
    edges = np.linspace(z + wall, h - wall, count + 1).tolist()
    for k, (low, high) in enumerate(itertools.pairwise(edges)):
        drawer(b, f"drawer{k + 1}", (-x + wall, split - wall / 2), (low, high), (-y, y - wall), wood, overlap=-0.001)
    shelf = (z + h) / 2
    p.block((split + wall / 2, -y + 0.02, shelf - 0.008), (x - wall, y - wall, shelf + 0.008), wood)
    b.hollow(p, (split + wall / 2, -y + 0.02, z + wall), (x - wall, y - wall, shelf - 0.008))
    b.hollow(p, (split + wall / 2, -y + 0.02, shelf + 0.008), (x - wall, y - wall, h - wall))
    door(b, "door", (split, x), (z, h - 0.002), -y, "right", wood, thickness=0.019)
    return b


def fridge(rng: np.random.Generator) -> ModelBuilder:
    """A rounded body on a plinth, an inner liner of three unequal bays, one door above a fixed vent."""
    b, body = ModelBuilder("fridge", "fridge on a plinth with a vent"), _tinted(rng, APPLIANCE)
    p, x, h, wall = b.part(), rng.uniform(0.26, 0.36), rng.uniform(1.1, 1.65), rng.uniform(0.035, 0.045)
    y0, y1, foot = -0.27, rng.uniform(0.3, 0.36), rng.uniform(0.11, 0.16)
    p.block((-x + 0.02, y0 + 0.03, 0.0), (x - 0.02, y1 - 0.02, foot), BLACK_STEEL.painted((70, 72, 76)), solid=True)
    carcass(p, (-x, x), (y0, y1), (foot, h), wall, body)
    levels = [foot + wall, foot + wall + 0.22 * (h - foot), foot + wall + 0.55 * (h - foot), h - wall]
    for z in levels[1:-1]:
        p.block((-x + wall, y0 + 0.08, z - 0.012), (x - wall, y1 - wall, z), SHELL)
    for low, high in itertools.pairwise(levels):
        b.hollow(p, (-x + wall, y0 + 0.08, low), (x - wall, y1 - wall, high - 0.012))
    b.support(p, (0.0, (y0 + y1) / 2, h), (2 * x, y1 - y0))
    side = "left" if rng.random() < 0.5 else "right"
    door(b, "door", (-x, x), (foot, h), y0, side, body, thickness=0.065, friction=1.0, grip=(0.6 * h, 0.85 * h))
    return b


def microwave(rng: np.random.Generator) -> ModelBuilder:
    """Controls in a strip below the door."""
    b, case = ModelBuilder("microwave", "microwave with controls below its door"), _tinted(rng, ELECTRONICS)
    p, x, h, wall = b.part(), rng.uniform(0.21, 0.26), rng.uniform(0.27, 0.33), 0.02
    y0, y1, strip = -0.17, rng.uniform(0.15, 0.2), 0.07
    p.block((-x, y0 - 0.02, 0.0), (x, y1, strip), case)
    carcass(p, (-x, x), (y0, y1), (strip, h), wall, case)
    b.hollow(p, (-x + wall, y0, strip + wall), (x - wall, y1 - wall, h - wall))
    b.support(p, (0.0, 0.0, h), (2 * x, y1 - y0))
    door(b, "door", (-x, x), (strip, h), y0, "right", ELECTRONICS, thickness=0.02, friction=0.2)
    return b


def monitor(rng: np.random.Generator) -> ModelBuilder:
    """A screen in a thick frame on a slab, carried by two posts."""
    b = ModelBuilder("monitor", "monitor on two posts")
    p, x, h = b.part(), rng.uniform(0.22, 0.34), rng.uniform(0.27, 0.38)
    low = rng.uniform(0.06, 0.12)
    p.block((-0.7 * x, -0.09, 0.0), (0.7 * x, 0.11, 0.02), ELECTRONICS)
    for s in (-1, 1):
        p.block((s * 0.4 * x - 0.015, 0.02, 0.02), (s * 0.4 * x + 0.015, 0.045, low + 0.6 * h), STEEL)
    p.block((-x, -0.03, low), (x, 0.02, low + h), ELECTRONICS)
    p.block((-x + 0.03, -0.033, low + 0.03), (x - 0.03, -0.03, low + h - 0.03), SCREEN, solid=False)
    return b


def keyboard(rng: np.random.Generator) -> ModelBuilder:
    """A wedge with three separate fields of keys."""
    b, case = ModelBuilder("keyboard", "keyboard with three fields"), _one_of(rng, (ELECTRONICS, SHELL))
    p, x, y = b.part(), rng.uniform(0.19, 0.23), rng.uniform(0.07, 0.085)
    p.block((-x, -y, 0.0), (x, y, 0.02), case)
    for low, high in ((-0.97, 0.4), (0.44, 0.66), (0.7, 0.97)):
        for k in range(5):
            at = -0.8 * y + 0.4 * y * k
            p.block(
                (low * x, at - 0.15 * y, 0.02),
                (high * x, at + 0.15 * y, 0.027),
                case.painted((90, 92, 96)),
                solid=k in (0, 4),
            )
    return b


def bag(rng: np.random.Generator) -> ModelBuilder:
    """A box-shaped bag that narrows in two steps under a bow."""
    b, cloth = ModelBuilder("bag", "stepped bag with a bow"), _tinted(rng, TEXTILE)
    p, x, y, h = b.part(), rng.uniform(0.14, 0.22), rng.uniform(0.08, 0.12), rng.uniform(0.24, 0.36)
    p.add(rounded_plate((2 * x, 2 * y, 0.6 * h), 0.03), cloth)
    p.add(rounded_plate((1.7 * x, 1.5 * y, 0.4 * h), 0.03).at(z=0.6 * h - 0.002), cloth)
    points = [(-0.4 * x, 0.0, h - 0.01), (-0.4 * x, 0.0, h + 0.1), (0.4 * x, 0.0, h + 0.1), (0.4 * x, 0.0, h - 0.01)]
    for a, c in itertools.pairwise(points):
        bar(p, a, c, 0.009, cloth)
    b.handle(p, (-0.4 * x, -0.01, h + 0.09), (0.4 * x, 0.01, h + 0.11))
    return b


def cup(rng: np.random.Generator) -> ModelBuilder:
    """Waisted, with an ear of one thick block."""
    b, clay = ModelBuilder("cup", "waisted cup with a block for an ear"), _tinted(rng, CERAMIC)
    p, r, h = b.part(), rng.uniform(0.035, 0.045), rng.uniform(0.07, 0.11)
    vessel(p, ((r, 0.0), (0.86 * r, 0.5 * h), (1.05 * r, h)), 0.005, 0.008, clay, segments=24)
    p.block((0.84 * r, -0.005, 0.35 * h), (r + 0.022, 0.005, 0.65 * h), clay)
    b.handle(p, (r, -0.005, 0.35 * h), (r + 0.022, 0.005, 0.65 * h))
    b.hollow(p, (-0.55 * r, -0.55 * r, 0.008), (0.55 * r, 0.55 * r, h), floor=False)
    return b


def bottle(rng: np.random.Generator) -> ModelBuilder:
    """A hexagonal body, a stepped neck."""
    b = ModelBuilder("bottle", "six-sided bottle with a stepped neck")
    r, g, c = (int(v) for v in rng.integers(60, 220, 3))
    p, full, radius, h = (
        b.part(),
        Material("glass", (r, g, c), 520.0, 0.4),
        rng.uniform(0.032, 0.045),
        rng.uniform(0.15, 0.22),
    )
    p.add(cylinder(radius, h, segments=6), full)
    p.add(cylinder(0.6 * radius, 0.03, segments=16).at(z=h - 0.001), full)
    p.add(cylinder(0.4 * radius, 0.035, segments=16).at(z=h + 0.028), PLASTIC)
    return b


def bowl(rng: np.random.Generator) -> ModelBuilder:
    """A cone in two steps."""
    b, clay = ModelBuilder("bowl", "stepped conical bowl"), _tinted(rng, CERAMIC)
    p, r = b.part(), rng.uniform(0.07, 0.12)
    h = rng.uniform(0.5, 0.7) * r
    vessel(p, ((0.5 * r, 0.0), (0.75 * r, 0.45 * h), (0.82 * r, 0.5 * h), (r, h)), 0.006, 0.01, clay, segments=24)
    b.hollow(p, (-0.4 * r, -0.4 * r, 0.01), (0.4 * r, 0.4 * r, h), floor=False)
    return b


def book(rng: np.random.Generator) -> ModelBuilder:
    """A block of pages in a slip case that is open on one long side."""
    b, case = ModelBuilder("book", "book in a slip case"), _tinted(rng, Material("card", (0, 0, 0), 700.0, 0.45))
    p, x, y, h = b.part(), rng.uniform(0.06, 0.11), rng.uniform(0.09, 0.14), rng.uniform(0.018, 0.05)
    p.add(box((2 * x - 0.006, 2 * y - 0.008, h - 0.006)).at(0.003, 0.0, h / 2), PAPER, ())
    for z in (0.0015, h - 0.0015):
        p.add(box((2 * x, 2 * y, 0.003)).at(z=z), case, ())
    p.add(box((0.003, 2 * y, h)).at(-x + 0.0015, 0.0, h / 2), case, [box((2 * x, 2 * y, h)).at(z=h / 2)])
    for s in (-1, 1):
        p.add(box((2 * x, 0.003, h)).at(0.0, s * (y - 0.0015), h / 2), case, ())
    b.support(p, (0.0, 0.0, h), (2 * x - 0.02, 2 * y - 0.02))
    return b


def plant(rng: np.random.Generator) -> ModelBuilder:
    """A stack of leaf discs on a stem in a stepped pot."""
    b = ModelBuilder("plant", "stem with discs of leaves")
    p, r, h = b.part(), rng.uniform(0.06, 0.13), rng.uniform(0.35, 0.9)
    top = 1.3 * r
    p.add(cylinder(0.8 * r, 0.7 * top, segments=20), CLAY)
    p.add(cylinder(r, 0.3 * top, segments=20).at(z=0.7 * top), SOIL.painted(CLAY.color))
    bar(p, (0.0, 0.0, top - 0.02), (0.0, 0.0, h), 0.012, LEAF)
    for k, z in enumerate(np.linspace(top + 0.08, h, 4)):
        p.add(cylinder((1.5 - 0.3 * k) * r, 0.02, top=0.3 * r, segments=9).at(z=float(z)), LEAF)
    return b


def carton(rng: np.random.Generator) -> ModelBuilder:
    """An open box with an inner partition and a double rim."""
    b, card = ModelBuilder("box", "open box with a partition"), _tinted(rng, CARD)
    p, x, y, h, t = b.part(), rng.uniform(0.12, 0.2), rng.uniform(0.1, 0.15), rng.uniform(0.1, 0.22), 0.006
    p.block((-x, -y, 0.0), (x, y, t), card)
    for s in (-1, 1):
        p.block((s * x, -y, t), (s * (x - t), y, h), card)
        p.block((-x + t, s * y, t), (x - t, s * (y - t), h), card)
        p.block((s * (x + t), -y - t, h - 0.025), (s * x, y + t, h), card)
        p.block((-x, s * (y + t), h - 0.025), (x, s * y, h), card)
    p.block((-t / 2, -y + t, t), (t / 2, y - t, 0.7 * h), card)
    b.hollow(p, (-x + t, -y + t, t), (-t / 2, y - t, h))
    b.hollow(p, (t / 2, -y + t, t), (x - t, y - t, h))
    return b


def counter(rng: np.random.Generator) -> ModelBuilder:
    """A kitchen base unit: worktop, one drawer over a door each, open toe space."""
    b, front = ModelBuilder("cabinet", "kitchen base unit"), _one_of(rng, (WHITE_BOARD, GREY_BOARD, OAK))
    p, bays, h, t = b.part(), int(rng.integers(2, 4)), rng.uniform(0.86, 0.92), 0.018
    x, y = 0.27 * bays, 0.29
    p.block((-x + 0.01, -y + 0.06, 0.0), (x - 0.01, y, 0.1), BLACK_STEEL.painted((60, 60, 62)))
    carcass(p, (-x, x), (-y, y), (0.1, h - 0.036), t, WHITE_BOARD)
    p.block((-x - 0.01, -y - 0.03, h - 0.036), (x + 0.01, y, h), WALNUT)
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    rail = h - 0.21
    p.block((-x + t, -y, rail - t), (x - t, y - t, rail), WHITE_BOARD)
    for k in range(bays):
        low, high = -x + 0.54 * k, -x + 0.54 * (k + 1)
        if k:
            p.block((low - t / 2, -y, 0.1 + t), (low + t / 2, y - t, rail - t), WHITE_BOARD)
            p.block((low - t / 2, -y, rail), (low + t / 2, y - t, h - 0.036 - t), WHITE_BOARD)
        inner = (low + (t if k == 0 else t / 2), high - (t if k == bays - 1 else t / 2))
        b.hollow(p, (inner[0], -y, 0.1 + t), (inner[1], y - t, rail - t))
        drawer(b, f"drawer{k + 1}", inner, (rail, h - 0.036 - t), (-y, y - t), front, overlap=0.004)
        door(
            b,
            f"door{k + 1}",
            (low, high),
            (0.1, rail - 0.004),
            -y,
            "left" if k % 2 else "right",
            front,
            thickness=0.018,
            front_pin=True,
            limit=1.5,
        )
    return b


FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        "bag": bag, "bed": bed, "board": board, "book": book, "bottle": bottle, "bowl": bowl, "box": carton,
        "cabinet": cabinet, "chair": chair, "counter": counter, "cup": cup, "fridge": fridge, "keyboard": keyboard,
        "microwave": microwave, "monitor": monitor, "picture": picture, "plant": plant, "shelf": wall_shelf,
        "sofa": sofa, "table": table, "wall cabinet": wall_cabinet,
    }
)  # fmt: skip
"""Name -> family; a ``counter`` and a ``wall cabinet`` are of the class ``cabinet``."""
