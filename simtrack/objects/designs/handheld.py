"""Pistol-grip tools with a battery: a slim screwdriver and a drill."""

import numpy as np

from simtrack.objects.shapes import (
    Color,
    Design,
    Solid,
    both_sides,
    box,
    chain,
    cylinder,
    hull,
    minus,
    plate,
    ring_of,
    rounded_box,
    rounded_plate,
    sphere,
    turned_part,
    union,
)

GREEN: Color = (20, 110, 72)
RUBBER: Color = (36, 38, 42)
STEEL: Color = (178, 180, 184)
DARK_STEEL: Color = (92, 95, 100)
RED: Color = (205, 32, 34)
YELLOW: Color = (245, 186, 20)
LIGHT: Color = (250, 246, 220)
WHITE: Color = (238, 238, 236)


def screwdriver() -> Design:
    """Cordless pistol-grip screwdriver, 224 x 63 x 163 mm, standing on its battery foot; +x is the bit.

    Slim and rounded with a hexagonal bit, unlike the drill: no chuck, a short nose, half the volume.
    """
    height, along_x = 0.132, {"pitch": np.pi / 2}
    housing = turned_part(
        [(0.012, -0.092), (0.021, -0.086), (0.026, -0.070), (0.027, -0.030), (0.025, 0.010), (0.022, 0.034)], GREEN, 24
    )
    cap = turned_part([(0.015, -0.094), (0.023, -0.088), (0.0275, -0.074), (0.0275, -0.066)], RUBBER, 24)
    nose = turned_part([(0.0225, 0.028), (0.0225, 0.040), (0.015, 0.062), (0.013, 0.070)], RUBBER, 24)
    ring = turned_part([(0.024, 0.014), (0.025, 0.016), (0.024, 0.028), (0.023, 0.030)], RED, 24)
    collar = turned_part([(0.010, 0.068), (0.010, 0.084), (0.008, 0.088)], STEEL, 18)
    bit = cylinder(0.0042, 0.034, STEEL, segments=6).at(z=0.084) + cylinder(
        0.003, 0.012, DARK_STEEL, top=0.001, segments=8
    ).at(z=0.116)
    barrel = union(housing, cap, ring, nose, collar, bit).turned(**along_x).at(z=height)
    body = union(barrel, _screwdriver_handle(height), _vents(height, -0.050, 0.027, 4, 0.009))
    lamp = sphere(0.005, LIGHT, 12).at(x=0.052, z=height - 0.019)
    slider = rounded_plate((0.018, 0.012, 0.006), 0.004, RED, segments=12).at(x=-0.030, z=height + 0.0245)
    return Design(
        description="cordless pistol-grip screwdriver with a hexagonal bit",
        semantic_class="screwdriver",
        body=union(body, lamp, slider),
        collision=(
            cylinder(0.027, 0.126, GREEN, segments=12).turned(**along_x).at(x=-0.092, z=height),
            cylinder(0.022, 0.036, GREEN, top=0.013, segments=12).turned(**along_x).at(x=0.034, z=height),
            cylinder(0.009, 0.058, STEEL, top=0.003, segments=8).turned(**along_x).at(x=0.070, z=height),
            hull(
                GREEN,
                box((0.036, 0.036, 0.004)).at(x=-0.040, z=height - 0.012),
                box((0.038, 0.036, 0.004)).at(x=-0.062, z=0.030),
            ),
            plate((0.086, 0.062, 0.028), RUBBER).at(x=-0.052),
        ),
        mass=0.62,
        friction=0.6,
        faces=26682,
    )


def _screwdriver_handle(height: float) -> Solid:
    """Grip that leans back into the battery foot, trigger in front."""
    grip = chain(
        GREEN,
        *(
            sphere(radius, GREEN, 16).scaled(1.05, 0.86, 1.0).at(x=x, z=z)
            for x, z, radius in ((-0.034, height - 0.008, 0.024), (-0.048, 0.082, 0.0205), (-0.060, 0.034, 0.022))
        ),
    )
    pad = chain(
        RUBBER,
        *(
            sphere(radius, RUBBER, 12).scaled(0.9, 0.90, 1.0).at(x=x, z=z)
            for x, z, radius in ((-0.050, height - 0.034, 0.0205), (-0.057, 0.080, 0.0200), (-0.066, 0.046, 0.020))
        ),
    )
    foot = rounded_box((0.086, 0.062, 0.026), 0.008, RUBBER, 12).at(x=-0.052)
    band = rounded_plate((0.088, 0.0625, 0.004), 0.010, GREEN, segments=12).at(x=-0.052, z=0.013)
    trigger = chain(
        RED,
        *(
            sphere(0.008, RED, 10).scaled(0.9, 0.9, 1.0).at(x=x, z=z)
            for x, z in ((-0.014, height - 0.028), (-0.024, 0.080))
        ),
    )
    return union(grip, pad, foot, band, trigger)


def _vents(height: float, x: float, radius: float, count: int, spacing: float, color: Color = RUBBER) -> Solid:
    """Slanted dark bars on both sides of a barrel."""
    bar = box((0.004, 0.004, 0.020), color).turned(pitch=0.35)
    return both_sides(union(*(bar.at(x=x + spacing * k, y=radius - 0.0012, z=height) for k in range(count))))


