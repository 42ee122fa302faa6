"""Cups, bottles and bowls of the catalogue: solids of revolution, hollow in physics too."""

import itertools

import numpy as np

from simtrack.objects.cad.builder import ModelBuilder, PartBuilder
from simtrack.objects.cad.materials import CERAMIC, CLAY, GLASS, PLASTIC, SHELL, STEEL, Material
from simtrack.objects.shapes import Solid, cylinder, hull, lathe, solid, tube

STAVES = 10
"""Convex pieces around a hollow."""
Profile = tuple[tuple[float, float], ...]
"""(radius, z) of the outside from the lowest to the highest ring."""


def _staves(outer: Profile, wall: float, floor: float) -> list[Solid]:
    """A floor and a ring of convex staves that stand for a hollow vessel."""
    from manifold3d import Manifold

    parts = []
    step = 2.0 * np.pi / STAVES
    rings = [ring for ring in outer if ring[1] <= floor + 1e-9]
    base = [(r, z) for r, z in rings] + [(float(np.interp(floor, *_columns(outer))), floor)]
    parts.append(
        hull(
            (0, 0, 0), *(cylinder(max(r, 1e-3), 1e-4, segments=2 * STAVES).at(z=min(z, floor - 1e-4)) for r, z in base)
        )
    )
    for (r0, z0), (r1, z1) in itertools.pairwise(outer):
        if z1 <= floor + 1e-6 or z1 - z0 < 1e-6:
            continue
        z0, r0 = max(z0, floor), float(np.interp(max(z0, floor), *_columns(outer)))
        for k in range(STAVES):
            points = []
            for r, z in ((r0, z0), (r1, z1)):
                for a in (step * k, step * (k + 1)):
                    for radius in (r, max(r - wall, 0.0)):
                        points.append((radius * np.cos(a), radius * np.sin(a), z))
            parts.append(solid(Manifold.hull_points(np.array(points)), (0, 0, 0)))
    return parts


def _columns(profile: Profile) -> tuple[list[float], list[float]]:
    return [z for _, z in profile], [r for r, _ in profile]


def vessel(p: PartBuilder, outer: Profile, wall: float, floor: float, material: Material, segments: int = 32) -> None:
    """Add a vessel that is open at the top."""
    inner = [(max(r - wall, 0.002), z) for r, z in outer if z > floor]
    inner = [(max(float(np.interp(floor, *_columns(outer))) - wall, 0.002), floor), *inner]
    outline = [(0.0, outer[0][1]), *outer, *reversed(inner), (0.0, floor)]
    p.add(lathe(outline, segments=segments), material, _staves(outer, wall, floor))


def _inside(b: ModelBuilder, p: PartBuilder, radius: float, floor: float, top: float) -> None:
    side = radius * np.sqrt(0.5)
    b.hollow(p, (-side, -side, floor), (side, side, top), floor=False)


def cup(
    description: str,
    outer: Profile,
    *,
    wall: float = 0.004,
    material: Material = CERAMIC,
    handle: str = "loop",
    saucer: float = 0.0,
    lid: bool = False,
) -> ModelBuilder:
    """A cup: its outside, and a handle (``loop``, ``square``, ``ring``, ``none``) on its right."""
    b = ModelBuilder("cup", description)
    p = b.part()
    base = 0.0
    if saucer:
        p.add(cylinder(0.45 * saucer, 0.008, top=saucer, segments=28), material)
        base = 0.006
    body = tuple((r, z + base) for r, z in outer)
    low, high = body[0][1], body[-1][1]
    vessel(p, body, wall, low + 0.006, material)
    middle = 0.5 * (low + high)
    r = float(np.interp(middle, *_columns(body))) - 0.5 * wall
    half = 0.28 * (high - low)
    tall = {
        "loop": [(r, half), (r + 0.022, 0.8 * half), (r + 0.03, 0.0), (r + 0.02, -0.8 * half), (r - 0.001, -half)],
        "square": [(r, half), (r + 0.03, half), (r + 0.03, -half), (r, -half)],
        "ring": [(r, 0.5 * half), (r + 0.016, 0.45 * half), (r + 0.016, -0.45 * half), (r, -0.5 * half)],
    }
    if handle in tall:
        points = [(x, 0.0, middle + z) for x, z in tall[handle]]
        bent = tube(points, 0.0045, segments=8)
        p.add(bent, material, [tube(points[k : k + 2], 0.0045, segments=8) for k in range(len(points) - 1)])
        b.handle(p, (r, -0.006, middle - half), (r + 0.032, 0.006, middle + half))
    else:
        b.handle(p, (-r, -r, middle - half), (r, r, middle + half))
    if lid:
        p.add(cylinder(body[-1][0] + 0.002, 0.008, segments=28).at(z=high - 0.002), PLASTIC)
    else:
        _inside(b, p, body[-1][0] - wall, low + 0.006, high)
    return b


