"""Parametric furniture as closed coloured pieces with collision boxes and support faces.

Every builder works in a frame that stands on the floor: origin below the middle of the footprint, x to the front (where
one stands or sits to use it), y to its left, z up; sizes are depth (x), width (y), height (z) in metres.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import Mesh, box_mesh, concatenate, cylinder_mesh, painted, transformed
from simtrack.geometry.transforms import exp_so3, transform, transform_planar
from simtrack.simulation.building.parts import Box, Group, StaticPart, Support, Survey

Color: TypeAlias = tuple[int, int, int]
Point: TypeAlias = tuple[float, float, float]

BEECH: Color = (205, 170, 125)
OAK: Color = (164, 116, 73)
WHITE: Color = (232, 232, 228)
GREY: Color = (140, 144, 148)
STEEL: Color = (92, 98, 106)
BLACK: Color = (42, 44, 48)
BLUE: Color = (52, 92, 150)
GREEN: Color = (70, 124, 66)
RED: Color = (168, 60, 52)
YELLOW: Color = (222, 176, 54)
TERRACOTTA: Color = (176, 98, 66)
FINISHES: tuple[Color, ...] = (BEECH, OAK, WHITE, GREY, STEEL)
FABRICS: tuple[Color, ...] = (BLACK, BLUE, GREY, RED, GREEN)


_UNIT_BOX = box_mesh((1.0, 1.0, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class Furniture:
    """A piece of furniture in its own frame: origin in the centre of its box, x to its front, z up."""

    semantic_class: str
    mesh: Mesh
    extents: Float64
    """(3,), metres."""
    centre: Float64
    """(3,), the box's centre in the builder's frame, which stands on the floor."""
    supports: tuple[Support, ...]
    collision: tuple[Box, ...]
    survey: Survey = "movable"
    group: Group = "furniture"

    def placed(self, name: str, x: float, y: float, yaw: float, *, room: str = "", z: float = 0.0) -> StaticPart:
        """The part that stands at (x, y) metres on a surface at height `z`, its front turned to `yaw` radians."""
        T_map_floor = transform_planar(x, y, yaw)
        T_map_floor[2, 3] = z
        return StaticPart(
            name=name,
            semantic_class=self.semantic_class,
            mesh=self.mesh,
            T_map_part=T_map_floor @ transform(None, self.centre),
            extents=self.extents,
            supports=self.supports,
            room=room,
            survey=self.survey,
            collision=self.collision,
            group=self.group,
        )


class Assembly:
    """Collects the pieces of one piece of furniture in the builder's frame."""

    def __init__(self, semantic_class: str) -> None:
        self.semantic_class = semantic_class
        self.meshes: list[Mesh] = []
        self.solids: list[Box] = []
        self.supports: list[Support] = []

    def block(self, low: Point, high: Point, color: Color, *, solid: bool = True) -> None:
        """Add a closed box; `solid` ones also collide."""
        self.meshes.append(block(low, high, color))
        if solid:
            self.solid(low, high)

    def mesh(self, mesh: Mesh, at: Point = (0.0, 0.0, 0.0), rotation: Float64 | None = None) -> None:
        """Add a closed mesh that does not collide."""
        self.meshes.append(transformed(mesh, transform(rotation, at)))

    def solid(self, low: Point, high: Point) -> None:
        """Add an invisible collision box."""
        a, b = np.array(low), np.array(high)
        self.solids.append((transform(None, (a + b) / 2), b - a))

    def support(self, x: float, y: float, z: float, size: tuple[float, float]) -> None:
        """Add a face to stand on, centred at (x, y, z)."""
        self.supports.append((transform(None, (x, y, z)), np.array(size)))

    def finish(self, survey: Survey = "movable", group: Group = "furniture") -> Furniture:
        """Move everything into the frame of the common box."""
        mesh = concatenate(self.meshes)
        low, high = mesh.bounds
        centre = (low + high) / 2
        shift = transform(None, -centre)
        return Furniture(
            semantic_class=self.semantic_class,
            mesh=Mesh(mesh.vertices - centre, mesh.faces, mesh.face_colors),
            extents=high - low,
            centre=centre,
            supports=tuple((shift @ T, size) for T, size in self.supports),
            collision=tuple((shift @ T, size) for T, size in self.solids),
            survey=survey,
            group=group,
        )


def block(low: Point, high: Point, color: Color) -> Mesh:
    """Closed axis-aligned box between two corners."""
    corner = np.array(low)
    vertices = corner + (_UNIT_BOX.vertices + 0.5) * (np.array(high) - corner)
    return Mesh(vertices, _UNIT_BOX.faces, np.full((12, 3), color, np.uint8))


