"""Books, boxes, bags and plants of the catalogue."""

import itertools

import numpy as np

from simtrack.objects.cad.builder import ModelBuilder
from simtrack.objects.cad.designs.pieces import GAP, bar
from simtrack.objects.cad.designs.vessels import vessel
from simtrack.objects.cad.materials import (
    CARD,
    CLAY,
    LEAF,
    LEATHER,
    OAK,
    PAPER,
    PLASTIC,
    SHELL,
    SOIL,
    STEEL,
    TEXTILE,
    Material,
)
from simtrack.objects.shapes import box, cylinder, hull, rounded_plate, sphere, tube

Size = tuple[float, float, float]


def book(
    description: str, size: Size, color: tuple[int, int, int], *, hard: bool = True, spiral: bool = False, flat: int = 1
) -> ModelBuilder:
    """A book that lies on its back cover (width, depth, thickness), its spine on the left; `flat` of them in a pile."""
    b = ModelBuilder("book", description)
    p = b.part()
    x, y, board = size[0] / 2, size[1] / 2, 0.0025 if hard else 0.0012
    rim = 0.003 if hard else 0.0
    for k in range(flat):
        z, turn = k * size[2], (0.0, 0.06, -0.09)[k % 3]
        shade = tuple(int(c * (1.0 - 0.25 * k)) for c in color)
        cover = Material("card", (shade[0], shade[1], shade[2]), 800.0, 0.45)
        pieces = [
            (box((2 * x, 2 * y, board)).at(z=z + board / 2), cover),
            (box((2 * x, 2 * y, board)).at(z=z + size[2] - board / 2), cover),
            (
                box((2 * x - 0.004 - rim, 2 * y - 2 * rim, size[2] - 2 * board)).at(
                    0.001 - rim / 2, 0.0, z + size[2] / 2
                ),
                PAPER,
            ),
        ]
        if not spiral:
            pieces.append((box((0.004, 2 * y, size[2])).at(-x + 0.002, 0.0, z + size[2] / 2), cover))
        for shape, material in pieces:
            p.add(shape.turned(yaw=turn), material, ())
        p.convex.append(box((2 * x, 2 * y, size[2])).at(z=z + size[2] / 2).turned(yaw=turn))
    if spiral:
        for k in range(9):
            at = -y + 2 * y * (k + 0.5) / 9
            p.add(
                cylinder(size[2] * 0.62, 0.004, segments=12).turned(roll=np.pi / 2).at(-x + 0.002, at, size[2] * 0.62),
                STEEL,
                (),
            )
    b.support(p, (0.0, 0.0, flat * size[2]), (2 * x - 0.02, 2 * y - 0.02))
    b.handle(p, (x - 0.03, -y, 0.0), (x, y, flat * size[2]))
    return b


BOOKS = {
    "novel": lambda: book("paperback", (0.125, 0.19, 0.025), (170, 60, 48), hard=False),
    "textbook": lambda: book("hard-cover textbook", (0.19, 0.25, 0.038), (40, 76, 128)),
    "atlas": lambda: book("large thin atlas", (0.28, 0.36, 0.018), (46, 104, 84)),
    "notebook": lambda: book("spiral notebook", (0.148, 0.21, 0.012), (220, 190, 70), hard=False, spiral=True),
    "dictionary": lambda: book("thick dictionary", (0.15, 0.22, 0.075), (96, 36, 60)),
    "pile": lambda: book("three books in a pile", (0.15, 0.22, 0.022), (178, 116, 60), flat=3),
    "magazine": lambda: book("magazine", (0.21, 0.28, 0.006), (60, 150, 190), hard=False),
    "pocket": lambda: book("pocket book", (0.09, 0.13, 0.015), (30, 30, 34), hard=True),
    "pair": lambda: book("two large books in a pile", (0.22, 0.29, 0.03), (70, 90, 60), flat=2),
}
"""Name -> design."""


