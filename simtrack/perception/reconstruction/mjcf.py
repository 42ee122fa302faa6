"""MJCF of a body tree: what floats is a free body of the world, and what it rests on is kept as metadata.

MuJoCo cannot load floating joints below other bodies. Each component of the tree becomes a body of the world with its
fixed and moving parts nested in it; ``custom/text`` elements named ``support:BODY`` hold the name of the supporting
body, those named ``class:BODY`` its semantic class. Contacts between the two sides of a joint are left out, as the
shapes of doors overlap their frames at the hinge. Group 2 is seen, group 3 collides.
"""

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from simtrack.contracts import Float64
from simtrack.geometry.transforms import quaternion_from_rotation
from simtrack.perception.reconstruction.body_tree import Body, BodyJoint, BodyTree, Component
from simtrack.perception.reconstruction.files import MeshFiles, numbers

TIMESTEP = 0.002
SEEN, COLLIDES = "2", "3"


def write_mjcf(tree: BodyTree, meshes: MeshFiles, path: Path) -> None:
    """Write the MJCF file; the mesh files lie beside it."""
    root = Element("mujoco", model=tree.name)
    SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    # Elliptic cones with a high ratio of frictional to normal impedance keep what rests from creeping.
    SubElement(root, "option", timestep=numbers([TIMESTEP]), integrator="implicitfast", cone="elliptic", impratio="10")
    SubElement(root, "statistic", extent="4", center="0 0 0.5")
    asset = SubElement(root, "asset")
    for body in tree.bodies:
        for file in meshes.visual[body.name]:
            SubElement(asset, "mesh", name=file.path, file=file.path, inertia="shell")
        for file in meshes.collision[body.name].values():
            SubElement(asset, "mesh", name=file.path, file=file.path, inertia="convex")
    world = SubElement(root, "worldbody")
    SubElement(world, "light", pos="0 0 4", dir="0 0 -1", directional="true")
    for component in tree.components:
        _component(world, component, meshes)
    _excludes(root, tree)
    custom = SubElement(root, "custom")
    for component in tree.components:
        if component.support is not None:
            SubElement(custom, "text", name=f"support:{component.name}", data=component.support)
    for body in tree.bodies:
        SubElement(custom, "text", name=f"class:{body.name}", data=body.semantic_class)
    ElementTree.indent(root)
    path.write_bytes(ElementTree.tostring(root, encoding="utf-8") + b"\n")


def _component(world: Element, component: Component, meshes: MeshFiles) -> None:
    elements: dict[str, Element] = {}
    for number, body in enumerate(component.bodies):
        if number == 0:
            element = _body(world, body, component.T_scene_root, meshes)
            if not component.static:
                element.insert(0, Element("freejoint", name=f"{body.name}/free"))
        else:
            assert body.joint is not None
            element = _body(elements[body.joint.parent], body, body.joint.T_parent_body, meshes)
            if body.joint.moves:
                element.insert(0, _joint(body.joint))
        elements[body.name] = element


def _body(parent: Element, body: Body, T_parent_body: Float64, meshes: MeshFiles) -> Element:
    element = SubElement(parent, "body", {"name": body.name, **_pose(T_parent_body)})
    if body.mass > 0.0:
        moments, T_body_principal = body.principal_inertia()
        inertial = {"mass": numbers([body.mass]), "diaginertia": numbers(moments)}
        SubElement(element, "inertial", {**inertial, **_pose(T_body_principal)})
    for k, file in enumerate(meshes.visual[body.name]):
        rgba = numbers([channel / 255.0 for channel in file.color] + [1.0])
        seen = {"group": SEEN, "contype": "0", "conaffinity": "0", "rgba": rgba}
        SubElement(element, "geom", {"name": f"{body.name}/visual{k}", "type": "mesh", "mesh": file.path, **seen})
    for k, shape in enumerate(body.collision):
        geom = {"name": f"{body.name}/collision{k}", "group": COLLIDES, "friction": numbers([body.friction])}
        if shape.kind == "convex":
            geom |= {"type": "mesh", "mesh": meshes.collision[body.name][k].path}
        elif shape.kind == "cylinder":
            geom |= {"type": "cylinder", "size": numbers([shape.size[0], 0.5 * shape.size[1]])}
        else:
            half = [0.5 * side for side in shape.size] if shape.kind == "box" else shape.size
            geom |= {"type": shape.kind, "size": numbers(half)}
        SubElement(element, "geom", {**geom, **_pose(shape.pose)})
    return element


def _joint(joint: BodyJoint) -> Element:
    attributes = {"name": joint.name, "type": "slide" if joint.kind == "prismatic" else "hinge"}
    attributes |= {"axis": numbers(joint.direction), "damping": numbers([joint.damping])}
    attributes["frictionloss"] = numbers([joint.friction])
    if joint.kind != "continuous" and joint.lower < joint.upper:
        attributes["range"] = numbers([joint.lower, joint.upper])
    return Element("joint", attributes)


def _pose(T: Float64) -> dict[str, str]:
    return {"pos": numbers(T[:3, 3]), "quat": numbers(quaternion_from_rotation(T[:3, :3]))}


def _excludes(root: Element, tree: BodyTree) -> None:
    """No contacts between the rigid bodies on the two sides of a moving joint."""
    groups = tree.rigid_groups()
    members: dict[str, list[str]] = {}
    for name, group in groups.items():
        members.setdefault(group, []).append(name)
    contact = SubElement(root, "contact")
    for body in tree.joints.values():
        assert body.joint is not None
        for fixed in members[groups[body.joint.parent]]:
            for moved in members[groups[body.name]]:
                SubElement(contact, "exclude", body1=fixed, body2=moved)