CUPS = {
    "mug": lambda: cup("straight mug", ((0.038, 0.0), (0.041, 0.004), (0.041, 0.095))),
    "tea": lambda: cup("tea cup on a saucer", ((0.022, 0.0), (0.036, 0.022), (0.046, 0.058)), saucer=0.075),
    "espresso": lambda: cup("espresso cup", ((0.02, 0.0), (0.028, 0.012), (0.031, 0.056)), handle="ring"),
    "tumbler": lambda: cup("glass tumbler", ((0.032, 0.0), (0.039, 0.11)), material=GLASS, handle="none", wall=0.003),
    "travel": lambda: cup(
        "travel cup with a lid", ((0.034, 0.0), (0.036, 0.09), (0.043, 0.17)), material=STEEL, handle="none", lid=True
    ),
    "stein": lambda: cup(
        "tall mug with a square handle", ((0.045, 0.0), (0.042, 0.07), (0.044, 0.14)), handle="square"
    ),
    "barrel": lambda: cup("bellied mug", ((0.032, 0.0), (0.046, 0.03), (0.047, 0.05), (0.037, 0.088)), material=CLAY),
    "paper": lambda: cup(
        "paper cup", ((0.029, 0.0), (0.042, 0.108), (0.045, 0.112)), material=SHELL, handle="none", wall=0.0025
    ),
}
"""Name -> design."""


def bottle(
    description: str,
    outer: Profile,
    material: Material,
    *,
    cap: tuple[float, float] = (0.015, 0.02),
    square: bool = False,
    grip: bool = False,
    label: tuple[float, float] | None = None,
    fill: float = 0.35,
) -> ModelBuilder:
    """A closed bottle; `fill` of its volume counts, with the density of water, as its content."""
    b = ModelBuilder("bottle", description)
    p = b.part()
    glass = Material(material.name, material.color, 1000.0 * fill + 120.0, material.friction)
    segments = 4 if square else 32
    turn = np.pi / 4 if square else 0.0
    outline = [(0.0, outer[0][1]), *outer, (0.0, outer[-1][1])]
    convex = [
        hull(
            (0, 0, 0),
            *(cylinder(r, 1e-4, segments=segments if square else 16).turned(yaw=turn).at(z=z) for r, z in pair),
        )
        for pair in itertools.pairwise(outer)
        if pair[1][1] - pair[0][1] > 1e-6
    ]
    p.add(lathe(outline, segments=segments).turned(yaw=turn), glass, convex)
    top = outer[-1][1]
    p.add(cylinder(cap[0], cap[1], segments=16).at(z=top - 0.002), PLASTIC.painted((180, 60, 52)))
    if label is not None:
        r = max(float(np.interp(z, *_columns(outer))) for z in np.linspace(*label, 5)) + 0.0006
        band = cylinder(r, label[1] - label[0], segments=segments).turned(yaw=turn).at(z=label[0])
        p.add(band, Material("paper", (236, 226, 190), 300.0, 0.45), ())
    if grip:
        r = float(np.interp(0.6 * top, *_columns(outer)))
        points = [
            (r - 0.002, 0.0, 0.75 * top),
            (r + 0.04, 0.0, 0.72 * top),
            (r + 0.04, 0.0, 0.42 * top),
            (r - 0.002, 0.0, 0.4 * top),
        ]
        p.add(tube(points, 0.008, segments=8), glass, [tube(points[k : k + 2], 0.008, segments=8) for k in range(3)])
        b.handle(p, (r, -0.01, 0.42 * top), (r + 0.048, 0.01, 0.72 * top))
    else:
        r = outer[-1][0]
        b.handle(p, (-r, -r, outer[-2][1]), (r, r, top))
    return b