def hollow_box(
    description: str,
    size: Size,
    wall: float,
    material: Material,
    *,
    lid: str = "none",
    band: Material | None = None,
    grips: bool = False,
) -> ModelBuilder:
    """A box of (width, depth, height); lid: ``none`` (open), ``closed``, ``hinged``, ``flaps`` (open)."""
    b = ModelBuilder("box", description)
    p, x, y = b.part(), size[0] / 2, size[1] / 2
    h = size[2] - (wall + GAP if lid == "hinged" else wall if lid == "closed" else 0.0)
    p.block((-x, -y, 0.0), (x, y, wall), material)
    for s in (-1, 1):
        p.block((s * x, -y, wall), (s * (x - wall), y, h), material)
        p.block((-x + wall, s * y, wall), (x - wall, s * (y - wall), h), material)
        if grips:
            p.block((s * x, -0.05, 0.7 * h), (s * (x + 0.015), 0.05, 0.76 * h), material)
            b.handle(p, (s * x, -0.05, 0.7 * h), (s * (x + 0.015), 0.05, 0.76 * h))
        if lid == "flaps":
            flap = box((wall, 2 * y - 0.01, 0.4 * x)).at(z=0.2 * x).turned(pitch=s * 0.9)
            p.add(flap.at(x=s * (x - wall / 2), z=h - 0.002), material)
    inside = ((-x + wall, -y + wall, wall), (x - wall, y - wall, h))
    if lid == "closed":
        p.block((-x, -y, h), (x, y, size[2]), material)
        b.support(p, (0.0, 0.0, size[2]), (2 * x, 2 * y))
        if band is not None:
            p.block((-0.025, -y - 0.0005, -0.0), (0.025, y + 0.0005, size[2] + 0.0005), band, solid=False)
    else:
        b.hollow(p, *inside)
    if lid == "hinged":
        top = b.part("lid")
        top.block((-x, -y, h + GAP), (x, y, size[2]), material)
        b.handle(top, (-0.03, -y - 0.012, h + GAP), (0.03, -y, h + GAP + 0.006), STEEL)
        b.joint("revolute", top, (0.0, y, h + GAP), (-1.0, 0.0, 0.0), (0.0, 1.8), 0.3)
    return b


_TAPE = Material("plastic", (214, 196, 150), 500.0, 0.4)
BOXES = {
    "parcel": lambda: hollow_box("taped parcel", (0.35, 0.25, 0.2), 0.006, CARD, lid="closed", band=_TAPE),
    "shoe": lambda: hollow_box(
        "shoe box with a lid", (0.33, 0.2, 0.12), 0.004, CARD.painted((190, 62, 52)), lid="hinged"
    ),
    "open_carton": lambda: hollow_box("open carton with flaps", (0.4, 0.3, 0.25), 0.006, CARD, lid="flaps"),
    "crate": lambda: hollow_box(
        "plastic crate with grips", (0.4, 0.3, 0.22), 0.008, PLASTIC.painted((56, 110, 70)), grips=True
    ),
    "chest": lambda: hollow_box("wooden chest", (0.5, 0.32, 0.3), 0.018, OAK, lid="hinged", grips=True),
    "tray": lambda: hollow_box("shallow tray", (0.36, 0.26, 0.06), 0.007, SHELL),
    "cube": lambda: hollow_box("small cube", (0.15, 0.15, 0.15), 0.004, CARD.painted((234, 230, 220)), lid="closed"),
    "flat_parcel": lambda: hollow_box(
        "flat parcel", (0.4, 0.3, 0.07), 0.004, CARD.painted((222, 214, 198)), lid="closed", band=_TAPE
    ),
}
"""Name -> design."""


def _hung(b: ModelBuilder, points: list[tuple[float, float, float]], radius: float, material: Material) -> None:
    """A strap or grip through points."""
    part = b.parts[0]
    part.add(
        tube(points, radius, segments=8),
        material,
        [tube(points[k : k + 2], radius, segments=8) for k in range(len(points) - 1)],
    )
    array = np.array(points)
    low, high = array.min(axis=0) - radius, array.max(axis=0) + radius
    b.handles.append(
        (part.name, (float(low[0]), float(low[1]), float(low[2])), (float(high[0]), float(high[1]), float(high[2])))
    )


def back_pack() -> ModelBuilder:
    """Rounded, with a front pocket and two shoulder straps."""
    b = ModelBuilder("bag", "backpack with a front pocket")
    p = b.part()
    p.add(rounded_plate((0.3, 0.18, 0.44), 0.07, chamfer=0.03), TEXTILE)
    p.add(rounded_plate((0.24, 0.1, 0.2), 0.04, chamfer=0.02).at(y=-0.07, z=0.03), TEXTILE.painted((52, 62, 52)))
    for s in (-1, 1):
        p.beam((s * 0.09, 0.08, 0.1), (s * 0.09, 0.09, 0.4), (0.04, 0.05), TEXTILE)
    _hung(b, [(-0.04, 0.05, 0.43), (-0.03, 0.05, 0.475), (0.03, 0.05, 0.475), (0.04, 0.05, 0.43)], 0.008, TEXTILE)
    return b


