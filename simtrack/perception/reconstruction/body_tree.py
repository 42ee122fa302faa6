"""Kinematic tree of a reconstructed scene (section 4.5 of the reconstruction paper): a plain description.

Nodes are rigid bodies: the scene root, layout, rigid objects, rigid parts of articulated objects. Edges are joints:
supporting edges are fixed or floating, the models' own joints revolute, continuous or prismatic.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeAlias, get_args

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import exp_so3, is_rigid, transform

JointKind: TypeAlias = Literal["fixed", "floating", "revolute", "continuous", "prismatic"]
MOVING_KINDS: tuple[JointKind, ...] = ("revolute", "continuous", "prismatic")
ShapeKind: TypeAlias = Literal["box", "sphere", "cylinder", "convex"]
_LENGTHS = {"box": 3, "sphere": 1, "cylinder": 2, "convex": 0}


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A convex shape that collides."""

    kind: ShapeKind
    size: tuple[float, ...] = ()
    """Metres. box: full side lengths; sphere: radius; cylinder: radius, length along z; convex: empty."""
    mesh: Mesh | None = None
    """Of a convex shape: closed and convex, in the frame of the shape."""
    T_body_shape: Float64 | None = None
    """(4, 4); the identity if None."""

    def __post_init__(self) -> None:
        if self.kind not in _LENGTHS:
            raise InvalidValueError("Shape.kind", self.kind, ", ".join(_LENGTHS))
        size = np.asarray(self.size, float)
        if size.shape != (_LENGTHS[self.kind],) or not (np.isfinite(size) & (size > 0.0)).all():
            raise InvalidValueError("Shape.size", self.size, f"{_LENGTHS[self.kind]} positive lengths of a {self.kind}")
        if (self.kind == "convex") != (self.mesh is not None):
            raise InvalidValueError("Shape.mesh", self.mesh, "a mesh for a convex shape, None for the others")
        if self.T_body_shape is None:
            object.__setattr__(self, "T_body_shape", np.eye(4))
        elif not is_rigid(self.T_body_shape):
            raise InvalidValueError("Shape.T_body_shape", self.T_body_shape, "a (4, 4) rigid transform")

    @property
    def pose(self) -> Float64:
        """(4, 4) T_body_shape."""
        assert self.T_body_shape is not None
        return self.T_body_shape

    def corners(self) -> Float64:
        """(N, 3) points in the frame of the body whose convex hull contains the shape (exact for box and convex)."""
        if self.mesh is not None:
            points = self.mesh.vertices
        else:
            size = self.size
            x, y, z = (2.0 * size[0],) * 3 if self.kind == "sphere" else (2.0 * size[0], 2.0 * size[0], size[-1])
            extents = np.array(size if self.kind == "box" else (x, y, z))
            points = 0.5 * extents * [[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
        return points @ self.pose[:3, :3].T + self.pose[:3, 3]


@dataclass(frozen=True, slots=True, eq=False)
class BodyJoint:
    """How a body hangs on its parent. The body's frame is the joint's frame."""

    name: str
    kind: JointKind
    parent: str
    """Name of the parent body."""
    T_parent_body: Float64
    """(4, 4), with the joint at zero."""
    axis: Float64 | None = None
    """(3,), unit vector in the frame of the body; z if None."""
    lower: float = 0.0
    """rad or m; not of a continuous joint."""
    upper: float = 0.0
    friction: float = 0.0
    """N m or N that has to be overcome."""
    damping: float = 0.0
    """N m s/rad or N s/m."""
    effort: float = 100.0
    """N m or N: the most that a drive may apply."""
    velocity: float = 2.0
    """rad/s or m/s: the fastest that a drive may go."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(JointKind):
            raise InvalidValueError(f"joint '{self.name}'.kind", self.kind, ", ".join(get_args(JointKind)))
        if not is_rigid(self.T_parent_body):
            raise InvalidValueError(
                f"joint '{self.name}'.T_parent_body", self.T_parent_body, "a (4, 4) rigid transform"
            )
        axis = np.array([0.0, 0.0, 1.0]) if self.axis is None else np.asarray(self.axis, float)
        if axis.shape != (3,) or not abs(np.linalg.norm(axis) - 1.0) < 1e-6:
            raise InvalidValueError(f"joint '{self.name}'.axis", self.axis, "a unit vector (3,)")
        object.__setattr__(self, "axis", axis)
        if not (np.isfinite([self.lower, self.upper]).all() and self.lower <= self.upper):
            raise InvalidValueError(f"joint '{self.name}'.lower, upper", (self.lower, self.upper), "lower <= upper")
        values = (self.friction, self.damping, self.effort, self.velocity)
        if not (np.isfinite(values).all() and min(values) >= 0.0):
            raise InvalidValueError(f"joint '{self.name}'.friction, damping, effort, velocity", values, "0 or more")

    @property
    def moves(self) -> bool:
        """Whether it has a position: revolute, continuous or prismatic."""
        return self.kind in MOVING_KINDS

    @property
    def direction(self) -> Float64:
        """(3,) the axis."""
        assert self.axis is not None
        return self.axis

    def motion(self, position: float) -> Float64:
        """(4, 4) displacement of the body at a joint position, rad or m, in the joint's frame."""
        if self.kind == "prismatic":
            return transform(None, position * self.direction)
        return transform(exp_so3(position * self.direction))


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A rigid body. One without mass at the root of a component is static."""

    name: str
    joint: BodyJoint | None = None
    """None for the scene root."""
    visual: Mesh | None = None
    """Coloured surface, frame of the body."""
    collision: tuple[Shape, ...] = ()
    mass: float = 0.0
    """Kilograms."""
    centre_of_mass: Float64 | None = None
    """(3,), frame of the body; its origin if None."""
    inertia: Float64 | None = None
    """(3, 3), about the centre of mass, axes of the body, kg m^2; zero if None."""
    friction: float = 0.5
    """Coefficient of sliding friction against its like."""
    semantic_class: str = "thing"

    def __post_init__(self) -> None:
        if not self.name or any(ord(letter) < 32 for letter in self.name):
            raise InvalidValueError("Body.name", self.name, "printable characters, one at least")
        if not (np.isfinite(self.mass) and self.mass >= 0.0):
            raise InvalidValueError(f"body '{self.name}'.mass", self.mass, "0 (static) or a positive number of kg")
        if not (np.isfinite(self.friction) and self.friction >= 0.0):
            raise InvalidValueError(f"body '{self.name}'.friction", self.friction, "0 or more")
        if self.centre_of_mass is None:
            object.__setattr__(self, "centre_of_mass", np.zeros(3))
        if self.inertia is None:
            object.__setattr__(self, "inertia", np.zeros((3, 3)))
        if self.mass > 0.0:
            moments, _ = self.principal_inertia()
            if not moments.min() > 0.0 or moments[0] + moments[1] < moments[2] * (1.0 - 1e-6):
                allowed = "positive, none larger than the other two together"
                raise InvalidValueError(f"body '{self.name}'.inertia: principal moments", moments.tolist(), allowed)

    def principal_inertia(self) -> tuple[Float64, Float64]:
        """(3,) principal moments in rising order and (4, 4) T_body_principal: centre of mass and principal axes."""
        assert self.inertia is not None and self.centre_of_mass is not None
        moments, axes = np.linalg.eigh(self.inertia)
        if np.linalg.det(axes) < 0.0:
            axes = axes * [1.0, 1.0, -1.0]
        return moments, transform(axes, self.centre_of_mass)


@dataclass(frozen=True, slots=True, eq=False)
class Component:
    """Bodies that hang together without a floating joint: what an engine loads as one."""

    bodies: tuple[Body, ...]
    """The root first, parents before children."""
    T_scene_root: Float64
    """(4, 4), with all joints at zero."""
    support: str | None
    """Name of the body that it rests on: parent of the floating joint; None for the component of the scene root."""

    @property
    def name(self) -> str:
        """Name of its root body."""
        return self.bodies[0].name

    @property
    def static(self) -> bool:
        """Whether it cannot move as a whole: its root has no mass."""
        return self.bodies[0].mass == 0.0


@dataclass(frozen=True, eq=False)
class BodyTree:
    """A scene as a kinematic tree. Frame: that of the root body, z up."""

    name: str
    bodies: tuple[Body, ...]
    """The scene root first, parents before children."""

    def __post_init__(self) -> None:
        known: set[str] = set()
        joints: set[str] = set()
        for number, body in enumerate(self.bodies):
            where = f"BodyTree '{self.name}': body '{body.name}'"
            if body.name in known:
                raise InvalidValueError(where, body.name, "names that differ")
            if (body.joint is None) != (number == 0):
                raise InvalidValueError(f"{where}.joint", body.joint, "None for the first body, a joint for the others")
            if body.joint is not None and body.joint.parent not in known:
                raise InvalidValueError(f"{where}.joint.parent", body.joint.parent, "a body earlier in the list")
            if body.joint is not None and body.joint.name in joints:
                raise InvalidValueError(f"{where}.joint.name", body.joint.name, "names that differ")
            if body.joint is not None:
                joints.add(body.joint.name)
                if body.joint.moves and body.mass == 0.0:
                    raise InvalidValueError(f"{where}.mass", body.mass, "a positive mass of what a joint moves")
            known.add(body.name)
        if not self.bodies:
            raise InvalidValueError(f"BodyTree '{self.name}'.bodies", (), "one body or more")

    @cached_property
    def by_name(self) -> Mapping[str, Body]:
        """Name -> body."""
        return {body.name: body for body in self.bodies}

    @cached_property
    def joints(self) -> Mapping[str, Body]:
        """Name of each joint that has a position -> the body that it moves."""
        return {body.joint.name: body for body in self.bodies if body.joint is not None and body.joint.moves}

    def forward(self, positions: Mapping[str, float] | None = None) -> dict[str, Float64]:
        """Body name -> (4, 4) T_scene_body; joints that are not named are at zero, floating ones where described."""
        poses: dict[str, Float64] = {}
        for body in self.bodies:
            joint = body.joint
            if joint is None:
                poses[body.name] = np.eye(4)
                continue
            poses[body.name] = poses[joint.parent] @ joint.T_parent_body
            if joint.moves and positions:
                poses[body.name] = poses[body.name] @ joint.motion(positions.get(joint.name, 0.0))
        return poses

    @cached_property
    def components(self) -> tuple[Component, ...]:
        """The tree cut at its floating joints; the scene root's component first."""
        poses = self.forward()
        roots: dict[str, list[Body]] = {}
        owner: dict[str, str] = {}
        for body in self.bodies:
            starts = body.joint is None or body.joint.kind == "floating"
            owner[body.name] = body.name if body.joint is None or starts else owner[body.joint.parent]
            roots.setdefault(owner[body.name], []).append(body)
        return tuple(
            Component(tuple(bodies), poses[name], None if bodies[0].joint is None else bodies[0].joint.parent)
            for name, bodies in roots.items()
        )

    def below(self, name: str) -> frozenset[str]:
        """The named body and all that hangs on it, through joints of any kind: what moves along."""
        found = {name}
        for body in self.bodies:
            if body.joint is not None and body.joint.parent in found:
                found.add(body.name)
        return frozenset(found)

    def rigid_groups(self) -> dict[str, str]:
        """Body name -> name of the topmost body of the object that it is a rigid part of.

        Fixed joints tie an object together, except those to the static scene root, and those of what has a mass to
        what has none: furniture that is fixed to the floor is an object of its own.
        """
        group: dict[str, str] = {}
        root = self.bodies[0]
        for body in self.bodies:
            joint = body.joint
            tied = joint is not None and joint.kind == "fixed"
            if joint is not None and self.by_name[joint.parent].mass == 0.0:
                tied = tied and body.mass == 0.0 and joint.parent != root.name
            group[body.name] = group[joint.parent] if joint is not None and tied else body.name
        return group

    def mechanism(self, name: str) -> frozenset[str]:
        """Bodies of the object that a body is a part of: what fixed joints and moving ones tie together."""
        rigid, top = self.rigid_groups(), dict[str, str]()
        for body in self.bodies:
            tied = body.joint is not None and (body.joint.moves or rigid[body.name] != body.name)
            top[body.name] = top[body.joint.parent] if body.joint is not None and tied else body.name
        return frozenset(other for other in top if top[other] == top[name])


def standing_on(ground: Body, tree: BodyTree, T_ground_root: Float64) -> BodyTree:
    """The tree with `ground` as its new, static root, on which the old root rests freely."""
    joint = BodyJoint(f"{ground.name}/floating", "floating", ground.name, T_ground_root)
    return BodyTree(tree.name, (ground, replace(tree.bodies[0], joint=joint), *tree.bodies[1:]))


def collision_points(bodies: Sequence[Body], poses: Mapping[str, Float64]) -> Float64:
    """(N, 3) corners of all collision shapes at the given T_scene_body (4, 4)."""
    clouds = [
        shape.corners() @ poses[body.name][:3, :3].T + poses[body.name][:3, 3]
        for body in bodies
        for shape in body.collision
    ]
    return np.concatenate(clouds) if clouds else np.empty((0, 3))
