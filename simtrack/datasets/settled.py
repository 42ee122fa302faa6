"""Frames of settled scenes: a scene is drawn, dropped and dressed, and looked at from many sides."""

from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64, Int32, Relation
from simtrack.datasets.annotate import Annotator, Owners
from simtrack.datasets.cameras import CameraShell
from simtrack.datasets.content import ColorRenderer, Content
from simtrack.datasets.effects import Effects
from simtrack.datasets.frame import LabelledFrame, SceneInfo, StuffCategory
from simtrack.datasets.looks import Wardrobe
from simtrack.datasets.mujoco_renderer import MujocoColorRenderer
from simtrack.datasets.physics import PlacementError, settle
from simtrack.datasets.primitives import ANY_CLASS
from simtrack.datasets.randomness import random_of
from simtrack.datasets.recipe import Recipe, SceneWorld, ShellViews
from simtrack.datasets.relations import Relations
from simtrack.datasets.stages import (
    FAR,
    Stage,
    build_stage,
    category_of,
    depth_noise,
    map_entities,
    scene_of,
    stuff_categories,
)
from simtrack.datasets.things import Things
from simtrack.errors import FileFormatError
from simtrack.geometry.meshes import concatenate, transformed
from simtrack.raycast import RayScene, TriangleMesh
from simtrack.sensors.depth_noise import apply_depth_noise

PERIOD = 33_333_333
"""Nanoseconds between the stamps of a settled scene's images."""


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """A settled scene, ready to be looked at."""

    content: Content
    owners: Owners
    segment_categories: Int32
    relations: tuple[Relation, ...]
    middle: Float64
    """(3,), of the support's area."""


