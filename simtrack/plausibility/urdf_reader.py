"""Reads any URDF into a body tree; what is wrong or unusual becomes findings, what cannot be used ends the reading.

The file is data: no entities, nothing outside of the allowed folder, bounded sizes.
"""

from pathlib import Path
from typing import get_args
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import FileFormatError, InvalidValueError, MeshError
from simtrack.geometry.meshes import Mesh, concatenate, decimate, load_mesh, painted, transformed
from simtrack.geometry.transforms import transform, transform_xyz_rpy
from simtrack.perception.reconstruction.body_tree import Body, BodyJoint, BodyTree, JointKind, Shape
from simtrack.plausibility import mesh_parts
from simtrack.plausibility.inertials import Inertial, credible_inertial
from simtrack.plausibility.verdict import Finding, Severity

MAX_BYTES = 20_000_000
MAX_LINKS = 5000
MAX_SIZE = 30.0
"""Metres: side of a free body above which it was most likely drawn in millimetres."""
MIN_SIZE = 0.001
MAX_DRAWN_FACES = 5000
JOINT_KINDS: dict[str, JointKind] = {kind: kind for kind in get_args(JointKind)}
DEFAULT_FRICTION = 0.5
"""Bullet's ``lateral_friction`` of bodies that state none; two such bodies have its square."""


