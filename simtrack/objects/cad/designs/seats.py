"""Chairs and sofas of the catalogue."""

import itertools

import numpy as np

from simtrack.objects.cad.builder import ModelBuilder, PartBuilder
from simtrack.objects.cad.designs.pieces import bar, round_legs, square_legs
from simtrack.objects.cad.materials import (
    BLACK_STEEL,
    FOAM,
    LEATHER,
    OAK,
    PINE,
    PLASTIC,
    SHELL,
    STEEL,
    TEXTILE,
    WALNUT,
    Material,
)
from simtrack.objects.shapes import box, cylinder, rounded_plate


def slat_back() -> ModelBuilder:
    """Square legs, the rear ones run up and carry three slats."""
    b = ModelBuilder("chair", "wooden chair with a slatted back")
    p, x, y, seat = b.part(), 0.22, 0.22, 0.45
    square_legs(p, (2 * x, 2 * y), seat - 0.02, 0.035, OAK)
    p.block((-x, -y, seat - 0.02), (x, y, seat), OAK)
    for s in (-1, 1):
        p.block((s * x, y - 0.03, seat), (s * (x - 0.03), y, 0.92), OAK)
    for k in range(3):
        p.block((-x + 0.03, y - 0.022, 0.56 + 0.12 * k), (x - 0.03, y - 0.008, 0.63 + 0.12 * k), OAK)
    b.support(p, (0.0, -0.015, seat), (2 * x, 2 * y - 0.03))
    return b


def upholstered() -> ModelBuilder:
    """A padded seat and a padded closed back on tapered round legs."""
    b = ModelBuilder("chair", "upholstered dining chair")
    p, x, y, seat = b.part(), 0.24, 0.25, 0.48
    round_legs(p, (2 * x - 0.04, 2 * y - 0.04), seat - 0.09, 0.02, WALNUT, foot=0.6)
    p.add(rounded_plate((2 * x, 2 * y, 0.1), 0.05, chamfer=0.02).at(z=seat - 0.1), FOAM)
    p.add(rounded_plate((2 * x, 0.09, 0.5), 0.04).at(y=y - 0.045, z=seat - 0.04), FOAM)
    b.support(p, (0.0, -0.04, seat), (0.4, 0.36))
    return b


def arm_chair() -> ModelBuilder:
    """A wooden frame with arm rests and a panel for a back."""
    b = ModelBuilder("chair", "wooden chair with arm rests")
    p, x, y, seat = b.part(), 0.28, 0.26, 0.44
    square_legs(p, (2 * x, 2 * y), 0.66, 0.04, PINE)
    for s in (-1, 1):
        p.block((s * (x + 0.01), -y - 0.01, 0.66), (s * (x - 0.05), y, 0.685), PINE)
    p.block((-x + 0.04, -y, seat - 0.025), (x - 0.04, y, seat), PINE)
    p.block((-x + 0.04, y - 0.035, seat), (x - 0.04, y - 0.015, 0.9), PINE)
    for s in (-1, 1):
        p.block((s * (x - 0.04), y - 0.04, 0.66), (s * x, y, 0.9), PINE)
    p.add(rounded_plate((0.46, 0.42, 0.04), 0.03).at(y=-0.03, z=seat), TEXTILE)
    b.support(p, (0.0, -0.03, seat + 0.04), (0.42, 0.38))
    return b


def swivel() -> ModelBuilder:
    """A seat that turns on a five-armed foot with castors."""
    b = ModelBuilder("chair", "swivel chair on a five-armed foot")
    foot = b.part("foot")
    for k in range(5):
        a = 2 * np.pi * k / 5 - np.pi / 2
        foot.add(box((0.3, 0.045, 0.03)).at(0.15, 0.0, 0.085).turned(yaw=a), PLASTIC)
        foot.add(cylinder(0.03, 0.07, segments=12).at(0.27 * np.cos(a), 0.27 * np.sin(a)), PLASTIC)
    foot.add(cylinder(0.03, 0.28, segments=16).at(z=0.08), STEEL)
    seat = b.part("seat")
    seat.add(rounded_plate((0.5, 0.48, 0.08), 0.06, chamfer=0.015).at(z=0.43), TEXTILE)
    seat.add(cylinder(0.05, 0.06, segments=16).at(z=0.37), PLASTIC)
    seat.block((-0.03, 0.18, 0.4), (0.03, 0.29, 0.43), PLASTIC)
    seat.block((-0.03, 0.26, 0.43), (0.03, 0.29, 0.7), PLASTIC)
    seat.add(rounded_plate((0.44, 0.05, 0.5), 0.02).at(y=0.255, z=0.58), TEXTILE)
    for s in (-1, 1):
        seat.block((s * 0.24, -0.02, 0.46), (s * 0.27, 0.03, 0.66), PLASTIC)
        seat.block((s * 0.225, -0.14, 0.66), (s * 0.285, 0.12, 0.69), PLASTIC)
    b.support(seat, (0.0, -0.02, 0.51), (0.4, 0.38))
    b.joint("continuous", seat, (0.0, 0.0, 0.37), (0.0, 0.0, 1.0), (-np.pi, np.pi), 1.5)
    return b