class SettledScenes:
    """What `simtrack.datasets.generator.Generator` makes of recipes with views of kind ``shell``."""

    def __init__(self, recipe: Recipe, seed: int, renderer: ColorRenderer | None = None) -> None:
        """Load what all scenes share.

        Args:
            recipe: from `load_recipe`, with views of kind ``shell``.
            seed: of everything random.
            renderer: instead of the one that the recipe names.

        Raises:
            FileFormatError: what the recipe names does not exist or cannot be used.
        """
        assert isinstance(recipe.views, ShellViews)
        self._recipe, self._seed = recipe, seed
        self._things, self._wardrobe = Things(recipe), Wardrobe(recipe)
        self.categories = self._things.categories
        self._scenes = [
            scene_of(recipe, k) if isinstance(world, SceneWorld) else None for k, world in enumerate(recipe.worlds)
        ]
        self._noise = depth_noise(recipe)
        self._stuff = self._all_stuff()
        intrinsics = recipe.camera.intrinsics
        self._shell = CameraShell(recipe.views, intrinsics)
        self._annotator, self._relations = Annotator(intrinsics, FAR), Relations()
        self._renderer = renderer or color_renderer(recipe)
        self._effects = Effects(recipe.effects, intrinsics, linear=recipe.renderer == "pyrender")
        self.stuff = tuple(self._stuff.values())

    def scenes(self, count: int) -> int:
        """Number of scenes that hold at least `count` frames."""
        return -(-count // self._recipe.counts.views_per_scene)

    def scene_info(self, scene: int) -> SceneInfo:
        """What is known of a scene before it is made."""
        return SceneInfo(scene, self._recipe.counts.views_per_scene)

    def frames(self, scene: int) -> Iterator[LabelledFrame]:
        """Make the frames of a scene, in order.

        Raises:
            FileFormatError: the things cannot be placed, or the cameras; names the thing.
            RenderingError: no image can be rendered here.
        """
        with ExitStack() as exits:
            try:
                made = self._make(scene, exits.enter_context(closing(RayScene())))
            except PlacementError as error:
                raise FileFormatError(self._recipe.path, "placement", f"scene {scene}: {error}") from error
            self._renderer.begin(made.content)
            for index in range(self._recipe.counts.views_per_scene):
                yield self._frame(made, scene, index)

    def close(self) -> None:
        """Release OpenGL; may be called twice."""
        self._renderer.close()

    # ------------------------------------------------------------------------------------------------------- one scene

    def _make(self, scene: int, rays: RayScene) -> _Scene:
        stage = self._stage(scene)
        bodies = self._things.draw(random_of(self._seed, "things", scene))
        settled = settle(
            stage.static,
            [body for body, _ in bodies],
            stage.area,
            self._recipe.placement,
            random_of(self._seed, "placement", scene),
        )
        parts = [part for part in stage.static.parts if len(part.mesh.faces)]
        things = self._things.placed(bodies, settled.poses, first_id=len(parts), first_ray=1)
        building = concatenate([transformed(part.mesh, part.T_map_part) for part in parts])
        rays.add(TriangleMesh(building.vertices, building.faces, "building"), instance=0)
        for thing in things:
            rays.add(thing.mesh, thing.T_map_mesh, thing.ray_instance)
        by_face = np.repeat(np.arange(len(parts), dtype=np.int32), [len(part.mesh.faces) for part in parts])
        owners = Owners({thing.ray_instance: thing.instance for thing in things}, {0: by_face})

        rng, middle = random_of(self._seed, "looks", scene), stage.area.T_map_face[:3, 3]
        shapes = self._wardrobe.stage(stage, rng)
        for thing, (body, category) in zip(things, bodies, strict=True):
            shapes.append(self._wardrobe.thing(body, thing.T_map_object, category is not None, rng))
        lights, ambient = self._wardrobe.lights(middle, rng)
        names = (*(part.name for part in parts), *(thing.name for thing in things))
        content = Content(
            scene, tuple(shapes), things, rays, lights, ambient, rng.uniform(0.2, 0.9, 3), settled.support, names
        )
        categories = [category_of(self._stuff, part.semantic_class, False) for part in parts]
        categories += [thing.category or category_of(self._stuff, thing.semantic_class, True) for thing in things]
        relations = self._relations.of(things, map_entities(stage.static), settled.support)
        return _Scene(content, owners, np.array(categories, np.int32), relations, middle)

    def _stage(self, scene: int) -> Stage:
        rng = random_of(self._seed, "stage", scene)
        weights = np.array([world.weight for world in self._recipe.worlds])
        number = int(rng.choice(len(weights), p=weights / weights.sum()))
        return build_stage(self._recipe, number, self._scenes[number], rng)

    # ------------------------------------------------------------------------------------------------------- one frame

    def _frame(self, made: _Scene, scene: int, index: int) -> LabelledFrame:
        content, rng = made.content, random_of(self._seed, "camera", scene, index)
        try:
            T_map_camera = self._shell.draw(content.things, content.rays, made.middle, rng)
        except PlacementError as error:
            raise FileFormatError(self._recipe.path, "views", f"scene {scene}, view {index}: {error}") from error
        view = self._annotator.look(content.rays, made.owners, T_map_camera)
        noise = random_of(self._seed, "depth", scene, index)
        intrinsics = self._recipe.camera.intrinsics
        depth = apply_depth_noise(view.depth, view.normals, intrinsics, self._noise, noise)
        rgb = self._renderer.render(T_map_camera)
        rgb = self._effects.apply(rgb, content, view, T_map_camera, random_of(self._seed, "effects", scene, index))
        labels = self._annotator.annotate(content.things, content.rays, T_map_camera, view.ids, depth)
        return LabelledFrame(
            scene=scene,
            index=index,
            stamp=index * PERIOD,
            intrinsics=intrinsics,
            T_map_camera=T_map_camera,
            rgb=rgb,
            depth=depth,
            clean_depth=view.depth,
            normals=view.normals,
            ids=view.ids,
            names=content.names,
            segment_categories=made.segment_categories,
            labels=labels,
            support=content.support,
            relations=made.relations,
        )

    # ------------------------------------------------------------------------------------------------------- categories

    def _all_stuff(self) -> dict[tuple[str, bool], StuffCategory]:
        """(class, whether instances are told apart) -> category; the same for every seed."""
        static: set[str] = set()
        for k, scene in enumerate(self._scenes):
            parts = build_stage(self._recipe, k, scene, np.random.default_rng(0)).static.parts
            static |= {part.semantic_class for part in parts}
        loose = {model.semantic_class for model in self._things.distractors}
        if self._recipe.distractors.primitives.count[1]:
            loose.add(ANY_CLASS)
        return stuff_categories(static, loose, len(self.categories))


def color_renderer(recipe: Recipe) -> ColorRenderer:
    """The renderer that a recipe names."""
    intrinsics = recipe.camera.intrinsics
    if recipe.renderer == "mujoco":
        return MujocoColorRenderer(intrinsics, recipe.effects.antialiasing**2)
    from simtrack.datasets.pbr_renderer import PbrRenderer

    return PbrRenderer(intrinsics, recipe.effects.antialiasing**2)
