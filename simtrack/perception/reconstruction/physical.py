"""Mass, inertia and friction of a reconstructed body from its size, class and material.

For bodies that have no CAD model with masses of its own. The shapes enclose more than there is of material, as
furniture is hollow: a class has the share of the enclosed volume that its material fills.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from simtrack.contracts import Float64
from simtrack.errors import MeshError, UnknownNameError
from simtrack.geometry.meshes import Mesh, concatenate, convex_hull, mass_properties


@dataclass(frozen=True, slots=True)
class Substance:
    """What a body is made of."""

    density: float
    """kg/m^3 of the solid."""
    friction: float
    """Coefficient of sliding friction against its like, dry."""
    source: str
    """Of the density; frictions are middles of the ranges in usual engineering tables."""


WOOD_HANDBOOK = "USDA Forest Products Laboratory, Wood Handbook, FPL-GTR-282 (2021), tables of specific gravity"
POLYMERS = "Polymer data sheets: ABS 1.02 to 1.08 g/cm^3, polypropylene 0.90 to 0.915 g/cm^3"
METALS = "Lust CDA3000 engineering guide, table 7.23: steel 7860 kg/m^3"
ASHBY = "M. F. Ashby, Materials Selection in Mechanical Design, table of densities"

SUBSTANCES = {
    "hardwood": Substance(650.0, 0.4, WOOD_HANDBOOK),
    "particleboard": Substance(680.0, 0.4, WOOD_HANDBOOK),
    "paper": Substance(800.0, 0.4, ASHBY),
    "plastic": Substance(1050.0, 0.4, POLYMERS),
    "steel": Substance(7860.0, 0.4, METALS),
    "ceramic": Substance(2300.0, 0.4, ASHBY),
    "glass": Substance(2500.0, 0.4, ASHBY),
    "foam": Substance(40.0, 0.7, ASHBY),
    "textile": Substance(300.0, 0.6, ASHBY),
    "soil": Substance(1300.0, 0.6, ASHBY),
}

CLASSES: dict[str, tuple[str, float]] = {
    # Shares are chosen so that common sizes come out at common weights, which the comments name.
    "bed": ("foam", 1.5),  # 2.0 x 1.6 x 0.5 m of mattress and frame: 95 kg
    "table": ("hardwood", 1.0),  # its parts are boards and legs
    "desk": ("particleboard", 1.0),
    "chair": ("hardwood", 1.0),
    "shelf": ("particleboard", 1.0),
    "cupboard": ("particleboard", 1.0),
    "cabinet": ("particleboard", 1.0),
    "sofa": ("foam", 1.6),  # 2.0 x 0.9 x 0.5 m of cushions and frame: 60 kg
    "fridge": ("steel", 0.0127),  # 0.6 x 0.65 x 1.8 m: 70 kg
    "microwave": ("steel", 0.032),  # 0.48 x 0.36 x 0.28 m: 12 kg
    "monitor": ("plastic", 0.55),
    "keyboard": ("plastic", 0.6),
    "bag": ("textile", 0.25),
    "box": ("paper", 0.15),  # cardboard, mostly empty
    "book": ("paper", 1.0),
    "cup": ("ceramic", 1.0),  # its parts are walls
    "mug": ("ceramic", 1.0),
    "bowl": ("ceramic", 1.0),
    "bottle": ("glass", 0.35),
    "plant": ("soil", 0.4),
}
"""Class -> substance, and the share of the volume of its convex parts that the substance fills."""
OTHER = ("plastic", 0.4)


@dataclass(frozen=True, slots=True)
class PhysicalProperties:
    """What an engine needs to know of a rigid body."""

    mass: float
    """Kilograms."""
    centre_of_mass: Float64
    """(3,), metres, frame of the parts."""
    inertia: Float64
    """(3, 3), about the centre of mass, kg m^2."""
    friction: float
    """Coefficient of sliding friction against its like."""
    substance: str


def physical_properties(parts: Sequence[Mesh], semantic_class: str, substance: str | None = None) -> PhysicalProperties:
    """Properties of a body of evenly filled convex parts; where parts overlap, the material counts once.

    Args:
        parts: closed convex meshes in one frame, metres.
        semantic_class: a key of `CLASSES`; any other is taken for a thing of plastic, mostly empty.
        substance: a key of `SUBSTANCES`; the class's own if None.

    Raises:
        UnknownNameError: no such substance.
        MeshError: there are no parts, or they enclose no volume.
    """
    usual, share = CLASSES.get(semantic_class, OTHER)
    name = usual if substance is None else substance
    if name not in SUBSTANCES:
        raise UnknownNameError("substance", name, SUBSTANCES)
    if not parts:
        raise MeshError(f"body of class '{semantic_class}'", "has no parts; at least one convex mesh is needed")
    material = SUBSTANCES[name]
    solid = _union(parts)
    mass, centre, inertia = mass_properties(solid, density=share * material.density)
    return PhysicalProperties(mass, centre, inertia, material.friction, name)


def _union(parts: Sequence[Mesh]) -> Mesh:
    import manifold3d
    import numpy as np

    hulls = [manifold3d.Manifold.hull_points(np.ascontiguousarray(part.vertices)) for part in parts]
    data = manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add).to_mesh64()
    if not len(data.tri_verts):
        return convex_hull(concatenate(parts).vertices)
    return Mesh(np.asarray(data.vert_properties)[:, :3], np.asarray(data.tri_verts, np.int32))
