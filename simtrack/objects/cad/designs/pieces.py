"""Pieces that many designs share: legs, carcasses, doors, drawers."""

from typing import Literal, TypeAlias

from simtrack.objects.cad.builder import ModelBuilder, PartBuilder
from simtrack.objects.cad.materials import STEEL, Material
from simtrack.objects.shapes import cylinder, hull, rod

Side: TypeAlias = Literal["left", "right"]
Span: TypeAlias = tuple[float, float]
GAP = 0.003
"""Metres between what moves and what it moves past."""
SIGNS = ((-1, -1), (1, -1), (-1, 1), (1, 1))


def square_legs(part: PartBuilder, size: Span, height: float, thickness: float, material: Material) -> None:
    """Four upright legs flush with the corners of a footprint (width, depth)."""
    x, y, t = size[0] / 2, size[1] / 2, thickness
    for sx, sy in SIGNS:
        part.block((sx * x, sy * y, 0.0), (sx * (x - t), sy * (y - t), height), material)


def round_legs(
    part: PartBuilder,
    size: Span,
    height: float,
    radius: float,
    material: Material,
    *,
    splay: float = 0.0,
    foot: float = 1.0,
) -> None:
    """Four round legs, their tops inset into a footprint (width, depth); `splay` metres outwards at the floor."""
    x, y = size[0] / 2 - radius, size[1] / 2 - radius
    for sx, sy in SIGNS:
        top = cylinder(radius, 0.004, segments=12).at(sx * x, sy * y, height - 0.004)
        low = cylinder(foot * radius, 0.004, segments=12).at(sx * (x + splay), sy * (y + splay))
        part.add(hull(material.color, top, low), material)


def bar(
    part: PartBuilder, a: tuple[float, float, float], b: tuple[float, float, float], radius: float, m: Material
) -> None:
    """Round bar between two points."""
    part.add(rod(a, b, radius, m.color, segments=10), m)


def carcass(
    part: PartBuilder, x: Span, y: Span, z: Span, wall: float, material: Material, *, back: bool = True
) -> None:
    """Five boards around a hollow that is open towards -y."""
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    part.block((x0, y0, z0), (x0 + wall, y1, z1), material)
    part.block((x1 - wall, y0, z0), (x1, y1, z1), material)
    part.block((x0 + wall, y0, z0), (x1 - wall, y1, z0 + wall), material)
    part.block((x0 + wall, y0, z1 - wall), (x1 - wall, y1, z1), material)
    if back:
        part.block((x0 + wall, y1 - wall, z0 + wall), (x1 - wall, y1, z1 - wall), material)


def door(
    b: ModelBuilder,
    name: str,
    x: Span,
    z: Span,
    front: float,
    hinge: Side,
    material: Material,
    *,
    thickness: float = 0.02,
    limit: float = 1.75,
    friction: float = 0.4,
    grip: Span | None = None,
    grip_material: Material = STEEL,
    window: Material | None = None,
    front_pin: bool = False,
) -> PartBuilder:
    """A door that lies before a carcass whose front edges are at y = `front`; its handle is a bar at the free edge.

    `grip` is the handle's span in z, by default the middle fifth; a `window` is let into the leaf.
    A `front_pin` keeps the leaf within its own width as it turns: for a hinge beside another door.
    """
    leaf = b.part(name)
    x0, x1 = x[0] + GAP / 2, x[1] - GAP / 2
    z0, z1 = z[0] + GAP / 2, z[1] - GAP / 2
    rear, face = front - GAP, front - GAP - thickness
    if window is None:
        leaf.block((x0, face, z0), (x1, rear, z1), material)
    else:
        rim = min(0.06, 0.2 * (x1 - x0), 0.2 * (z1 - z0))
        leaf.block((x0, face, z0), (x0 + rim, rear, z1), material)
        leaf.block((x1 - rim, face, z0), (x1, rear, z1), material)
        leaf.block((x0 + rim, face, z0), (x1 - rim, rear, z0 + rim), material)
        leaf.block((x0 + rim, face, z1 - rim), (x1 - rim, rear, z1), material)
        leaf.block((x0 + rim, face + 0.3 * thickness, z0 + rim), (x1 - rim, rear - 0.3 * thickness, z1 - rim), window)
    low, high = grip if grip is not None else (z0 + 0.4 * (z1 - z0), z0 + 0.6 * (z1 - z0))
    at = x1 - 0.05 if hinge == "left" else x0 + 0.05
    b.handle(leaf, (at - 0.008, face - 0.032, low), (at + 0.008, face, high), grip_material)
    # A left hinge opens clockwise seen from above, a right one counter-clockwise: both swing the free edge to -y.
    edge, turn = (x0, -1.0) if hinge == "left" else (x1, 1.0)
    pin = face if front_pin else rear
    b.joint("revolute", leaf, (edge, pin, (z0 + z1) / 2), (0.0, 0.0, turn), (0.0, limit), friction)
    return leaf


def drawer(
    b: ModelBuilder,
    name: str,
    x: Span,
    z: Span,
    y: Span,
    material: Material,
    *,
    parent: PartBuilder | None = None,
    front: float = 0.018,
    overlap: float = 0.012,
    friction: float = 3.0,
    grip_material: Material = STEEL,
) -> PartBuilder:
    """An open tray in the hollow x, z between y[0] (the carcass's front edges) and y[1]; its front overlaps them."""
    tray = b.part(name)
    x0, x1, wall, play = x[0] + GAP, x[1] - GAP, 0.010, 0.004
    z0, z1 = z[0] + play, z[0] + play + 0.72 * (z[1] - z[0] - play)
    y0, y1 = y[0] - GAP, y[1] - 0.02
    face = y0 - front
    tray.block(
        (x[0] - overlap + GAP, face, z[0] - overlap + GAP), (x[1] + overlap - GAP, y0, z[1] + overlap - GAP), material
    )
    tray.block((x0, y0, z0), (x1, y1, z0 + wall), material)
    tray.block((x0, y0, z0 + wall), (x0 + wall, y1, z1), material)
    tray.block((x1 - wall, y0, z0 + wall), (x1, y1, z1), material)
    tray.block((x0 + wall, y1 - wall, z0 + wall), (x1 - wall, y1, z1), material)
    b.hollow(tray, (x0 + wall, y0, z0 + wall), (x1 - wall, y1 - wall, z[1]))
    middle, half, height = (x0 + x1) / 2, min(0.08, 0.3 * (x1 - x0)), 0.5 * (z[0] + z[1])
    b.handle(tray, (middle - half, face - 0.03, height - 0.007), (middle + half, face, height + 0.007), grip_material)
    travel = 0.75 * (y1 - y0)
    b.joint(
        "prismatic", tray, (middle, y0, height), (0.0, -1.0, 0.0), (0.0, travel), friction, damping=8.0, parent=parent
    )
    return tray
