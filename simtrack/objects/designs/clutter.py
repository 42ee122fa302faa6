"""Things that lie about and that no tracker has a model of."""

import numpy as np
from manifold3d import Manifold

from simtrack.objects.model import rotational
from simtrack.objects.shapes import (
    Color,
    Design,
    Solid,
    both_sides,
    box,
    cylinder,
    hull,
    lathe,
    minus,
    plate,
    ring_of,
    rod,
    rounded_plate,
    side_prism,
    solid,
    sphere,
    tube,
    turned_part,
    union,
)

CERAMIC: Color = (238, 236, 228)
TEAL: Color = (28, 128, 140)
COFFEE: Color = (70, 42, 24)
KRAFT: Color = (186, 142, 92)
KRAFT_DARK: Color = (160, 118, 74)
TAPE: Color = (214, 176, 92)
BLACK: Color = (30, 31, 34)
STEEL: Color = (176, 180, 186)
RED: Color = (206, 44, 40)
WHITE: Color = (242, 242, 240)
BLUE: Color = (42, 96, 178)
CLEAR: Color = (176, 208, 232)
TERRACOTTA: Color = (184, 92, 58)
SOIL: Color = (62, 44, 32)
LEAF: Color = (52, 128, 52)
LEAF_LIGHT: Color = (96, 160, 70)
YELLOW: Color = (240, 196, 40)


def mug() -> Design:
    """Coffee mug, half full, handle at +x."""
    radius, height = 0.041, 0.096
    cup = turned_part(
        [(0.034, 0.0), (0.038, 0.003), (radius, 0.012), (radius, height - 0.002), (0.0395, height)], CERAMIC, 40
    )
    band = cylinder(radius + 0.0008, 0.026, TEAL, segments=40).at(z=0.036)
    inside = cylinder(0.0365, 0.06, CERAMIC, segments=40).at(z=0.050)
    coffee = cylinder(0.0370, 0.004, COFFEE, segments=40).at(z=0.048)
    angles = np.linspace(-0.42 * np.pi, 0.42 * np.pi, 7)
    bow = tube([(0.034 + 0.036 * np.cos(a), 0.0, 0.050 + 0.030 * np.sin(a)) for a in angles], 0.0055, CERAMIC)
    bow = bow - cylinder(0.036, 0.2, CERAMIC, segments=40)
    return Design(
        description="coffee mug, half full",
        semantic_class="mug",
        body=union(minus(union(cup, band), inside), coffee, bow),
        collision=(
            cylinder(radius, 0.052, CERAMIC, segments=16),
            *_ring_wall(radius, 0.037, 0.050, height, 12),
            hull(
                CERAMIC,
                box((0.010, 0.011, 0.010)).at(x=0.044, z=0.075),
                box((0.008, 0.011, 0.034)).at(x=0.071, z=0.050),
            ),
            hull(
                CERAMIC,
                box((0.010, 0.011, 0.010)).at(x=0.044, z=0.025),
                box((0.008, 0.011, 0.034)).at(x=0.071, z=0.050),
            ),
        ),
        mass=0.45,
        friction=0.5,
        faces=8000,
    )


def _ring_wall(outer: float, inner: float, low: float, high: float, count: int) -> list[Solid]:
    """Convex staves of an upright tube wall."""
    half = np.pi / count
    outline = [
        (r * np.cos(a), r * np.sin(a)) for r, a in ((inner, half), (inner, -half), (outer, -half), (outer, half))
    ]
    points = [np.array([(x, y, z) for x, y in outline]) for z in (low, high)]
    stave = solid(Manifold.hull_points(np.concatenate(points)), CERAMIC)
    return [stave.turned(yaw=2.0 * half * k) for k in range(count)]