def hand_bag() -> ModelBuilder:
    """Stiff leather, narrower at the top, one bow."""
    b = ModelBuilder("bag", "stiff leather handbag")
    p = b.part()
    p.add(hull((0, 0, 0), box((0.32, 0.14, 0.01)).at(z=0.005), box((0.24, 0.06, 0.01)).at(z=0.215)), LEATHER)
    _hung(b, [(-0.08, 0.0, 0.21), (-0.06, 0.0, 0.3), (0.06, 0.0, 0.3), (0.08, 0.0, 0.21)], 0.007, LEATHER)
    return b


def suit_case() -> ModelBuilder:
    """Upright hard shell on four wheels with a drawn-out handle."""
    b = ModelBuilder("bag", "upright suitcase with a pull handle")
    p, shell = b.part(), PLASTIC.painted((64, 84, 110))
    case = Material(shell.name, shell.color, 110.0, 0.4)
    p.add(rounded_plate((0.4, 0.25, 0.55), 0.04, chamfer=0.02).at(z=0.05), case)
    for s in (-1, 1):
        for t in (-1, 1):
            p.add(cylinder(0.025, 0.055, segments=12).at(s * 0.15, t * 0.08), PLASTIC)
    _hung(b, [(-0.1, 0.1, 0.59), (-0.1, 0.1, 0.95), (0.1, 0.1, 0.95), (0.1, 0.1, 0.59)], 0.009, STEEL)
    return b


def duffel() -> ModelBuilder:
    """A lying cylinder with two bows."""
    b = ModelBuilder("bag", "duffel bag")
    p = b.part()
    p.add(
        cylinder(0.14, 0.55, segments=20).turned(pitch=np.pi / 2).at(-0.275, 0.0, 0.135)
        & box((1, 1, 0.27)).at(z=0.135),
        TEXTILE,
    )
    for s in (-1, 1):
        _hung(
            b,
            [(-0.1, s * 0.06, 0.25), (-0.08, s * 0.05, 0.34), (0.08, s * 0.05, 0.34), (0.1, s * 0.06, 0.25)],
            0.008,
            TEXTILE,
        )
    return b


def tote() -> ModelBuilder:
    """Open shopping bag of cloth with two long grips."""
    b = ModelBuilder("bag", "open tote bag")
    p = b.part()
    cloth = TEXTILE.painted((214, 204, 180))
    x, y, h, t = 0.19, 0.07, 0.38, 0.008
    p.block((-x, -y, 0.0), (x, y, t), cloth)
    for s in (-1, 1):
        p.block((s * x, -y, t), (s * (x - t), y, h), cloth)
        p.block((-x + t, s * y, t), (x - t, s * (y - t), h), cloth)
        _hung(
            b,
            [
                (-0.08, s * 0.066, h - 0.02),
                (-0.05, s * 0.06, h + 0.15),
                (0.05, s * 0.06, h + 0.15),
                (0.08, s * 0.066, h - 0.02),
            ],
            0.006,
            cloth,
        )
    b.hollow(p, (-x + t, -y + t, t), (x - t, y - t, h))
    return b


def brief_case() -> ModelBuilder:
    """Flat, upright, one grip."""
    b = ModelBuilder("bag", "briefcase")
    p = b.part()
    p.add(rounded_plate((0.42, 0.1, 0.31), 0.02, chamfer=0.006), LEATHER)
    p.block((-0.21, -0.052, 0.2), (0.21, -0.05, 0.21), STEEL, solid=False)
    _hung(b, [(-0.06, 0.0, 0.3), (-0.05, 0.0, 0.34), (0.05, 0.0, 0.34), (0.06, 0.0, 0.3)], 0.009, LEATHER)
    return b


def messenger() -> ModelBuilder:
    """A flap over the front, the strap lies over it."""
    b = ModelBuilder("bag", "messenger bag with a flap")
    p = b.part()
    p.add(rounded_plate((0.38, 0.12, 0.28), 0.03, chamfer=0.015), TEXTILE.painted((60, 66, 88)))
    p.add(rounded_plate((0.37, 0.02, 0.2), 0.008).at(y=-0.066, z=0.078), TEXTILE.painted((48, 52, 70)))
    _hung(b, [(-0.185, 0.0, 0.22), (-0.13, 0.0, 0.4), (0.13, 0.0, 0.4), (0.185, 0.0, 0.22)], 0.01, TEXTILE)
    return b


def sack() -> ModelBuilder:
    """A drawstring sack that bulges and is tied at the top."""
    b = ModelBuilder("bag", "tied sack")
    p = b.part()
    cloth = TEXTILE.painted((150, 120, 84))
    rings = [(0.13, 0.0), (0.17, 0.08), (0.16, 0.2), (0.05, 0.32), (0.03, 0.34)]
    for (r0, z0), (r1, z1) in itertools.pairwise(rings):
        p.add(cylinder(r0, z1 - z0, top=r1, segments=20).at(z=z0), cloth)
    p.add(cylinder(0.03, 0.08, top=0.075, segments=20).at(z=0.34), cloth)
    b.handle(p, (-0.05, -0.05, 0.3), (0.05, 0.05, 0.38))
    return b


