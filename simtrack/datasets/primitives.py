"""Shapes of random form, and texture coordinates for what has none."""

import numpy as np

from simtrack.contracts import Float32
from simtrack.datasets.recipe import PrimitiveKind, PrimitiveSettings
from simtrack.geometry import meshes
from simtrack.geometry.meshes import Mesh
from simtrack.objects import ObjectModel, Symmetries, shapes
from simtrack.objects.model import build_model
from simtrack.objects.shapes import Solid

ANY_CLASS = "artifact"
"""Semantic class of a shape without a name."""
DENSITY = 400.0
"""kg/m^3, of a hollow thing of plastic or a solid one of wood."""


def primitive(settings: PrimitiveSettings, rng: np.random.Generator) -> ObjectModel:
    """A random shape whose sides are as long as `settings.size` says, of one of its kinds."""
    kind = settings.kinds[int(rng.integers(len(settings.kinds)))]
    size = rng.uniform(*settings.size, 3)
    parts = _parts(kind, size, rng)
    mesh = meshes.concatenate([part.mesh() for part in parts]) if len(parts) > 1 else parts[0].mesh()
    mesh = meshes.validate(Mesh(mesh.vertices, mesh.faces), kind)
    # What a solid of two boxes weighs does not matter to a thousandth; that it is closed does.
    mass = max(0.01, DENSITY * meshes.volume(mesh))
    return build_model(
        name=kind, semantic_class=ANY_CLASS, mesh=mesh, visual=mesh,
        collision=[meshes.convex_hull(part.mesh().vertices) for part in parts],
        mass=mass, friction=0.6, symmetries=Symmetries(), trackable=False,
    )  # fmt: skip


def _parts(kind: PrimitiveKind, size: np.ndarray, rng: np.random.Generator) -> list[Solid]:
    """Convex solids that make up a shape in a box of that size."""
    x, y, z = size.tolist()
    if kind == "box":
        return [shapes.box((x, y, z))]
    if kind == "cylinder":
        return [shapes.cylinder(0.5, z, segments=40).scaled(x, y, 1.0)]
    if kind == "cone":
        return [shapes.cylinder(0.5, z, top=float(rng.uniform(0.05, 0.4)), segments=40).scaled(x, y, 1.0)]
    if kind == "prism":
        angles = np.sort(2.0 * np.pi * (np.arange(n := int(rng.integers(3, 8))) + rng.uniform(-0.3, 0.3, n)) / n)
        return [shapes.prism([(x / 2 * np.cos(a), y / 2 * np.sin(a)) for a in angles], z)]
    if kind == "sphere":
        return [shapes.sphere(0.5, segments=32).scaled(x, y, z)]
    if kind == "capsule":
        radius = min(x, z) / 2
        ends = [shapes.sphere(radius, segments=24).at(y=side * y / 2) for side in (-1, 1)]
        return [shapes.hull(shapes.GREY, *ends)]
    wall = float(rng.uniform(0.15, 0.4))
    foot, back = shapes.box((x, y, wall * z)), shapes.box((wall * x, y, (1 - wall) * z))
    return [foot, back.at(x=(wall - 1) * x / 2, z=z / 2)]


def box_mapping(mesh: Mesh, tile: float, rng: np.random.Generator) -> Float32:
    """(F, 3, 2) texture coordinates: each face is projected along the axis that it faces, from a random origin.

    Args:
        mesh: to be textured.
        tile: metres that the texture covers before it repeats.
        rng: decides where it begins.
    """
    across = np.abs(meshes.face_normals(mesh)).argmax(axis=1)
    axes = np.array([[1, 2], [0, 2], [0, 1]])[across]
    corners = mesh.vertices[mesh.faces] / tile + rng.random(3)
    return np.take_along_axis(corners, np.repeat(axes[:, None, :], 3, axis=1), axis=2).astype(np.float32)