def spray_bottle() -> Design:
    """Trigger spray bottle with a label; +x is the nozzle."""
    flask = turned_part(
        [(0.030, 0.0), (0.036, 0.004), (0.037, 0.012), (0.037, 0.110), (0.034, 0.135), (0.024, 0.165), (0.015, 0.185),
         (0.013, 0.200)], CLEAR, 32,
    ).scaled(1.12, 0.88, 1.0)  # fmt: skip
    label = cylinder(0.0375, 0.070, BLUE, segments=32).scaled(1.12, 0.88, 1.0).at(z=0.030)
    stripe = cylinder(0.0380, 0.012, WHITE, segments=32).scaled(1.12, 0.88, 1.0).at(z=0.060)
    cap = cylinder(0.018, 0.024, RED, top=0.016, segments=20).at(z=0.192) + ring_of(
        box((0.003, 0.003, 0.020), RED).at(x=0.017, z=0.203), 12
    )
    head = side_prism(
        [(-0.026, 0.226), (-0.014, 0.212), (0.046, 0.214), (0.050, 0.236), (0.020, 0.246), (-0.020, 0.246)], 0.026, RED
    )
    nozzle = cylinder(0.009, 0.016, WHITE, segments=12).turned(pitch=np.pi / 2).at(x=0.046, z=0.226)
    trigger = side_prism(
        [(0.026, 0.216), (0.024, 0.190), (0.030, 0.158), (0.037, 0.160), (0.033, 0.192), (0.038, 0.216)], 0.014, WHITE
    )
    return Design(
        description="trigger spray bottle with a blue label",
        semantic_class="spray-bottle",
        body=union(flask, label, stripe, cap, head, nozzle, trigger),
        collision=(
            cylinder(0.037, 0.135, CLEAR, segments=14).scaled(1.12, 0.88, 1.0),
            cylinder(0.034, 0.060, CLEAR, top=0.016, segments=14).scaled(1.1, 0.9, 1.0).at(z=0.135),
            cylinder(0.018, 0.030, RED, segments=10).at(z=0.190),
            box((0.086, 0.026, 0.034)).at(x=0.018, z=0.229),
            hull(
                WHITE, box((0.012, 0.014, 0.002)).at(x=0.032, z=0.214), box((0.007, 0.014, 0.002)).at(x=0.0335, z=0.160)
            ),
        ),
        mass=0.52,
        friction=0.5,
        faces=8000,
    )


def tape_dispenser() -> Design:
    """Desk dispenser with a roll of packing tape; +x is the cutting edge."""
    side = [(-0.078, 0.0), (0.086, 0.0), (0.090, 0.012), (0.088, 0.046), (0.078, 0.050), (0.048, 0.026), (0.014, 0.024),
            (-0.020, 0.030), (-0.060, 0.034), (-0.078, 0.026)]  # fmt: skip
    base = side_prism(side, 0.062, BLACK)
    cheek = side_prism(
        [(-0.072, 0.020), (0.012, 0.020), (-0.012, 0.066), (-0.026, 0.072), (-0.040, 0.066)], 0.006, BLACK
    )
    roll = lathe([(0.0375, -0.0235), (0.049, -0.0235), (0.049, 0.0235), (0.0375, 0.0235)], TAPE, 36)
    core = lathe([(0.034, -0.024), (0.038, -0.024), (0.038, 0.024), (0.034, 0.024)], KRAFT_DARK, 36)
    hub = cylinder(0.0345, 0.040, RED, segments=24).at(z=-0.020) + ring_of(
        box((0.030, 0.004, 0.044), RED).at(x=0.018), 5
    )
    axle = cylinder(0.008, 0.062, STEEL, segments=14).at(z=-0.031)
    wheel = union(roll, core, hub, axle).turned(roll=np.pi / 2).at(x=-0.026, z=0.064)
    ribbon = hull(
        TAPE, box((0.004, 0.046, 0.001)).at(x=-0.010, z=0.1090), box((0.004, 0.046, 0.001)).at(x=0.084, z=0.0505)
    )
    blade = side_prism([(0.080, 0.044), (0.094, 0.044), (0.096, 0.056), (0.092, 0.052), (0.080, 0.050)], 0.050, STEEL)
    return Design(
        description="desk tape dispenser with a roll of packing tape",
        semantic_class="tape-dispenser",
        body=union(base, both_sides(cheek.at(y=0.028)), wheel, ribbon, blade),
        collision=(
            plate((0.164, 0.062, 0.026), BLACK).at(x=0.004),
            cylinder(0.049, 0.047, TAPE, segments=16).turned(roll=np.pi / 2).at(x=-0.026, y=0.0235, z=0.064),
            hull(
                BLACK, box((0.030, 0.062, 0.002)).at(x=0.072, z=0.024), box((0.014, 0.056, 0.004)).at(x=0.086, z=0.051)
            ),
        ),
        mass=0.68,
        friction=0.7,
        faces=8000,
    )


