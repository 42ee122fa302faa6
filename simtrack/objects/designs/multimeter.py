"""A hand-held digital multimeter in its rubber holster."""

import numpy as np
from manifold3d import CrossSection, JoinType

from simtrack.objects.shapes import (
    Color,
    Design,
    Solid,
    box,
    cylinder,
    hull,
    minus,
    plate,
    prism,
    rounded_plate,
    side_prism,
    union,
)

HOLSTER: Color = (236, 178, 22)
CASE: Color = (58, 62, 68)
BEZEL: Color = (24, 26, 30)
LCD: Color = (176, 190, 164)
DIGIT: Color = (28, 34, 30)
WHITE: Color = (235, 235, 235)
RED: Color = (200, 30, 30)
BLACK: Color = (18, 18, 20)
BLUE: Color = (40, 90, 170)

LENGTH = 0.190
FACE_HEIGHT = 0.034
SLOPE = np.arctan2(0.010, 0.060)
"""The display leans back towards the user, radians."""
SEGMENTS = {"0": "abcdef", "2": "abged", "3": "abgcd", "4": "fgbc"}
"""Lit segments of seven-segment digits, named clockwise from the top, g in the middle."""


def multimeter() -> Design:
    """Digital multimeter 104 x 198 x 54 mm, lying on its back: +y is the head with the display, +z the face.

    The head is 14 mm thicker than the foot and the case tapers, so no half turn comes close to a symmetry.
    """
    body = union(_holster(), _case())
    body = minus(body, _display_recess(), *_jack_holes())
    body = union(body, _display(), _dial(), *_buttons(), *_jack_collars())
    return Design(
        description="hand-held digital multimeter in a rubber holster, lying on its back",
        semantic_class="multimeter",
        body=body,
        collision=(
            prism(_outline(0.003), 0.040, CASE)
            & side_y([(-0.099, 0.0), (0.099, 0.0), (0.099, 0.034), (-0.099, 0.033)]),
            prism(_outline(0.0), 0.060, CASE)
            & side_y([(0.010, 0.030), (0.095, 0.030), (0.095, 0.052), (0.080, 0.052)]),
            cylinder(0.0215, 0.016, CASE, segments=12).at(y=-0.023, z=FACE_HEIGHT - 0.002),
        ),
        mass=0.46,
        friction=0.8,
        faces=100338,
    )


def _outline(margin: float) -> CrossSection:
    """Seen from above: wide at the head, a waist, rounded corners."""
    half = [(-0.036, -0.095), (0.036, -0.095), (0.038, -0.020), (0.048, 0.025), (0.048, 0.095), (-0.048, 0.095),
            (-0.048, 0.025), (-0.038, -0.020)]  # fmt: skip
    core = CrossSection([np.array(half)]).offset(-0.010, JoinType.Miter)
    return core.offset(0.010 + margin, JoinType.Round, circular_segments=24)


def side_y(outline: list[tuple[float, float]]) -> Solid:
    """Outline in y, z (counter-clockwise seen from +x), pushed through all of x."""
    return side_prism(outline, 0.2, CASE).turned(yaw=np.pi / 2)


def _holster() -> Solid:
    """Rubber shell around the back and the sides, open above, with grips at the waist and a lip around the head."""
    profile = side_y([(-0.100, 0.004), (-0.096, 0.0), (0.096, 0.0), (0.100, 0.004), (0.100, 0.046), (0.030, 0.040),
                      (0.012, 0.027), (-0.100, 0.027)])  # fmt: skip
    shell = _painted(prism(_outline(0.004), 0.060, HOLSTER) & profile, HOLSTER)
    grips = [box((0.005, 0.006, 0.020), HOLSTER).at(x=s * 0.0425, y=y, z=0.014) for s in (-1, 1) for y in _GRIPS]
    stand = box((0.050, 0.070, 0.004), BLACK).at(y=0.015)
    return minus(union(shell, *grips), stand, box((0.020, 0.030, 0.008), BLACK).at(y=-0.070))


_GRIPS = (-0.070, -0.058, -0.046, -0.034)


def _painted(part: Solid, color: Color) -> Solid:
    original = part.manifold.as_original()
    return Solid(original, {original.original_id(): color})


