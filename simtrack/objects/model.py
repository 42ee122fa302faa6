"""What is known about a kind of object: shape, colours, physics, symmetries, keypoints."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry import meshes
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import exp_so3, transform

BOX_CORNERS = np.array([[x, y, z] for z in (-1.0, 1.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)])
"""(8, 3), signs of the box corners in the order of the keypoints: x changes fastest, then y, then z.

0 ``---``, 1 ``+--``, 2 ``-+-``, 3 ``++-``, 4 ``--+``, 5 ``+-+``, 6 ``-++``, 7 ``+++``; keypoint 8 is the box centre.
"""
BOX_EDGES = ((0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7))
"""The twelve edges of the box as pairs of keypoints, for drawing."""


@dataclass(frozen=True, slots=True, eq=False)
class SymmetryAxis:
    """An axis about which any turn maps the model onto itself, up to the facets of its tessellation."""

    axis: Float64
    """(3,), unit vector, object frame."""
    offset: Float64 = field(default_factory=lambda: np.zeros(3))
    """(3,), a point on the axis, object frame, metres."""


@dataclass(frozen=True, slots=True, eq=False)
class Symmetries:
    """Rigid motions of the object frame that map the model onto itself (as in BOP's models_info)."""

    discrete: Float64 = field(default_factory=lambda: np.eye(4)[None])
    """(S, 4, 4), the identity first."""
    axes: tuple[SymmetryAxis, ...] = ()
    """Continuous symmetries."""

    @property
    def trivial(self) -> bool:
        """Whether the identity is the only symmetry."""
        return len(self.discrete) == 1 and not self.axes

    def poses(self, max_angle_step: float = np.pi / 18.0) -> Float64:
        """(S, 4, 4) symmetries, the identity first; continuous axes in equal steps of at most `max_angle_step` rad."""
        out = self.discrete
        for axis in self.axes:
            steps = int(np.ceil(2.0 * np.pi / max_angle_step))
            turns = np.stack([_turn_about(axis, 2.0 * np.pi * k / steps) for k in range(steps)])
            out = np.einsum("aij,bjk->abik", turns, out).reshape(-1, 4, 4)
        return out


def _turn_about(axis: SymmetryAxis, angle: float) -> Float64:
    rotation = exp_so3(angle * axis.axis)
    return transform(rotation, axis.offset - rotation @ axis.offset)


def half_turns(*axes: str) -> Symmetries:
    """Symmetries by 180 degrees about the named object axes (``x``, ``y``, ``z``) through the box centre."""
    signs = {"x": (1.0, -1.0, -1.0, 1.0), "y": (-1.0, 1.0, -1.0, 1.0), "z": (-1.0, -1.0, 1.0, 1.0)}
    return Symmetries(np.stack([np.eye(4)] + [np.diag(signs[a]) for a in axes]))


def rotational(axis: str = "z") -> Symmetries:
    """Symmetry by any turn about an object axis (``x``, ``y``, ``z``) through the box centre."""
    return Symmetries(axes=(SymmetryAxis(np.eye(3)["xyz".index(axis)]),))


def box_keypoints(extents: Float64) -> Float64:
    """(9, 3) corners of the box with side lengths `extents` centred at the origin (`BOX_CORNERS`), then its centre."""
    return np.concatenate([0.5 * BOX_CORNERS * extents, np.zeros((1, 3))])


@dataclass(frozen=True, slots=True, eq=False)
class ObjectModel:
    """A kind of object. Object frame: origin = centre of the model's axis-aligned box, z up when it stands."""

    name: str
    semantic_class: str
    """A key of `simtrack.objects.SEMANTIC_CLASSES`."""
    mesh: Mesh
    """Full resolution, for ray casting."""
    visual: Mesh
    """Few faces, coloured, for rendering. Catalogue objects: the same surface as `mesh` to rounding, so that a
    rasteriser and a ray caster see the same thing."""
    collision: tuple[Mesh, ...]
    """Convex parts whose union stands for the body in physics."""
    mass: float
    """Kilograms."""
    centre_of_mass: Float64
    """(3,), object frame, metres."""
    inertia: Float64
    """(3, 3), about the centre of mass, axes of the object frame, kg m^2."""
    friction: float
    """Coefficient of sliding friction."""
    extents: Float64
    """(3,), side lengths of the box, metres."""
    diameter: float
    """Largest distance between two points of the model, metres."""
    symmetries: Symmetries
    keypoints: Float64
    """(9, 3), object frame: the eight box corners in the order of `BOX_CORNERS`, then the centre."""
    trackable: bool
    """Whether the tracker has a model of it; clutter has none."""
    description: str = ""


def centred(points_of: Mesh, moved: Sequence[Mesh]) -> list[Mesh]:
    """Each of `moved`, shifted so that the box of `points_of` has its centre at the origin."""
    T = transform(translation=-points_of.bounds.mean(axis=0))
    return [meshes.transformed(mesh, T) for mesh in moved]


def build_model(
    *,
    name: str,
    semantic_class: str,
    mesh: Mesh,
    visual: Mesh,
    collision: Sequence[Mesh],
    mass: float,
    friction: float,
    symmetries: Symmetries,
    trackable: bool,
    description: str = "",
    solid: Mesh | None = None,
) -> ObjectModel:
    """Complete a model whose meshes share one frame: moves the origin to the box centre and derives the rest.

    `solid` is the closed mesh that the mass fills evenly (`visual` if None).
    """
    solid = visual if solid is None else solid
    mesh, visual, solid, *parts = centred(mesh, [mesh, visual, solid, *collision])
    _, centre_of_mass, inertia = meshes.mass_properties(solid, mass=mass)
    return ObjectModel(
        name=name,
        semantic_class=semantic_class,
        mesh=mesh,
        visual=visual,
        collision=tuple(parts),
        mass=mass,
        centre_of_mass=centre_of_mass,
        inertia=inertia,
        friction=friction,
        extents=mesh.extents,
        diameter=meshes.diameter(mesh),
        symmetries=symmetries,
        keypoints=box_keypoints(mesh.extents),
        trackable=trackable,
        description=description,
    )