def soldering_station() -> Design:
    """Soldering station with a display, a knob, and the iron in its spring stand; +x is the front."""
    case = side_prism(
        [(-0.085, 0.0), (0.060, 0.0), (0.066, 0.006), (0.046, 0.092), (0.040, 0.098), (-0.080, 0.098), (-0.085, 0.090)],
        0.110,
        BLUE,
    )
    lean = -np.arctan2(0.020, 0.086)
    panel = box((0.004, 0.098, 0.072), BLACK).turned(pitch=lean).at(x=0.0555, z=0.050)
    display = box((0.005, 0.050, 0.022), LEAF_LIGHT).turned(pitch=lean).at(x=0.0528, y=-0.016, z=0.064)
    knob = (
        cylinder(0.013, 0.014, STEEL, top=0.0115, segments=20)
        .turned(pitch=np.pi / 2 + lean)
        .at(x=0.052, y=0.030, z=0.058)
    )
    plug = cylinder(0.010, 0.012, STEEL, segments=16).turned(pitch=np.pi / 2 + lean).at(x=0.057, y=-0.028, z=0.028)
    switch = box((0.008, 0.016, 0.020), RED).turned(pitch=lean).at(x=0.060, y=0.030, z=0.027)
    slots = [box((0.006, 0.080, 0.006), BLACK).at(x=x, z=0.098) for x in (-0.060, -0.045, -0.030)]
    feet = [
        cylinder(0.008, 0.006, BLACK, segments=10).at(x=x, y=y, z=-0.004) for x in (-0.07, 0.045) for y in (-0.04, 0.04)
    ]
    body = union(minus(case, *slots), panel, display, knob, plug, switch, *feet, _iron_stand()).at(z=0.004)
    return Design(
        description="soldering station with its iron in a spring stand",
        semantic_class="soldering-station",
        body=body,
        collision=(
            hull(BLUE, plate((0.149, 0.110, 0.010)).at(x=-0.0105), plate((0.126, 0.110, 0.010)).at(x=-0.0220, z=0.092)),
            plate((0.110, 0.062, 0.012), BLACK).at(x=-0.020, y=0.085),
            hull(
                STEEL,
                sphere(0.016, segments=8).at(-0.045, 0.086, 0.040),
                sphere(0.013, segments=8).at(0.060, 0.086, 0.135),
            ),
        ),
        mass=2.4,
        friction=0.6,
        faces=10000,
    )


def _iron_stand() -> Solid:
    """Sponge tray with a coiled holder that leans forward, the iron's handle sticking out above."""
    tray = rounded_plate((0.110, 0.064, 0.016), 0.010, BLACK).at(x=-0.020, y=0.084, z=-0.004)
    sponge = plate((0.034, 0.048, 0.008), YELLOW).at(x=0.010, y=0.086, z=0.008)
    lean = np.arctan2(0.105, 0.095)
    coils = [_washer(0.0125 - 0.0006 * k, 0.004, 0.004).at(z=0.0085 * k) for k in range(9)]
    turns = [(np.cos(a), np.sin(a)) for a in (0.5, 2.6, 4.7)]
    rails = [rod((0.0145 * c, 0.0145 * s, 0.0), (0.011 * c, 0.011 * s, 0.072), 0.002, STEEL, 8) for c, s in turns]
    iron = union(
        cylinder(0.0045, 0.090, STEEL, segments=10),
        turned_part(
            [(0.013, 0.072), (0.015, 0.076), (0.013, 0.084), (0.0095, 0.090), (0.011, 0.130), (0.009, 0.150)], RED, 16
        ),
        cylinder(0.004, 0.016, BLACK, segments=10).at(z=0.148),
    )
    holder = union(*coils, *rails, iron).turned(pitch=lean).at(x=-0.052, y=0.086, z=0.034)
    post = hull(
        BLACK,
        plate((0.016, 0.020, 0.004)).at(x=-0.050, y=0.086, z=0.008),
        plate((0.012, 0.012, 0.004)).at(x=-0.046, y=0.086, z=0.036),
    )
    bridge = plate((0.060, 0.020, 0.010), BLACK).at(x=-0.020, y=0.055, z=-0.002)
    return union(tray, sponge, holder, post, bridge)


def _washer(inner: float, width: float, height: float) -> Solid:
    outer = inner + width
    return lathe([(inner, 0.0), (outer, 0.0), (outer, height), (inner, height)], STEEL, 16)


