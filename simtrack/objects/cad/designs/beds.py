"""Beds of the catalogue: eight constructions."""

from simtrack.objects.cad.builder import ModelBuilder, PartBuilder
from simtrack.objects.cad.designs.pieces import SIGNS, bar, carcass, drawer, square_legs
from simtrack.objects.cad.materials import BLACK_STEEL, FOAM, MATTRESS, OAK, PINE, TEXTILE, WALNUT, WHITE_BOARD
from simtrack.objects.shapes import rounded_plate


def _mattress(b: ModelBuilder, part: PartBuilder, width: float, length: float, top: float, thick: float) -> None:
    part.add(rounded_plate((width, length, thick), 0.05, chamfer=0.015).at(z=top - thick), MATTRESS)
    b.support(part, (0.0, 0.0, top), (width - 0.1, length - 0.1))


def _pillows(part: PartBuilder, xs: tuple[float, ...], rear: float, top: float) -> None:
    for x in xs:
        part.add(rounded_plate((0.55, 0.36, 0.11), 0.08, chamfer=0.04).at(x, rear - 0.22, top - 0.003), MATTRESS)


def corner_posts() -> ModelBuilder:
    """Four square posts, side rails, a board at the head and a lower one at the foot."""
    b = ModelBuilder("bed", "double bed on corner posts with head and foot boards")
    p, x, y = b.part(), 0.84, 1.04
    for sx, sy in SIGNS:
        high = 0.95 if sy > 0 else 0.55
        p.block((sx * x, sy * y, 0.0), (sx * (x - 0.07), sy * (y - 0.07), high), PINE)
    for s in (-1, 1):
        p.block((s * x, -y + 0.07, 0.22), (s * (x - 0.03), y - 0.07, 0.38), PINE)
    p.block((-x + 0.07, y - 0.05, 0.3), (x - 0.07, y - 0.02, 0.9), PINE)
    p.block((-x + 0.07, -y + 0.02, 0.22), (x - 0.07, -y + 0.05, 0.5), PINE)
    p.block((-x + 0.03, -y + 0.05, 0.27), (x - 0.03, y - 0.05, 0.30), PINE)
    _mattress(b, p, 1.6, 1.96, 0.48, 0.18)
    _pillows(p, (-0.4, 0.4), 0.96, 0.48)
    return b


def box_spring() -> ModelBuilder:
    """Two upholstered blocks on the floor before a padded headboard."""
    b = ModelBuilder("bed", "box-spring bed with a padded headboard")
    p = b.part()
    for s in (-1, 1):
        p.add(rounded_plate((0.9, 2.0, 0.3), 0.04).at(x=s * 0.45), FOAM)
    p.add(rounded_plate((1.9, 0.12, 1.15), 0.05).at(y=1.06), FOAM)
    _mattress(b, p, 1.8, 2.0, 0.56, 0.26)
    _pillows(p, (-0.45, 0.45), 0.98, 0.56)
    return b


def day_bed() -> ModelBuilder:
    """A narrow bed with boards on three sides: used from the side."""
    b = ModelBuilder("bed", "day bed with boards on three sides")
    p, x, y = b.part(), 1.04, 0.47
    p.block((-x, y - 0.03, 0.05), (x, y, 0.78), WHITE_BOARD)
    for s in (-1, 1):
        p.block((s * x, -y, 0.0), (s * (x - 0.03), y - 0.03, 0.68), WHITE_BOARD)
    p.block((-x + 0.03, -y, 0.14), (x - 0.03, -y + 0.025, 0.32), WHITE_BOARD)
    p.block((-x + 0.03, -y + 0.025, 0.22), (x - 0.03, y - 0.03, 0.25), WHITE_BOARD)
    p.add(rounded_plate((1.99, 0.88, 0.16), 0.05, chamfer=0.015).at(y=-0.015, z=0.25), MATTRESS)
    b.support(p, (0.0, -0.02, 0.41), (1.9, 0.75))
    return b


def bunk() -> ModelBuilder:
    """Two beds one above the other between four posts, with a ladder."""
    b = ModelBuilder("bed", "bunk bed with a ladder")
    p, x, y = b.part(), 0.49, 1.04
    square_legs(p, (2 * x, 2 * y), 1.65, 0.06, OAK)
    for level in (0.3, 1.15):
        for s in (-1, 1):
            p.block((s * x, -y + 0.06, level), (s * (x - 0.025), y - 0.06, level + 0.12), OAK)
            p.block((-x + 0.06, s * y, level), (x - 0.06, s * (y - 0.025), level + 0.25), OAK)
        p.block((-x + 0.025, -y + 0.025, level + 0.04), (x - 0.025, y - 0.025, level + 0.06), OAK)
        p.add(rounded_plate((0.9, 1.98, 0.14), 0.04).at(z=level + 0.06), MATTRESS)
        b.support(p, (0.0, 0.0, level + 0.2), (0.8, 1.85), 0.65 if level < 1 else float("inf"))
    for s in (-1, 1):
        p.block((s * 0.2 - 0.02, -y - 0.05, 0.0), (s * 0.2 + 0.02, -y, 1.5), OAK)
    for k in range(5):
        p.block((-0.18, -y - 0.045, 0.25 + 0.25 * k), (0.18, -y - 0.01, 0.28 + 0.25 * k), OAK)
    return b


