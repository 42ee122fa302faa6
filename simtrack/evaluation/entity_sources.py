"""Entities to reconstruct a scene from: of rooms (true, or seen on a walk), of a map, and of what a run believed."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias, get_args

import numpy as np

from simtrack.errors import InvalidValueError
from simtrack.objects import ObjectModel
from simtrack.perception.scene_graph.contact.nodes import EntityMesh, Finding
from simtrack.simulation.building.rooms.plan import kind_of
from simtrack.simulation.scene_file import SceneFile, load_scene

LISTING = "entities.json"
"""What tells the folder of a map."""
EntityChoice: TypeAlias = Literal["true", "partial", "tracked", "mapped"]


@dataclass(frozen=True, slots=True)
class SourceEntities:
    """Entities of a source."""

    name: str
    """Of the scene, fit for a file's name."""
    entities: tuple[EntityMesh, ...]
    models: Mapping[str, ObjectModel] = field(default_factory=dict)
    """Name of a tracked entity -> its model."""
    findings: tuple[Finding, ...] = ()
    """What was left out, and why."""


def source_entities(source: str, choice: EntityChoice | None = None, seed: int = 0) -> SourceEntities:
    """Entities of a scene (``rooms:7``) or of the folder of a run.

    Args:
        source: name or path of a scene, or the folder of a run or of a map.
        choice: ``true`` meshes, ``partial`` ones as seen on a walk, ``tracked`` or ``mapped`` ones; if None, mapped for
            maps, tracked for runs and true for scenes.
        seed: of a scene whose name fixes none, and of the walk.

    Raises:
        UnknownNameError: no such scene.
        FileFormatError: a file of the scene or run is missing or broken.
        InvalidValueError: the source does not have such entities.
    """
    if choice not in (None, *get_args(EntityChoice)):
        raise InvalidValueError("entities", choice, ", ".join(get_args(EntityChoice)))
    folder = Path(source)
    if folder.is_dir() and not (folder / "scene.yaml").is_file():
        if choice == "mapped" or (choice is None and (folder / LISTING).is_file()):
            return mapped_entities(folder)
        if choice not in (None, "tracked"):
            raise InvalidValueError("entities", choice, f"tracked: {source} is the folder of a run")
        from simtrack.evaluation.run_entities import tracked_entities

        run = tracked_entities(folder)
        return SourceEntities(run.name, run.entities, run.models, run.findings)
    scene = load_scene(source)
    if choice in ("tracked", "mapped"):
        raise InvalidValueError(
            "entities", choice, f"true or partial: {source} is a scene, and nothing {choice} it yet"
        )
    if scene.static.builder != "room":
        return scene_objects(scene, choice or "true", seed)
    return room_entities(scene, choice or "true", seed)


def mapped_entities(folder: Path) -> SourceEntities:
    """Entities of the folder of a panoptic map, every wall by itself.

    Raises:
        FileFormatError, MeshError: a file of it is missing or broken.
    """
    from simtrack.perception.mapping.panoptic.files import read_entities
    from simtrack.perception.mapping.panoptic.layout import split_layout

    entities = split_layout(read_entities(folder), np.random.default_rng(0))
    meshes = tuple(EntityMesh(e.name, e.semantic_class, e.mesh) for e in entities)
    return SourceEntities(folder.resolve().name, meshes)


def room_entities(scene: SceneFile, choice: EntityChoice, seed: int) -> SourceEntities:
    """Entities of a room of a seed: all of their surface, or what a camera saw of it on a walk."""
    from simtrack.simulation.building.rooms.physics import settled_room
    from simtrack.simulation.building.rooms.walk import partial_entities

    number = scene.static.seed if scene.static.seed is not None else seed
    kind = kind_of(scene.static.config)
    room = settled_room(number, kind)
    if choice == "true":
        meshes = tuple(EntityMesh(e.name, e.semantic_class, e.mesh) for e in room.entities)
    else:
        seen = partial_entities(room, np.random.default_rng(np.random.SeedSequence([number, seed])))
        # What nobody saw is not there for whoever looks.
        meshes = tuple(EntityMesh(e.name, e.semantic_class, e.mesh) for e in seen if len(e.mesh.faces))
    return SourceEntities(f"{scene.name}-{number}", meshes)


def scene_objects(scene: SceneFile, choice: EntityChoice, seed: int) -> SourceEntities:
    """Pieces and objects of a scene that is no room, as they truly are when a run of that seed begins."""
    if choice != "true":
        raise InvalidValueError("entities", choice, f"true: nobody walks through {scene.name}; run it for tracked ones")
    from simtrack.simulation.scene_entities import true_entities

    entities, models = true_entities(scene, seed)
    return SourceEntities(f"{scene.name}-{seed}", entities, models)