def desk_lamp() -> Design:
    """Jointed desk lamp on a heavy foot; +x is where it shines."""
    foot = turned_part([(0.082, 0.0), (0.085, 0.004), (0.085, 0.022), (0.078, 0.030), (0.020, 0.034)], RED, 36)
    socket = turned_part([(0.014, 0.030), (0.014, 0.052), (0.010, 0.056)], STEEL, 16)
    elbow, wrist = (-0.095, 0.0, 0.235), (0.070, 0.0, 0.372)
    arms = both_sides(rod((0.0, 0.009, 0.050), (elbow[0], 0.009, elbow[2]), 0.0045, STEEL, 10))
    arms = arms + both_sides(rod((elbow[0], 0.009, elbow[2]), (wrist[0], 0.009, wrist[2]), 0.0045, STEEL, 10))
    joints = [cylinder(0.014, 0.034, BLACK, segments=18).turned(roll=np.pi / 2).at(x=p[0], y=0.017, z=p[2])
              for p in ((0.0, 0.0, 0.050), elbow, wrist)]  # fmt: skip
    shade = turned_part([(0.066, 0.0), (0.066, 0.004), (0.030, 0.082), (0.022, 0.100), (0.018, 0.122)], RED, 32)
    hollow = turned_part([(0.063, -0.001), (0.027, 0.080)], WHITE, 32)
    bulb = union(sphere(0.022, YELLOW, 16).at(z=0.036), cylinder(0.010, 0.05, STEEL, segments=12).at(z=0.045))
    head = union(minus(shade, hollow), bulb).at(z=-0.100).turned(pitch=-0.45).at(x=wrist[0] + 0.012, z=wrist[2])
    return Design(
        description="jointed desk lamp on a heavy round foot",
        semantic_class="lamp",
        body=union(foot, socket, arms, *joints, head),
        collision=(
            cylinder(0.085, 0.022, RED, segments=16),
            cylinder(0.083, 0.012, RED, top=0.040, segments=16).at(z=0.022),
            hull(STEEL, box((0.016, 0.028, 0.012)).at(z=0.050), box((0.016, 0.028, 0.012)).at(*elbow)),
            hull(STEEL, box((0.016, 0.028, 0.012)).at(*elbow), box((0.016, 0.028, 0.012)).at(*wrist)),
            hull(RED, cylinder(0.066, 0.004, segments=14), cylinder(0.020, 0.004, segments=10).at(z=0.118))
            .at(z=-0.100)
            .turned(pitch=-0.45)
            .at(x=wrist[0] + 0.012, z=wrist[2]),
        ),
        mass=1.9,
        friction=0.7,
        faces=10000,
    )


def cardboard_box() -> Design:
    """Shipping carton with open flaps and a shipping label; +x has the label."""
    x, y, z, wall = 0.220, 0.160, 0.120, 0.004
    shell = plate((x, y, z), KRAFT) - plate((x - 2 * wall, y - 2 * wall, z), KRAFT_DARK).at(z=wall)
    long_flap = box((x - 0.004, 0.072, 0.003), KRAFT).at(y=0.036)
    short_flap = box((0.072, y - 0.004, 0.003), KRAFT).at(x=0.036)
    flaps = [
        long_flap.turned(roll=0.70).at(y=0.5 * y - 0.004, z=z - 0.001),
        long_flap.turned(roll=1.20).at(y=0.5 * y - 0.004, z=z - 0.001).turned(yaw=np.pi),
        short_flap.turned(pitch=0.55).at(x=0.5 * x - 0.004, z=z - 0.001),
        short_flap.turned(pitch=-0.35).at(x=0.5 * x - 0.004, z=z - 0.001).turned(yaw=np.pi),
    ]
    label = box((0.002, 0.080, 0.055), WHITE).at(x=0.5 * x, y=-0.025, z=0.060)
    bars = [box((0.0026, w, 0.016), BLACK).at(x=0.5 * x, y=y0, z=0.050) for w, y0 in _BARCODE]
    address = [box((0.0026, 0.040, 0.003), BLACK).at(x=0.5 * x, y=-0.035, z=h) for h in (0.079, 0.073, 0.067)]
    tape = plate((x + 0.0012, 0.048, z - 0.020), TAPE).at(z=-0.0006) - plate((x, y, z), KRAFT)
    return Design(
        description="shipping carton with open flaps",
        semantic_class="cardboard-box",
        body=union(shell, tape, *flaps, label, *bars, *address),
        collision=(
            plate((x, y, wall + 0.002), KRAFT).at(z=-0.0006),
            *(plate((0.006, y, z), KRAFT).at(x=s * (0.5 * x - 0.003)) for s in (-1, 1)),
            *(plate((x, 0.006, z), KRAFT).at(y=s * (0.5 * y - 0.003)) for s in (-1, 1)),
            *flaps,
        ),
        mass=0.28,
        friction=0.5,
        faces=6000,
    )