def legs(a: Assembly, size: tuple[float, float, float], thickness: float, color: Color) -> None:
    """Add four square legs inside a footprint `size` (depth, width), as high as `size[2]`."""
    x, y, top = size[0] / 2, size[1] / 2, size[2]
    for sx in (-1, 1):
        for sy in (-1, 1):
            corner = (sx * (x - thickness), sy * (y - thickness))
            low = (corner[0] - thickness / 2, corner[1] - thickness / 2, 0.0)
            a.block(low, (corner[0] + thickness / 2, corner[1] + thickness / 2, top), color)


def workbench(depth: float = 0.75, width: float = 1.8, height: float = 0.85, color: Color = BEECH) -> Furniture:
    """Workbench with a drawer unit, a foot rail and a perforated back panel with a rail for tools."""
    a = Assembly("workbench")
    x, y, top = depth / 2, width / 2, 0.045
    a.block((-x, -y, height - top), (x, y, height), color)
    legs(a, (depth - 0.04, width - 0.04, height - top), 0.06, STEEL)
    a.block((-x + 0.06, -y + 0.08, 0.16), (-x + 0.10, y - 0.08, 0.24), STEEL)
    a.block((-x + 0.08, y - 0.56, 0.30), (x - 0.06, y - 0.12, height - top), GREY)
    for k in range(3):
        z = 0.32 + 0.155 * k
        a.block((x - 0.06, y - 0.54, z), (x - 0.045, y - 0.14, z + 0.14), BLUE, solid=False)
        a.block((x - 0.045, y - 0.42, z + 0.09), (x - 0.025, y - 0.26, z + 0.105), STEEL, solid=False)
    a.block((-x, -y, height), (-x + 0.025, y, height + 0.42), GREY)
    for k in range(2):
        z = height + 0.14 + 0.16 * k
        a.block((-x + 0.025, -y + 0.05, z), (-x + 0.04, y - 0.05, z + 0.025), STEEL, solid=False)
    a.support(0.0125, 0.0, height, (depth - 0.025, width))
    return a.finish("as-is")


def shelf(
    depth: float = 0.4, width: float = 1.2, height: float = 1.9, boards: int = 5, color: Color = BEECH
) -> Furniture:
    """Open shelf unit: two sides, a cross brace at the rear and `boards` boards, all of which support things."""
    a = Assembly("shelf")
    x, y, t = depth / 2, width / 2, 0.022
    for side in (-1, 1):
        a.block((-x, min(side * y, side * (y - t)), 0.0), (x, max(side * y, side * (y - t)), height), color)
    for z in np.linspace(0.08, height - t, boards):
        a.block((-x, -y + t, float(z)), (x, y - t, float(z) + t), color)
        a.support(0.0, 0.0, float(z) + t, (depth, width - 2 * t))
    a.block((-x, -y + t, 0.45 * height), (-x + 0.012, y - t, 0.45 * height + 0.12), STEEL)
    return a.finish()


def bin_box(depth: float = 0.4, width: float = 0.3, height: float = 0.25, color: Color = BLUE) -> Furniture:
    """Open storage bin with tapered walls and a rim, hollowed out by a boolean difference."""
    from manifold3d import CrossSection, Manifold

    def frustum(x: float, y: float, low: float, high: float, flare: float) -> Manifold:
        section = CrossSection.square((x, y), True)
        return section.extrude(high - low, 0, 0.0, (flare, flare)).translate((0.0, 0.0, low))

    wall, flare = 0.006, 1.12
    x, y = depth / flare, width / flare
    outer = frustum(x, y, 0.0, height, flare) + Manifold.cube((depth + 0.02, width + 0.02, 0.02), True).translate(
        (0.0, 0.0, height - 0.01)
    )
    solid = outer - frustum(x - 2 * wall, y - 2 * wall, wall, height + 0.01, flare)
    data = solid.to_mesh64()
    a = Assembly("bin")
    a.mesh(painted(Mesh(np.asarray(data.vert_properties)[:, :3], np.asarray(data.tri_verts)), color))
    a.solid((-x / 2, -y / 2, 0.0), (x / 2, y / 2, wall))
    for s in (-1, 1):
        a.solid(*ordered((s * depth / 2, -width / 2, 0.0), (s * (x / 2 - wall), width / 2, height)))
        a.solid(*ordered((-depth / 2, s * width / 2, 0.0), (depth / 2, s * (y / 2 - wall), height)))
    a.support(0.0, 0.0, wall, (x - 2 * wall, y - 2 * wall))
    return a.finish()


def ordered(a: Point, b: Point) -> tuple[Point, Point]:
    """Lower and upper corner of the box between any two opposite corners."""
    low, high = np.minimum(a, b), np.maximum(a, b)
    return (float(low[0]), float(low[1]), float(low[2])), (float(high[0]), float(high[1]), float(high[2]))


