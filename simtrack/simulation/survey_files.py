"""A survey as a folder: ``survey.npz`` with the map, ``survey.ply`` to look at."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from simtrack.contracts import Articulation, StaticMap
from simtrack.errors import FileFormatError
from simtrack.geometry.meshes import Mesh
from simtrack.objects.cache import UNUSABLE, open_arrays, write_arrays
from simtrack.objects.export import write_ply
from simtrack.simulation.building.cache import pack_map, unpack_map

FILE, MESH = "survey.npz", "survey.ply"
MOST_BYTES = 2**32
_JOINTS = "joints"


def write_survey(static_map: StaticMap, folder: Path) -> list[str]:
    """Write a survey into an existing folder; returns the names of the files."""
    arrays = dict(pack_map(static_map))
    for number, joint in enumerate(static_map.articulations):
        label = f"{_JOINTS}.{number}"
        arrays |= {
            f"{label}.text": np.array([joint.name, joint.semantic_class, joint.kind]),
            f"{label}.numbers": np.array([*joint.anchor, *joint.axis, joint.lower, joint.upper], float),
            f"{label}.vertices": joint.vertices,
            f"{label}.faces": joint.faces,
        }
    write_arrays(folder / FILE, {**arrays, f"{_JOINTS}.count": np.array(len(static_map.articulations))})
    write_ply(folder / MESH, Mesh(static_map.vertices.astype(float), static_map.faces))
    return [FILE, MESH]


def check_survey(path: Path) -> None:
    """Whether there is a survey, before anything is built; raises FileFormatError."""
    if not (path / FILE if path.is_dir() else path).is_file():
        raise FileFormatError(path, "", f"no {FILE} there; `simtrack survey SCENE --out DIR` makes one")


def read_survey(path: Path) -> StaticMap:
    """Read a survey from its folder, or its ``survey.npz``.

    Raises:
        FileFormatError: there is none, or it is damaged.
    """
    file = path / FILE if path.is_dir() else path
    try:
        if file.stat().st_size > MOST_BYTES:
            raise FileFormatError(file, "", f"is larger than {MOST_BYTES} bytes")
        with open_arrays(file) as data:
            arrays = dict(data)
        static_map = unpack_map(arrays)
        joints = tuple(_joint(arrays, f"{_JOINTS}.{k}") for k in range(int(arrays[f"{_JOINTS}.count"])))
        static_map = replace(static_map, articulations=joints)
    except UNUSABLE as error:
        reason = f"is no survey that can be read ({error}); `simtrack survey SCENE --out DIR` makes one"
        raise FileFormatError(file, "", reason) from error
    faces, vertices = static_map.faces, static_map.vertices
    if faces.ndim != 2 or faces.shape[1:] != (3,) or vertices.ndim != 2 or vertices.shape[1:] != (3,):
        raise FileFormatError(file, "vertices, faces", f"{vertices.shape}, {faces.shape}; expected (V, 3) and (F, 3)")
    if not len(faces) or not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
        raise FileFormatError(file, "faces", f"must name vertices 0 to {len(vertices) - 1}, at least one face")
    if not np.isfinite(vertices).all():
        raise FileFormatError(file, "vertices", "are not finite")
    return static_map


def _joint(arrays: dict[str, np.ndarray], label: str) -> Articulation:
    name, semantic_class, kind = (str(word) for word in arrays[f"{label}.text"])
    numbers = arrays[f"{label}.numbers"]
    if kind not in ("revolute", "prismatic") or numbers.shape != (8,):
        raise ValueError(f"{label}: a joint of kind {kind}")
    return Articulation(
        name, semantic_class, "revolute" if kind == "revolute" else "prismatic", numbers[:3], numbers[3:6],
        float(numbers[6]), float(numbers[7]), arrays[f"{label}.vertices"], arrays[f"{label}.faces"],
    )  # fmt: skip
