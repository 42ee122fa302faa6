"""GLB of a body tree, for viewers and virtual reality: one node a body, named as the body, at its rest pose."""

from pathlib import Path

import numpy as np

from simtrack.geometry.meshes import concatenate, convex_hull, split_by_color
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.perception.reconstruction.body_tree import Body, BodyTree

ROOT = "scene"
T_GLTF_SCENE = transform(exp_so3(np.array([-0.5 * np.pi, 0.0, 0.0])))
"""glTF has y up."""


def write_glb(tree: BodyTree, path: Path) -> None:
    """Write the binary glTF 2.0 file. Bodies without a visual mesh show their collision shapes."""
    import trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    scene = trimesh.Scene(base_frame=ROOT if ROOT not in tree.by_name else f"{ROOT}/gltf")
    base = scene.graph.base_frame
    for body in tree.bodies:
        parent = base if body.joint is None else body.joint.parent
        matrix = T_GLTF_SCENE if body.joint is None else body.joint.T_parent_body
        scene.graph.update(frame_to=body.name, frame_from=parent, matrix=matrix)
        for k, (color, part) in enumerate(_shown(body)):
            material = PBRMaterial(baseColorFactor=[*color, 255], metallicFactor=0.0, roughnessFactor=0.9)
            visual = TextureVisuals(material=material)
            mesh = trimesh.Trimesh(part.vertices, part.faces, process=False, visual=visual)
            scene.add_geometry(mesh, f"{body.name}/{k}", f"{body.name}/{k}", parent_node_name=body.name)
    path.write_bytes(export_glb(scene))


def _shown(body: Body) -> list:
    if body.visual is not None:
        return split_by_color(body.visual)
    if not body.collision:
        return []
    return split_by_color(concatenate([convex_hull(shape.corners()) for shape in body.collision]))