def shell_sled() -> ModelBuilder:
    """A one-piece plastic shell on two bent rods."""
    b = ModelBuilder("chair", "plastic shell on a sled of rods")
    p, seat = b.part(), 0.45
    for s in (-1, 1):
        at = s * 0.2
        points = [(at, -0.2, 0.4), (at, -0.23, 0.012), (at, 0.23, 0.012), (at, 0.18, 0.4)]
        for u, v in itertools.pairwise(points):
            bar(p, u, v, 0.011, STEEL)
    for y in (-0.19, 0.17):
        bar(p, (-0.2, y, 0.41), (0.2, y, 0.41), 0.011, STEEL)
    p.add(rounded_plate((0.46, 0.44, 0.03), 0.08, chamfer=0.008).at(z=seat - 0.03), SHELL)
    p.add(rounded_plate((0.44, 0.42, 0.018), 0.1).turned(roll=1.4).at(y=0.215, z=0.6), SHELL)
    b.support(p, (0.0, -0.03, seat), (0.36, 0.32))
    return b


def cantilever() -> ModelBuilder:
    """A tube bent to a C: no rear legs."""
    b = ModelBuilder("chair", "cantilever chair of bent tube")
    p = b.part()
    for s in (-1, 1):
        at = s * 0.23
        points = [(at, 0.24, 0.014), (at, -0.24, 0.014), (at, -0.23, 0.44), (at, 0.2, 0.44), (at, 0.27, 0.85)]
        for u, v in itertools.pairwise(points):
            bar(p, u, v, 0.014, STEEL)
    bar(p, (-0.23, 0.24, 0.014), (0.23, 0.24, 0.014), 0.014, STEEL)
    p.block((-0.23, -0.22, 0.445), (0.23, 0.19, 0.465), LEATHER)
    p.add(box((0.46, 0.015, 0.26)).turned(roll=-0.17).at(y=0.245, z=0.71), LEATHER)
    b.support(p, (0.0, -0.02, 0.465), (0.4, 0.36))
    return b


def folding() -> ModelBuilder:
    """Two crossed pairs of legs."""
    b = ModelBuilder("chair", "folding chair with crossed legs")
    p = b.part()
    for s in (-1, 1):
        p.beam((s * 0.21, -0.24, 0.002), (s * 0.21, 0.2, 0.82), 0.026, BLACK_STEEL)
        p.beam((s * 0.18, 0.24, 0.002), (s * 0.18, -0.16, 0.44), 0.026, BLACK_STEEL)
    p.block((-0.22, -0.2, 0.44), (0.22, 0.18, 0.46), PLASTIC)
    p.block((-0.21, 0.14, 0.62), (0.21, 0.165, 0.82), PLASTIC)
    b.support(p, (0.0, -0.04, 0.46), (0.4, 0.3))
    return b


def bar_stool() -> ModelBuilder:
    """A high round seat with a low rail behind it and a foot ring."""
    b = ModelBuilder("chair", "bar chair with a foot rail")
    p, seat = b.part(), 0.74
    round_legs(p, (0.32, 0.32), seat - 0.03, 0.016, BLACK_STEEL, splay=0.06)
    p.add(cylinder(0.2, 0.035, segments=28).at(z=seat - 0.035), WALNUT)
    for s in (-1, 1):
        for a, c in (
            ((s * 0.178, -0.178, 0.25), (s * 0.178, 0.178, 0.25)),
            ((-0.178, s * 0.178, 0.25), (0.178, s * 0.178, 0.25)),
        ):
            bar(p, a, c, 0.01, BLACK_STEEL)
        bar(p, (s * 0.13, 0.13, seat - 0.02), (s * 0.13, 0.17, seat + 0.22), 0.01, BLACK_STEEL)
    p.block((-0.15, 0.155, seat + 0.16), (0.15, 0.18, seat + 0.24), WALNUT)
    b.support(p, (0.0, -0.02, seat), (0.26, 0.24))
    return b


