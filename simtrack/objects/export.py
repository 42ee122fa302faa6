"""Write object models for other programs: PLY in millimetres with BOP's ``models_info.json``, OBJ, an overview."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.errors import InvalidValueError
from simtrack.geometry import meshes
from simtrack.geometry.meshes import Mesh
from simtrack.objects.model import ObjectModel
from simtrack.objects.registry import catalogue, load_object

MILLIMETRES = 1000.0


def export(names: Iterable[str], folder: str | Path) -> list[Path]:
    """Write the named objects (all known ones if empty) to `folder`, created if missing; ids run from 1 by name.

    * ``models/obj_000001.ply`` and ``models/models_info.json``: full resolution, BOP's format and units (mm);
    * ``obj/NAME.obj``: light coloured mesh in metres, one group a colour, with ``obj/objects.mtl``;
    * ``objects.json``: what the models say besides, in metres and kilograms.

    Returns:
        The files that were written.

    Raises:
        UnknownNameError: no such object.
        InvalidValueError: `folder` is a file.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InvalidValueError("folder", str(folder), "a folder, existing or new")
    chosen = sorted(set(names)) or sorted(catalogue())
    models = [load_object(name) for name in chosen]
    for part in ("models", "obj"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    written, info, overview, palette = [], {}, {}, set()
    for number, model in enumerate(models, start=1):
        ply, obj = folder / "models" / f"obj_{number:06d}.ply", folder / "obj" / f"{model.name}.obj"
        write_ply(ply, model.mesh, scale=MILLIMETRES)
        palette |= _write_obj(obj, model.visual)
        info[str(number)] = models_info(model)
        overview[model.name] = {"id": number, **describe(model)}
        written += [ply, obj]
    documents = {"models/models_info.json": info, "objects.json": overview}
    for name, document in documents.items():
        (folder / name).write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    (folder / "obj" / "objects.mtl").write_text("".join(_material(c) for c in sorted(palette)), encoding="utf-8")
    return [*written, folder / "obj" / "objects.mtl", *(folder / name for name in documents)]


def models_info(model: ObjectModel) -> dict[str, Any]:
    """The object's entry in BOP's ``models_info.json``: millimetres, row-major matrices, identity not listed."""
    low, size = model.mesh.bounds[0] * MILLIMETRES, model.extents * MILLIMETRES
    out: dict[str, Any] = {"diameter": model.diameter * MILLIMETRES}
    out |= {f"min_{a}": float(v) for a, v in zip("xyz", low, strict=True)}
    out |= {f"size_{a}": float(v) for a, v in zip("xyz", size, strict=True)}
    if len(model.symmetries.discrete) > 1:
        scaled = model.symmetries.discrete[1:].copy()
        scaled[:, :3, 3] *= MILLIMETRES
        out["symmetries_discrete"] = scaled.reshape(-1, 16).tolist()
    if model.symmetries.axes:
        out["symmetries_continuous"] = [
            {"axis": a.axis.tolist(), "offset": (a.offset * MILLIMETRES).tolist()} for a in model.symmetries.axes
        ]
    return out


def describe(model: ObjectModel) -> dict[str, Any]:
    """What a person or a program wants to know of an object, JSON-ready, in metres and kilograms."""
    return {
        "description": model.description,
        "semantic_class": model.semantic_class,
        "trackable": model.trackable,
        "mass": model.mass,
        "centre_of_mass": model.centre_of_mass.tolist(),
        "inertia": model.inertia.tolist(),
        "friction": model.friction,
        "extents": model.extents.tolist(),
        "diameter": model.diameter,
        "keypoints": model.keypoints.tolist(),
        "symmetries_discrete": model.symmetries.discrete.tolist(),
        "symmetries_continuous": [
            {"axis": a.axis.tolist(), "offset": a.offset.tolist()} for a in model.symmetries.axes
        ],
        "faces": len(model.mesh.faces),
        "visual_faces": len(model.visual.faces),
        "collision_parts": len(model.collision),
    }


def write_ply(
    path: Path,
    mesh: Mesh,
    scale: float = 1.0,
    labels: Mapping[str, np.ndarray | int] | None = None,
    comments: Iterable[str] = (),
) -> None:
    """Binary little-endian PLY with vertex normals and, where the mesh has colours, vertex colours.

    Vertices between faces of several colours take the colour of the first of them.

    Args:
        path: of the file.
        mesh: to be written.
        scale: of the coordinates.
        labels: further integer properties of the vertices, (V,) or one number for all, by name.
        comments: lines of the header.
    """
    labels = labels or {}
    fields = [(n, "<f4") for n in ("x", "y", "z", "nx", "ny", "nz")]
    if mesh.face_colors is not None:
        fields += [(n, "u1") for n in ("red", "green", "blue")]
    fields += [(name, "<i4") for name in labels]
    rows = np.zeros(len(mesh.vertices), dtype=fields)
    for name, values in labels.items():
        rows[name] = values
    rows["x"], rows["y"], rows["z"] = scale * mesh.vertices.T
    rows["nx"], rows["ny"], rows["nz"] = meshes.vertex_normals(mesh).T
    if mesh.face_colors is not None:
        corners, first = np.unique(mesh.faces.ravel(), return_index=True)
        for k, name in enumerate(("red", "green", "blue")):
            rows[name][corners] = mesh.face_colors[first // 3, k]
    faces = np.empty(len(mesh.faces), dtype=[("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, mesh.faces
    kinds = {"<f4": "float", "u1": "uchar", "<i4": "int"}
    properties = [f"property {kinds[kind]} {name}" for name, kind in fields]
    notes = [f"comment {line}" for line in comments]
    header = ["ply", "format binary_little_endian 1.0", *notes, f"element vertex {len(rows)}", *properties,
              f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]  # fmt: skip
    path.write_bytes("\n".join(header).encode("ascii") + rows.tobytes() + faces.tobytes())


def _write_obj(path: Path, mesh: Mesh) -> set[tuple[int, int, int]]:
    """Write one material a colour; returns the colours."""
    lines = ["mtllib objects.mtl"]
    used, offset = set(), 1
    for color, part in meshes.split_by_color(mesh):
        used.add(color)
        lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in part.vertices]
        lines.append(f"usemtl {_material_name(color)}")
        lines += [f"f {a} {b} {c}" for a, b, c in part.faces + offset]
        offset += len(part.vertices)
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return used


def _material_name(color: tuple[int, int, int]) -> str:
    return "rgb_" + "".join(f"{c:02x}" for c in color)


def _material(color: tuple[int, int, int]) -> str:
    r, g, b = (c / 255.0 for c in color)
    return f"newmtl {_material_name(color)}\nKd {r:.4f} {g:.4f} {b:.4f}\n\n"
