"""A user's MJCF file as a part of the world: checked, attached under a prefix, its shapes seen by both renderers."""

from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import FileFormatError
from simtrack.geometry.meshes import Mesh, box_mesh, cylinder_mesh, painted, transformed
from simtrack.geometry.transforms import rotation_from_quaternion, transform
from simtrack.simulation.composer import COLLISION
from simtrack.simulation.scene_file import SceneFile

if TYPE_CHECKING:
    import mujoco

PREFIX = "mjcf/"
MAX_BYTES = 20_000_000
PLANE_SIZE = 20.0
"""Metres: side of what an infinite plane is drawn as."""
SEGMENTS = 96
"""Of round shapes, around."""


def attach(
    spec: "mujoco.MjSpec",
    scene: SceneFile,
    show: Callable[["mujoco.MjsBody", str, Mesh, Float64], None],
    *,
    without: Collection[str] = (),
    lowered: float = 0.0,
) -> None:
    """Attach the scene's MJCF file.

    Args:
        spec: the world that is being composed.
        scene: names the file.
        show: called with (body, name, mesh, T_body_mesh) for every visible shape.
        without: names of bodies that are left out.
        lowered: metres by which all of it is put lower.

    Raises:
        FileFormatError: broken XML, something that MuJoCo refuses, or a file outside of the scene's folder.
    """
    path = scene.mjcf_path
    assert path is not None
    user, model = read_model(path, scene.path.parent, without)
    for geom in user.geoms:
        geom.group = COLLISION if geom.group <= 2 else geom.group
    for name in ("timestep", "integrator", "cone", "impratio"):  # one physics for all; MuJoCo warns of others
        setattr(user.option, name, getattr(spec.option, name))
    shapes = [geom_shape(model, geom, path) for geom in range(model.ngeom) if model.geom_group[geom] <= 2]
    spec.attach(user, prefix=PREFIX, frame=spec.worldbody.add_frame(pos=[0.0, 0.0, -lowered]))
    for number, (body, mesh, T) in enumerate(shapes):
        target = spec.worldbody if body == 0 else spec.body(PREFIX + model.body(body).name)
        T = T if body else transform(None, (0.0, 0.0, -lowered)) @ T
        show(target, f"{PREFIX}{model.body(body).name}#{number}", mesh, T)


def read_model(path: Path, folder: Path, without: Collection[str] = ()) -> "tuple[mujoco.MjSpec, mujoco.MjModel]":
    """A file as a spec in which every body has a name, and as a model.

    Args:
        path: the file.
        folder: in which all files that it names must lie.
        without: names of bodies that are left out, if there are such.

    Raises:
        FileFormatError: see `attach`.
    """
    import mujoco

    _check_files(path, folder.resolve())
    try:
        user = mujoco.MjSpec.from_file(str(path))
        for number, body in enumerate(user.bodies[1:]):
            body.name = body.name or f"body{number}"
        for name in without:
            if (body := user.body(name)) is not None:
                user.delete(body)
        return user, user.compile()
    except ValueError as error:
        raise FileFormatError(path, "", f"MuJoCo cannot use it: {error}") from error


def _check_files(path: Path, folder: Path) -> None:
    """Refuse broken XML, oversized files and anything referenced outside of the scene's folder."""
    if path.stat().st_size > MAX_BYTES:
        raise FileFormatError(path, "", f"larger than {MAX_BYTES} bytes")
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except ElementTree.ParseError as error:
        raise FileFormatError(path, f"line {error.position[0]}", f"not valid XML: {error}") from error
    roots = {path.parent}
    for compiler in root.iter("compiler"):
        for attribute in ("meshdir", "texturedir", "assetdir"):
            roots.add(path.parent / compiler.get(attribute, "."))
    for element in root.iter():
        for attribute, value in element.attrib.items():
            if not attribute.startswith("file") and attribute not in ("meshdir", "texturedir", "assetdir"):
                continue
            for start in roots if attribute.startswith("file") else {path.parent}:
                if not (start / value).resolve().is_relative_to(folder):
                    reason = f"'{value}' leads out of the scene's folder {folder}"
                    raise FileFormatError(path, f"{element.tag}.{attribute}", reason)
        if element.tag == "include":
            _check_files(path.parent / element.get("file", ""), folder)


def geom_shape(model: "mujoco.MjModel", geom: int, path: Path) -> tuple[int, Mesh, Float64]:
    """Body, coloured mesh and T_body_mesh (4, 4) of a compiled geom."""
    import mujoco

    kinds, kind, size = mujoco.mjtGeom, int(model.geom_type[geom]), model.geom_size[geom].copy()
    if kind == kinds.mjGEOM_MESH:
        mesh = _mesh_of(model, int(model.geom_dataid[geom]))
    elif kind == kinds.mjGEOM_BOX:
        mesh = box_mesh(2.0 * size)
    elif kind == kinds.mjGEOM_PLANE:
        x, y = (2.0 * side if side > 0 else PLANE_SIZE for side in size[:2])
        corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]]) / 2.0
        mesh = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    elif kind == kinds.mjGEOM_CYLINDER:
        mesh = cylinder_mesh(float(size[0]), float(2.0 * size[1]), SEGMENTS)
    elif kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID, kinds.mjGEOM_CAPSULE):
        axes = size if kind == kinds.mjGEOM_ELLIPSOID else np.full(3, size[0])
        mesh = _round(axes, float(size[1]) if kind == kinds.mjGEOM_CAPSULE else 0.0)
    else:
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"number {geom}"
        allowed = "plane, sphere, capsule, ellipsoid, cylinder, box and mesh geoms, or a group above 2 to hide it"
        raise FileFormatError(path, f"geom {name}", f"its type cannot be shown; allowed: {allowed}")
    material = int(model.geom_matid[geom])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    color = tuple(int(value) for value in np.round(255 * np.clip(rgba[:3], 0.0, 1.0)))
    T = transform(rotation_from_quaternion(model.geom_quat[geom]), model.geom_pos[geom].copy())
    return int(model.geom_bodyid[geom]), painted(mesh, color), T


def _mesh_of(model: "mujoco.MjModel", mesh: int) -> Mesh:
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    first, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return Mesh(
        model.mesh_vert[start : start + count].astype(np.float64), model.mesh_face[first : first + faces].copy()
    )


def _round(axes: Float64, half_length: float) -> Mesh:
    """Ellipsoid with half axes `axes` (3,), its halves moved apart along z (a capsule)."""
    import trimesh

    ball = trimesh.creation.uv_sphere(radius=1.0, count=[SEGMENTS // 2 + 1, SEGMENTS])
    mesh = transformed(Mesh(np.asarray(ball.vertices), np.asarray(ball.faces)), np.diag([*axes, 1.0]))
    shift = np.where(mesh.vertices[:, 2] > 1e-9, half_length, -half_length)
    return Mesh(mesh.vertices + shift[:, None] * [0.0, 0.0, 1.0], mesh.faces)
