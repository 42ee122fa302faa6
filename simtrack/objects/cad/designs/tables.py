"""Tables of the catalogue: nine constructions."""

import numpy as np

from simtrack.objects.cad.builder import ModelBuilder
from simtrack.objects.cad.designs.pieces import bar, carcass, drawer, round_legs, square_legs
from simtrack.objects.cad.materials import BLACK_STEEL, GLASS, OAK, PINE, STEEL, WALNUT, WHITE_BOARD
from simtrack.objects.shapes import cylinder, rounded_plate


def corner_legs() -> ModelBuilder:
    """Square legs flush with the corners, an apron between them."""
    b = ModelBuilder("table", "dining table with square corner legs and an apron")
    p, x, y, h = b.part(), 0.8, 0.45, 0.75
    square_legs(p, (2 * x, 2 * y), h - 0.03, 0.07, OAK)
    p.block((-x, -y, h - 0.03), (x, y, h), OAK)
    for s in (-1, 1):
        p.block((-x + 0.07, s * (y - 0.01), h - 0.12), (x - 0.07, s * (y - 0.03), h - 0.03), OAK)
        p.block((s * (x - 0.01), -y + 0.07, h - 0.12), (s * (x - 0.03), y - 0.07, h - 0.03), OAK)
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    return b


def pedestal() -> ModelBuilder:
    """A round top on one column with a disc for a foot."""
    b = ModelBuilder("table", "round table on one column")
    p, r, h = b.part(), 0.5, 0.73
    p.add(cylinder(0.32, 0.03, top=0.28, segments=32), STEEL)
    p.add(cylinder(0.04, h - 0.05, segments=16).at(z=0.02), STEEL)
    p.add(cylinder(r, 0.025, segments=40).at(z=h - 0.025), WHITE_BOARD)
    b.support(p, (0.0, 0.0, h), (1.38 * r, 1.38 * r))
    return b


def trestle() -> ModelBuilder:
    """A loose plate on two trestles."""
    b = ModelBuilder("table", "plate on two trestles")
    p, h = b.part(), 0.74
    for s in (-1, 1):
        at = s * 0.55
        for t in (-1, 1):
            for u in (-1, 1):
                p.beam((at + u * 0.12, t * 0.3, 0.002), (at, t * 0.26, h - 0.06), 0.035, PINE)
            p.block((at - 0.09, t * 0.3 - 0.015, 0.22), (at + 0.09, t * 0.3 + 0.012, 0.25), PINE)
        p.block((at - 0.03, -0.33, h - 0.06), (at + 0.03, 0.33, h - 0.02), PINE)
    p.block((-0.85, -0.4, h - 0.02), (0.85, 0.4, h), PINE)
    b.support(p, (0.0, 0.0, h), (1.7, 0.8))
    return b


def panel_ends() -> ModelBuilder:
    """Two full boards for legs and one across at the rear."""
    b = ModelBuilder("table", "writing table on two boards")
    p, x, y, h = b.part(), 0.65, 0.33, 0.74
    for s in (-1, 1):
        p.block((s * x, -y, 0.0), (s * (x - 0.025), y, h - 0.025), WHITE_BOARD)
    p.block((-x + 0.025, y - 0.1, 0.25), (x - 0.025, y - 0.08, h - 0.025), WHITE_BOARD)
    p.block((-x, -y, h - 0.025), (x, y, h), WHITE_BOARD)
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    return b


def three_legs() -> ModelBuilder:
    """A low round top on three splayed legs."""
    b = ModelBuilder("table", "low round table on three splayed legs")
    p, r, h = b.part(), 0.4, 0.45
    p.add(cylinder(r, 0.022, segments=36).at(z=h - 0.022), WALNUT)
    for k in range(3):
        a = 2 * np.pi * k / 3 + np.pi / 2
        p.beam(
            (0.36 * np.cos(a), 0.36 * np.sin(a), 0.002),
            (0.22 * np.cos(a), 0.22 * np.sin(a), h - 0.024),
            (0.025, 0.045),
            WALNUT,
        )
    b.support(p, (0.0, 0.0, h), (1.38 * r, 1.38 * r))
    return b