# ------------------------------------------------------------------------------------------------------------- sofas


def _seats(
    b: ModelBuilder, p: PartBuilder, x: float, y: tuple[float, float], z: float, thick: float, count: int, m: Material
):
    """Seat cushions side by side on z."""
    pitch = 2 * x / count
    for k in range(count):
        at = -x + pitch * (k + 0.5)
        size = (pitch - 0.01, y[1] - y[0], thick)
        p.add(rounded_plate(size, 0.05, chamfer=0.02).at(at, (y[0] + y[1]) / 2, z), m)
        b.support(p, (at, (y[0] + y[1]) / 2 - 0.08, z + thick), (pitch - 0.15, y[1] - y[0] - 0.2))


def block_sofa() -> ModelBuilder:
    """Arms as high as the back is low, closed to the floor."""
    b = ModelBuilder("sofa", "three-seater closed to the floor with square arms")
    p, x, y = b.part(), 1.05, 0.45
    p.block((-x, -y, 0.0), (x, y, 0.24), FOAM)
    p.block((-x, y - 0.2, 0.24), (x, y, 0.82), FOAM)
    for s in (-1, 1):
        p.block((s * x, -y, 0.24), (s * (x - 0.2), y - 0.2, 0.6), FOAM)
    _seats(b, p, x - 0.2, (-y, y - 0.2), 0.24, 0.2, 3, FOAM.painted((120, 130, 146)))
    return b


def slender() -> ModelBuilder:
    """A thin frame on high tapered legs, two seats."""
    b = ModelBuilder("sofa", "two-seater on high legs")
    p, x, y = b.part(), 0.8, 0.4
    round_legs(p, (2 * x - 0.1, 2 * y - 0.1), 0.2, 0.025, WALNUT, splay=0.03, foot=0.6)
    p.block((-x, -y, 0.2), (x, y, 0.28), WALNUT)
    p.add(rounded_plate((2 * x, 0.16, 0.5), 0.06).at(y=y - 0.08, z=0.279), TEXTILE)
    for s in (-1, 1):
        p.add(rounded_plate((0.09, 2 * y - 0.17, 0.32), 0.04).at(s * (x - 0.045), -0.08, 0.279), TEXTILE)
    _seats(b, p, x - 0.09, (-y + 0.02, y - 0.17), 0.279, 0.15, 2, TEXTILE)
    return b


def chaise() -> ModelBuilder:
    """L-shaped: the left seat runs on forwards."""
    b = ModelBuilder("sofa", "corner sofa with a long seat on its left")
    p, x, y = b.part(), 1.2, 0.45
    p.block((-x, -y, 0.04), (x, y, 0.25), FOAM)
    p.block((-x, -y - 0.65, 0.04), (-x + 0.85, -y, 0.25), FOAM)
    for sx, sy in ((-1, 0.4), (1, 0.4), (1, -0.4), (-1, -1.05)):
        p.block((sx * (x - 0.05), sy, 0.0), (sx * (x - 0.12), sy - 0.03, 0.04), BLACK_STEEL)
    p.block((-x, y - 0.22, 0.25), (x, y, 0.78), FOAM)
    p.block((x - 0.18, -y, 0.25), (x, y - 0.22, 0.58), FOAM)
    p.add(rounded_plate((0.85, 1.32, 0.19), 0.05, chamfer=0.02).at(-x + 0.425, -0.435, 0.249), FOAM)
    b.support(p, (-x + 0.43, -0.4, 0.439), (0.6, 1.0))
    p.add(rounded_plate((1.36, 0.67, 0.19), 0.05, chamfer=0.02).at(0.335, -0.115, 0.249), FOAM)
    b.support(p, (0.33, -0.15, 0.439), (1.1, 0.45))
    return b


