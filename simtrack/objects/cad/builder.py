"""Putting a CAD model together from coloured solids: parts, joints, handles, faces to stand on, hollows.

The builder's frame stands on the floor (z = 0), x to the right of who stands before it, the front towards -y.
"""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import convex_hull, mass_properties, transformed
from simtrack.geometry.transforms import transform
from simtrack.objects.cad.features import mesh_planes, yaw_symmetries
from simtrack.objects.cad.materials import Material
from simtrack.objects.cad.model import (
    Affordance,
    CadBox,
    CadJoint,
    CadModel,
    CadPart,
    CadPlane,
    CadSupport,
    JointKind,
    box_around,
)
from simtrack.objects.shapes import Solid, Vector, box, hull, union

Point: TypeAlias = tuple[float, float, float]
GRIP_WIDTH = 0.09
"""Metres that a gripper opens."""
GRIP_MASS = 3.0
"""Kilograms that a robot's arm lifts."""


class PartBuilder:
    """One rigid part being made."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.pieces: list[tuple[Solid, Material]] = []
        self.convex: list[Solid] = []

    def add(self, solid: Solid, material: Material, convex: Sequence[Solid] | None = None) -> None:
        """Add a solid in a material's colour; `convex` are the pieces that collide (the solid, if None)."""
        colored = Solid(solid.manifold, dict.fromkeys(solid.colors, material.color))
        self.pieces.append((colored, material))
        self.convex.extend([solid] if convex is None else convex)

    def block(self, low: Point, high: Point, material: Material, *, solid: bool = True) -> None:
        """Add a box between two corners, in any order; `solid` ones collide."""
        a, b = np.minimum(low, high), np.maximum(low, high)
        self.add(box(b - a).at(*(a + b) / 2), material, None if solid else ())

    def beam(self, a: Point, b: Point, thickness: float | tuple[float, float], material: Material) -> None:
        """Add a leg or strut: square of side `thickness` (at both ends) from a to b, ends level."""
        ends = thickness if isinstance(thickness, tuple) else (thickness, thickness)
        tips = [box((t, t, 0.004)).at(*p) for p, t in zip((a, b), ends, strict=True)]
        self.add(hull(material.color, *tips), material)

    def finished(self, T_model_builder: Float64) -> CadPart:
        """The part in the model frame; mass and inertia are the sums over its pieces."""
        if not self.pieces:
            raise InvalidValueError(f"part '{self.name}'", 0, "one or more solids")
        mass, first, properties = 0.0, np.zeros(3), []
        by_material: dict[str, float] = {}
        for solid, material in self.pieces:
            mesh = transformed(solid.mesh(), T_model_builder)
            own, centre, inertia = mass_properties(mesh, density=material.density)
            mass, first = mass + own, first + own * centre
            properties.append((own, centre, inertia))
            by_material[material.name] = by_material.get(material.name, 0.0) + own
        centre_of_mass = first / mass
        inertia = np.zeros((3, 3))
        for own, centre, about in properties:
            r = centre - centre_of_mass
            inertia += about + own * (r @ r * np.eye(3) - np.outer(r, r))
        return CadPart(
            name=self.name,
            mesh=transformed(union(*(solid for solid, _ in self.pieces)).mesh(), T_model_builder),
            convex=tuple(transformed(convex_hull(s.mesh().vertices), T_model_builder) for s in self.convex),
            mass=mass,
            centre_of_mass=centre_of_mass,
            inertia=inertia,
            friction=sum(m.friction * own for (_, m), (own, _, _) in zip(self.pieces, properties, strict=True)) / mass,
            material=max(by_material, key=lambda name: by_material[name]),
        )


