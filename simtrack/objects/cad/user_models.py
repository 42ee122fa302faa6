"""Users' own CAD models: a folder with a folder for each class, which holds meshes and URDF files.

::

    my_models/
      chair/kitchen_chair.obj       a rigid model; any of `simtrack.geometry.meshes.MESH_SUFFIXES`
      fridge/larder.urdf            an articulated one; its meshes lie anywhere below ``my_models/``

Metres, z up, the front towards -y. Meshes get convex parts by approximate convex decomposition (coacd), once: they
are kept in the disk cache under the content of the file.
"""

from collections.abc import Callable
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np

from simtrack.errors import FileFormatError, MeshError
from simtrack.geometry import meshes
from simtrack.geometry.meshes import MESH_SUFFIXES, Mesh
from simtrack.geometry.transforms import transform
from simtrack.objects.cache import digest
from simtrack.objects.cad.builder import assembled
from simtrack.objects.cad.model import CadModel, CadPart
from simtrack.objects.cad.store import cached_models
from simtrack.objects.decomposition import convex_parts
from simtrack.objects.user_folder import DEFAULT_DENSITY, MAX_SIZE, MAX_VISUAL_FACES

FRICTION = 0.5
MAX_MODELS = 2000
"""Files that one folder may hold."""


def find_models(root: Path) -> dict[str, tuple[Callable[[], CadModel], ...]]:
    """Class (name of a folder in `root`) -> what loads each of its models.

    Raises:
        FileFormatError: more files than `MAX_MODELS`.
    """
    suffixes = (*MESH_SUFFIXES, ".urdf")
    files = [path for path in sorted(root.glob("*/*")) if path.suffix.lower() in suffixes and path.is_file()]
    if len(files) > MAX_MODELS:
        raise FileFormatError(root, "", f"holds {len(files)} models; at most {MAX_MODELS} are read")
    found: dict[str, tuple[Callable[[], CadModel], ...]] = {}
    for path in files:
        semantic_class = path.parent.name
        if path.suffix.lower() == ".urdf":
            from simtrack.objects.cad.urdf_models import load_urdf

            loader = partial(load_urdf, path, root)
        else:
            loader = partial(load_mesh_model, path)
        found[semantic_class] = (*found.get(semantic_class, ()), loader)
    return found


def load_mesh_model(path: Path) -> CadModel:
    """A rigid model from one mesh file; its class is the name of the file's folder.

    Raises:
        MeshError: unreadable, flat, or so large that it is most likely drawn in millimetres.
    """
    semantic_class = path.parent.name
    name = f"{semantic_class}-{path.stem}"
    key = digest(b"cad", name.encode(), sha256(path.read_bytes()).digest())

    def build() -> tuple[CadModel, ...]:
        mesh = meshes.load_mesh(path)
        check_size(mesh, path)
        mesh = meshes.transformed(mesh, transform(None, -mesh.bounds.mean(axis=0)))
        part = part_of_meshes("body", mesh, path)
        return (assembled(name, semantic_class, (part,), (), mesh.extents, (), (), (), path.name),)

    return cached_models(f"user-{path.stem}", key, build)[0]


def check_size(mesh: Mesh, path: Path) -> None:
    """Raise MeshError for what is flat or of absurd size."""
    box = np.round(mesh.extents, 4).tolist()
    if mesh.extents.min() < 1e-4:
        raise MeshError(path, f"is flat: its box measures {box} m; a body is needed")
    if mesh.extents.max() > MAX_SIZE:
        raise MeshError(path, f"measures {box} m; models are in metres and at most {MAX_SIZE:g} m long")


def part_of_meshes(name: str, mesh: Mesh, path: Path, convex: tuple[Mesh, ...] | None = None) -> CadPart:
    """A part of `DEFAULT_DENSITY` with convex parts from coacd unless they are given."""
    if convex is None:
        convex = tuple(convex_parts(mesh, path))
    closed = meshes.is_closed(mesh) and meshes.volume(mesh) > 0.0
    solid = mesh if closed else meshes.convex_hull(mesh.vertices)
    mass, centre, inertia = meshes.mass_properties(solid, density=DEFAULT_DENSITY)
    shown = meshes.decimate(mesh, 4 * MAX_VISUAL_FACES)
    return CadPart(name, shown, convex, mass, centre, inertia, FRICTION, "unknown")