_GREEN = GLASS.painted((46, 92, 60))
_CLEAR = SHELL.painted((196, 214, 226))
BOTTLES = {
    "wine": lambda: bottle(
        "wine bottle",
        ((0.036, 0.0), (0.037, 0.19), (0.015, 0.235), (0.014, 0.3)),
        _GREEN,
        cap=(0.0145, 0.008),
        label=(0.06, 0.15),
        fill=0.6,
    ),
    "water": lambda: bottle(
        "plastic water bottle",
        ((0.03, 0.0), (0.032, 0.09), (0.029, 0.1), (0.032, 0.11), (0.032, 0.17), (0.012, 0.215)),
        _CLEAR,
        label=(0.12, 0.16),
    ),
    "square": lambda: bottle(
        "square bottle",
        ((0.055, 0.0), (0.055, 0.15), (0.02, 0.17), (0.018, 0.2)),
        GLASS,
        cap=(0.02, 0.025),
        square=True,
    ),
    "jug": lambda: bottle(
        "detergent jug with a grip",
        ((0.06, 0.0), (0.062, 0.17), (0.03, 0.23), (0.024, 0.245)),
        PLASTIC.painted((52, 108, 176)),
        cap=(0.028, 0.03),
        grip=True,
        fill=0.5,
        label=(0.03, 0.12),
    ),
    "flask": lambda: bottle(
        "steel flask",
        ((0.033, 0.0), (0.035, 0.006), (0.035, 0.2), (0.026, 0.22)),
        STEEL.painted((120, 150, 150)),
        cap=(0.026, 0.04),
    ),
    "beer": lambda: bottle(
        "long-necked bottle",
        ((0.03, 0.0), (0.0305, 0.13), (0.014, 0.18), (0.012, 0.22)),
        GLASS.painted((96, 60, 34)),
        cap=(0.0135, 0.006),
        label=(0.04, 0.1),
    ),
    "sauce": lambda: bottle(
        "sauce bottle",
        ((0.03, 0.0), (0.034, 0.05), (0.024, 0.11), (0.026, 0.14), (0.012, 0.165)),
        PLASTIC.painted((186, 46, 40)),
        cap=(0.013, 0.03),
    ),
    "carafe": lambda: bottle(
        "bellied carafe",
        ((0.05, 0.0), (0.07, 0.04), (0.06, 0.09), (0.024, 0.15), (0.03, 0.23)),
        GLASS,
        cap=(0.024, 0.03),
    ),
}
"""Name -> design."""


def bowl(
    description: str,
    outer: Profile,
    *,
    wall: float = 0.005,
    material: Material = CERAMIC,
    ears: float = 0.0,
    segments: int = 32,
) -> ModelBuilder:
    """An open bowl; `ears` metres wide grips on both sides of its rim."""
    b = ModelBuilder("bowl", description)
    p = b.part()
    vessel(p, outer, wall, outer[0][1] + 0.008, material, segments)
    r, top = outer[-1][0], outer[-1][1]
    for s in (-1, 1):
        if ears:
            p.block((s * (r - 0.004), -ears / 2, top - 0.012), (s * (r + 0.025), ears / 2, top - 0.004), material)
        b.handle(p, (s * (r - wall), -0.03, top - 0.02), (s * (r + (0.025 if ears else 0.0)), 0.03, top))
    _inside(b, p, r - wall, outer[0][1] + 0.008, top)
    return b


BOWLS = {
    "cereal": lambda: bowl("round cereal bowl", ((0.035, 0.0), (0.06, 0.02), (0.075, 0.06))),
    "salad": lambda: bowl(
        "wide wooden salad bowl",
        ((0.06, 0.0), (0.11, 0.03), (0.14, 0.09)),
        material=Material("wood", (168, 118, 72), 650.0, 0.5),
        wall=0.009,
    ),
    "mixing": lambda: bowl(
        "steel mixing bowl", ((0.05, 0.0), (0.09, 0.03), (0.11, 0.08), (0.12, 0.12)), material=STEEL, wall=0.003
    ),
    "soup": lambda: bowl("soup bowl with ears", ((0.04, 0.0), (0.058, 0.012), (0.062, 0.065)), ears=0.04),
    "pasta": lambda: bowl("flat pasta plate", ((0.05, 0.0), (0.075, 0.012), (0.09, 0.03), (0.13, 0.038))),
    "footed": lambda: bowl(
        "bowl on a foot", ((0.04, 0.0), (0.018, 0.014), (0.02, 0.02), (0.06, 0.04), (0.07, 0.075)), material=CLAY
    ),
    "hexagonal": lambda: bowl("six-sided bowl", ((0.05, 0.0), (0.09, 0.05)), segments=6),
    "straight": lambda: bowl("straight-sided dish", ((0.085, 0.0), (0.09, 0.005), (0.09, 0.055)), material=GLASS),
}
"""Name -> design."""