def sled() -> ModelBuilder:
    """A glass plate on two closed frames of flat steel."""
    b = ModelBuilder("table", "glass plate on two closed steel frames")
    p, h = b.part(), 0.74
    for s in (-1, 1):
        x0, x1 = s * 0.6, s * 0.66
        p.block((x0, -0.38, 0.0), (x1, 0.38, 0.03), BLACK_STEEL)
        p.block((x0, -0.38, h - 0.042), (x1, 0.38, h - 0.012), BLACK_STEEL)
        for t in (-1, 1):
            p.block((x0, t * 0.38, 0.03), (x1, t * 0.35, h - 0.042), BLACK_STEEL)
    p.block((-0.85, -0.425, h - 0.012), (0.85, 0.425, h), GLASS)
    b.support(p, (0.0, 0.0, h), (1.7, 0.85))
    return b


def desk() -> ModelBuilder:
    """A desk with three drawers on its right."""
    b = ModelBuilder("table", "desk with three drawers")
    p, x, y, h = b.part(), 0.7, 0.35, 0.75
    p.block((-x, -y, h - 0.03), (x, y, h), OAK)
    p.block((-x, -y + 0.02, 0.0), (-x + 0.03, y, h - 0.03), OAK)
    carcass(p, (x - 0.42, x), (-y + 0.04, y), (0.0, h - 0.03), 0.018, OAK)
    b.support(p, (-0.05, 0.0, h), (1.3, 0.7))
    pitch = (h - 0.03 - 0.036) / 3
    for k in range(3):
        z = 0.018 + pitch * k
        if k:
            p.block((x - 0.402, -y + 0.04, z - 0.006), (x - 0.018, y - 0.018, z + 0.006), OAK)
        span = (z + 0.006 * (k > 0), z + pitch - 0.006 * (k < 2))
        drawer(b, f"drawer{k + 1}", (x - 0.402, x - 0.018), span, (-y + 0.04, y - 0.03), OAK, overlap=0.004)
    p.block((-x + 0.03, y - 0.03, 0.35), (x - 0.42, y - 0.012, h - 0.03), OAK)
    return b


def coffee() -> ModelBuilder:
    """Low, with a second board below the top."""
    b = ModelBuilder("table", "coffee table with a shelf")
    p, x, y, h = b.part(), 0.55, 0.3, 0.42
    round_legs(p, (2 * x - 0.03, 2 * y - 0.03), h - 0.025, 0.02, PINE)
    p.add(rounded_plate((2 * x, 2 * y, 0.025), 0.03).at(z=h - 0.025), PINE)
    p.block((-x + 0.03, -y + 0.03, 0.14), (x - 0.03, y - 0.03, 0.155), PINE)
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    b.support(p, (0.0, 0.0, 0.155), (2 * x - 0.12, 2 * y - 0.12), h - 0.18)
    return b


def star_foot() -> ModelBuilder:
    """A square bistro top on a tube with four flat feet."""
    b = ModelBuilder("table", "square bistro table with a star foot")
    p, h = b.part(), 0.76
    foot = rounded_plate((0.34, 0.06, 0.025), 0.01).at(x=0.17)
    for k in range(4):
        p.add(foot.turned(yaw=np.pi / 2 * k + np.pi / 4), BLACK_STEEL)
    bar(p, (0.0, 0.0, 0.04), (0.0, 0.0, h - 0.03), 0.035, BLACK_STEEL)
    p.add(rounded_plate((0.7, 0.7, 0.028), 0.03).at(z=h - 0.028), WALNUT)
    b.support(p, (0.0, 0.0, h), (0.68, 0.68))
    return b


VARIANTS = (corner_legs, pedestal, trestle, panel_ends, three_legs, sled, desk, coffee, star_foot)