def _case() -> Solid:
    """The meter itself: flat at the foot, thicker and sloped at the head."""
    profile = side_y([(-0.096, 0.003), (0.096, 0.003), (0.096, 0.052), (0.078, 0.0535), (0.018, 0.0435),
                      (0.008, FACE_HEIGHT), (-0.090, FACE_HEIGHT), (-0.096, 0.030)])  # fmt: skip
    return _painted(prism(_outline(0.0), 0.070, CASE) & profile, CASE)


def _on_head(part: Solid) -> Solid:
    """Place a part drawn on z = 0 on the middle of the sloped head."""
    return part.turned(roll=SLOPE).at(y=0.049, z=0.0487)


def _display_recess() -> Solid:
    return _on_head(plate((0.074, 0.046, 0.010), BEZEL).at(z=-0.0025))


def _display() -> Solid:
    """Liquid crystal behind a frame, reading 230.4."""
    glass = plate((0.064, 0.036, 0.004), LCD).at(z=-0.0038)
    figures = [
        _digit(d).at(x=x, y=-0.002, z=-0.0002) for d, x in zip("2304", (-0.024, -0.010, 0.004, 0.020), strict=True)
    ]
    point = plate((0.002, 0.002, 0.0008), DIGIT).at(x=0.012, y=-0.012, z=-0.0002)
    bar = plate((0.052, 0.0015, 0.0008), DIGIT).at(y=-0.0155, z=-0.0002)
    return union(*(_on_head(part) for part in (glass, *figures, point, bar)))


def _digit(figure: str) -> Solid:
    w, h, t = 0.008, 0.018, 0.0018
    x, y = 0.5 * w, 0.25 * h
    across, upright = (w, t), (t, 2.0 * y)
    places = {
        "a": (0.0, 2.0 * y, *across),
        "b": (x, y, *upright),
        "c": (x, -y, *upright),
        "d": (0.0, -2.0 * y, *across),
        "e": (-x, -y, *upright),
        "f": (-x, y, *upright),
        "g": (0.0, 0.0, *across),
    }
    lit = (places[segment] for segment in SEGMENTS[figure])
    return union(*(plate((size_x, size_y, 0.0008), DIGIT).at(at_x, at_y) for at_x, at_y, size_x, size_y in lit))


def _dial() -> Solid:
    """Rotary switch with a grip bar and a pointer, in a ring of ticks."""
    disc = cylinder(0.0215, 0.006, BEZEL, segments=36) + cylinder(0.0195, 0.010, BEZEL, top=0.0180, segments=36)
    bar = hull(BEZEL, plate((0.010, 0.036, 0.010), BEZEL), plate((0.007, 0.032, 0.016), BEZEL))
    pointer = plate((0.0022, 0.013, 0.0166), WHITE).at(y=0.0105)
    knob = union(disc, bar, pointer).turned(yaw=np.deg2rad(40.0))
    colors = {0: RED, 5: HOLSTER, 9: BLUE}
    ticks = [
        plate((0.0016, 0.005, 0.0008), colors.get(k, WHITE)).at(y=0.0262).turned(yaw=2.0 * np.pi * k / 14)
        for k in range(14)
    ]
    return union(knob, *ticks).at(y=-0.023, z=FACE_HEIGHT - 0.0002)


def _buttons() -> list[Solid]:
    colors = (HOLSTER, WHITE, WHITE, BLUE)
    return [
        rounded_plate((0.013, 0.007, 0.005), 0.003, c, segments=12).at(x=x, y=0.0125, z=FACE_HEIGHT + 0.0015)
        for c, x in zip(colors, (-0.027, -0.009, 0.009, 0.027), strict=True)
    ]


_JACKS = ((-0.0255, RED), (-0.0085, RED), (0.0085, BLACK), (0.0255, RED))


def _jack_collars() -> list[Solid]:
    ring = [
        cylinder(0.0072, 0.003, c, segments=20) - cylinder(0.0042, 0.01, BLACK, segments=16).at(z=-0.002)
        for _, c in _JACKS
    ]
    return [part.at(x=x, y=-0.076, z=FACE_HEIGHT - 0.0005) for part, (x, _) in zip(ring, _JACKS, strict=True)]


def _jack_holes() -> list[Solid]:
    return [cylinder(0.0042, 0.030, BLACK, segments=16).at(x=x, y=-0.076, z=0.018) for x, _ in _JACKS]
