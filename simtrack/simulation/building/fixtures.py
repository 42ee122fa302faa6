"""What is built into a room or stands about in it: doors, radiators, columns, boards, plants, carts, small clutter.

Frames and sizes are those of `simtrack.simulation.building.furniture`: x to the front, y to the left, z up.
"""

import numpy as np

from simtrack.geometry.meshes import Mesh, convex_hull, cylinder_mesh, painted
from simtrack.geometry.transforms import exp_so3
from simtrack.simulation.building.furniture import (
    BLACK,
    GREEN,
    GREY,
    OAK,
    STEEL,
    TERRACOTTA,
    WHITE,
    Assembly,
    Color,
    Furniture,
    legs,
    ordered,
)

LEAF = 0.04
"""Thickness of a door leaf, metres."""


def door_leaf(width: float = 0.95, height: float = 2.05, color: Color = OAK) -> Furniture:
    """Door leaf with handles on both faces; its width runs along y with the hinge at the right end (negative y)."""
    a = Assembly("door")
    y = width / 2
    a.block((-LEAF / 2, -y, 0.008), (LEAF / 2, y, height), color)
    for side in (-1, 1):
        low, high = ordered((side * LEAF / 2, y - 0.09, 1.0), (side * (LEAF / 2 + 0.045), y - 0.07, 1.02))
        a.block(low, high, STEEL, solid=False)
        low, high = ordered((side * (LEAF / 2 + 0.03), y - 0.2, 1.0), (side * (LEAF / 2 + 0.05), y - 0.07, 1.02))
        a.block(low, high, STEEL, solid=False)
    return a.finish("as-is")


def hinged(width: float, hinge: tuple[float, float], direction: float) -> tuple[float, float, float]:
    """(x, y, yaw) of a door leaf whose hinge stands at `hinge` and whose free edge points to `direction` radians."""
    half = width / 2
    return hinge[0] + half * np.cos(direction), hinge[1] + half * np.sin(direction), direction - np.pi / 2


def door_frame(width: float = 0.95, height: float = 2.05, color: Color = WHITE) -> Furniture:
    """Casing around a door opening of clear `width` and `height` on one face of a wall, 18 mm proud of it."""
    a = Assembly("door-frame")
    y, trim, proud = width / 2, 0.07, 0.018
    a.block((0.0, -y - trim, 0.0), (proud, -y, height + trim), color)
    a.block((0.0, y, 0.0), (proud, y + trim, height + trim), color)
    a.block((0.0, -y, height), (proud, y, height + trim), color)
    return a.finish("as-is", "structure")


def whiteboard(width: float = 1.6, height: float = 1.0, bottom: float = 0.95) -> Furniture:
    """Framed whiteboard with a pen tray; its rear lies against a wall."""
    a = Assembly("whiteboard")
    y, top = width / 2, bottom + height
    a.block((0.004, -y, bottom), (0.024, y, top), WHITE)
    for low, high in (((-y, bottom), (y, bottom + 0.02)), ((-y, top - 0.02), (y, top))):
        a.block((0.024, *low), (0.03, *high), STEEL, solid=False)
    a.block((0.024, -0.35 * width, bottom), (0.09, 0.35 * width, bottom + 0.012), STEEL)
    return a.finish("as-is")


def radiator(width: float = 1.2, height: float = 0.55, bottom: float = 0.12) -> Furniture:
    """Panel radiator with ribs, mounted below a window; its rear lies against the wall."""
    a = Assembly("radiator")
    y = width / 2
    a.block((0.03, -y, bottom), (0.07, y, bottom + height), WHITE)
    ribs = max(3, round(width / 0.12))
    for k in range(ribs):
        middle = -y + width * (k + 0.5) / ribs
        a.block(
            (0.07, middle - 0.025, bottom + 0.03), (0.085, middle + 0.025, bottom + height - 0.03), WHITE, solid=False
        )
    for side in (-1, 1):
        a.block(
            (0.0, side * 0.7 * y - 0.02, bottom + 0.2), (0.03, side * 0.7 * y + 0.02, bottom + 0.26), STEEL, solid=False
        )
    return a.finish("as-is")


def column(depth: float = 0.35, width: float = 0.35, height: float = 2.8, color: Color = WHITE) -> Furniture:
    """Square column from floor to ceiling, 1 mm short of the latter, with a dark protective band."""
    a = Assembly("column")
    x, y = depth / 2, width / 2
    a.block((-x, -y, 0.0), (x, y, height - 0.001), color)
    a.block((-x - 0.004, -y - 0.004, 0.0), (x + 0.004, y + 0.004, 0.12), GREY, solid=False)
    return a.finish("as-is", "structure")


def round_column(diameter: float = 0.45, height: float = 2.8, color: Color = WHITE) -> Furniture:
    """Round column from floor to ceiling, 1 mm short of the latter."""
    a = Assembly("column")
    a.mesh(cylinder_mesh(diameter / 2, height - 0.001, 24, color), (0.0, 0.0, (height - 0.001) / 2))
    side = 0.85 * diameter / 2
    a.solid((-side, -side, 0.0), (side, side, height - 0.001))
    return a.finish("as-is", "structure")


