"""The meshes that a URDF names: found inside the allowed folder, and made into the convex parts that engines use."""

from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np

from simtrack.errors import MeshError
from simtrack.geometry.meshes import MAX_FILE_BYTES, Mesh, convex_hull, is_closed, load_mesh, volume

MAX_PARTS = 500
"""Groups of one OBJ file."""
THICKNESS = 0.001
"""Metres that a flat mesh is given."""
HOLLOW = 1.3
"""Volume of the hull over that of the mesh from which a mesh counts as concave."""


class OutsideError(MeshError):
    """A file outside of the folder that may be read."""


def locate(reference: str, folder: Path, root: Path) -> Path:
    """The file that a URDF in `folder` names: relative, ``package://`` or ``file://``; it must lie inside of `root`.

    Raises:
        OutsideError: it leads out of `root`, through a link too.
        MeshError: there is no such file.
    """
    root = root.resolve()
    if reference.startswith("package://"):
        parts = Path(unquote(reference.removeprefix("package://"))).parts
        package, inner = (parts[0], Path(*parts[1:])) if parts else ("", Path())
        tried = [root / inner, root / package / inner]
        tried += [base / inner for base in folder.resolve().parents if base.name == package]
    elif reference.startswith("file://"):
        tried = [Path(unquote(urlsplit(reference).path))]
    else:
        tried = [folder / reference]
    inside = [path.resolve() for path in tried if path.resolve().is_relative_to(root)]
    if not inside:
        raise OutsideError(reference, f"leads out of {root}; allowed: files within (--root names another folder)")
    for path in inside:
        if path.is_file():
            if path.stat().st_size > MAX_FILE_BYTES:
                raise MeshError(reference, f"is larger than {MAX_FILE_BYTES} bytes")
            return path
    raise MeshError(reference, f"no such file ({inside[0]})")


def convex_parts(path: Path, scale: tuple[float, float, float]) -> tuple[list[Mesh], str]:
    """Convex hulls of a mesh file, scaled, and what is to be said of them.

    The groups of an OBJ file are hulls of their own, as in Bullet; any other file is one hull.

    Raises:
        MeshError: the file cannot be used.
    """
    whole = load_mesh(path)
    clouds = obj_groups(path) if path.suffix.lower() == ".obj" else []
    if len(clouds) < 2:
        clouds = [whole.vertices]
    if len(clouds) > MAX_PARTS:
        raise MeshError(path, f"has {len(clouds)} groups; at most {MAX_PARTS} convex parts are allowed")
    said = ""
    hulls = []
    for cloud in clouds:
        points = cloud * np.asarray(scale)
        try:
            hulls.append(convex_hull(points))
        except MeshError:
            hulls.append(_thickened(points, path))
            said = f"is flat in part: taken as {1e3 * THICKNESS:g} mm thick"
    if len(hulls) == 1 and is_closed(whole):
        inner = abs(volume(whole) * float(np.prod(scale)))
        ratio = volume(hulls[0]) / inner if inner > 0.0 else 1.0
        if ratio > HOLLOW:
            said = f"is concave and in one piece: engines take its convex hull, {ratio:.1f} times the volume"
    return hulls, said


def _thickened(points: np.ndarray, path: Path) -> Mesh:
    centred = points - points.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][-1]
    if normal[2] < 0.0:
        normal = -normal
    try:
        return convex_hull(np.concatenate([points, points - THICKNESS * normal]))
    except MeshError as error:
        raise MeshError(path, "spans neither a volume nor an area after scaling") from error


def obj_groups(path: Path) -> list[np.ndarray]:
    """(N, 3) vertices used by each group (``o`` or ``g``) with faces of an OBJ file, in its order."""
    vertices: list[list[float]] = []
    groups: list[set[int]] = [set()]
    try:
        with path.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                words = line.split()
                if not words:
                    continue
                if words[0] == "v":
                    vertices.append([float(word) for word in words[1:4]])
                elif words[0] in ("o", "g"):
                    groups.append(set())
                elif words[0] == "f":
                    indices = (int(word.split("/")[0]) for word in words[1:])
                    groups[-1].update(k - 1 if k > 0 else len(vertices) + k for k in indices)
        points = np.array(vertices, float).reshape(-1, 3)
        return [points[sorted(group)] for group in groups if group]
    except (ValueError, IndexError) as error:
        raise MeshError(path, f"cannot be read: {error}") from error