BAGS = (back_pack, hand_bag, suit_case, duffel, tote, brief_case, messenger, sack)


def plant(
    description: str, pot: tuple[tuple[float, float], ...], material: Material, *, kind: str, height: float
) -> ModelBuilder:
    """A potted plant; kind: ``ball``, ``tree``, ``cactus``, ``fronds``, ``tufts``."""
    b = ModelBuilder("plant", description)
    p = b.part()
    top, r = pot[-1][1], pot[-1][0]
    wall = max(0.004, 0.08 * r)
    vessel(p, pot, wall, 0.7 * top, material, segments=24)
    soil = r - wall + 0.001
    p.add(cylinder(soil * 0.92, 0.15 * top, top=soil, segments=24).at(z=0.7 * top), SOIL)
    z, free = 0.85 * top, height - 0.85 * top
    if kind == "ball":
        p.add(sphere(free / 2, segments=14).at(z=z + free / 2), LEAF)
    elif kind == "tree":
        bar(p, (0.0, 0.0, z), (0.0, 0.0, z + 0.6 * free), 0.02, OAK)
        for x, y, at, size in (
            (0.0, 0.0, 0.8, 0.2),
            (0.1, 0.06, 0.62, 0.16),
            (-0.1, 0.02, 0.58, 0.15),
            (0.0, -0.1, 0.66, 0.15),
        ):
            p.add(sphere(size * free, segments=12).at(x * free * 1.6, y * free * 1.6, z + at * free), LEAF)
    elif kind == "cactus":
        bar(p, (0.0, 0.0, z), (0.0, 0.0, z + free - 0.3 * r), 0.3 * r, LEAF)
        for s, at in ((-1, 0.35), (1, 0.5)):
            bar(p, (0.0, 0.0, z + at * free), (s * 0.75 * r, 0.0, z + at * free), 0.16 * r, LEAF)
            bar(p, (s * 0.75 * r, 0.0, z + at * free), (s * 0.75 * r, 0.0, z + (at + 0.3) * free), 0.16 * r, LEAF)
    else:
        count, lean = (9, 1.3) if kind == "fronds" else (14, 0.35)
        for k in range(count):
            a = 2.0 * np.pi * k / count
            reach = lean * (0.6 + 0.4 * (k % 3) / 2) * 0.5 * free
            rise = free * (0.75 + 0.25 * (k % 2))
            foot, knee, tip = 0.2 * r, 0.55 * reach, reach + 0.2 * r
            c, s = np.cos(a), np.sin(a)
            p.beam((foot * c, foot * s, z), (knee * c, knee * s, z + 0.8 * rise), (0.012, 0.03), LEAF)
            p.beam(
                (knee * c, knee * s, z + 0.8 * rise),
                (tip * c, tip * s, z + rise * (0.7 if lean > 1 else 1.0)),
                (0.03, 0.006),
                LEAF,
            )
    return b


_CONE = ((0.06, 0.0), (0.085, 0.13), (0.092, 0.15))
PLANTS = {
    "box_ball": lambda: plant("box ball in a clay pot", _CONE, CLAY, kind="ball", height=0.42),
    "fig": lambda: plant("small tree in a tub", ((0.15, 0.0), (0.17, 0.3)), SHELL, kind="tree", height=1.5),
    "cactus": lambda: plant("cactus", ((0.05, 0.0), (0.06, 0.08)), CLAY, kind="cactus", height=0.32),
    "palm": lambda: plant("palm with hanging fronds", ((0.13, 0.0), (0.16, 0.26)), PLASTIC, kind="fronds", height=1.2),
    "sansevieria": lambda: plant(
        "upright leaves in a cylinder", ((0.09, 0.0), (0.09, 0.18)), SHELL, kind="tufts", height=0.7
    ),
    "herb": lambda: plant("herb in a small pot", ((0.04, 0.0), (0.055, 0.09)), CLAY, kind="tufts", height=0.26),
    "fern": lambda: plant("fern in a bowl", ((0.06, 0.0), (0.12, 0.07), (0.125, 0.1)), CLAY, kind="fronds", height=0.4),
    "standard": lambda: plant(
        "tall standard tree in a square-set tub",
        ((0.12, 0.0), (0.14, 0.02), (0.14, 0.28)),
        PLASTIC,
        kind="tree",
        height=1.15,
    ),
}
"""Name -> design."""