def cart(depth: float = 0.5, width: float = 0.8, height: float = 0.85, color: Color = GREY) -> Furniture:
    """Trolley with two trays, a handle and castors."""
    a = Assembly("cart")
    x, y = depth / 2, width / 2
    for z in (0.22, height - 0.03):
        a.block((-x, -y, z), (x, y, z + 0.03), color)
        a.support(0.0, 0.0, z + 0.03, (depth, width))
    for sx in (-1, 1):
        for sy in (-1, 1):
            cx, cy = sx * (x - 0.02), sy * (y - 0.02)
            a.block((cx - 0.012, cy - 0.012, 0.1), (cx + 0.012, cy + 0.012, height + 0.1 * (sy > 0)), STEEL)
            a.mesh(cylinder_mesh(0.05, 0.03, 10, BLACK), (cx, cy, 0.05), exp_so3(np.array([np.pi / 2, 0.0, 0.0])))
    a.block((-x + 0.01, y - 0.032, height + 0.08), (x - 0.01, y - 0.008, height + 0.104), STEEL, solid=False)
    return a.finish()


def plant(diameter: float = 0.4, height: float = 1.3, leaves: int = 14, *, rng: np.random.Generator) -> Furniture:
    """Potted plant: a pot, a stem and closed leaf blades that lean outwards."""
    a = Assembly("plant")
    pot = 0.3 * height
    a.mesh(cylinder_mesh(0.45 * diameter, pot, 14, TERRACOTTA), (0.0, 0.0, pot / 2))
    a.mesh(cylinder_mesh(0.02, 0.6 * height, 6, OAK), (0.0, 0.0, pot + 0.2 * height))
    for k in range(leaves):
        azimuth = 2.4 * k + rng.uniform(-0.3, 0.3)
        lean, reach = rng.uniform(0.3, 1.0), rng.uniform(0.35, 0.6) * (height - pot)
        root = pot + rng.uniform(0.2, 0.55) * (height - pot)
        rotation = exp_so3(np.array([0.0, 0.0, azimuth])) @ exp_so3(np.array([0.0, lean, 0.0]))
        a.mesh(_leaf(reach, 0.12 * diameter), (0.0, 0.0, root), rotation)
    side = 0.4 * diameter
    a.solid((-side, -side, 0.0), (side, side, pot))
    a.solid((-0.05, -0.05, pot), (0.05, 0.05, 0.8 * height))
    return a.finish()


def _leaf(length: float, half_width: float) -> Mesh:
    points = [(0.0, 0.0, 0.0), (0.012, 0.0, 0.5 * length), (-0.004, 0.0, 0.5 * length), (0.03, 0.0, length)]
    points += [(0.0, half_width, 0.45 * length), (0.0, -half_width, 0.45 * length)]
    return painted(convex_hull(np.array(points)), GREEN)


def trash_bin(diameter: float = 0.3, height: float = 0.35, color: Color = BLACK) -> Furniture:
    """Round waste-paper bin, hollow."""
    from manifold3d import Manifold

    r, wall = diameter / 2, 0.005
    outer = Manifold.cylinder(height, 0.85 * r, r, 18)
    solid = outer - Manifold.cylinder(height, 0.85 * r - wall, r - wall, 18).translate((0.0, 0.0, wall))
    data = solid.to_mesh64()
    a = Assembly("trash-bin")
    a.mesh(painted(Mesh(np.asarray(data.vert_properties)[:, :3], np.asarray(data.tri_verts)), color))
    a.solid((-0.6 * r, -0.6 * r, 0.0), (0.6 * r, 0.6 * r, height))
    return a.finish()


def stool(diameter: float = 0.36, height: float = 0.62, color: Color = OAK) -> Furniture:
    """Round workshop stool on four legs."""
    a = Assembly("stool")
    a.mesh(cylinder_mesh(diameter / 2, 0.04, 20, color), (0.0, 0.0, height - 0.02))
    legs(a, (0.75 * diameter, 0.75 * diameter, height - 0.04), 0.03, STEEL)
    side = 0.42 * diameter
    a.solid((-side, -side, height - 0.04), (side, side, height))
    a.support(0.0, 0.0, height, (1.3 * side, 1.3 * side))
    return a.finish()


def carton(depth: float = 0.3, width: float = 0.25, height: float = 0.2, color: Color = (182, 148, 104)) -> Furniture:
    """Closed cardboard box or bound stack of paper: the small things that a survey leaves out."""
    a = Assembly("carton")
    x, y = depth / 2, width / 2
    a.block((-x, -y, 0.0), (x, y, height), color)
    a.support(0.0, 0.0, height, (depth, width))
    return a.finish("omitted", "clutter")
