"""``simtrack objects``: the object models, and their export."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from simtrack.objects import ObjectModel


def objects(
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    export: Path | None = None,
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> int:
    """List the object models, or export them as meshes. More are found in the folders that $SIMTRACK_OBJECTS names.

    Args:
        names: Objects to list; all if none is given.
        export: Write each object to a folder here: a coloured PLY mesh (metres) and an object.yaml to load it again.
        overwrite: Replace files of an earlier export.
    """
    from simtrack.cli import console
    from simtrack.objects import catalogue, load_object

    models = [load_object(name) for name in (names or sorted(catalogue()))]
    if export is not None:
        for model in models:
            export_object(model, export / model.name, overwrite)
        console.show_written(export, [f"{model.name}/" for model in models])
        return 0
    columns = ("object", "class", "size in mm", "mass", "triangles", "symmetry", "tracked")
    rows = [
        (model.name, model.semantic_class, " x ".join(f"{1000 * side:.0f}" for side in model.extents),
         f"{model.mass:.3f} kg", len(model.mesh.faces), _symmetry(model), "yes" if model.trackable else "no")
        for model in models
    ]  # fmt: skip
    console.show_table(columns, rows, right=(2, 3, 4))
    return 0


def export_object(model: "ObjectModel", folder: Path, overwrite: bool = False) -> None:
    """Write a model as a user's object folder: ``NAME.ply`` (metres, face colours) and ``object.yaml``.

    Raises:
        OutputExistsError: the folder exists and may not be overwritten.
        InvalidValueError: the folder cannot be written.
    """
    import yaml

    from simtrack.errors import InvalidValueError, OutputExistsError

    if folder.exists() and not overwrite:
        raise OutputExistsError(folder)
    specification = {
        "name": model.name,
        "mesh": f"{model.name}.ply",
        "semantic_class": model.semantic_class,
        "mass": round(model.mass, 6),
        "friction": model.friction,
        "trackable": model.trackable,
        "symmetries": _axes(model),
        "description": model.description,
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{model.name}.ply").write_bytes(_ply(model))
        (folder / "object.yaml").write_text(yaml.safe_dump(specification, sort_keys=False), encoding="utf-8")
    except OSError as error:
        raise InvalidValueError("export", str(folder), f"a folder that can be written ({error.strerror})") from error


def _symmetry(model: "ObjectModel") -> str:
    if model.symmetries.axes:
        return "any turn"
    count = len(model.symmetries.discrete)
    return f"{count}-fold" if count > 1 else "none"


def _axes(model: "ObjectModel") -> list[dict[str, object]]:
    """The symmetries as ``object.yaml`` states them: axes with how often a turn repeats the object."""
    import math

    from simtrack.geometry.transforms import log_so3

    axes: list[dict[str, object]] = [
        {"axis": [round(float(v), 9) for v in axis.axis], "fold": "continuous"} for axis in model.symmetries.axes
    ]
    smallest: dict[tuple[float, ...], float] = {}
    for S in model.symmetries.discrete[1:]:
        vector = log_so3(S[:3, :3])
        angle = math.sqrt(float(vector @ vector))
        direction = vector / angle
        # An axis and its opposite are one: the first component that is not zero is made positive.
        leading = next(float(v) for v in direction if abs(v) > 1e-6)
        key = tuple(round(float(v) * (1 if leading > 0 else -1), 6) + 0.0 for v in direction)
        smallest[key] = min(angle, smallest.get(key, math.pi))
    return axes + [{"axis": list(key), "fold": round(2 * math.pi / angle)} for key, angle in smallest.items()]


def _ply(model: "ObjectModel") -> bytes:
    """The full-resolution mesh as binary PLY with the colours of its faces."""
    import numpy as np

    mesh = model.mesh if model.mesh.face_colors is not None else model.visual
    colors = mesh.face_colors if mesh.face_colors is not None else np.full((len(mesh.faces), 3), 128, np.uint8)
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment metres, origin at the centre of the box, z up\n"
        f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    )
    faces = np.zeros(len(mesh.faces), dtype=[("n", "u1"), ("v", "<i4", 3), ("c", "u1", 3)])
    faces["n"], faces["v"], faces["c"] = 3, mesh.faces, colors
    return header.encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()
