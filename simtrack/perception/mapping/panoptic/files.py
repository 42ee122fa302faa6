"""A folder of mapped entities: one PLY file an entity, and ``entities.json`` that says what they are.

entities.json            [{"name", "class", "class_id", "instance", "score", "file"}, ...]
entities/NAME.ply        map frame, metres; vertices carry class_id and instance, the header class and name
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from simtrack.errors import FileFormatError, MeshError
from simtrack.geometry.meshes import load_mesh
from simtrack.objects.export import write_ply
from simtrack.perception.mapping.panoptic.entities import MapEntityMesh, extract_surface
from simtrack.perception.mapping.panoptic.panoptic_map import PanopticMap

LISTING, FOLDER = "entities.json", "entities"
MOST_BYTES, MOST_ENTITIES = 10_000_000, 10_000
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _.-]{0,99}")


def write_entities(entities: Sequence[MapEntityMesh], folder: Path) -> list[str]:
    """Write entities into an existing folder; returns the names of the files, relative to it."""
    (folder / FOLDER).mkdir(exist_ok=True)
    classes = {name: k for k, name in enumerate(sorted({entity.semantic_class for entity in entities}), start=1)}
    rows = []
    for entity in entities:
        file = f"{FOLDER}/{entity.name.replace(' ', '_')}.ply"
        labels = {"class_id": classes[entity.semantic_class], "instance": entity.instance}
        comments = (f"class {entity.semantic_class}", f"name {entity.name}")
        write_ply(folder / file, entity.mesh, labels=labels, comments=comments)
        rows.append(
            {
                "name": entity.name,
                "class": entity.semantic_class,
                **labels,
                "score": round(entity.score, 6),
                "file": file,
            }
        )
    (folder / LISTING).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return [LISTING, *(str(row["file"]) for row in rows)]


def write_surface(panoptic_map: PanopticMap, entities: Sequence[MapEntityMesh], path: Path) -> None:
    """Write the whole surface of a map in one PLY file; class_id and instance of a vertex are 0 where there is none."""
    surface = extract_surface(panoptic_map.volume, panoptic_map.config.entities.least_weight)
    classes = {name: k for k, name in enumerate(sorted({entity.semantic_class for entity in entities}), start=1)}
    known = {(entity.semantic_class, entity.instance) for entity in entities}
    canonical = panoptic_map.labels.canonical
    ids = np.zeros((len(canonical), 2), np.int32)
    for label, each in panoptic_map.told_segments(surface).items():
        if (each.semantic_class, each.instance) in known:
            ids[label] = classes[each.semantic_class], each.instance
    of_vertex = np.zeros((len(surface.vertices), 2), np.int32)
    of_vertex[surface.faces] = ids[canonical[surface.labels]][:, None]
    mesh = surface.mesh
    comments = [f"class_id {number} {name}" for name, number in classes.items()]
    write_ply(path, mesh, labels={"class_id": of_vertex[:, 0], "instance": of_vertex[:, 1]}, comments=comments)


def read_entities(folder: Path) -> tuple[MapEntityMesh, ...]:
    """Read what `write_entities` wrote.

    Raises:
        FileFormatError: the listing is missing or broken, or names files outside the folder.
        MeshError: a mesh is.
    """
    path = folder / LISTING
    try:
        if path.stat().st_size > MOST_BYTES:
            raise FileFormatError(path, "", f"is larger than {MOST_BYTES} bytes")
        rows = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileFormatError(path, "", f"cannot be read: {error}") from error
    if not isinstance(rows, list) or len(rows) > MOST_ENTITIES:
        raise FileFormatError(path, "", f"expected a list of at most {MOST_ENTITIES} entities")
    found = []
    for number, row in enumerate(rows):
        where = f"[{number}]"
        try:
            name, kind, file = str(row["name"]), str(row["class"]), str(row["file"])
            instance, score = int(row["instance"]), float(row["score"])
        except (KeyError, TypeError, ValueError) as error:
            reason = "expected an object with name, class, instance, score and file"
            raise FileFormatError(path, where, reason) from error
        if not _NAME.fullmatch(name) or not _NAME.fullmatch(kind):
            raise FileFormatError(path, where, f"{name!r} of class {kind!r}: letters, digits, blanks, '_', '.', '-'")
        mesh_path = (folder / file).resolve()
        if not mesh_path.is_relative_to(folder.resolve()):
            raise FileFormatError(path, f"{where}.file", f"{file!r} lies outside the folder")
        if mesh_path.suffix != ".ply":
            raise MeshError(mesh_path, "is no .ply file")
        found.append(MapEntityMesh(name, kind, instance, score, load_mesh(mesh_path)))
    return tuple(found)