class ModelBuilder:
    """One CAD model being made."""

    def __init__(self, semantic_class: str, description: str) -> None:
        self.semantic_class = semantic_class
        self.description = description
        self.parts: list[PartBuilder] = []
        self.joints: list[tuple[str, JointKind, str, str, Point, Point, float, float, float, float]] = []
        self.supports: list[tuple[str, Point, tuple[float, float], float]] = []
        self.hollows: list[tuple[str, Point, Point]] = []
        self.handles: list[tuple[str, Point, Point]] = []

    def part(self, name: str = "body") -> PartBuilder:
        """Begin a part; the first one is the base."""
        self.parts.append(PartBuilder(name))
        return self.parts[-1]

    def joint(
        self,
        kind: JointKind,
        child: PartBuilder,
        anchor: Point,
        axis: Point,
        limits: tuple[float, float],
        friction: float,
        *,
        damping: float = 0.5,
        parent: PartBuilder | None = None,
    ) -> None:
        """Hang a part on another (the base, if None); `limits` are its lowest and highest position."""
        on = self.parts[0] if parent is None else parent
        self.joints.append((f"{child.name}-joint", kind, on.name, child.name, anchor, axis, *limits, friction, damping))

    def support(self, part: PartBuilder, centre: Point, size: tuple[float, float], clearance: float = np.inf) -> None:
        """Declare a face to stand on."""
        self.supports.append((part.name, centre, size, clearance))

    def hollow(self, part: PartBuilder, low: Point, high: Point, *, floor: bool = True) -> None:
        """Declare a hollow that holds things; its `floor` is a face to stand on."""
        self.hollows.append((part.name, low, high))
        if floor:
            middle = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2])
            self.support(part, middle, (high[0] - low[0], high[1] - low[1]), high[2] - low[2])

    def handle(self, part: PartBuilder, low: Point, high: Point, material: Material | None = None) -> None:
        """Declare a handle; with a `material` a bar is drawn there too."""
        if material is not None:
            part.block(low, high, material)
        self.handles.append((part.name, low, high))

    def finish(self, name: str) -> CadModel:
        """The model: origin moved into the centre of the box, planes, symmetries and affordances derived."""
        centre, _ = box_around([s.mesh().vertices for part in self.parts for s, _ in part.pieces])
        T = transform(None, -centre)
        parts = tuple(part.finished(T) for part in self.parts)
        whole = [part.mesh.vertices for part in parts]
        _, extents = box_around(whole)
        supports = tuple(CadSupport(p, np.array(c) - centre, np.array(s), h) for p, c, s, h in self.supports)
        hollows = tuple(_cad_box(*given, centre) for given in self.hollows)
        handles = tuple(_cad_box(*given, centre) for given in self.handles)
        joints = tuple(
            CadJoint(n, kind, on, child, np.array(at) - centre, _unit(axis), low, high, friction, damping)
            for n, kind, on, child, at, axis, low, high, friction, damping in self.joints
        )
        return assembled(
            name, self.semantic_class, parts, joints, extents, supports, hollows, handles, self.description
        )


def assembled(
    name: str,
    semantic_class: str,
    parts: tuple[CadPart, ...],
    joints: tuple[CadJoint, ...],
    extents: Float64,
    supports: tuple[CadSupport, ...],
    hollows: tuple[CadBox, ...],
    handles: tuple[CadBox, ...],
    description: str,
) -> CadModel:
    """A model with its planes, symmetries and affordances derived from what is given."""
    planes: list[CadPlane] = []
    total = sum(float(np.prod(np.sort(part.mesh.extents)[1:])) for part in parts)
    for part in parts:
        planes += [CadPlane(part.name, *plane) for plane in mesh_planes(part.mesh, least_area=0.01 * total)]
    planes.sort(key=lambda plane: -plane.area)
    meshes = [part.mesh for part in parts]
    mass = sum(part.mass for part in parts)
    affordances: set[Affordance] = set()
    if any(joint.kind != "continuous" for joint in joints):
        affordances.add("openable")
    if supports:
        affordances.add("supports")
    if hollows:
        affordances.add("contains")
    if mass <= GRIP_MASS and (min(extents) <= GRIP_WIDTH or handles):
        affordances.add("graspable")
    return CadModel(
        name=name,
        semantic_class=semantic_class,
        parts=parts,
        joints=joints,
        extents=extents,
        planes=tuple(planes),
        supports=supports,
        hollows=hollows,
        handles=handles,
        affordances=frozenset(affordances),
        # What opens has one front, however alike its sides are.
        yaw_symmetries=np.zeros(1) if joints else yaw_symmetries(meshes),
        description=description,
    )


def _cad_box(part: str, low: Point, high: Point, centre: Float64) -> CadBox:
    a, b = np.minimum(low, high), np.maximum(low, high)
    return CadBox(part, (a + b) / 2 - centre, b - a)


def _unit(axis: Vector) -> Float64:
    vector = np.asarray(axis, float)
    return vector / np.linalg.norm(vector)
