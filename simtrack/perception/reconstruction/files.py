"""A body tree as files that travel together: URDF, MJCF, GLB, and the meshes that the first two refer to."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import Mesh, concatenate, split_by_color
from simtrack.perception.reconstruction.body_tree import BodyTree

MESHES = "meshes"
MIN_VERTICES = 4
"""MuJoCo refuses meshes with fewer."""


@dataclass(frozen=True, slots=True)
class MeshFile:
    """A mesh that is written beside the URDF."""

    path: str
    """Relative to the folder, with forward slashes."""
    color: tuple[int, int, int]
    """RGB."""


@dataclass(frozen=True, slots=True)
class MeshFiles:
    """The mesh files of a tree; the URDF and the MJCF share them."""

    visual: dict[str, tuple[MeshFile, ...]]
    """Body name -> one file a colour."""
    collision: dict[str, dict[int, MeshFile]]
    """Body name -> number of the shape -> file of the convex mesh."""


@dataclass(frozen=True, slots=True)
class SceneFiles:
    """What `write_scene` wrote."""

    urdf: Path
    mjcf: Path
    glb: Path


def write_scene(tree: BodyTree, folder: str | Path, name: str = "scene") -> SceneFiles:
    """Write ``NAME.urdf``, ``NAME.xml`` (MJCF), ``NAME.glb`` and ``meshes/`` into `folder`, created if missing.

    Paths inside of the files are relative: the folder can be moved.
    """
    from simtrack.perception.reconstruction.glb import write_glb
    from simtrack.perception.reconstruction.mjcf import write_mjcf
    from simtrack.perception.reconstruction.urdf import write_urdf

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    meshes = write_meshes(tree, folder)
    out = SceneFiles(folder / f"{name}.urdf", folder / f"{name}.xml", folder / f"{name}.glb")
    write_urdf(tree, meshes, out.urdf)
    write_mjcf(tree, meshes, out.mjcf)
    write_glb(tree, out.glb)
    return out


def write_meshes(tree: BodyTree, folder: Path) -> MeshFiles:
    """Write the visual and the convex meshes of all bodies as OBJ into ``meshes/`` of `folder`."""
    (folder / MESHES).mkdir(parents=True, exist_ok=True)
    visual: dict[str, tuple[MeshFile, ...]] = {}
    collision: dict[str, dict[int, MeshFile]] = {}
    for number, body in enumerate(tree.bodies):
        stem = f"{MESHES}/{number:03d}_{re.sub('[^A-Za-z0-9_-]', '_', body.name)[:60]}"
        files = []
        for k, (color, part) in enumerate(_colored_parts(body.visual) if body.visual is not None else []):
            files.append(MeshFile(f"{stem}_visual{k}.obj", color))
            write_obj(folder / files[-1].path, part)
        visual[body.name] = tuple(files)
        collision[body.name] = {}
        for k, shape in enumerate(body.collision):
            if shape.mesh is not None:
                collision[body.name][k] = MeshFile(f"{stem}_convex{k}.obj", (160, 160, 160))
                write_obj(folder / collision[body.name][k].path, shape.mesh)
    return MeshFiles(visual, collision)


def _colored_parts(mesh: Mesh) -> list[tuple[tuple[int, int, int], Mesh]]:
    """One mesh a colour; what has too few vertices for a mesh of its own joins the largest."""
    parts = sorted(split_by_color(mesh), key=lambda item: -len(item[1].vertices))
    small = [part for _, part in parts[1:] if len(part.vertices) < MIN_VERTICES]
    kept = [item for k, item in enumerate(parts) if k == 0 or len(item[1].vertices) >= MIN_VERTICES]
    if small:
        kept[0] = (kept[0][0], concatenate([kept[0][1], *small]))
    if len(kept[0][1].vertices) < MIN_VERTICES:
        corner = kept[0][1]
        doubled = Mesh(np.repeat(corner.vertices, 2, axis=0), 2 * corner.faces)
        kept[0] = (kept[0][0], doubled)
    return kept


def write_obj(path: Path, mesh: Mesh) -> None:
    """Write a Wavefront OBJ without materials, metres."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def numbers(values: Float64 | tuple[float, ...] | list[float]) -> str:
    """Numbers for an XML attribute; nine digits, no negative zeros."""
    return " ".join(f"{value:.9g}" for value in (np.asarray(values, float).ravel() + 0.0).tolist())