def rolled_arms() -> ModelBuilder:
    """Leather, arms that are rolls, a buttoned back."""
    b = ModelBuilder("sofa", "leather sofa with rolled arms")
    p, x, y = b.part(), 0.95, 0.45
    for sx in (-1, 1):
        for sy in (-1, 1):
            p.add(cylinder(0.03, 0.1, top=0.04, segments=12).at(sx * (x - 0.08), sy * (y - 0.08)), WALNUT)
        p.block((sx * x, -y, 0.09), (sx * (x - 0.16), y - 0.1, 0.5), LEATHER)
        p.add(
            cylinder(0.12, 2 * y - 0.1, segments=20).turned(roll=np.pi / 2).at(sx * (x - 0.08), y - 0.1, 0.54), LEATHER
        )
    p.block((-x + 0.16, -y, 0.09), (x - 0.16, y, 0.28), LEATHER)
    p.add(rounded_plate((2 * x, 0.2, 0.7), 0.08).at(y=y - 0.1, z=0.09), LEATHER)
    _seats(b, p, x - 0.16, (-y, y - 0.2), 0.279, 0.16, 2, LEATHER)
    return b


def futon() -> ModelBuilder:
    """Slats that fold, a thin mattress over seat and back, no arms."""
    b = ModelBuilder("sofa", "folding sofa of slats without arms")
    p, x = b.part(), 0.95
    square_legs(p, (2 * x, 0.8), 0.26, 0.06, PINE)
    p.block((-x, -0.4, 0.26), (x, 0.4, 0.3), PINE)
    p.add(box((2 * x, 0.03, 0.6)).turned(roll=-0.25).at(y=0.43, z=0.6), PINE)
    p.block((-x, 0.33, 0.29), (x, 0.4, 0.4), PINE)
    p.add(rounded_plate((2 * x, 0.72, 0.12), 0.04).at(y=-0.04, z=0.299), TEXTILE)
    p.add(rounded_plate((2 * x, 0.11, 0.5), 0.04).turned(roll=-0.25).at(y=0.31, z=0.4), TEXTILE)
    b.support(p, (0.0, -0.12, 0.419), (1.7, 0.45))
    return b


def bench_seat() -> ModelBuilder:
    """A bench with a wooden back and loose cushions."""
    b = ModelBuilder("sofa", "wooden settle with a cushion")
    p, x, y = b.part(), 0.75, 0.3
    for s in (-1, 1):
        p.block((s * x, -y, 0.0), (s * (x - 0.04), y, 0.62), OAK)
    p.block((-x + 0.04, -y, 0.36), (x - 0.04, y, 0.4), OAK)
    p.block((-x + 0.04, y - 0.03, 0.4), (x - 0.04, y, 0.95), OAK)
    p.add(rounded_plate((2 * x - 0.1, 2 * y - 0.06, 0.08), 0.03, chamfer=0.01).at(y=-0.02, z=0.399), TEXTILE)
    b.support(p, (0.0, -0.05, 0.479), (1.2, 0.36))
    return b


def tub() -> ModelBuilder:
    """A single seat in a wrap of even height."""
    b = ModelBuilder("sofa", "single tub seat")
    p = b.part()
    p.add(rounded_plate((0.82, 0.8, 0.36), 0.18).at(z=0.04), FOAM)
    for s in (-1, 1):
        p.add(rounded_plate((0.15, 0.74, 0.64), 0.07).at(s * 0.36, 0.02, 0.06), FOAM)
        p.block((s * 0.2, -0.3, 0.0), (s * 0.26, 0.3, 0.045), BLACK_STEEL)
    p.add(rounded_plate((0.86, 0.15, 0.64), 0.07).at(y=0.34, z=0.06), FOAM)
    b.support(p, (0.0, -0.06, 0.4), (0.42, 0.45))
    return b


def modular() -> ModelBuilder:
    """Three cubes with back cushions of different heights, no arms."""
    b = ModelBuilder("sofa", "modular sofa of three cubes without arms")
    p = b.part()
    for k, high in enumerate((0.75, 0.66, 0.75)):
        at = -0.78 + 0.78 * k
        p.add(rounded_plate((0.775, 0.92, 0.4), 0.06, chamfer=0.02).at(at), TEXTILE)
        p.add(rounded_plate((0.7, 0.22, high - 0.38), 0.08, chamfer=0.04).at(at, 0.33, 0.399), TEXTILE)
        b.support(p, (at, -0.14, 0.4), (0.55, 0.5))
    p.block((-1.0, -0.3, 0.1), (1.0, 0.3, 0.3), TEXTILE, solid=False)
    return b


CHAIRS = (slat_back, upholstered, arm_chair, swivel, shell_sled, cantilever, folding, bar_stool)
SOFAS = (block_sofa, slender, chaise, rolled_arms, futon, bench_seat, tub, modular)