def tubular() -> ModelBuilder:
    """A frame of round steel tubes with bars at head and foot."""
    b = ModelBuilder("bed", "single bed of steel tubes with bars at head and foot")
    p, x, y = b.part(), 0.48, 1.02
    for sy, high in ((-1, 0.65), (1, 0.95)):
        for sx in (-1, 1):
            bar(p, (sx * x, sy * y, 0.018), (sx * x, sy * y, high), 0.018, BLACK_STEEL)
        for z in (high, 0.32):
            bar(p, (-x, sy * y, z), (x, sy * y, z), 0.014, BLACK_STEEL)
        for k in range(5):
            at = -x + 2 * x * (k + 1) / 6
            bar(p, (at, sy * y, 0.32), (at, sy * y, high), 0.008, BLACK_STEEL)
    for sx in (-1, 1):
        p.block((sx * x - 0.015, -y, 0.28), (sx * x + 0.015, y, 0.33), BLACK_STEEL)
    for k in range(7):
        at = -y + 2 * y * (k + 1) / 8
        p.block((-x, at - 0.03, 0.31), (x, at + 0.03, 0.33), PINE)
    p.add(rounded_plate((0.92, 1.98, 0.17), 0.05, chamfer=0.015).at(z=0.33), MATTRESS)
    b.support(p, (0.0, 0.0, 0.5), (0.8, 1.85))
    return b


def platform() -> ModelBuilder:
    """A low platform wider than its mattress on a set-back plinth."""
    b = ModelBuilder("bed", "low platform bed on a set-back plinth")
    p = b.part()
    p.block((-0.75, -0.85, 0.0), (0.75, 0.85, 0.16), WALNUT)
    p.block((-1.0, -1.12, 0.16), (1.0, 1.12, 0.22), WALNUT)
    p.block((-1.0, 1.09, 0.22), (1.0, 1.12, 0.62), WALNUT)
    _mattress(b, p, 1.6, 2.0, 0.4, 0.18)
    _pillows(p, (0.0,), 0.98, 0.4)
    return b


def four_poster() -> ModelBuilder:
    """Tall posts joined by rails at the top."""
    b = ModelBuilder("bed", "four-poster bed")
    p, x, y = b.part(), 0.8, 1.05
    square_legs(p, (2 * x, 2 * y), 2.0, 0.05, BLACK_STEEL)
    for s in (-1, 1):
        for z in (0.28, 1.95):
            p.block((s * x, -y + 0.05, z), (s * (x - 0.04), y - 0.05, z + 0.05), BLACK_STEEL)
            p.block((-x + 0.05, s * y, z), (x - 0.05, s * (y - 0.04), z + 0.05), BLACK_STEEL)
    p.block((-x + 0.04, -y + 0.04, 0.3), (x - 0.04, y - 0.04, 0.33), PINE)
    p.add(rounded_plate((1.5, 2.0, 0.2), 0.05, chamfer=0.02).at(z=0.33), MATTRESS)
    b.support(p, (0.0, 0.0, 0.53), (1.4, 1.85), 1.4)
    p.add(rounded_plate((1.4, 0.5, 0.06), 0.05).at(y=-0.7, z=0.528), TEXTILE)
    return b


def storage() -> ModelBuilder:
    """A base with two drawers that open to the foot; bookcase headboard."""
    b = ModelBuilder("bed", "bed with drawers in its base and a bookcase at its head")
    p, x = b.part(), 0.72
    carcass(p, (-x, x), (-1.02, 1.0), (0.0, 0.34), 0.02, OAK)
    p.block((-0.01, -1.02, 0.02), (0.01, 0.98, 0.32), OAK)
    for k, span in enumerate(((-x + 0.02, -0.01), (0.01, x - 0.02))):
        drawer(b, f"drawer{k + 1}", span, (0.02, 0.32), (-1.02, -0.3), OAK, overlap=0.008)
    carcass(p, (-x, x), (1.0, 1.2), (0.0, 0.95), 0.02, OAK)
    p.block((-x + 0.02, 1.0, 0.6), (x - 0.02, 1.18, 0.62), OAK)
    b.hollow(p, (-x + 0.02, 1.0, 0.62), (x - 0.02, 1.18, 0.93))
    b.support(p, (0.0, 1.1, 0.95), (1.4, 0.18))
    p.add(rounded_plate((1.4, 1.98, 0.16), 0.05, chamfer=0.015).at(y=-0.02, z=0.34), MATTRESS)
    b.support(p, (0.0, -0.02, 0.5), (1.3, 1.85))
    for s in (-1, 1):
        p.add(rounded_plate((0.5, 0.34, 0.1), 0.08, chamfer=0.04).at(s * 0.33, 0.78, 0.497), MATTRESS)
    return b


VARIANTS = (corner_posts, box_spring, day_bed, bunk, tubular, platform, four_poster, storage)
