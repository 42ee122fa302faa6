"""CAD models: what is known of a piece of furniture or a household thing, rigid or articulated.

Model frame: origin in the centre of the model's box at rest, z up, the front (where it is used from) towards -y.
Everything is given in this one frame with all joints at 0; metres, kilograms, radians.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.meshes import Mesh, concatenate, transformed
from simtrack.geometry.transforms import exp_so3, transform

JointKind: TypeAlias = Literal["revolute", "continuous", "prismatic"]
Affordance: TypeAlias = Literal["openable", "graspable", "supports", "contains"]
JOINT_KINDS: tuple[JointKind, ...] = ("revolute", "continuous", "prismatic")
AFFORDANCES: tuple[Affordance, ...] = ("openable", "graspable", "supports", "contains")


@dataclass(frozen=True, slots=True, eq=False)
class CadPart:
    """One rigid part."""

    name: str
    """Unique in its model, e.g. ``body`` or ``door``."""
    mesh: Mesh
    """Coloured surface."""
    convex: tuple[Mesh, ...]
    """Convex parts whose union stands for it in physics."""
    mass: float
    centre_of_mass: Float64
    """(3,)."""
    inertia: Float64
    """(3, 3), about the centre of mass, axes of the model frame, kg m^2."""
    friction: float
    """Coefficient of sliding friction."""
    material: str
    """What most of its mass is made of."""


@dataclass(frozen=True, slots=True, eq=False)
class CadJoint:
    """How a part moves against another."""

    name: str
    kind: JointKind
    parent: str
    """Name of the part that it hangs on."""
    child: str
    """Name of the part that moves."""
    anchor: Float64
    """(3,), a point of the axis."""
    axis: Float64
    """(3,), unit vector; a positive position opens."""
    lower: float
    """Radians or metres; a continuous joint has -pi."""
    upper: float
    friction: float
    """N m or N that has to be overcome."""
    damping: float = 0.0
    """N m s/rad or N s/m."""

    def motion(self, position: float) -> Float64:
        """(4, 4) displacement of the child, model frame, at a joint position."""
        if self.kind == "prismatic":
            return transform(None, position * self.axis)
        rotation = exp_so3(position * self.axis)
        return transform(rotation, self.anchor - rotation @ self.anchor)


@dataclass(frozen=True, slots=True, eq=False)
class CadPlane:
    """A flat part of the surface: points v with ``normal @ v + offset = 0``."""

    part: str
    normal: Float64
    """(3,), unit vector, outwards."""
    offset: float
    """Metres: d of the plane [n, d]."""
    area: float
    """Square metres."""
    centre: Float64
    """(3,), area centroid."""


@dataclass(frozen=True, slots=True, eq=False)
class CadBox:
    """An axis-parallel box in a part: a handle to grip, or a hollow that holds things."""

    part: str
    centre: Float64
    """(3,)."""
    extents: Float64
    """(3,), full side lengths."""


@dataclass(frozen=True, slots=True, eq=False)
class CadSupport:
    """A horizontal rectangle that things can stand on."""

    part: str
    centre: Float64
    """(3,)."""
    size: Float64
    """(2,), along x and y."""
    clearance: float
    """Metres of free height above it; inf under the open sky."""


@dataclass(frozen=True, slots=True, eq=False)
class CadModel:
    """A model of a class of things."""

    name: str
    semantic_class: str
    parts: tuple[CadPart, ...]
    """The first one is the base; all others hang on it through `joints`, parents before children."""
    joints: tuple[CadJoint, ...]
    extents: Float64
    """(3,), side lengths of the box, metres."""
    planes: tuple[CadPlane, ...]
    """The larger ones first."""
    supports: tuple[CadSupport, ...]
    hollows: tuple[CadBox, ...]
    handles: tuple[CadBox, ...]
    affordances: frozenset[Affordance]
    yaw_symmetries: Float64
    """(S,), turns about z in (-pi, pi] that map the model onto itself within 3 % of its size, 0 first; 24 equal steps
    where any turn does."""
    description: str = ""

    def __post_init__(self) -> None:
        names = [part.name for part in self.parts]
        if not names or len(set(names)) < len(names):
            raise InvalidValueError(f"CadModel '{self.name}'.parts", names, "one or more parts with names of their own")
        hung = {names[0]}
        for joint in self.joints:
            if joint.parent not in hung or joint.child in hung or joint.child not in names:
                allowed = f"a tree over {names} with {names[0]} at its root, parents before children"
                raise InvalidValueError(f"CadModel '{self.name}'.joints", (joint.parent, joint.child), allowed)
            hung.add(joint.child)
        if len(hung) < len(names):
            raise InvalidValueError(f"CadModel '{self.name}'.joints", sorted(set(names) - hung), "a joint each")

    @property
    def articulated(self) -> bool:
        """Whether it has joints."""
        return bool(self.joints)

    @property
    def mass(self) -> float:
        """Kilograms, all parts."""
        return sum(part.mass for part in self.parts)

    def part(self, name: str) -> CadPart:
        """The part of that name; raises UnknownNameError with those there are."""
        for part in self.parts:
            if part.name == name:
                return part
        raise UnknownNameError(f"part of {self.name}", name, [part.name for part in self.parts])

    def part_poses(self, positions: Mapping[str, float] | None = None) -> dict[str, Float64]:
        """Part name -> (4, 4) displacement in the model frame at joint positions (0 where none is given).

        Raises:
            UnknownNameError: a position is given for a joint that does not exist.
        """
        positions = positions or {}
        known = {joint.name for joint in self.joints}
        for name in positions:
            if name not in known:
                raise UnknownNameError(f"joint of {self.name}", name, known)
        poses = {self.parts[0].name: np.eye(4)}
        for joint in self.joints:
            poses[joint.child] = poses[joint.parent] @ joint.motion(positions.get(joint.name, 0.0))
        return poses

    def mesh(self, positions: Mapping[str, float] | None = None) -> Mesh:
        """All parts in one mesh at joint positions."""
        poses = self.part_poses(positions)
        return concatenate([transformed(part.mesh, poses[part.name]) for part in self.parts])


def box_around(points: Sequence[Float64]) -> tuple[Float64, Float64]:
    """Centre and side lengths of the axis-parallel box around (N, 3) point arrays."""
    stacked = np.concatenate(points)
    low, high = stacked.min(axis=0), stacked.max(axis=0)
    return (low + high) / 2, high - low
