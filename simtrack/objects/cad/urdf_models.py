"""Users' articulated CAD models from URDF: links and joints become the parts and joints of one model.

Links that fixed joints hold together are one part. Masses follow from the volumes, as those of meshes do.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import FileFormatError
from simtrack.geometry import meshes
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import apply, rotation_from_rpy, transform
from simtrack.objects.cache import digest
from simtrack.objects.cad.builder import assembled
from simtrack.objects.cad.model import CadJoint, CadModel, CadPart, JointKind
from simtrack.objects.cad.store import cached_models
from simtrack.objects.cad.user_models import check_size, part_of_meshes

MAX_BYTES = 2_000_000
KINDS: dict[str, JointKind] = {"revolute": "revolute", "continuous": "continuous", "prismatic": "prismatic"}
FRICTION = 0.5
"""N m or N, of a joint that states none."""


@dataclass(slots=True, eq=False)
class _Link:
    """A link of the file; everything in the frame of the root link."""

    T_root_link: Float64
    visuals: list[Mesh] = field(default_factory=list)
    collisions: list[Mesh] = field(default_factory=list)


def load_urdf(path: Path, root: Path) -> CadModel:
    """The model that a URDF describes; the meshes that it names must lie below `root`.

    Raises:
        FileFormatError: what cannot be used: file, element, reason.
        MeshError: a mesh that cannot be used.
    """
    text = _text(path)
    robot = _parsed(text, path)
    files = sorted({_mesh_file(tag, path, root) for tag in robot.iter("mesh")})
    semantic_class = path.parent.name
    name = f"{semantic_class}-{path.stem}"
    contents = (sha256(file.read_bytes()).digest() for file in files)
    key = digest(b"urdf", name.encode(), text.encode(), *contents)
    return cached_models(f"user-{path.stem}", key, lambda: (_build(robot, name, semantic_class, path, root),))[0]


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FileFormatError(path, "", f"is larger than {MAX_BYTES} bytes")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(path, "", f"cannot be read: {error}") from error
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise FileFormatError(
            path, "", "declares a document type; URDF needs none, and entities may grow without bound"
        )
    return text


def _parsed(text: str, path: Path) -> ET.Element:
    try:
        robot = ET.fromstring(text)
    except ET.ParseError as error:
        raise FileFormatError(path, "", f"is not valid XML: {error}") from error
    if robot.tag != "robot":
        raise FileFormatError(path, robot.tag, "the outermost element must be <robot>")
    return robot


def _build(robot: ET.Element, name: str, semantic_class: str, path: Path, root: Path) -> CadModel:
    links = {tag.get("name", ""): tag for tag in robot.findall("link")}
    tags = robot.findall("joint")
    children = [_named(tag, "child", links, path) for tag in tags]
    bases = [link for link in links if link not in children]
    if len(bases) != 1 or len(set(children)) < len(children):
        raise FileFormatError(path, "joint", f"the links must form one tree; links without a parent: {bases}")
    owner, built = {bases[0]: bases[0]}, {bases[0]: _Link(np.eye(4))}
    joints: list[CadJoint] = []
    waiting = list(zip(tags, children, strict=True))
    while waiting:
        ready = [pair for pair in waiting if _named(pair[0], "parent", links, path) in built]
        if not ready:
            raise FileFormatError(path, "joint", f"go in a circle: {sorted(child for _, child in waiting)}")
        waiting = [pair for pair in waiting if pair not in ready]
        for tag, child in ready:
            parent = _named(tag, "parent", links, path)
            T = built[parent].T_root_link @ _origin(tag, path)
            built[child], owner[child] = _Link(T), child
            if tag.get("type") == "fixed":
                owner[child] = owner[parent]
            else:
                joints.append(_joint(tag, T, owner[parent], child, path))
    for link, tag in links.items():
        into = built[owner[link]]
        into.visuals += [_geometry(v, built[link].T_root_link, path, root) for v in tag.findall("visual")]
        into.collisions += [_geometry(c, built[link].T_root_link, path, root) for c in tag.findall("collision")]
    parts = [_part(link, built[link], path) for link in dict.fromkeys(owner.values())]
    whole = meshes.concatenate([part.mesh for part in parts])
    check_size(whole, path)
    centre = whole.bounds.mean(axis=0)
    moved = tuple(_shifted(part, -centre) for part in parts)
    hung = tuple(replace(joint, anchor=joint.anchor - centre) for joint in joints)
    return assembled(name, semantic_class, moved, hung, whole.extents, (), (), (), path.name)


def _named(tag: ET.Element, end: str, links: dict[str, ET.Element], path: Path) -> str:
    found = tag.find(end)
    link = "" if found is None else found.get("link", "")
    if link not in links:
        raise FileFormatError(path, f"joint {tag.get('name')}.{end}", f"'{link}' is no link; links: {sorted(links)}")
    return link


def _joint(tag: ET.Element, T: Float64, parent: str, child: str, path: Path) -> CadJoint:
    where, kind = f"joint {tag.get('name')}", tag.get("type", "")
    if kind not in KINDS:
        raise FileFormatError(path, f"{where}.type", f"'{kind}'; allowed: fixed, {', '.join(KINDS)}")
    found = tag.find("axis")
    axis = T[:3, :3] @ _numbers("1 0 0" if found is None else found.get("xyz", "1 0 0"), 3, f"{where}.axis", path)
    if np.linalg.norm(axis) < 1e-9:
        raise FileFormatError(path, f"{where}.axis", "must be a direction other than 0 0 0")
    lower, upper = -np.pi, np.pi
    if kind != "continuous":
        limit = tag.find("limit")
        if limit is None:
            raise FileFormatError(path, f"{where}.limit", f"a {kind} joint needs one")
        lower, upper = (_numbers(limit.get(k, "0"), 1, f"{where}.limit.{k}", path)[0] for k in ("lower", "upper"))
        if not lower < upper:
            raise FileFormatError(path, f"{where}.limit", f"lower {lower:g} must be less than upper {upper:g}")
    dynamics = tag.find("dynamics")
    friction, damping = FRICTION, 0.0
    if dynamics is not None:
        friction = _numbers(dynamics.get("friction", str(FRICTION)), 1, f"{where}.dynamics.friction", path)[0]
        damping = _numbers(dynamics.get("damping", "0"), 1, f"{where}.dynamics.damping", path)[0]
    unit = axis / np.linalg.norm(axis)
    name = tag.get("name") or f"{child}-joint"
    return CadJoint(
        name, KINDS[kind], parent, child, T[:3, 3], unit, float(lower), float(upper), float(friction), float(damping)
    )


def _part(name: str, link: _Link, path: Path) -> CadPart:
    shown = link.visuals or link.collisions
    if not shown:
        raise FileFormatError(path, f"link {name}", "has neither a visual nor a collision shape")
    convex = tuple(meshes.convex_hull(mesh.vertices) for mesh in link.collisions) or None
    return part_of_meshes(name, meshes.concatenate(shown), path, convex)


def _shifted(part: CadPart, offset: Float64) -> CadPart:
    T = transform(None, offset)
    return replace(
        part,
        mesh=meshes.transformed(part.mesh, T),
        convex=tuple(meshes.transformed(convex, T) for convex in part.convex),
        centre_of_mass=apply(T, part.centre_of_mass),
    )


def _geometry(tag: ET.Element, T_root_link: Float64, path: Path, root: Path) -> Mesh:
    geometry = tag.find("geometry")
    shape = None if geometry is None or not len(geometry) else geometry[0]
    if shape is None:
        raise FileFormatError(path, f"{tag.tag}.geometry", "is missing; allowed: box, cylinder, sphere, mesh")
    if shape.tag == "box":
        mesh = meshes.box_mesh(_numbers(shape.get("size", ""), 3, "box.size", path))
    elif shape.tag == "cylinder":
        radius, length = (_numbers(shape.get(k, ""), 1, f"cylinder.{k}", path)[0] for k in ("radius", "length"))
        mesh = meshes.cylinder_mesh(float(radius), float(length), 24)
    elif shape.tag == "sphere":
        from simtrack.objects.shapes import sphere

        mesh = sphere(float(_numbers(shape.get("radius", ""), 1, "sphere.radius", path)[0])).mesh()
    elif shape.tag == "mesh":
        mesh = meshes.load_mesh(_mesh_file(shape, path, root))
        scale = _numbers(shape.get("scale", "1 1 1"), 3, "mesh.scale", path)
        mesh = meshes.transformed(mesh, np.diag([*scale, 1.0]))
    else:
        raise FileFormatError(path, f"{tag.tag}.geometry.{shape.tag}", "allowed: box, cylinder, sphere, mesh")
    return meshes.transformed(mesh, T_root_link @ _origin(tag, path))


def _mesh_file(tag: ET.Element, path: Path, root: Path) -> Path:
    name = tag.get("filename", "").removeprefix("package://").removeprefix("file://")
    folder = root.resolve()
    for base in (path.parent.resolve(), folder):
        file = (base / name).resolve()
        if file.is_relative_to(folder) and file.is_file():
            return file
    raise FileFormatError(path, "mesh.filename", f"there is no file '{name}' below {folder}")


def _origin(tag: ET.Element, path: Path) -> Float64:
    found = tag.find("origin")
    if found is None:
        return np.eye(4)
    roll, pitch, yaw = _numbers(found.get("rpy", "0 0 0"), 3, "origin.rpy", path).tolist()
    return transform(rotation_from_rpy(roll, pitch, yaw), _numbers(found.get("xyz", "0 0 0"), 3, "origin.xyz", path))


def _numbers(text: str, count: int, where: str, path: Path) -> Float64:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.empty(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise FileFormatError(path, where, f"'{text}' must be {count} finite number{'s' * (count > 1)}")
    return values
