"""Labels of the images that a simulated robot's camera takes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from simtrack.contracts import Int32, LidarScan, MapEntity, Odometry, RgbdFrame
from simtrack.datasets.annotate import Annotator, Owners
from simtrack.datasets.content import Placed
from simtrack.datasets.frame import Category, LabelledFrame, LidarLabels, StuffCategory
from simtrack.datasets.relations import Relations
from simtrack.datasets.stages import FAR, category_of, stuff_categories
from simtrack.errors import InvalidValueError
from simtrack.objects import ObjectModel
from simtrack.simulation.simulation import Simulation

LOOSE = ("robot", "hand")
"""Classes of what moves and is no object."""


def target_categories(models: Sequence[ObjectModel]) -> tuple[Category, ...]:
    """The classes of labelled objects, numbered in the order of the models."""
    return tuple(Category(k, model) for k, model in enumerate(models, start=1))


def stuff_of(static: set[str], clutter: set[str], targets: int) -> dict[tuple[str, bool], StuffCategory]:
    """(class, whether instances are told apart) -> category, of all that is no target.

    Args:
        static: semantic classes of building and furniture.
        clutter: those of loose things without a category.
        targets: number of categories of targets.
    """
    return stuff_categories(static, {*clutter, *LOOSE}, targets)


class SimulationLabels:
    """Labels for one simulation; made anew where another scene is simulated."""

    def __init__(
        self,
        simulation: Simulation,
        categories: Sequence[Category],
        stuff: Mapping[tuple[str, bool], StuffCategory],
        annotator: Annotator | None = None,
    ) -> None:
        """Look up what there is.

        Args:
            simulation: whose images are labelled.
            categories: of the scene's catalogue objects.
            stuff: of everything else, see `stuff_of`.
            annotator: for the simulation's camera; made here if None.
        """
        self._simulation, self._stuff = simulation, stuff
        self._of_model = {category.model.name: category.id for category in categories}
        self._annotator = annotator or Annotator(simulation.camera.intrinsics, FAR)
        self._owners, self._things, self._segments = self._find_owners(), self._find_things(), self._find_segments()

    def label(
        self,
        frame: RgbdFrame,
        scene: int,
        index: int,
        *,
        scan: LidarScan | None = None,
        odometry: Odometry | None = None,
        relations: Relations | None = None,
        entities: Sequence[MapEntity] = (),
    ) -> LabelledFrame:
        """All labels of an image.

        Args:
            frame: with colour, of a moment that the simulation remembers.
            scene: number of the scene that it belongs to.
            index: of the image in it.
            scan: that goes with it.
            odometry: that goes with it.
            relations: keeps those between objects up to date; none are written if None.
            entities: what they refer to besides objects.

        Raises:
            InvalidValueError: the image has no colour.
        """
        if frame.rgb is None:
            raise InvalidValueError("frame.rgb", None, "an image with colour")
        simulation, truth = self._simulation, self._simulation.truth.at(frame.stamp)
        rays = simulation.truth.rays(frame.stamp).scene
        placed = tuple(replace(thing, T_map_object=truth.objects[thing.name].T_map_object) for thing in self._things)
        view = self._annotator.look(rays, self._owners, truth.T_map_camera)
        support = tuple(sorted(truth.contacts))
        return LabelledFrame(
            scene=scene,
            index=index,
            stamp=frame.stamp,
            intrinsics=frame.intrinsics,
            T_map_camera=truth.T_map_camera,
            rgb=frame.rgb,
            depth=frame.depth,
            clean_depth=view.depth,
            normals=view.normals,
            ids=view.ids,
            names=simulation.truth.names,
            segment_categories=self._segments,
            labels=self._annotator.annotate(placed, rays, truth.T_map_camera, view.ids, frame.depth),
            lidar=None if scan is None else self._lidar_labels(scan),
            odometry=odometry,
            T_map_base=truth.T_map_base,
            joints=simulation.truth.joint_positions(frame.stamp),
            support=support,
            relations=() if relations is None else relations.of(placed, list(entities), support),
        )

    def _find_owners(self) -> Owners:
        """Ids of the simulation's ray instances: `World.names` by index."""
        rays, names = self._simulation.truth.rays(0), self._simulation.world.names
        first = 0 if rays.fixed is None else 1
        whole = {k: names.index(thing.name) for k, thing in enumerate(rays.moving, first)}
        return Owners(whole, {} if rays.fixed is None else {rays.fixed: rays.face_ids(rays.fixed)})

    def _find_things(self) -> list[Placed]:
        """Objects and clutter, wherever they are."""
        world, rays = self._simulation.world, self._simulation.truth.rays(0)
        instances = {thing.name: k for k, thing in enumerate(rays.moving, 0 if rays.fixed is None else 1)}
        things = []
        for name, model in world.objects.items():
            category = self._of_model[model.name] if world.is_catalogue(name) else None
            things.append(
                Placed(
                    instance=world.names.index(name),
                    ray_instance=instances[name],
                    name=name,
                    semantic_class=model.semantic_class,
                    category=category,
                    mesh=rays.scene.mesh(instances[name]),
                    T_map_object=np.eye(4),
                    scale=np.ones(3),
                    extents=model.extents,
                    keypoints=model.keypoints if category is not None else np.empty((0, 3)),
                )
            )
        return things

    def _find_segments(self) -> Int32:
        """(N,), category of each of the simulation's names."""
        world = self._simulation.world
        parts = {part.name: part.semantic_class for part in world.static.parts}
        categories = []
        for name in world.names:
            if name in world.objects and world.is_catalogue(name):
                categories.append(self._of_model[world.objects[name].name])
                continue
            loose = name in world.objects or name in LOOSE
            semantic_class = world.objects[name].semantic_class if name in world.objects else parts.get(name, name)
            categories.append(category_of(self._stuff, semantic_class, loose))
        return np.array(categories, np.int32)

    def _lidar_labels(self, scan: LidarScan) -> LidarLabels:
        truth = self._simulation.truth
        return LidarLabels(scan, truth.at(scan.stamp).T_map_lidar, truth.lidar_ids(scan.stamp))
