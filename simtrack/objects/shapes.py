"""Coloured solids for the procedural catalogue: a thin layer over manifold3d (booleans on closed meshes).

Metres and radians. Each face remembers the solid that it came from, so colours survive booleans; a face that a
subtraction uncovers takes the colour of what was subtracted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from manifold3d import CrossSection, JoinType, Manifold, OpType

from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import rotation_from_rpy
from simtrack.objects.model import Symmetries

Color = tuple[int, int, int]
Vector = Sequence[float] | npt.NDArray[np.float64]

GREY: Color = (128, 128, 128)


@dataclass(frozen=True, slots=True)
class Solid:
    """A closed body with coloured faces."""

    manifold: Manifold
    colors: Mapping[int, Color]
    """manifold3d's original id of a primitive -> its colour."""

    def __add__(self, other: "Solid") -> "Solid":
        return Solid(self.manifold + other.manifold, {**self.colors, **other.colors})

    def __sub__(self, other: "Solid") -> "Solid":
        return Solid(self.manifold - other.manifold, {**self.colors, **other.colors})

    def __and__(self, other: "Solid") -> "Solid":
        return Solid(self.manifold ^ other.manifold, {**self.colors, **other.colors})

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Solid":
        """Moved by a translation."""
        return Solid(self.manifold.translate((x, y, z)), self.colors)

    def turned(self, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> "Solid":
        """Turned about the origin, ``Rz(yaw) @ Ry(pitch) @ Rx(roll)``."""
        matrix = np.hstack([rotation_from_rpy(roll, pitch, yaw), np.zeros((3, 1))])
        return Solid(self.manifold.transform(matrix), self.colors)

    def scaled(self, x: float = 1.0, y: float = 1.0, z: float = 1.0) -> "Solid":
        """Stretched along the axes; a negative factor mirrors."""
        return Solid(self.manifold.scale((x, y, z)), self.colors)

    def mesh(self) -> Mesh:
        """The surface, coloured."""
        data = self.manifold.to_mesh64()
        runs = np.diff(np.asarray(data.run_index)) // 3
        palette = np.array([self.colors.get(int(i), GREY) for i in data.run_original_id], np.uint8).reshape(-1, 3)
        vertices = np.asarray(data.vert_properties)[:, :3]
        return Mesh(vertices, np.asarray(data.tri_verts, np.int32), np.repeat(palette, runs, axis=0))


@dataclass(frozen=True, slots=True)
class Design:
    """An object of the catalogue before it is tessellated; any frame with z up."""

    description: str
    semantic_class: str
    body: Solid
    collision: tuple[Solid, ...]
    """Their convex hulls stand for the body in physics."""
    mass: float
    """Kilograms."""
    friction: float
    """Coefficient of sliding friction."""
    faces: int
    """Number of faces of the full-resolution mesh."""
    symmetries: Symmetries = field(default_factory=Symmetries)


def solid(manifold: Manifold, color: Color) -> Solid:
    """A manifold in one colour."""
    original = manifold.as_original()
    return Solid(original, {original.original_id(): color})


def union(*parts: Solid) -> Solid:
    """All parts in one."""
    colors: dict[int, Color] = {}
    for part in parts:
        colors.update(part.colors)
    return Solid(Manifold.batch_boolean([part.manifold for part in parts], OpType.Add), colors)


def hull(color: Color, *parts: Solid) -> Solid:
    """Convex hull of the parts."""
    return solid(Manifold.batch_hull([part.manifold for part in parts]), color)


def chain(color: Color, *parts: Solid) -> Solid:
    """Convex hulls of neighbours in a row: a bent, tapering limb."""
    return union(*(hull(color, a, b) for a, b in pairwise(parts)))


def box(size: Vector, color: Color = GREY) -> Solid:
    """Box with its centre at the origin."""
    return solid(Manifold.cube((size[0], size[1], size[2]), center=True), color)


def plate(size: Vector, color: Color = GREY) -> Solid:
    """Box that stands on z = 0, centred in x and y."""
    return box(size, color).at(z=0.5 * size[2])


def rounded_box(size: Vector, radius: float, color: Color = GREY, segments: int = 12) -> Solid:
    """Box that stands on z = 0 with all edges rounded."""
    ball = Manifold.sphere(radius, circular_segments=segments)
    half = 0.5 * np.asarray(size, float) - radius
    corners = [ball.translate((sx * half[0], sy * half[1], sz * half[2])) for sx, sy, sz in _SIGNS]
    return solid(Manifold.batch_hull(corners), color).at(z=0.5 * size[2])


_SIGNS = [(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]


def rounded_plate(size: Vector, radius: float, color: Color = GREY, chamfer: float = 0.0, segments: int = 16) -> Solid:
    """Plate on z = 0 whose vertical edges are rounded, its upper and lower rims chamfered."""
    x, y, height = size
    return tapered(
        [
            (rounded_rectangle(x - 2 * chamfer, y - 2 * chamfer, max(radius - chamfer, 1e-4), segments), 0.0),
            (rounded_rectangle(x, y, radius, segments), chamfer),
            (rounded_rectangle(x, y, radius, segments), height - chamfer),
            (rounded_rectangle(x - 2 * chamfer, y - 2 * chamfer, max(radius - chamfer, 1e-4), segments), height),
        ],
        color,
    )


def rounded_rectangle(x: float, y: float, radius: float, segments: int = 16) -> CrossSection:
    """Rectangle centred at the origin with rounded corners."""
    core = CrossSection.square((x - 2 * radius, y - 2 * radius), center=True)
    return core.offset(radius, JoinType.Round, circular_segments=segments)


def tapered(sections: Sequence[tuple[CrossSection, float]], color: Color = GREY) -> Solid:
    """Convex hull of outlines at heights (a frustum, a chamfered plate)."""
    points = [
        np.column_stack([polygon, np.full(len(polygon), z)])
        for section, z in sections
        for polygon in section.to_polygons()
    ]
    return solid(Manifold.hull_points(np.concatenate(points)), color)


def prism(outline: Sequence[tuple[float, float]] | CrossSection, height: float, color: Color = GREY) -> Solid:
    """Outline in x, y (counter-clockwise) pushed up from z = 0."""
    section = outline if isinstance(outline, CrossSection) else CrossSection([np.asarray(outline)])
    return solid(Manifold.extrude(section, height), color)


def side_prism(outline: Sequence[tuple[float, float]], width: float, color: Color = GREY) -> Solid:
    """Outline in x, z (counter-clockwise seen from -y) with its `width` along y, centred at y = 0."""
    return prism(outline, width, color).turned(roll=np.pi / 2).at(y=0.5 * width)


def lathe(profile: Sequence[tuple[float, float]], color: Color = GREY, segments: int = 32) -> Solid:
    """Outline in radius, z (counter-clockwise) turned about z."""
    section = CrossSection([np.asarray(profile)])
    return solid(Manifold.revolve(section, circular_segments=segments), color)


def turned_part(rings: Sequence[tuple[float, float]], color: Color = GREY, segments: int = 32) -> Solid:
    """Solid of revolution about z through (radius, z) rings from the lowest to the highest."""
    return lathe([(0.0, rings[0][1]), *rings, (0.0, rings[-1][1])], color, segments)


def cylinder(radius: float, height: float, color: Color = GREY, top: float | None = None, segments: int = 32) -> Solid:
    """Cylinder or cone frustum on z = 0."""
    return solid(Manifold.cylinder(height, radius, radius if top is None else top, segments), color)


def sphere(radius: float, color: Color = GREY, segments: int = 16) -> Solid:
    """Ball about the origin."""
    return solid(Manifold.sphere(radius, circular_segments=segments), color)


def rod(a: Vector, b: Vector, radius: float, color: Color = GREY, segments: int = 12) -> Solid:
    """Capsule from one point to another."""
    ball = sphere(radius, color, segments)
    return hull(color, ball.at(*a), ball.at(*b))


def tube(points: Sequence[Vector], radius: float, color: Color = GREY, segments: int = 10) -> Solid:
    """Bent rod through points."""
    return union(*(rod(a, b, radius, color, segments) for a, b in pairwise(points)))


def ring_of(part: Solid, count: int, start: float = 0.0, span: float = 2.0 * np.pi) -> Solid:
    """`count` copies of a part turned about z from `start` over `span`, the end excluded."""
    return union(*(part.turned(yaw=start + span * k / count) for k in range(count)))


def both_sides(part: Solid) -> Solid:
    """A part and its mirror image in y."""
    return part + part.scaled(y=-1.0)


def minus(body: Solid, *cutters: Solid) -> Solid:
    """The body without the cutters."""
    return reduce(lambda left, cutter: left - cutter, cutters, body)
