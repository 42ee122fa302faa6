"""URDF of a body tree (section 4.5 of the reconstruction paper): fixed, floating and the models' own joints.

Readers differ in what they make of it: ROS and yourdfpy keep floating joints, pybullet freezes them and MuJoCo refuses
them below other bodies. `simtrack.plausibility` therefore cuts the tree there, and the MJCF file has free bodies.

Inertias are written along principal axes, since Bullet uses the diagonal alone. Bullet multiplies the friction of two
bodies: its element ``lateral_friction`` gets the square root, so that two equal bodies have the body's coefficient.
"""

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.transforms import rpy_from_rotation
from simtrack.perception.reconstruction.body_tree import Body, BodyJoint, BodyTree
from simtrack.perception.reconstruction.files import MeshFile, MeshFiles, numbers


def write_urdf(tree: BodyTree, meshes: MeshFiles, path: Path) -> None:
    """Write the URDF file; the mesh files lie beside it."""
    robot = Element("robot", name=tree.name)
    colors = sorted({file.color for files in meshes.visual.values() for file in files})
    for color in colors:
        rgba = [channel / 255.0 for channel in color] + [1.0]
        SubElement(SubElement(robot, "material", name=_material(color)), "color", rgba=numbers(rgba))
    for body in tree.bodies:
        _link(robot, body, meshes)
    for body in tree.bodies:
        if body.joint is not None:
            _joint(robot, body.name, body.joint)
    ElementTree.indent(robot)
    path.write_bytes(ElementTree.tostring(robot, encoding="utf-8", xml_declaration=True) + b"\n")


def _material(color: tuple[int, int, int]) -> str:
    return "rgb_" + "".join(f"{channel:02x}" for channel in color)


def _link(robot: Element, body: Body, meshes: MeshFiles) -> None:
    link = SubElement(robot, "link", name=body.name)
    inertial = SubElement(link, "inertial")
    moments, T_body_principal = body.principal_inertia()
    if body.mass == 0.0:
        moments = np.zeros(3)
    _origin(inertial, T_body_principal)
    SubElement(inertial, "mass", value=numbers([body.mass]))
    diagonal = {f"i{axis}": numbers([moment]) for axis, moment in zip(("xx", "yy", "zz"), moments, strict=True)}
    SubElement(inertial, "inertia", {**diagonal, "ixy": "0", "ixz": "0", "iyz": "0"})
    for file in meshes.visual[body.name]:
        visual = SubElement(link, "visual")
        _origin(visual, np.eye(4))
        _mesh(visual, file)
        SubElement(visual, "material", name=_material(file.color))
    for number, shape in enumerate(body.collision):
        collision = SubElement(link, "collision")
        _origin(collision, shape.pose)
        if shape.kind == "convex":
            _mesh(collision, meshes.collision[body.name][number])
            continue
        geometry = SubElement(collision, "geometry")
        if shape.kind == "box":
            SubElement(geometry, "box", size=numbers(shape.size))
        elif shape.kind == "sphere":
            SubElement(geometry, "sphere", radius=numbers(shape.size))
        else:
            radius, length = shape.size
            SubElement(geometry, "cylinder", radius=numbers([radius]), length=numbers([length]))
    contact = SubElement(link, "contact")
    SubElement(contact, "lateral_friction", value=numbers([np.sqrt(body.friction)]))


def _mesh(parent: Element, file: MeshFile) -> None:
    SubElement(SubElement(parent, "geometry"), "mesh", filename=file.path)


def _origin(parent: Element, T: Float64) -> None:
    SubElement(parent, "origin", xyz=numbers(T[:3, 3]), rpy=numbers(rpy_from_rotation(T[:3, :3])))


def _joint(robot: Element, child: str, joint: BodyJoint) -> None:
    element = SubElement(robot, "joint", name=joint.name, type=joint.kind)
    SubElement(element, "parent", link=joint.parent)
    SubElement(element, "child", link=child)
    _origin(element, joint.T_parent_body)
    if not joint.moves:
        return
    SubElement(element, "axis", xyz=numbers(joint.direction))
    limit = {"effort": numbers([joint.effort]), "velocity": numbers([joint.velocity])}
    if joint.kind != "continuous":
        limit |= {"lower": numbers([joint.lower]), "upper": numbers([joint.upper])}
    SubElement(element, "limit", limit)
    SubElement(element, "dynamics", damping=numbers([joint.damping]), friction=numbers([joint.friction]))
