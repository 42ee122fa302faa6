"""What stands in a generated scene and how it looks: the seam between its making, its images and its labels."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from simtrack.contracts import Float32, Float64, Uint8
from simtrack.geometry.meshes import Mesh
from simtrack.raycast import RayScene, TriangleMesh


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A thing that is labelled, target or distractor, where it stands."""

    instance: int
    """Its value in id images."""
    ray_instance: int
    """Its instance in the scene's `RayScene`."""
    name: str
    semantic_class: str
    category: int | None
    """`Category.id` of a target; None for a distractor."""
    mesh: TriangleMesh
    """Object frame before scaling, metres: exactly what rays meet."""
    T_map_object: Float64
    """(4, 4), rigid."""
    scale: Float64
    """(3,), of the mesh along the object's axes; ones for targets."""
    extents: Float64
    """(3,), side lengths of the scaled box about the object frame's origin, metres."""
    keypoints: Float64
    """(K, 3), object frame, metres; (0, 3) for a distractor."""

    @property
    def T_map_mesh(self) -> Float64:
        """(4, 4), scale included: the transform of its instance in the ray scene."""
        return self.T_map_object @ np.diag([*self.scale, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """A light source of one scene."""

    position: Float64
    """(3,), map frame, metres. A directional light shines from there to the middle of the scene."""
    direction: Float64
    """(3,), unit, in which it shines."""
    color: Float64
    """(3,), 0 to 1, times its intensity: what a white matt surface shows that faces it at `reach` (point) or anywhere
    (directional)."""
    directional: bool
    reach: float = 1.0
    """Metres from a point light at which it has its nominal intensity; it falls with the square of the distance."""
    radius: float = 0.0
    """Metres: size of the source, for soft shadows."""


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """How a surface looks, as in the metallic-roughness model of glTF 2.0."""

    texture: Uint8 | None = None
    """(H, W, 3), sRGB, repeated, row 0 at v = 0; None = the mesh's face colours, sRGB (grey if it has none)."""
    roughness: float = 0.7
    """0 = mirror, 1 = matt."""
    metallic: float = 0.0
    """0 = dielectric, 1 = metal."""


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """One visible mesh of a scene."""

    mesh: Mesh
    """Own frame before scaling, metres, in its colours of this scene; the light visual mesh where rays meet a finer one
    of the same surface."""
    T_map_mesh: Float64
    """(4, 4), with the scale in it."""
    material: Material
    uv: Float32 | None = None
    """(F, 3, 2), texture coordinates of each face's corners, for a texture."""


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """One settled scene, complete: enough for any renderer."""

    scene: int
    shapes: tuple[Shape, ...]
    things: tuple[Placed, ...]
    """By ascending instance."""
    rays: RayScene
    """The same scene to be cast at, in its present state."""
    lights: tuple[Light, ...]
    ambient: Float64
    """(3,), 0 to 1: light from everywhere."""
    background: Float64
    """(3,), sRGB 0 to 1, of what rays miss."""
    support: tuple[tuple[str, str], ...] = ()
    """(carried, carrier)."""
    names: tuple[str, ...] = field(default=())
    """Of everything in it, by id."""

    def targets(self) -> Iterator[Placed]:
        """Things with a category."""
        return (thing for thing in self.things if thing.category is not None)


@runtime_checkable
class ColorRenderer(Protocol):
    """Makes the colour images of settled scenes; pixel centres at integer indices, as everywhere."""

    def begin(self, content: Content) -> None:
        """Take over the next scene; images depend on `content` alone, not on scenes before it."""
        ...

    def render(self, T_map_camera: Float64) -> Uint8:
        """(H, W, 3), sRGB, what a camera at a (4, 4) pose sees."""
        ...

    def close(self) -> None:
        """Release what it holds; may be called twice."""
        ...
