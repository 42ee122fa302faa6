"""An industrial plug-in relay."""

import numpy as np

from simtrack.objects.shapes import (
    Color,
    Design,
    Solid,
    box,
    cylinder,
    minus,
    plate,
    rounded_box,
    side_prism,
    union,
)

SOCKET: Color = (46, 50, 56)
HOUSING: Color = (226, 160, 84)
PLATE: Color = (238, 238, 230)
INK: Color = (40, 40, 40)
METAL: Color = (190, 190, 182)
GREEN: Color = (30, 140, 70)
BRASS: Color = (200, 165, 80)


def relay() -> Design:
    """Ice-cube power relay on a screw socket for a DIN rail, 60 x 110 x 89 mm; +y is the high terminal block.

    The terminal block at +y has two storeys and stands 16 mm above the one at -y, the cube is off the middle, and the
    retaining lever stands at +y: no half turn comes close to a symmetry.
    """
    body = union(_socket(), _cube(), _pins(), _lever())
    return Design(
        description="plug-in power relay on a DIN-rail socket with screw terminals",
        semantic_class="relay",
        body=body,
        collision=(
            plate((0.060, 0.110, 0.020), SOCKET),
            plate((0.060, 0.034, 0.036), SOCKET).at(y=0.038),
            plate((0.050, 0.050, 0.062), HOUSING).at(y=-0.010, z=0.024),
            plate((0.012, 0.012, 0.062), GREEN).at(y=0.024),
        ),
        mass=0.21,
        friction=0.45,
        faces=9312,
    )


def _socket() -> Solid:
    """Stepped body with clamps: screws in wells above, wire entries at both ends, a rail groove below."""
    outline = [(-0.055, 0.0), (0.055, 0.0), (0.055, 0.022), (0.039, 0.022), (0.039, 0.036), (0.019, 0.036),
               (0.019, 0.020), (-0.055, 0.020)]  # fmt: skip
    block = side_prism(outline, 0.060, SOCKET).turned(yaw=np.pi / 2)
    rail = side_prism([(-0.018, -0.001), (0.018, -0.001), (0.016, 0.006), (-0.016, 0.006)], 0.1, SOCKET).turned(
        yaw=np.pi / 2
    )
    wells, screws = [], []
    for y, top, xs in ((-0.046, 0.020, _FOUR), (0.047, 0.022, _FOUR), (0.029, 0.036, _THREE)):
        for x in xs:
            wells.append(cylinder(0.0046, 0.008, BRASS, segments=14).at(x=x, y=y, z=top - 0.0035))
            screw = cylinder(0.0040, 0.004, METAL, segments=14) - box((0.012, 0.0014, 0.003), INK).turned(yaw=0.6).at(
                z=0.004
            )
            screws.append(screw.at(x=x, y=y, z=top - 0.005))
    entries = [box((0.007, 0.008, 0.007), BRASS).at(x=x, y=y, z=0.010) for x in _FOUR for y in (-0.053, 0.053)]
    return union(minus(block, rail, *wells, *entries), *screws)


_FOUR = (-0.021, -0.007, 0.007, 0.021)
_THREE = (-0.017, 0.0, 0.017)


def _cube() -> Solid:
    """Housing with a bevelled top, a wiring diagram on one side, a test button and a flag window on top."""
    cube = rounded_box((0.050, 0.050, 0.062), 0.003, HOUSING, segments=8).at(y=-0.010, z=0.024)
    foot = plate((0.053, 0.053, 0.007), SOCKET).at(y=-0.010, z=0.0245)
    label = plate((0.040, 0.0515, 0.034), PLATE).at(y=-0.010, z=0.040)
    lines = [plate((w, 0.0525, 0.0016), INK).at(x=x, y=-0.010, z=z) for w, x, z in _DIAGRAM]
    posts = [plate((0.0016, 0.0525, 0.012), INK).at(x=x, y=-0.010, z=0.046) for x in (-0.012, 0.0, 0.012)]
    button = plate((0.012, 0.014, 0.004), GREEN).at(x=-0.014, y=-0.024, z=0.0845)
    window = box((0.026, 0.010, 0.003), INK).at(x=0.004, y=0.004, z=0.086)
    return union(minus(union(foot, cube, label, *lines, *posts), window), button)


_DIAGRAM = (
    (0.032, 0.0, 0.070),
    (0.026, 0.0, 0.0655),
    (0.030, 0.0, 0.046),
    (0.012, 0.012, 0.058),
    (0.012, -0.012, 0.058),
)


def _pins() -> Solid:
    """Blades that go into the socket, seen in the gap below the housing."""
    return union(
        *(plate((0.006, 0.0016, 0.010), BRASS).at(x=x, y=y, z=0.017) for x in (-0.016, 0.0, 0.016) for y in _ROWS)
    )


_ROWS = (-0.028, -0.010, 0.008)


def _lever() -> Solid:
    """Retaining and ejecting lever beside the housing."""
    stem = [(0.0, 0.020), (0.006, 0.020), (0.006, 0.058), (0.012, 0.066), (0.010, 0.069), (0.0, 0.062)]
    return side_prism(stem, 0.022, GREEN).turned(yaw=np.pi / 2).at(y=0.0185)
