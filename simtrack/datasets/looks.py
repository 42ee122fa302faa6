"""How a scene looks: colours, materials, textures and lights, drawn as a recipe says."""

from pathlib import Path

import numpy as np

from simtrack.contracts import Float64, Uint8
from simtrack.datasets.content import Light, Material, Shape
from simtrack.datasets.physics import Body
from simtrack.datasets.primitives import box_mapping
from simtrack.datasets.recipe import PRIMITIVES, LightSettings, MaterialSettings, Recipe
from simtrack.datasets.stages import Stage
from simtrack.datasets.textures import image_texture, random_color, texture
from simtrack.geometry.meshes import Mesh, area, subdivide_to

FACE_AREA, SUPPORT_AREA = 0.1, 0.01
"""Square metres: faces of the building, and of the part that carries things, are cut to about this size, for renderers
that light vertices alone."""


class Wardrobe:
    """Draws the looks of scenes. Images of the user's folder are listed once, read where they are drawn."""

    def __init__(self, recipe: Recipe) -> None:
        """Prepare; raises FileFormatError if the recipe names a folder without images."""
        from simtrack.datasets.textures import image_files

        self._materials, self._textures, self._lights = recipe.materials, recipe.textures, recipe.lights
        images = recipe.textures.images
        self._images: tuple[Path, ...] = () if images is None else image_files(recipe.beside(images))

    def stage(self, stage: Stage, rng: np.random.Generator) -> list[Shape]:
        """Shapes of the building: parts of one semantic class share a texture, the others share a shift of colours."""
        plain, drawn, shapes = self._material(rng, None), {}, []
        shift = rng.uniform(-1.0, 1.0, 3)
        for part in stage.static.parts:
            if not len(part.mesh.faces):
                continue
            mesh = _cut(part.mesh, SUPPORT_AREA if part.name == stage.support else FACE_AREA)
            if part.name not in stage.textured:
                shapes.append(Shape(_shifted(mesh, self._materials, shift), part.T_map_part, plain))
                continue
            if part.semantic_class not in drawn:
                drawn[part.semantic_class] = self._material(rng, self._texture(rng)), rng.uniform(*self._textures.tile)
            material, tile = drawn[part.semantic_class]
            shapes.append(Shape(mesh, part.T_map_part, material, box_mapping(mesh, tile, rng)))
        return shapes

    def thing(self, body: Body, T_map_object: Float64, target: bool, rng: np.random.Generator) -> Shape:
        """The shape of a thing: targets nearly in their own colours, distractors in any, primitives textured."""
        mesh = body.model.visual
        T_map_mesh = T_map_object @ np.diag([body.scale, body.scale, body.scale, 1.0])
        if body.model.name in PRIMITIVES and not target:
            mapping = box_mapping(mesh, 0.3 * rng.uniform(*self._textures.tile), rng)
            return Shape(mesh, T_map_mesh, self._material(rng, self._texture(rng)), mapping)
        if target or rng.random() >= self._materials.recolor:
            mesh = _shifted(mesh, self._materials, rng.uniform(-1.0, 1.0, 3))
        else:
            mesh = _recolored(mesh, rng)
        return Shape(mesh, T_map_mesh, self._material(rng, None))

    def lights(self, middle: Float64, rng: np.random.Generator) -> tuple[tuple[Light, ...], Float64]:
        """Lights about a point (3,) of the map, metres, and the ambient light (3,)."""
        settings = self._lights
        count = int(rng.integers(settings.count[0], settings.count[1] + 1))
        strength = rng.uniform(*settings.intensity) * rng.dirichlet(np.full(count, 3.0)) if count else np.empty(0)
        lights = tuple(_light(settings, middle, float(part), rng) for part in strength)
        return lights, rng.uniform(*settings.ambient) * _tint(settings, rng)

    def _material(self, rng: np.random.Generator, pattern: Uint8 | None) -> Material:
        roughness, metallic = rng.uniform(*self._materials.roughness), rng.uniform(*self._materials.metallic)
        return Material(pattern, float(roughness), float(metallic))

    def _texture(self, rng: np.random.Generator) -> Uint8:
        settings = self._textures
        if self._images and rng.random() < settings.image_share:
            return image_texture(self._images[int(rng.integers(len(self._images)))], settings.size, rng)
        return texture(settings.kinds[int(rng.integers(len(settings.kinds)))], settings.size, rng)


def _tint(settings: LightSettings, rng: np.random.Generator) -> Float64:
    color = rng.uniform(*settings.color, 3)
    return color / max(float(color.max()), 1e-6)


def _light(settings: LightSettings, middle: Float64, strength: float, rng: np.random.Generator) -> Light:
    azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(*settings.elevation)
    distance = float(rng.uniform(*settings.distance))
    toward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    return Light(
        position=middle + distance * toward,
        direction=-toward,
        color=strength * _tint(settings, rng),
        directional=bool(rng.random() < settings.directional),
        reach=distance,
        radius=float(rng.uniform(*settings.radius)),
    )


# -------------------------------------------------------------------------------------------------------------- colours


def _cut(mesh: Mesh, face_area: float) -> Mesh:
    """The same surface in smaller faces, of so many square metres on average."""
    wanted = int(area(mesh) / face_area)
    return mesh if wanted <= len(mesh.faces) else subdivide_to(mesh, wanted)


def _distinct(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) colours of a mesh, 0 to 1, ascending, and (F,) which of them a face has."""
    if mesh.face_colors is None:
        return np.full((1, 3), 200 / 255), np.zeros(len(mesh.faces), np.int64)
    keys = mesh.face_colors.astype(np.int64) @ np.array([65536, 256, 1])
    found, which = np.unique(keys, return_inverse=True)
    return np.stack([found >> 16, found >> 8 & 255, found & 255], axis=1) / 255.0, which


def _in_colors(mesh: Mesh, colors: Float64, which: np.ndarray) -> Mesh:
    rounded = np.round(255.0 * np.clip(colors, 0.0, 1.0)).astype(np.uint8)
    return Mesh(mesh.vertices, mesh.faces, rounded[which])


def _shifted(mesh: Mesh, settings: MaterialSettings, shift: Float64) -> Mesh:
    """The mesh with hue, saturation and brightness of all its colours shifted by shares (3,) of what is allowed."""
    import cv2

    colors, which = _distinct(mesh)
    hsv = cv2.cvtColor(colors[None].astype(np.float32), cv2.COLOR_RGB2HSV)[0].astype(np.float64)
    hsv[:, 0] = (hsv[:, 0] + 360.0 * settings.hue * shift[0]) % 360.0
    hsv[:, 1:] = np.clip(hsv[:, 1:] * (1.0 + np.array([settings.saturation, settings.value]) * shift[1:]), 0.0, 1.0)
    shifted = cv2.cvtColor(hsv[None].astype(np.float32), cv2.COLOR_HSV2RGB)[0]
    return _in_colors(mesh, shifted.astype(np.float64), which)


def _recolored(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """The mesh with each of its colours exchanged for a random one."""
    colors, which = _distinct(mesh)
    return _in_colors(mesh, np.stack([random_color(rng) for _ in colors]), which)
