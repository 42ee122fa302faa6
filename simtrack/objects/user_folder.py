"""Users' own objects: a folder with an ``object.yaml`` and a mesh file.

A minimal ``object.yaml``::

    name: gearbox
    mesh: gearbox.stl
    scale: 0.001            # the file is in millimetres
    semantic_class: component
    mass: 1.2               # kg; or density: 2700 (kg/m^3)
    symmetries:
      - {axis: [0, 0, 1], fold: 2}      # two-fold: half a turn; fold: continuous = any turn

The mesh stands with z up. Its origin moves to the centre of its box, whatever it was in the file.
"""

import warnings
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from simtrack.contracts import Float64
from simtrack.errors import FileFormatError, MeshError
from simtrack.geometry import meshes
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import exp_so3, inverse, transform
from simtrack.objects.cache import cached_model, digest
from simtrack.objects.decomposition import convex_parts
from simtrack.objects.model import ObjectModel, Symmetries, SymmetryAxis, build_model
from simtrack.objects.semantics import SEMANTIC_CLASSES

FILE_NAME = "object.yaml"
MAX_YAML_BYTES = 100_000
MAX_VISUAL_FACES = 3000
MAX_SIZE = 5.0
"""Metres. A larger object was most likely drawn in millimetres."""
MIN_SIZE = 0.0005
"""Metres. A smaller object was most likely scaled from millimetres although it was drawn in metres."""
DEFAULT_DENSITY = 500.0
"""kg/m^3, of an object that states neither mass nor density: a hollow thing of plastic and metal."""

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class SymmetrySpecification(BaseModel):
    """A rotational symmetry about an axis through a point."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    axis: tuple[Finite, Finite, Finite]
    """Direction, in the frame of the mesh file."""
    fold: Annotated[int, Field(ge=2, le=360)] | Literal["continuous"] = 2
    """2 = half a turn, 4 = quarter turns, ``continuous`` = any turn."""
    point: tuple[Finite, Finite, Finite] | None = None
    """A point on the axis in the frame of the (scaled) mesh file, metres; the box centre if not given."""

    @field_validator("axis")
    @classmethod
    def _direction(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if np.linalg.norm(value) < 1e-9:
            raise ValueError("must be a direction other than [0, 0, 0]")
        return value


class ObjectSpecification(BaseModel):
    """The content of an ``object.yaml``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,63}$")]
    """A letter, then letters, digits, ``_`` and ``-``."""
    mesh: str
    """Path of the mesh file relative to the folder (`simtrack.geometry.meshes.MESH_SUFFIXES`)."""
    scale: Positive = 1.0
    """Metres per unit of the mesh file: 0.001 for millimetres."""
    semantic_class: str = "artifact"
    """A key of `simtrack.objects.SEMANTIC_CLASSES`."""
    mass: Positive | None = None
    """Kilograms."""
    density: Positive | None = None
    """kg/m^3, of the solid that the mesh encloses; not together with `mass`."""
    friction: Annotated[float, Field(ge=0.0, le=10.0)] = 0.5
    """Coefficient of sliding friction."""
    symmetries: Annotated[tuple[SymmetrySpecification, ...], Field(max_length=8)] = ()
    trackable: bool = True
    """Whether the tracker is given a model of it."""
    colour: tuple[Annotated[int, Field(ge=0, le=255)], ...] | None = Field(None, min_length=3, max_length=3)
    """RGB; the mesh file's own colours, or grey, if not given."""
    collision: Literal["convex-hull", "coacd", "box"] = "convex-hull"
    """How physics sees it: its convex hull, an approximate convex decomposition (for hollow things), its box."""
    description: Annotated[str, Field(max_length=500)] = ""

    @field_validator("semantic_class")
    @classmethod
    def _known_class(cls, value: str) -> str:
        if value not in SEMANTIC_CLASSES:
            raise ValueError(f"'{value}' is not a known class; known: {', '.join(sorted(SEMANTIC_CLASSES))}")
        return value

    @model_validator(mode="after")
    def _one_weight(self) -> "ObjectSpecification":
        if self.mass is not None and self.density is not None:
            raise ValueError("mass and density are both given; give one of them")
        return self


def read_specification(folder: Path) -> ObjectSpecification:
    """Read and validate ``object.yaml`` of a folder.

    Raises:
        FileFormatError: names file, field, reason and allowed values.
    """
    path = folder / FILE_NAME
    try:
        if path.stat().st_size > MAX_YAML_BYTES:
            raise FileFormatError(path, "", f"is larger than {MAX_YAML_BYTES} bytes")
        content: Any = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(path, "", f"cannot be read: {error}") from error
    except (yaml.YAMLError, RecursionError) as error:
        raise FileFormatError(path, "", f"is not valid YAML: {error}") from error
    if not isinstance(content, dict):
        fields = ", ".join(ObjectSpecification.model_fields)
        raise FileFormatError(path, "", f"must be a mapping of fields to values; fields: {fields}")
    try:
        return ObjectSpecification.model_validate(content)
    except ValidationError as error:
        raise _format_error(path, error) from error


def _format_error(path: Path, error: ValidationError) -> FileFormatError:
    first = error.errors()[0]
    field = ".".join(str(part) for part in first["loc"])
    reason = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        reason = f"unknown field; allowed: {', '.join(ObjectSpecification.model_fields)}"
    elif "input" in first and not isinstance(first["input"], dict):
        reason += f" (got {first['input']!r:.80})"
    return FileFormatError(path, field, reason)