def cupboard(depth: float = 0.45, width: float = 1.0, height: float = 1.95, color: Color = WHITE) -> Furniture:
    """Closed cupboard with two doors, handles and a plinth."""
    a = Assembly("cupboard")
    x, y = depth / 2, width / 2
    a.block((-x, -y, 0.08), (x - 0.02, y, height), color)
    a.block((-x + 0.03, -y + 0.03, 0.0), (x - 0.06, y - 0.03, 0.08), BLACK)
    for side in (-1, 1):
        low, high = ordered((x - 0.02, side * 0.003, 0.09), (x, side * (y - 0.003), height - 0.01))
        a.block(low, high, color)
        low, high = ordered((x, side * 0.04, 0.45 * height), (x + 0.025, side * 0.055, 0.45 * height + 0.16))
        a.block(low, high, STEEL, solid=False)
    a.support(-0.01, 0.0, height, (depth - 0.02, width))
    return a.finish()


def desk(depth: float = 0.8, width: float = 1.6, height: float = 0.73, color: Color = BEECH) -> Furniture:
    """Office desk with a drawer unit, a modesty panel and a screen."""
    a = Assembly("desk")
    x, y = depth / 2, width / 2
    a.block((-x, -y, height - 0.025), (x, y, height), color)
    legs(a, (depth - 0.06, width - 0.06, height - 0.025), 0.05, STEEL)
    a.block((-x + 0.05, -y + 0.08, 0.3), (-x + 0.07, y - 0.08, height - 0.03), color)
    a.block((-x + 0.12, -y + 0.1, 0.04), (x - 0.1, -y + 0.5, height - 0.06), GREY)
    screen = min(0.55, width / 3)
    a.block((-x + 0.12, -screen / 2, height + 0.1), (-x + 0.15, screen / 2, height + 0.43), BLACK)
    a.block((-x + 0.08, -0.02, height), (-x + 0.12, 0.02, height + 0.2), STEEL)
    a.block((-x + 0.05, -0.11, height), (-x + 0.23, 0.11, height + 0.012), STEEL, solid=False)
    a.support(0.1, 0.0, height, (depth - 0.2, width))
    return a.finish()


def table(depth: float = 0.8, width: float = 1.4, height: float = 0.73, color: Color = OAK) -> Furniture:
    """Plain table on four legs with a frame below its top."""
    a = Assembly("table")
    x, y = depth / 2, width / 2
    a.block((-x, -y, height - 0.03), (x, y, height), color)
    legs(a, (depth - 0.04, width - 0.04, height - 0.03), 0.055, color)
    for side in (-1, 1):
        low, high = ordered((-x + 0.07, side * (y - 0.06), height - 0.11), (x - 0.07, side * (y - 0.08), height - 0.03))
        a.block(low, high, color, solid=False)
    a.support(0.0, 0.0, height, (depth, width))
    return a.finish()


def round_table(diameter: float = 0.9, height: float = 0.74, color: Color = WHITE) -> Furniture:
    """Round table on a central column with a disc foot."""
    a = Assembly("table")
    r = diameter / 2
    a.mesh(cylinder_mesh(r, 0.03, 24, color), (0.0, 0.0, height - 0.015))
    a.mesh(cylinder_mesh(0.05, height - 0.05, 10, STEEL), (0.0, 0.0, height / 2))
    a.mesh(cylinder_mesh(0.6 * r, 0.03, 16, STEEL), (0.0, 0.0, 0.015))
    side = 0.85 * r
    a.solid((-side, -side, height - 0.03), (side, side, height))
    a.solid((-0.05, -0.05, 0.0), (0.05, 0.05, height - 0.03))
    a.solid((-0.4 * r, -0.4 * r, 0.0), (0.4 * r, 0.4 * r, 0.03))
    a.support(0.0, 0.0, height, (1.4 * r, 1.4 * r))
    return a.finish()


def chair(width: float = 0.46, seat: float = 0.46, back: float = 0.9, color: Color = BLUE) -> Furniture:
    """Four-legged chair; one sits down on it from its front."""
    a = Assembly("chair")
    h = width / 2
    a.block((-h, -h, seat - 0.045), (h, h, seat), color)
    legs(a, (width, width, seat - 0.045), 0.03, STEEL)
    a.block((-h - 0.02, -h, seat + 0.12), (-h + 0.015, h, back), color)
    for side in (-1, 1):
        low, high = ordered((-h, side * (h - 0.05), seat), (-h + 0.02, side * (h - 0.02), back - 0.05))
        a.block(low, high, STEEL, solid=False)
    a.support(0.0, 0.0, seat, (width - 0.05, width))
    return a.finish()