class UrdfReader:
    """One reading of one file. Use `read_urdf`."""

    def __init__(self, path: Path, root: Path) -> None:
        self.path, self.root = path, root
        self.findings: list[Finding] = []
        self.materials: dict[str, tuple[int, int, int]] = {}

    def find(self, severity: Severity, kind: str, subject: str, message: str) -> None:
        """Keep a finding."""
        self.findings.append(Finding(severity, kind, subject, message))

    def read(self) -> BodyTree | None:
        """The tree; None if the file is unreadable."""
        try:
            robot = self._parse()
            links = self._named(robot, "link")
            joints = self._named(robot, "joint")
            for material in robot.findall("material"):
                color = self._color(material)
                if color is not None:
                    self.materials[material.get("name", "")] = color
            order, joint_of = self._order(links, joints)
            bodies = [self._body(links[name], joint_of.get(name)) for name in order]
        except FileFormatError as error:
            self.find("unreadable", "format", error.field, error.reason)
            return None
        if any(finding.severity == "unreadable" for finding in self.findings):
            return None
        try:
            return BodyTree(robot.get("name") or self.path.stem, tuple(bodies))
        except InvalidValueError as error:
            self.find("unreadable", "format", "", str(error))
            return None

    def _error(self, field: str, reason: str) -> FileFormatError:
        return FileFormatError(self.path, field, reason)

    def _parse(self) -> Element:
        if not self.path.is_file():
            raise self._error("", "is a folder; give the URDF file" if self.path.is_dir() else "no such file")
        if self.path.stat().st_size > MAX_BYTES:
            raise self._error("", f"is larger than {MAX_BYTES} bytes")
        content = self.path.read_bytes()
        if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
            raise self._error("", "declares entities; allowed: plain XML")
        try:
            robot = ElementTree.fromstring(content)
        except (ElementTree.ParseError, ValueError, LookupError) as error:
            raise self._error("", f"is not valid XML: {error}") from error
        if robot.tag != "robot":
            raise self._error("", f"its root element is <{robot.tag}>; a URDF has <robot>")
        if any("xacro" in str(element.tag) for element in robot.iter()):
            raise self._error("", "holds xacro macros; run xacro over it first")
        return robot

    def _named(self, robot: Element, tag: str) -> dict[str, Element]:
        out: dict[str, Element] = {}
        for element in robot.findall(tag):
            name = element.get("name", "")
            if not name:
                raise self._error(tag, "has no name")
            if name in out:
                raise self._error(f"{tag} '{name}'", "occurs twice; names must differ")
            out[name] = element
        if len(out) > MAX_LINKS:
            raise self._error(tag, f"occurs {len(out)} times; at most {MAX_LINKS} are allowed")
        if tag == "link" and not out:
            raise self._error("link", "there is none; one or more are needed")
        return out

    def _order(self, links: dict[str, Element], joints: dict[str, Element]) -> tuple[list[str], dict[str, Element]]:
        """Link names, parents before children, and the joint above each."""
        joint_of: dict[str, Element] = {}
        children: dict[str, list[str]] = {}
        for name, joint in joints.items():
            ends = []
            for role in ("parent", "child"):
                element = joint.find(role)
                end = "" if element is None else element.get("link", "")
                if end not in links:
                    raise self._error(f"joint '{name}'.{role}", f"no link is called '{end}'")
                ends.append(end)
            parent, child = ends
            if child in joint_of:
                raise self._error(f"joint '{name}'.child", f"link '{child}' has two parents; a URDF is a tree")
            joint_of[child] = joint
            children.setdefault(parent, []).append(child)
        roots = [name for name in links if name not in joint_of]
        if len(roots) != 1:
            found = f"these have none: {', '.join(roots[:5])}" if roots else "all have one: the joints form a cycle"
            raise self._error("link", f"one link must have no parent; {found}")
        order = list(roots)
        for name in order:
            order.extend(children.get(name, ()))
        lost = [name for name in links if name not in set(order)]
        if lost:
            raise self._error(f"link '{lost[0]}'", "cannot be reached from the root: its joints form a cycle")
        return order, joint_of

    def _numbers(self, element: Element | None, key: str, where: str, default: str, count: int) -> tuple[float, ...]:
        text = default if element is None else element.get(key, default)
        try:
            values = tuple(float(word) for word in text.split())
        except ValueError:
            values = ()
        if len(values) != count or not np.isfinite(values).all():
            raise self._error(f"{where}.{key}", f"'{text[:60]}' is not {count} finite number{'s' if count > 1 else ''}")
        return values

    def _origin(self, element: Element, where: str) -> Float64:
        origin = element.find("origin")
        x, y, z = self._numbers(origin, "xyz", f"{where}.origin", "0 0 0", 3)
        roll, pitch, yaw = self._numbers(origin, "rpy", f"{where}.origin", "0 0 0", 3)
        return transform_xyz_rpy((x, y, z), (roll, pitch, yaw))

    def _joint(self, element: Element) -> BodyJoint:
        name, stated = element.get("name", ""), element.get("type", "")
        where = f"joint '{name}'"
        kind = JOINT_KINDS.get(stated)
        if kind is None:
            if stated not in ("planar", "spherical"):
                raise self._error(f"{where}.type", f"'{stated}' is unknown; known: {', '.join(JOINT_KINDS)}, planar")
            self.find("warning", "joint-kind", name, f"{stated} joints are not simulated: taken as fixed")
            kind = "fixed"
        parent = element.find("parent")
        assert parent is not None
        T = self._origin(element, where)
        if kind in ("fixed", "floating"):
            return BodyJoint(name, kind, parent.get("link", ""), T)
        axis = np.array(self._numbers(element.find("axis"), "xyz", f"{where}.axis", "1 0 0", 3))
        length = float(np.linalg.norm(axis))
        if length < 1e-9:
            self.find("problem", "unreachable-joint", name, "its axis is 0 0 0: no direction to move in")
            axis, length = np.array([1.0, 0.0, 0.0]), 1.0
        lower, upper = self._limits(element, name, kind)
        dynamics = element.find("dynamics")
        friction, damping = (
            max(0.0, self._numbers(dynamics, key, f"{where}.dynamics", "0", 1)[0]) for key in ("friction", "damping")
        )
        return BodyJoint(name, kind, parent.get("link", ""), T, axis / length, lower, upper, friction, damping)

    def _limits(self, element: Element, name: str, kind: JointKind) -> tuple[float, float]:
        if kind == "continuous":
            return 0.0, 0.0
        limit = element.find("limit")
        if limit is None:
            message = f"a {kind} joint must state its limits: taken as unable to move"
            self.find("problem", "unreachable-joint", name, message)
            return 0.0, 0.0
        lower, upper = (self._numbers(limit, key, f"joint '{name}'.limit", "0", 1)[0] for key in ("lower", "upper"))
        if lower > upper:
            message = f"its lower limit {lower:g} is above its upper one {upper:g}: no position can be reached"
            self.find("problem", "unreachable-joint", name, message)
            return 0.0, 0.0
        if lower == upper:
            self.find("warning", "unreachable-joint", name, f"both limits are {lower:g}: it cannot move")
        elif not lower <= 0.0 <= upper:
            message = f"its rest position 0 lies outside of its limits {lower:g} to {upper:g}"
            self.find("warning", "joint-limits", name, message)
        unit = 1000.0 if kind == "revolute" else MAX_SIZE
        if max(abs(lower), abs(upper)) > unit:
            self.find("problem", "absurd-scale", name, f"limits {lower:g} to {upper:g} exceed {unit:g}")
        return lower, upper

    def _body(self, link: Element, joint_element: Element | None) -> Body:
        name = link.get("name", "")
        joint = None if joint_element is None else self._joint(joint_element)
        shapes: list[Shape] = []
        for number, element in enumerate(link.findall("collision")):
            shapes += self._shapes(element, name, f"link '{name}'.collision {number}")
        movable = joint is None or joint.kind != "fixed"
        self._check_scale(name, shapes, movable)
        stated = self._inertial(link, name)
        moving = joint is not None and joint.kind not in ("fixed", "floating")
        inertial = credible_inertial(stated, shapes, name, moving, movable, self.find)
        contact = link.find("contact")
        element = None if contact is None else contact.find("lateral_friction")
        value = self._numbers(element, "value", f"link '{name}'.contact.lateral_friction", str(DEFAULT_FRICTION), 1)[0]
        return Body(
            name=name,
            joint=joint,
            visual=self._visual(link, name),
            collision=tuple(shapes),
            mass=inertial.mass,
            centre_of_mass=inertial.centre_of_mass,
            inertia=inertial.inertia,
            friction=max(0.0, value) ** 2,
        )

    def _inertial(self, link: Element, name: str) -> Inertial | None:
        element = link.find("inertial")
        if element is None:
            return None
        where = f"link '{name}'.inertial"
        T = self._origin(element, where)
        mass = self._numbers(element.find("mass"), "value", f"{where}.mass", "0", 1)[0]
        if mass < 0.0:
            raise self._error(f"{where}.mass", f"{mass:g} kg is negative")
        tensor = element.find("inertia")
        value = {
            key: self._numbers(tensor, key, f"{where}.inertia", "0", 1)[0]
            for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        }
        inertia = np.array([[value["i" + "".join(sorted(a + b))] for b in "xyz"] for a in "xyz"])
        return Inertial(mass, T[:3, 3], T[:3, :3] @ inertia @ T[:3, :3].T)

    def _shapes(self, element: Element, name: str, where: str) -> list[Shape]:
        T = self._origin(element, where)
        geometry = element.find("geometry")
        shape = None if geometry is None or not len(geometry) else geometry[0]
        if shape is None:
            raise self._error(f"{where}.geometry", "is empty; allowed: box, sphere, cylinder, capsule, mesh, plane")
        try:
            if shape.tag == "mesh":
                return [Shape("convex", mesh=part, T_body_shape=T) for part in self._convex(shape, name)]
            return [_primitive(shape, self, where, T)]
        except InvalidValueError as error:
            raise self._error(where, str(error)) from error

    def _convex(self, element: Element, name: str) -> list[Mesh]:
        reference = element.get("filename", "")
        try:
            path = mesh_parts.locate(reference, self.path.parent, self.root)
            parts, said = mesh_parts.convex_parts(path, self._scale(element, name))
        except MeshError as error:
            self.find("unreadable", _mesh_kind(error), name, f"collision {error}")
            return []
        if said:
            self.find("warning", "mesh", name, f"collision mesh {reference} {said}")
        return parts

    def _scale(self, element: Element, name: str) -> tuple[float, float, float]:
        x, y, z = self._numbers(element, "scale", f"link '{name}'.mesh", "1 1 1", 3)
        if x * y * z == 0.0:
            raise self._error(
                f"link '{name}'.mesh.scale", f"{x:g} {y:g} {z:g} flattens the mesh; allowed: other than 0"
            )
        return x, y, z

    def _visual(self, link: Element, name: str) -> Mesh | None:
        drawn = []
        for element in link.findall("visual"):
            mesh = element.find("geometry/mesh")
            if mesh is None:
                continue
            reference = mesh.get("filename", "")
            try:
                path = mesh_parts.locate(reference, self.path.parent, self.root)
                if path.suffix.lower() == ".dae":
                    self.find("note", "not-drawn", name, f"visual mesh {reference} is not drawn: Collada")
                    continue
                part = decimate(load_mesh(path), MAX_DRAWN_FACES)
            except MeshError as error:
                self.find("unreadable", _mesh_kind(error), name, f"visual {error}")
                continue
            material = element.find("material")
            color = None if material is None else self._color(material)
            color = color or self.materials.get("" if material is None else material.get("name", ""))
            scaled = np.diag([*self._scale(mesh, name), 1.0])
            part = transformed(part, self._origin(element, f"link '{name}'.visual") @ scaled)
            drawn.append(painted(part, color) if color is not None else part)
        return concatenate(drawn) if drawn else None

    def _color(self, material: Element) -> tuple[int, int, int] | None:
        element = material.find("color")
        if element is None:
            return None
        rgba = self._numbers(element, "rgba", f"material '{material.get('name', '')}'.color", "", 4)
        r, g, b = (round(255.0 * min(max(channel, 0.0), 1.0)) for channel in rgba[:3])
        return r, g, b

    def _check_scale(self, name: str, shapes: list[Shape], movable: bool) -> None:
        if not shapes or not movable:
            return
        extents = np.ptp(np.concatenate([shape.corners() for shape in shapes]), axis=0)
        box = " x ".join(f"{side:.4g}" for side in extents)
        if extents.max() > MAX_SIZE:
            message = f"measures {box} m; drawn in millimetres? then scale it by 0.001"
            self.find("problem", "absurd-scale", name, message)
        elif extents.max() < MIN_SIZE:
            self.find("problem", "absurd-scale", name, f"measures {box} m; scaled from millimetres twice?")


