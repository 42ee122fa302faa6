"""Monitors and keyboards of the catalogue."""

from simtrack.objects.cad.builder import ModelBuilder, PartBuilder
from simtrack.objects.cad.designs.pieces import bar
from simtrack.objects.cad.materials import BLACK_STEEL, ELECTRONICS, SCREEN, SHELL, STEEL, Material
from simtrack.objects.shapes import box, cylinder, rounded_plate, side_prism

WHITE = ELECTRONICS.painted((222, 222, 220))


def _panel(p: PartBuilder, width: float, height: float, bottom: float, thick: float, case: Material, y: float = 0.0):
    """A flat screen whose face looks to -y."""
    p.block((-width / 2, y, bottom), (width / 2, y + thick, bottom + height), case)
    p.block(
        (-width / 2 + 0.012, y - 0.002, bottom + 0.014),
        (width / 2 - 0.012, y, bottom + height - 0.012),
        SCREEN,
        solid=False,
    )


def column_stand() -> ModelBuilder:
    """A 24-inch screen on a column with a flat foot."""
    b = ModelBuilder("monitor", "24-inch monitor on a column")
    p = b.part()
    p.add(rounded_plate((0.26, 0.22, 0.012), 0.02).at(y=0.02), BLACK_STEEL)
    p.block((-0.03, 0.05, 0.012), (0.03, 0.075, 0.34), BLACK_STEEL)
    p.block((-0.04, 0.02, 0.2), (0.04, 0.05, 0.34), ELECTRONICS)
    _panel(p, 0.54, 0.32, 0.13, 0.035, ELECTRONICS, -0.015)
    return b


def wide_v_foot() -> ModelBuilder:
    """An ultra-wide screen on two legs that form a V."""
    b = ModelBuilder("monitor", "ultra-wide monitor on a V-shaped foot")
    p = b.part()
    for s in (-1, 1):
        p.add(box((0.26, 0.03, 0.014)).at(-0.11, 0.0, 0.007).turned(yaw=s * 0.5 + (1.5708)).at(y=0.06), STEEL)
        p.add(
            box((0.2, 0.03, 0.014)).at(0.1).turned(yaw=s * 2.4 + 1.5708 if s < 0 else 1.5708 - 2.4).at(y=0.06, z=0.007),
            STEEL,
        )
    p.add(cylinder(0.025, 0.3, segments=16).at(y=0.06), STEEL)
    p.block((-0.05, 0.01, 0.22), (0.05, 0.06, 0.3), ELECTRONICS)
    _panel(p, 0.81, 0.34, 0.09, 0.04, ELECTRONICS, -0.03)
    return b


def two_legs() -> ModelBuilder:
    """A television on a leg at each end."""
    b = ModelBuilder("monitor", "television on two legs")
    p = b.part()
    _panel(p, 1.1, 0.63, 0.06, 0.05, ELECTRONICS, -0.025)
    for s in (-1, 1):
        for t in (-1, 1):
            p.beam((s * 0.42, t * 0.12, 0.003), (s * 0.4, 0.0, 0.07), 0.024, ELECTRONICS)
    return b


def all_in_one() -> ModelBuilder:
    """A thin white screen with a chin on a bent sheet."""
    b = ModelBuilder("monitor", "all-in-one computer with a chin")
    p = b.part()
    p.block((-0.1, -0.08, 0.0), (0.1, 0.12, 0.008), WHITE)
    p.beam((0.0, 0.1, 0.006), (0.0, 0.02, 0.22), (0.05, 0.05), WHITE)
    p.block((-0.27, 0.0, 0.09), (0.27, 0.02, 0.17), WHITE)
    _panel(p, 0.54, 0.32, 0.17, 0.02, WHITE)
    return b


def tube() -> ModelBuilder:
    """A cathode-ray tube: deep, on a low swivel foot."""
    b = ModelBuilder("monitor", "cathode-ray tube monitor")
    p, grey = b.part(), SHELL.painted((196, 192, 180))
    p.add(cylinder(0.13, 0.04, top=0.11, segments=24), grey)
    p.block((-0.2, -0.17, 0.04), (0.2, -0.08, 0.4), grey.painted((190, 186, 174)))
    body = side_prism([(-0.17, 0.06), (0.17, 0.12), (0.17, 0.32), (-0.17, 0.39)], 0.34).turned(yaw=1.5708)
    p.add(body.at(y=0.06), grey)
    p.block((-0.165, -0.174, 0.09), (0.165, -0.17, 0.36), SCREEN, solid=False)
    return b


def portrait() -> ModelBuilder:
    """Turned upright on a round foot."""
    b = ModelBuilder("monitor", "monitor turned upright on a round foot")
    p = b.part()
    p.add(cylinder(0.12, 0.012, segments=28).at(y=0.03), BLACK_STEEL)
    p.add(cylinder(0.02, 0.42, segments=14).at(y=0.05), BLACK_STEEL)
    p.block((-0.04, 0.01, 0.3), (0.04, 0.05, 0.4), ELECTRONICS)
    _panel(p, 0.33, 0.55, 0.08, 0.035, ELECTRONICS, -0.02)
    return b