def load_folder(folder: Path) -> ObjectModel:
    """The model that a folder describes, kept in the disk cache under the content of its two files.

    Warns (UserWarning) where the mesh is open or seems to be in millimetres.

    Raises:
        FileFormatError, MeshError: what cannot be used, where and why.
    """
    specification = read_specification(folder)
    path = _inside(folder, specification.mesh)
    if not path.is_file():
        raise MeshError(path, f"no such file, named by {folder / FILE_NAME}: mesh")
    mesh = meshes.load_mesh(path)
    mesh = Mesh(mesh.vertices * specification.scale, mesh.faces, mesh.face_colors)
    if specification.colour is not None:
        mesh = meshes.painted(mesh, specification.colour)
    _warn_about(mesh, path)
    content = sha256(path.read_bytes()).digest()
    key = digest(specification.model_dump_json().encode(), content)
    return cached_model(specification.name, key, lambda: _build(specification, mesh, path))


def _inside(folder: Path, relative: str) -> Path:
    """The named file, which may not lie outside of the folder (nor be a link to outside)."""
    root = folder.resolve()
    path = (root / relative).resolve()
    if not path.is_relative_to(root):
        raise FileFormatError(
            folder / FILE_NAME, "mesh", f"'{relative}' leads out of the folder; allowed: files within"
        )
    return path


def _warn_about(mesh: Mesh, path: Path) -> None:
    box = " x ".join(f"{side:.4g}" for side in mesh.extents)
    size = float(mesh.extents.max())
    if size > MAX_SIZE:
        warnings.warn(
            f"mesh {path}: measures {box} m; if it was drawn in millimetres, set 'scale: 0.001' in {FILE_NAME}",
            stacklevel=3,
        )
    if size < MIN_SIZE:
        warnings.warn(
            f"mesh {path}: measures {box} m; if it was drawn in metres, leave 'scale' out of {FILE_NAME}",
            stacklevel=3,
        )
    if not meshes.is_closed(mesh):
        warnings.warn(
            f"mesh {path}: is not closed (holes or inconsistent winding); it measures {box} m; "
            "mass and inertia are its convex hull's",
            stacklevel=3,
        )


def _build(specification: ObjectSpecification, mesh: Mesh, path: Path) -> ObjectModel:
    extents = mesh.extents
    if extents.min() < 1e-6:
        raise MeshError(path, f"is flat: its box measures {np.round(extents, 6).tolist()} m; a body is needed")
    closed = meshes.is_closed(mesh) and meshes.volume(mesh) > 0.0
    solid = mesh if closed else meshes.convex_hull(mesh.vertices)
    mass = specification.mass
    if mass is None:
        mass = meshes.mass_properties(solid, density=specification.density or DEFAULT_DENSITY)[0]
    return build_model(
        name=specification.name,
        semantic_class=specification.semantic_class,
        mesh=mesh,
        visual=meshes.decimate(mesh, MAX_VISUAL_FACES),
        collision=_collision_parts(specification.collision, mesh, path),
        mass=mass,
        friction=specification.friction,
        symmetries=_symmetries(specification, mesh.bounds.mean(axis=0)),
        trackable=specification.trackable,
        description=specification.description,
        solid=solid,
    )


def _collision_parts(kind: str, mesh: Mesh, path: Path) -> list[Mesh]:
    """Convex pieces that stand for a mesh in physics; `kind` as `ObjectSpecification.collision`, `path` for errors."""
    if kind == "box":
        return [meshes.transformed(meshes.box_mesh(mesh.extents), transform(translation=mesh.bounds.mean(axis=0)))]
    if kind == "convex-hull":
        return [meshes.convex_hull(mesh.vertices)]
    try:
        return convex_parts(mesh, path)
    except MeshError as error:
        reason = f"{error.reason}; allowed without it: convex-hull, box"
        raise FileFormatError(path.parent / FILE_NAME, "collision", reason) from error


def _symmetries(specification: ObjectSpecification, centre: Float64) -> Symmetries:
    """Discrete symmetries are closed under composition by multiplying the axes' turns with each other."""
    discrete, axes = np.eye(4)[None], []
    for item in specification.symmetries:
        axis = np.asarray(item.axis) / np.linalg.norm(item.axis)
        offset = np.zeros(3) if item.point is None else np.asarray(item.point) - centre
        if item.fold == "continuous":
            axes.append(SymmetryAxis(axis, offset))
            continue
        T_object_axis = transform(translation=offset)
        turns = np.stack(
            [
                T_object_axis @ transform(exp_so3(2.0 * np.pi * k / item.fold * axis)) @ inverse(T_object_axis)
                for k in range(item.fold)
            ]
        )
        products = np.einsum("aij,bjk->abik", turns, discrete).reshape(-1, 4, 4)
        discrete = _distinct(products)
    return Symmetries(discrete, tuple(axes))


def _distinct(poses: Float64) -> Float64:
    kept: list[Float64] = []
    for pose in poses:
        if not any(np.allclose(pose, other, atol=1e-9) for other in kept):
            kept.append(pose)
    return np.stack(kept)