def _mesh_kind(error: MeshError) -> str:
    if isinstance(error, mesh_parts.OutsideError):
        return "path-leads-out"
    return "missing-mesh" if error.reason.startswith("no such file") else "bad-mesh"


def _primitive(shape: Element, reader: UrdfReader, where: str, T: Float64) -> Shape:
    def number(key: str) -> float:
        return reader._numbers(shape, key, f"{where}.{shape.tag}", "", 1)[0]

    if shape.tag == "box":
        return Shape("box", reader._numbers(shape, "size", f"{where}.box", "", 3), T_body_shape=T)
    if shape.tag == "sphere":
        return Shape("sphere", (number("radius"),), T_body_shape=T)
    if shape.tag == "cylinder":
        return Shape("cylinder", (number("radius"), number("length")), T_body_shape=T)
    if shape.tag == "capsule":
        import trimesh

        capsule = trimesh.creation.capsule(number("length"), number("radius"), count=[16, 16])
        return Shape("convex", mesh=Mesh(capsule.vertices, capsule.faces), T_body_shape=T)
    if shape.tag == "plane":
        return Shape("box", (200.0, 200.0, 1.0), T_body_shape=T @ transform(None, (0.0, 0.0, -0.5)))
    raise reader._error(
        f"{where}.geometry", f"<{shape.tag}> is unknown; known: box, sphere, cylinder, capsule, mesh, plane"
    )


def read_urdf(path: str | Path, root: str | Path | None = None) -> tuple[BodyTree | None, tuple[Finding, ...]]:
    """Read a URDF file.

    Args:
        path: the file.
        root: folder in which all files that it names must lie; its own folder if None.

    Returns:
        The tree, None if it is unreadable, and what was found.
    """
    path = Path(path)
    reader = UrdfReader(path, path.parent if root is None else Path(root))
    tree = reader.read()
    return tree, tuple(reader.findings)
