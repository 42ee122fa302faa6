"""Object models on disk: what takes seconds to build is built once a version and kept in the user's cache folder."""

import hashlib
import json
import os
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from simtrack import paths
from simtrack.geometry.meshes import Mesh
from simtrack.objects.model import ObjectModel, Symmetries, SymmetryAxis

_SCALARS = ("name", "semantic_class", "mass", "friction", "diameter", "trackable", "description")
_ARRAYS = ("centre_of_mass", "inertia", "extents", "keypoints")


def digest(*content: bytes) -> str:
    """Key of cached content: its hash together with the code and the libraries that make models."""
    sha = hashlib.sha256()
    here = Path(__file__).resolve().parent
    for source in sorted([*here.rglob("*.py"), here.parent / "geometry" / "meshes.py"]):
        sha.update(source.read_bytes())
    for library in ("numpy", "manifold3d"):
        sha.update(version(library).encode())
    for part in content:
        sha.update(len(part).to_bytes(8, "little") + part)
    return sha.hexdigest()[:24]


def cached_model(name: str, key: str, build: Callable[[], ObjectModel]) -> ObjectModel:
    """The model kept under `name` and `key`, else built and kept; a cache that cannot be used is no error."""
    path = paths.cache_dir() / "objects" / f"{name}-{key}.npz"
    with suppress(OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return _read(path)
    model = build()
    with suppress(OSError):
        _write(path, model)
    return model


def _write(path: Path, model: ObjectModel) -> None:
    """Write under another name, then rename: readers see all of the file or none."""
    arrays: dict[str, Any] = {"scalars": np.array(json.dumps({k: getattr(model, k) for k in _SCALARS}))}
    arrays |= {k: getattr(model, k) for k in _ARRAYS}
    arrays["discrete"] = model.symmetries.discrete
    arrays["axes"] = np.array([[a.axis, a.offset] for a in model.symmetries.axes]).reshape(-1, 2, 3)
    for label, mesh in [("mesh", model.mesh), ("visual", model.visual), *_numbered(model.collision)]:
        arrays[f"{label}.vertices"], arrays[f"{label}.faces"] = mesh.vertices, mesh.faces
        if mesh.face_colors is not None:
            arrays[f"{label}.colors"] = mesh.face_colors
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
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
        parts = sum(1 for key in data.files if key.startswith("collision") and key.endswith(".faces"))

        def mesh(label: str) -> Mesh:
            colors = f"{label}.colors"
            return Mesh(data[f"{label}.vertices"], data[f"{label}.faces"], data.get(colors))

        return ObjectModel(
            mesh=mesh("mesh"),
            visual=mesh("visual"),
            collision=tuple(mesh(f"collision{i}") for i in range(parts)),
            symmetries=Symmetries(data["discrete"], tuple(SymmetryAxis(axis, offset) for axis, offset in data["axes"])),
            **{k: data[k] for k in _ARRAYS},
            **json.loads(str(data["scalars"])),
        )
