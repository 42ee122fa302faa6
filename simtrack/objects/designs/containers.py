"""Open-topped containers. Hollow in physics too: their collision parts are a floor and walls."""

import numpy as np

from simtrack.objects.model import half_turns
from simtrack.objects.shapes import (
    Color,
    Design,
    Solid,
    box,
    minus,
    plate,
    rounded_plate,
    rounded_rectangle,
    side_prism,
    tapered,
    union,
)

KLT_BLUE: Color = (0, 84, 159)
BIN_RED: Color = (196, 32, 38)
LABEL: Color = (240, 240, 232)
INK: Color = (40, 40, 44)


def klt3147() -> Design:
    """Small load carrier 300 x 200 x 147 mm after VDA 4500 (KLT 3147): tapered tub, stepped foot, rim, ribs, grips.

    Built from parts that come in pairs about z, so that half a turn maps it onto itself.
    """
    length, width, height, wall = 0.300, 0.200, 0.147, 0.003
    tub = tapered(
        [
            (rounded_rectangle(length - 0.044, width - 0.044, 0.012), 0.0),
            (rounded_rectangle(length - 0.044, width - 0.044, 0.012), 0.010),
        ],
        KLT_BLUE,
    ) + tapered(
        [
            (rounded_rectangle(length - 0.028, width - 0.028, 0.014), 0.008),
            (rounded_rectangle(length - 0.018, width - 0.018, 0.014), height - 0.001),
        ],
        KLT_BLUE,
    )
    rim = rounded_plate((length, width, 0.010), 0.012, KLT_BLUE).at(z=height - 0.010)
    collar = rounded_plate((length - 0.002, width - 0.002, 0.005), 0.012, KLT_BLUE).at(z=height - 0.042)
    base_ring = rounded_plate((length - 0.012, width - 0.012, 0.006), 0.014, KLT_BLUE).at(z=0.008)
    ribs = [plate((0.004, width - 0.003, 0.102), KLT_BLUE).at(x=x, z=0.008) for x in (-0.120, -0.060, 0.060, 0.120)]
    ribs += [plate((length - 0.003, 0.004, 0.102), KLT_BLUE).at(y=y, z=0.008) for y in (-0.075, -0.046, 0.046, 0.075)]
    short_ribs = [plate((0.004, width - 0.003, 0.030), KLT_BLUE).at(x=x, z=height - 0.038) for x in (-0.10, 0.10)]
    inside = tapered(
        [
            (rounded_rectangle(length - 0.028 - 2 * wall, width - 0.028 - 2 * wall, 0.011), 0.012),
            (rounded_rectangle(length - 0.018 - 2 * wall, width - 0.018 - 2 * wall, 0.011), height + 0.001),
        ],
        (0, 74, 145),
    )
    grip = box((length + 0.1, 0.080, 0.024), (0, 64, 125)).at(z=height - 0.027)
    grip_frame = plate((length - 0.001, 0.092, 0.040), KLT_BLUE).at(z=height - 0.044)
    underside = minus(
        plate((length - 0.056, width - 0.056, 0.006), (0, 64, 125)).at(z=-0.001),
        plate((length, 0.006, 0.01), KLT_BLUE),
        plate((0.006, width, 0.01), KLT_BLUE),
    )
    label_holder = plate((0.090, width - 0.004, 0.060), LABEL).at(z=0.030)
    body = minus(
        union(tub, rim, collar, base_ring, grip_frame, label_holder, *ribs, *short_ribs), inside, grip, underside
    )
    walls = [plate((0.012, width - 0.008, height), KLT_BLUE).at(x=s * (0.5 * length - 0.0085)) for s in (-1, 1)]
    walls += [plate((length - 0.008, 0.012, height), KLT_BLUE).at(y=s * (0.5 * width - 0.0085)) for s in (-1, 1)]
    floor = plate((length - 0.044, width - 0.044, 0.012), KLT_BLUE)
    return Design(
        description="small load carrier KLT 3147, 300 x 200 x 147 mm",
        semantic_class="small-load-carrier",
        body=body,
        collision=(floor, *(w & plate((1, 1, 0.147 - 0.008)).at(z=0.008) for w in walls)),
        mass=0.57,
        friction=0.4,
        faces=14124,
        symmetries=half_turns("z"),
    )


def materialbox() -> Design:
    """Open-fronted storage bin for small parts, 170 x 120 x 80 mm; +x is the low front with the label."""
    length, width, height, wall = 0.170, 0.120, 0.080, 0.003
    side = [
        (-0.5 * length, 0.0),
        (0.5 * length - 0.014, 0.0),
        (0.5 * length, 0.036),
        (0.5 * length - 0.004, 0.036),
        (0.5 * length - 0.052, height),
        (-0.5 * length, height),
    ]
    front = [
        (0.5 * length - 0.020, 0.0),
        (0.5 * length - 0.014, 0.0),
        (0.5 * length, 0.036),
        (0.5 * length - 0.006, 0.036),
    ]
    hollow = [
        (-0.5 * length + wall, wall),
        (0.5 * length - 0.016, wall),
        (0.5 * length - 0.004, 0.037),
        (0.5 * length - 0.004, height + 0.01),
        (-0.5 * length + wall, height + 0.01),
    ]
    shell = side_prism(side, width - 0.008, BIN_RED)
    rim = side_prism(
        [
            (-0.5 * length, height - 0.008),
            (0.5 * length - 0.046, height - 0.008),
            (0.5 * length - 0.052, height),
            (-0.5 * length, height),
        ],
        width,
        BIN_RED,
    )
    lip = box((0.010, width, 0.008), BIN_RED).at(x=0.5 * length - 0.005, z=0.034)
    feet = [plate((length - 0.030, 0.008, 0.004), BIN_RED).at(x=-0.01, y=s * 0.045) for s in (-1, 1)]
    label = (
        box((0.003, 0.060, 0.020), LABEL).turned(pitch=np.arctan2(0.014, 0.036)).at(x=0.5 * length - 0.0065, z=0.017)
    )
    text = [
        box((0.004, w, 0.003), INK)
        .turned(pitch=np.arctan2(0.014, 0.036))
        .at(x=0.5 * length - 0.0065 + dz * 0.39, z=0.017 + dz)
        for w, dz in ((0.044, 0.0045), (0.036, -0.0005), (0.040, -0.0055))
    ]
    ribs = [plate((0.003, width - 0.002, height - 0.012), BIN_RED).at(x=x, z=0.002) for x in (-0.06, -0.02)]
    back_grip = box((0.020, 0.050, 0.008), BIN_RED).at(x=-0.5 * length - 0.006, z=height - 0.004)
    inside = side_prism(hollow, width - 0.008 - 2 * wall, (170, 24, 30))
    body: Solid = union(shell, rim, lip, label, *text, *ribs, back_grip) - inside
    body = union(body.at(z=0.003), *feet)
    return Design(
        description="storage bin for small parts with a low front, 170 x 120 x 80 mm",
        semantic_class="parts-box",
        body=body,
        collision=(
            plate((length - 0.014, width - 0.006, 0.006), BIN_RED).at(x=-0.007),
            plate((0.006, width - 0.002, height + 0.003), BIN_RED).at(x=-0.5 * length + 0.003),
            side_prism(front, width - 0.002, BIN_RED).at(z=0.003),
            *(side_prism(side, 0.006, BIN_RED).at(y=s * (0.5 * width - 0.004), z=0.003) for s in (-1, 1)),
        ),
        mass=0.16,
        friction=0.4,
        faces=13616,
    )