def easel() -> ModelBuilder:
    """A portable screen leaning back on a strut."""
    b = ModelBuilder("monitor", "portable monitor that leans on a strut")
    p = b.part()
    p.add(box((0.36, 0.01, 0.23)).turned(roll=-0.3).at(y=0.0, z=0.116), ELECTRONICS)
    p.add(box((0.34, 0.002, 0.21)).turned(roll=-0.3).at(y=-0.0056, z=0.1145), SCREEN, ())
    p.beam((0.0, 0.11, 0.003), (0.0, 0.03, 0.16), (0.05, 0.05), ELECTRONICS)
    p.block((-0.17, -0.045, 0.0), (0.17, -0.025, 0.012), ELECTRONICS)
    return b


def dual() -> ModelBuilder:
    """Two screens on one crossbar."""
    b = ModelBuilder("monitor", "two screens on one stand")
    p = b.part()
    p.add(rounded_plate((0.34, 0.26, 0.014), 0.02).at(y=0.03), STEEL)
    bar(p, (0.0, 0.08, 0.02), (0.0, 0.08, 0.36), 0.02, STEEL)
    p.block((-0.3, 0.04, 0.28), (0.3, 0.08, 0.31), STEEL)
    for s in (-1, 1):
        x = s * 0.255
        p.block((x - 0.25, 0.0, 0.14), (x + 0.25, 0.04, 0.44), ELECTRONICS)
        p.block((x - 0.238, -0.002, 0.154), (x + 0.238, 0.0, 0.428), SCREEN, solid=False)
    return b


# ---------------------------------------------------------------------------------------------------------- keyboards


def keyboard(
    description: str,
    size: tuple[float, float],
    rows: int,
    columns: int,
    *,
    case: Material = ELECTRONICS,
    height: float = 0.018,
    slope: float = 0.0,
    rest: float = 0.0,
    split: bool = False,
    key: tuple[int, int, int] = (60, 62, 66),
) -> ModelBuilder:
    """A keyboard of (width, depth) with a grid of keys, `slope` higher at the rear, with a `rest` for the wrists."""
    b = ModelBuilder("keyboard", description)
    p, x, y = b.part(), size[0] / 2, size[1] / 2
    outline = [(-y, 0.0), (y, 0.0), (y, height + slope), (-y, height)]
    halves = ((-x, -0.02), (0.02, x)) if split else ((-x, x),)
    tilt = slope / (2 * y)
    for low, high in halves:
        p.add(side_prism(outline, high - low).turned(yaw=1.5708).at(x=(low + high) / 2), case)
        own = columns // len(halves)
        pitch, deep = (high - low - 0.012) / own, (2 * y - 0.012) / rows
        for r in range(rows):
            at = -y + 0.006 + deep * (r + 0.5)
            top = height + tilt * (at + y)
            p.block(
                (low + 0.008, at - 0.42 * deep, top - 0.004), (high - 0.008, at + 0.42 * deep, top + 0.003),
                case.painted(key), solid=r in (0, rows - 1),
            )  # fmt: skip
            for c in range(1, own):
                mid = low + 0.006 + pitch * c
                p.block(
                    (mid - 0.0012, at - 0.43 * deep, top - 0.003),
                    (mid + 0.0012, at + 0.43 * deep, top + 0.0034),
                    case,
                    solid=False,
                )
    if split:
        p.block((-0.021, -y + 0.02, 0.0), (0.021, y - 0.02, 0.006), case)
    if rest > 0.0:
        p.block((-x, -y - rest, 0.0), (x, -y, 0.6 * height), case)
    return b


KEYBOARDS = {
    "full": lambda: keyboard("full-size keyboard", (0.44, 0.135), 6, 21, slope=0.012),
    "tenkeyless": lambda: keyboard("keyboard without number block", (0.36, 0.14), 6, 17, slope=0.016, height=0.024),
    "compact": lambda: keyboard(
        "compact white keyboard", (0.28, 0.115), 5, 14, case=WHITE, key=(240, 240, 238), height=0.008
    ),
    "wrist_rest": lambda: keyboard("keyboard with a wrist rest", (0.45, 0.14), 6, 21, slope=0.01, rest=0.07),
    "split": lambda: keyboard("split keyboard", (0.42, 0.17), 5, 14, split=True, slope=0.008),
    "slim": lambda: keyboard("slim aluminium keyboard", (0.42, 0.115), 6, 18, case=STEEL, height=0.006, slope=0.004),
    "thick": lambda: keyboard(
        "heavy keyboard with high keys", (0.46, 0.17), 6, 21, case=SHELL, height=0.03, slope=0.018
    ),
    "number_pad": lambda: keyboard("number pad", (0.09, 0.13), 5, 4, slope=0.01),
}
"""Name -> design."""
MONITORS = (column_stand, wide_v_foot, two_legs, all_in_one, tube, portrait, easel, dual)
