"""Kinematic trees: links with meshes, joints, forward kinematics. What a robot knows about its own body."""

from collections.abc import Mapping
from dataclasses import dataclass

from simtrack.contracts import Float32, Float64, Int32
from simtrack.geometry.transforms import exp_so3, transform


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint between a parent link and the link that owns it."""

    name: str
    kind: str
    """``fixed``, ``revolute`` or ``prismatic``."""
    axis: Float64
    """(3,), unit vector in the joint's own frame."""
    lower: float
    """rad or m."""
    upper: float
    max_velocity: float
    """rad/s or m/s."""


@dataclass(frozen=True, slots=True)
class Link:
    """A rigid body of the tree."""

    name: str
    parent: str
    """Name of the parent link, empty for the root."""
    joint: Joint | None
    """None for the root."""
    T_parent_joint: Float64
    """(4, 4), pose of the joint in the parent link with the joint at zero."""
    vertices: Float32
    """(V, 3), link frame, metres; may be empty."""
    faces: Int32
    """(F, 3)."""
    mass: float
    """Kilograms."""
    color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    """RGB, 0 to 1."""


@dataclass(frozen=True, slots=True)
class KinematicTree:
    """Links, parents before children; the first is the root (``base``)."""

    links: tuple[Link, ...]

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The joints that move, in the order of their links."""
        return tuple(link.joint for link in self.links if link.joint is not None and link.joint.kind != "fixed")

    def forward(self, positions: Mapping[str, float]) -> dict[str, Float64]:
        """Link name -> (4, 4) T_root_link for joint positions in rad or m; joints not named are at zero."""
        poses: dict[str, Float64] = {}
        for link in self.links:
            poses[link.name] = _placed(link, poses, positions)
        return poses

    def pose(self, name: str, positions: Mapping[str, float]) -> Float64:
        """(4, 4) T_root_link of one link, see `forward`."""
        wanted, chain = name, []
        for link in reversed(self.links):  # children after parents
            if link.name == wanted:
                chain.append(link)
                wanted = link.parent
        poses: dict[str, Float64] = {}
        for link in reversed(chain):
            poses[link.name] = _placed(link, poses, positions)
        return poses[name]


def _placed(link: Link, poses: Mapping[str, Float64], positions: Mapping[str, float]) -> Float64:
    """(4, 4) T_root_link of a link below those whose poses are known."""
    if link.joint is None:
        return transform()
    T = poses[link.parent] @ link.T_parent_joint
    value = float(positions.get(link.joint.name, 0.0))
    if link.joint.kind == "revolute":
        return T @ transform(exp_so3(value * link.joint.axis))
    if link.joint.kind == "prismatic":
        return T @ transform(translation=value * link.joint.axis)
    return T
