"""Models and meshes on disk: what takes long to build is built once a version and kept in the user's cache folder."""

import hashlib
import json
import logging
import os
import tempfile
import threading
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from simtrack import paths
from simtrack.geometry.meshes import Mesh, decimate
from simtrack.objects.model import ObjectModel, Symmetries, SymmetryAxis

_log = logging.getLogger("simtrack.cache")
UNUSABLE = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile)
"""What a file may raise that is missing, damaged or of another version."""
_reading = threading.Lock()
"""CPython 3.11 before 3.11.8 may fail while two threads parse Python, which numpy does to read the head of an array."""
_SCALARS = ("name", "semantic_class", "mass", "friction", "diameter", "trackable", "description")
_ARRAYS = ("centre_of_mass", "inertia", "extents", "keypoints")


def digest(*content: bytes) -> str:
    """Key of cached content: its hash together with the code and the libraries that make models."""
    sha = hashlib.sha256(_makers())
    for part in content:
        sha.update(len(part).to_bytes(8, "little") + part)
    return sha.hexdigest()[:24]


@cache
def _makers() -> bytes:
    """Hash of the code and the libraries."""
    sha = hashlib.sha256()
    here = Path(__file__).resolve().parent
    for source in sorted([*here.rglob("*.py"), here.parent / "geometry" / "meshes.py"]):
        sha.update(source.read_bytes())
    for library in ("numpy", "manifold3d", "fast-simplification", "scipy"):
        sha.update(version(library).encode())
    return sha.digest()


def cached_model(name: str, key: str, build: Callable[[], ObjectModel]) -> ObjectModel:
    """The model kept under `name` and `key`, else built and kept; a cache that cannot be used is no error."""
    path = paths.cache_dir() / "objects" / f"{name}-{key}.npz"
    with suppress(*UNUSABLE):
        return _read(path)
    _log.info("building object models: %s", name)
    model = build()
    with suppress(OSError):
        write_arrays(path, _pack(model))
    return model


def cached_decimation(name: str, mesh: Mesh, target_faces: int) -> Mesh:
    """`simtrack.geometry.meshes.decimate`, its result kept under `name` and by what the mesh consists of."""
    if target_faces >= len(mesh.faces):
        return mesh
    parts = [mesh.vertices, mesh.faces, *([] if mesh.face_colors is None else [mesh.face_colors])]
    key = digest(*(part.tobytes() for part in parts), str(target_faces).encode())
    path = paths.cache_dir() / "objects" / f"{name}-{target_faces}-{key}.npz"
    with suppress(*UNUSABLE), open_arrays(path) as data:
        return read_mesh(data, "mesh")
    _log.info("simplifying object models: %s", name)
    mesh = decimate(mesh, target_faces)
    with suppress(OSError):
        write_arrays(path, mesh_arrays("mesh", mesh))
    return mesh


def _pack(model: ObjectModel) -> Mapping[str, Any]:
    arrays: dict[str, Any] = {"scalars": np.array(json.dumps({k: getattr(model, k) for k in _SCALARS}))}
    arrays |= {k: getattr(model, k) for k in _ARRAYS}
    arrays["discrete"] = model.symmetries.discrete
    arrays["axes"] = np.array([[a.axis, a.offset] for a in model.symmetries.axes]).reshape(-1, 2, 3)
    for label, mesh in [("mesh", model.mesh), ("visual", model.visual), *_numbered(model.collision)]:
        arrays |= mesh_arrays(label, mesh)
    return arrays


def mesh_arrays(label: str, mesh: Mesh) -> dict[str, np.ndarray]:
    """A mesh as named arrays, to be read by `read_mesh`."""
    arrays: dict[str, np.ndarray] = {f"{label}.vertices": mesh.vertices, f"{label}.faces": mesh.faces}
    return arrays if mesh.face_colors is None else {**arrays, f"{label}.colors": mesh.face_colors}


def read_mesh(data: Mapping[str, np.ndarray], label: str) -> Mesh:
    """The mesh that `mesh_arrays` named `label`."""
    return Mesh(data[f"{label}.vertices"], data[f"{label}.faces"], data.get(f"{label}.colors"))


@contextmanager
def open_arrays(path: Path) -> Iterator[Mapping[str, np.ndarray]]:
    """What `write_arrays` wrote, read as it is asked for; one thread at a time."""
    with _reading, path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
        yield data


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write under another name, then rename: readers see all of the file or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.stem, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as stream:
            np.savez(stream, **arrays)
        Path(temporary).replace(path)
    except OSError:
        Path(temporary).unlink(missing_ok=True)
        raise


def _numbered(parts: tuple[Mesh, ...]) -> list[tuple[str, Mesh]]:
    return [(f"collision{i}", part) for i, part in enumerate(parts)]


def _read(path: Path) -> ObjectModel:
    with open_arrays(path) as data:
        parts = sum(1 for key in data if key.startswith("collision") and key.endswith(".faces"))
        return ObjectModel(
            mesh=read_mesh(data, "mesh"),
            visual=read_mesh(data, "visual"),
            collision=tuple(read_mesh(data, f"collision{i}") for i in range(parts)),
            symmetries=Symmetries(data["discrete"], tuple(SymmetryAxis(axis, offset) for axis, offset in data["axes"])),
            **{k: data[k] for k in _ARRAYS},
            **json.loads(str(data["scalars"])),
        )