def office_chair(width: float = 0.5, seat: float = 0.48, back: float = 1.0, color: Color = BLACK) -> Furniture:
    """Swivel chair on a five-armed foot."""
    a = Assembly("chair")
    h = width / 2
    a.block((-h, -h, seat - 0.07), (h, h, seat), color)
    a.block((-h - 0.03, -h + 0.04, seat + 0.08), (-h + 0.03, h - 0.04, back), color)
    a.block((-h - 0.02, -0.04, seat - 0.05), (-h + 0.01, 0.04, seat + 0.12), STEEL, solid=False)
    for side in (-1, 1):
        low, high = ordered((-0.12, side * (h + 0.01), seat + 0.18), (0.14, side * (h + 0.05), seat + 0.21))
        a.block(low, high, color, solid=False)
        low, high = ordered((-0.02, side * (h - 0.01), seat - 0.04), (0.02, side * (h + 0.04), seat + 0.18))
        a.block(low, high, STEEL, solid=False)
    a.mesh(cylinder_mesh(0.03, seat - 0.13, 8, STEEL), (0.0, 0.0, (seat - 0.07 + 0.06) / 2))
    for k in range(5):
        rotation = exp_so3(np.array([0.0, 0.0, 2 * np.pi * k / 5]))
        a.mesh(block((0.0, -0.02, 0.05), (0.3, 0.02, 0.09), STEEL), rotation=rotation)
        a.mesh(block((0.25, -0.025, 0.0), (0.3, 0.025, 0.05), BLACK), rotation=rotation)
    a.solid((-0.2, -0.2, 0.0), (0.2, 0.2, 0.09))
    a.solid((-0.03, -0.03, 0.09), (0.03, 0.03, seat - 0.07))
    a.support(0.0, 0.0, seat, (width - 0.08, width))
    return a.finish()


def filing_cabinet(depth: float = 0.6, width: float = 0.45, height: float = 1.3, color: Color = GREY) -> Furniture:
    """Steel cabinet with drawers about 0.3 m high."""
    a = Assembly("cabinet")
    x, y = depth / 2, width / 2
    a.block((-x, -y, 0.0), (x - 0.02, y, height), color)
    drawers = max(1, round((height - 0.06) / 0.3))
    pitch = (height - 0.06) / drawers
    for k in range(drawers):
        z = 0.04 + pitch * k
        a.block((x - 0.02, -y + 0.01, z), (x, y - 0.01, z + pitch - 0.02), color)
        a.block((x, -0.08, z + 0.7 * pitch), (x + 0.02, 0.08, z + 0.7 * pitch + 0.02), STEEL, solid=False)
    a.support(-0.01, 0.0, height, (depth - 0.02, width))
    return a.finish()


def sofa(depth: float = 0.85, width: float = 1.8, color: Color = BLUE) -> Furniture:
    """Sofa with arm rests and one cushion a seat."""
    a = Assembly("sofa")
    x, y, arm = depth / 2, width / 2, 0.16
    a.block((-x, -y, 0.05), (x, y, 0.28), color)
    a.block((-x, -y, 0.28), (-x + 0.2, y, 0.8), color)
    for side in (-1, 1):
        a.block(*ordered((-x + 0.2, side * y, 0.28), (x, side * (y - arm), 0.6)), color)
    seats = max(1, round((width - 2 * arm) / 0.65))
    pitch = (width - 2 * arm) / seats
    for k in range(seats):
        left = -y + arm + pitch * k
        a.block((-x + 0.2, left + 0.01, 0.28), (x - 0.01, left + pitch - 0.01, 0.43), GREY)
    a.support(0.095, 0.0, 0.43, (depth - 0.21, width - 2 * arm - 0.02))
    return a.finish()


def counter(depth: float = 0.6, width: float = 2.4, height: float = 0.9, color: Color = WHITE) -> Furniture:
    """Kitchen counter: cupboards below a worktop, wall cupboards above its rear."""
    a = Assembly("counter")
    x, y = depth / 2, width / 2
    a.block((-x, -y, 0.1), (x - 0.03, y, height - 0.04), color)
    a.block((-x, -y, 0.0), (x - 0.08, y, 0.1), BLACK)
    a.block((-x, -y, height - 0.04), (x, y, height), OAK)
    a.block((-x, -y, 1.45), (-x + 0.35, y, 2.05), color)
    doors = max(2, round(width / 0.55))
    for k in range(doors):
        left = -y + width * k / doors
        a.block(
            (x - 0.03, left + 0.005, 0.12), (x - 0.012, left + width / doors - 0.005, height - 0.05), color, solid=False
        )
        a.block((-x + 0.35, left + 0.005, 1.46), (-x + 0.365, left + width / doors - 0.005, 2.04), color, solid=False)
    a.support(0.0, 0.0, height, (depth, width))
    return a.finish("as-is")
