"""What a run believed at its end, as entities: the surveyed map's pieces and the tracked objects with their models.

Read from ``graph.json``, ``map.npz`` and ``tracks.csv`` of its folder; no true pose is looked at.
"""

import csv
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtrack.contracts import MapEntity, StaticMap
from simtrack.errors import FileFormatError, SimtrackError, UnknownNameError
from simtrack.geometry.meshes import Mesh, box_mesh
from simtrack.objects import ObjectModel, load_object
from simtrack.perception.mapping.static_entities import entity_meshes
from simtrack.perception.scene_graph import Entity, Layer, SceneFacts, load_graph
from simtrack.perception.scene_graph.contact.nodes import EntityMesh, Finding, FindingCode

MAX_ELEMENTS = 50_000_000
"""Of an array in ``map.npz``; larger ones are refused before they are read."""


@dataclass(frozen=True, slots=True)
class RunEntities:
    """The believed scene of a run."""

    name: str
    """Of the run's folder."""
    entities: tuple[EntityMesh, ...]
    """Pieces of the map first, then tracked objects, whose frame is that of their model."""
    models: dict[str, ObjectModel]
    """Name of a tracked entity -> its model."""
    findings: tuple[Finding, ...]
    """What was left out, and why."""


def tracked_entities(run: str | Path) -> RunEntities:
    """The entities of a run's folder.

    What still moved when the run ended (in a hand, say) is left out: nothing at rest holds it.

    Raises:
        FileFormatError: a file of the run is missing or broken; names it.
    """
    run = Path(run)
    for name in ("graph.json", "map.npz"):
        if not (run / name).is_file():
            raise FileFormatError(run / name, "", "no such file; give the folder of a run of `simtrack run`")
    facts = load_graph(run / "graph.json")
    pieces = map_pieces(run / "map.npz", facts)
    findings: list[Finding] = []
    moving = _with_load(facts, moving_objects(run / "tracks.csv"))
    entities, models = list(pieces), dict[str, ObjectModel]()
    shapes: dict[str, Mesh] = {}
    for entity in facts.entities.values():
        if entity.layer is not Layer.OBJECT:
            continue
        if entity.name in moving:
            findings.append(Finding(FindingCode.IN_MOTION, entity.name, moving[entity.name]))
            continue
        model = _model(entity, findings)
        if model is not None:
            models[entity.name] = model
            shapes[entity.class_name] = model.visual
        elif entity.class_name not in shapes:
            shapes[entity.class_name] = box_mesh(entity.extents)
        entities.append(EntityMesh(entity.name, entity.class_name, shapes[entity.class_name], entity.T_map))
    return RunEntities(run.resolve().name, tuple(entities), models, tuple(findings))


def _model(entity: Entity, findings: list[Finding]) -> ObjectModel | None:
    """The catalogue's or the user's model of an object; None, with a finding, where there is none any more."""
    try:
        return load_object(entity.class_name)
    except UnknownNameError:
        reason = f"no object is called '{entity.class_name}' (is its folder in $SIMTRACK_OBJECTS?)"
    except SimtrackError as error:
        reason = str(error)
    findings.append(Finding(FindingCode.MODEL_MISSING, entity.name, f"{reason}: its box stands for it"))
    return None


def map_pieces(path: Path, facts: SceneFacts) -> list[EntityMesh]:
    """Pieces of the surveyed map in ``map.npz``, with the classes and poses that the scene graph knows them by.

    Raises:
        FileFormatError: the file is not what `RunFolder.write_map` writes, or is of another run.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if any(entry.file_size > 8 * MAX_ELEMENTS for entry in archive.infolist()):
                raise FileFormatError(path, "", f"holds more than {MAX_ELEMENTS} numbers")
        with np.load(path, allow_pickle=False) as data:
            vertices, faces = np.asarray(data["vertices"], np.float32), np.asarray(data["faces"], np.int32)
            owners, names = np.asarray(data["owners"], np.int32), [str(name) for name in data["names"]]
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise FileFormatError(path, "", f"is no map of a run: {error}") from error
    good = vertices.ndim == 2 and vertices.shape[1] == 3 and faces.ndim == 2 and faces.shape[1] == 3
    good = good and np.isfinite(vertices).all() and owners.shape == faces.shape[:1]
    if not good or (faces.size and not 0 <= faces.min() <= faces.max() < len(vertices)):
        raise FileFormatError(path, "vertices, faces, owners", "do not make a mesh with an owner for each face")
    for name in names:
        if name not in facts.entities or facts.entities[name].layer is not Layer.STATIC:
            raise FileFormatError(path, "names", f"'{name}' is no static entity of the run's graph.json")
    known = [facts.entities[name] for name in names]
    pieces = tuple(MapEntity(e.name, e.semantic_class, e.T_map, e.extents) for e in known)
    meshes = entity_meshes(StaticMap(vertices, faces, pieces), owners)
    return [EntityMesh(e.name, e.semantic_class, meshes[e.name], e.T_map) for e in known if e.name in meshes]


def moving_objects(path: Path) -> set[str]:
    """Names of the objects that were believed to move in the last frame of a ``tracks.csv``.

    Raises:
        FileFormatError: the file is missing, or is no table of tracks.
    """
    last, moving = -1, set[str]()
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            for row in csv.DictReader(stream):
                stamp = int(row["stamp_ns"])
                if stamp != last:
                    last, moving = stamp, set()
                if int(row["moving"]):
                    moving.add(f"{row['class']}-{int(row['track'])}")
    except (OSError, UnicodeDecodeError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise FileFormatError(path, "", f"is no table of tracks: {error}") from error
    return moving


def _with_load(facts: SceneFacts, moving: set[str]) -> dict[str, str]:
    """What moved and all that stood on or in it -> what is to be said of it."""
    said = dict.fromkeys(moving, "moved when the run ended, as in a hand: left out, since nothing at rest holds it")
    for name in facts.entities:
        below, carrier = [], name
        while carrier in facts.entities and carrier not in below:
            if carrier in moving and name not in moving:
                said[name] = f"stood on or in '{carrier}', which moved when the run ended: left out with it"
            below.append(carrier)
            carrier = facts.entities[carrier].parent
    return said