_BARCODE = (
    (0.004, -0.058),
    (0.002, -0.051),
    (0.006, -0.044),
    (0.002, -0.037),
    (0.003, -0.032),
    (0.005, -0.025),
    (0.002, -0.018),
)


def plant_pot() -> Design:
    """Potted plant with broad leaves."""
    pot = turned_part([(0.046, 0.0), (0.062, 0.086), (0.068, 0.087), (0.070, 0.112), (0.066, 0.113)], TERRACOTTA, 32)
    pot = minus(pot, cylinder(0.058, 0.05, TERRACOTTA, segments=32).at(z=0.094))
    soil = turned_part([(0.059, 0.090), (0.059, 0.098), (0.030, 0.102)], SOIL, 24)
    leaves, stems = [], []
    for k, (yaw, lean, reach) in enumerate(_LEAVES):
        blade = hull(
            LEAF if k % 2 else LEAF_LIGHT,
            sphere(0.004, segments=8),
            sphere(0.006, segments=8).scaled(1.0, 4.2, 0.6).at(x=0.034, z=0.003),
            sphere(0.002, segments=8).at(x=0.092),
        )
        tip = (reach * np.cos(yaw), reach * np.sin(yaw), 0.100 + _HEIGHTS[k])
        leaves.append(blade.turned(pitch=lean, yaw=yaw).at(*tip))
        stems.append(rod((0.25 * tip[0], 0.25 * tip[1], 0.096), tip, 0.0034, LEAF, 8))
    crown = cylinder(0.052, 0.110, LEAF, top=0.075, segments=10).at(z=0.113)
    return Design(
        description="potted plant with broad leaves",
        semantic_class="plant-pot",
        body=union(pot, soil, *stems, *leaves),
        collision=(
            cylinder(0.050, 0.087, TERRACOTTA, top=0.063, segments=16),
            cylinder(0.069, 0.027, TERRACOTTA, segments=16).at(z=0.086),
            crown,
        ),
        mass=0.95,
        friction=0.6,
        faces=8000,
    )


_LEAVES = (
    (0.2, -0.35, 0.030),
    (1.3, -0.55, 0.026),
    (2.3, -0.20, 0.034),
    (3.3, -0.60, 0.024),
    (4.4, -0.30, 0.034),
    (5.4, -0.65, 0.020),
    (0.9, -1.05, 0.012),
    (3.9, -1.20, 0.010),
)
"""Heading, lean and reach of every leaf, radians and metres."""
_HEIGHTS = (0.060, 0.075, 0.050, 0.085, 0.055, 0.095, 0.110, 0.120)
"""Height of every leaf's foot above the soil, metres."""


def thermos() -> Design:
    """Vacuum flask with a cup for a lid: a body of revolution."""
    profile = [(0.034, 0.0), (0.037, 0.003), (0.037, 0.178), (0.031, 0.192)]
    body = turned_part(profile, STEEL, 48)
    base = turned_part([(0.0345, 0.0), (0.0378, 0.003), (0.0378, 0.022), (0.036, 0.023)], BLACK, 48)
    band = cylinder(0.0374, 0.040, TEAL, segments=48).at(z=0.110)
    cup = turned_part([(0.032, 0.188), (0.0345, 0.190), (0.0325, 0.246), (0.0295, 0.250)], BLACK, 48)
    return Design(
        description="steel vacuum flask",
        semantic_class="thermos",
        body=union(body, base, band, cup),
        collision=(
            cylinder(0.0375, 0.180, STEEL, segments=24),
            cylinder(0.0345, 0.060, BLACK, top=0.030, segments=24).at(z=0.190),
            cylinder(0.037, 0.010, STEEL, top=0.0345, segments=24).at(z=0.180),
        ),
        mass=0.62,
        friction=0.5,
        faces=6000,
        symmetries=rotational("z"),
    )