def powerdrill() -> Design:
    """Cordless drill driver with keyless chuck, slide-on battery, torque ring and belt clip; +x is the chuck."""
    height, along_x = 0.190, {"pitch": np.pi / 2}
    motor = turned_part(
        [(0.020, -0.100), (0.031, -0.094), (0.034, -0.080), (0.034, -0.010), (0.031, 0.004)], YELLOW, 28
    )
    back = turned_part([(0.022, -0.104), (0.0335, -0.096), (0.0350, -0.082), (0.0350, -0.074)], RUBBER, 28)
    gearbox = turned_part([(0.0315, -0.004), (0.0315, 0.012), (0.028, 0.016)], RUBBER, 28)
    torque = turned_part([(0.026, 0.014), (0.0275, 0.016), (0.0275, 0.032), (0.025, 0.036)], DARK_STEEL, 28)
    knurls = ring_of(box((0.0035, 0.0035, 0.016), RUBBER).at(x=0.0272, z=0.024), 14)
    chuck = turned_part(
        [(0.0225, 0.034), (0.0235, 0.038), (0.0235, 0.062), (0.020, 0.068), (0.011, 0.088), (0.009, 0.089)], RUBBER, 28
    )
    ribs = ring_of(box((0.003, 0.003, 0.020), DARK_STEEL).at(x=0.0232, z=0.050), 12)
    jaws = ring_of(box((0.006, 0.004, 0.016), STEEL).at(x=0.005, z=0.090), 3) - cylinder(
        0.0028, 0.04, STEEL, segments=12
    ).at(z=0.072)
    barrel = union(motor, back, gearbox, torque, knurls, chuck, ribs, jaws).turned(**along_x).at(z=height)
    body = union(barrel, _drill_handle(height), _battery(), _vents(height, -0.066, 0.0345, 4, 0.011))
    switch = rounded_plate((0.026, 0.018, 0.006), 0.005, RUBBER, segments=12).at(x=-0.035, z=height + 0.0315)
    badge = both_sides(box((0.034, 0.004, 0.014), WHITE).at(x=-0.018 + 0.004, y=0.0325, z=height + 0.004))
    clip = union(
        box((0.014, 0.010, 0.006), STEEL).at(x=-0.050, y=0.030, z=0.072),
        box((0.014, 0.003, 0.046), STEEL).at(x=-0.050, y=0.034, z=0.092),
    )
    return Design(
        description="cordless drill driver with keyless chuck and slide-on battery, standing on the battery",
        semantic_class="powerdrill",
        body=union(body, switch, badge, clip),
        collision=(
            cylinder(0.034, 0.114, YELLOW, segments=12).turned(**along_x).at(x=-0.102, z=height),
            cylinder(0.028, 0.028, YELLOW, segments=12).turned(**along_x).at(x=0.010, z=height),
            cylinder(0.0235, 0.034, RUBBER, segments=12).turned(**along_x).at(x=0.034, z=height),
            cylinder(0.0225, 0.029, RUBBER, top=0.009, segments=12).turned(**along_x).at(x=0.066, z=height),
            hull(
                YELLOW,
                box((0.048, 0.040, 0.004)).at(x=-0.034, z=height - 0.016),
                box((0.046, 0.040, 0.004)).at(x=-0.056, z=0.060),
            ),
            plate((0.124, 0.074, 0.062), RUBBER).at(x=-0.034),
        ),
        mass=1.55,
        friction=0.6,
        faces=19998,
    )


def _drill_handle(height: float) -> Solid:
    """Grip with a rubber back, a trigger and the direction switch above it."""
    places = ((-0.034, height - 0.014, 0.028), (-0.046, 0.124, 0.0235), (-0.056, 0.066, 0.025))
    grip = chain(YELLOW, *(sphere(r, YELLOW, 14).scaled(1.08, 0.82, 1.0).at(x=x, z=z) for x, z, r in places))
    pad_places = ((-0.052, height - 0.036, 0.0235), (-0.055, 0.122, 0.0225), (-0.063, 0.076, 0.0235))
    pad = chain(RUBBER, *(sphere(r, RUBBER, 12).scaled(0.95, 0.88, 1.0).at(x=x, z=z) for x, z, r in pad_places))
    trigger_places = ((-0.008, height - 0.036, 0.010), (-0.016, 0.128, 0.009))
    trigger = chain(RED, *(sphere(r, RED, 10).at(x=x, z=z) for x, z, r in trigger_places))
    direction = box((0.012, 0.050, 0.009), RUBBER).at(x=-0.020, z=height - 0.0385)
    return union(grip, pad, trigger, direction)


def _battery() -> Solid:
    """Slide-on pack under a flared foot, with release buttons, seams and a charge indicator."""
    foot = hull(YELLOW, rounded_plate((0.062, 0.046, 0.004), 0.016, YELLOW).at(x=-0.050, z=0.064),
                rounded_plate((0.116, 0.068, 0.012), 0.012, YELLOW).at(x=-0.034, z=0.042))  # fmt: skip
    pack = rounded_box((0.124, 0.074, 0.044), 0.007, RUBBER, 12).at(x=-0.034)
    seam = minus(
        rounded_plate((0.140, 0.090, 0.0025), 0.012, RUBBER, segments=12),
        rounded_plate((0.121, 0.071, 0.01), 0.012, RUBBER, segments=12).at(z=-0.002),
    ).at(x=-0.034, z=0.022)
    releases = both_sides(box((0.026, 0.006, 0.010), RED).at(x=-0.006, y=0.0365, z=0.033))
    lights = [box((0.003, 0.006, 0.003), GREEN).at(x=0.0276, y=y, z=0.034) for y in (-0.012, -0.004, 0.004)]
    label = both_sides(box((0.060, 0.003, 0.012), YELLOW).at(x=-0.046, y=0.0362, z=0.012))
    return union(minus(union(foot, pack), seam), releases, label, *lights)
