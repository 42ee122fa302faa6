"""Pictures of an indoor scene from above, ray cast and shaded; walls before the camera are left out."""

from collections.abc import Mapping, Sequence

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64, Uint8
from simtrack.geometry.meshes import Mesh, face_normals, transformed
from simtrack.geometry.transforms import look_at
from simtrack.perception.reconstruction.body_tree import BodyTree
from simtrack.perception.scene_graph.contact.graph import ContactGraph, is_layout
from simtrack.perception.scene_graph.contact.nodes import EntityNode

WIDTH, HEIGHT = 960, 680
FOV = np.radians(48.0)
SUPERSAMPLING = 2
LIGHT = np.array([0.25, -0.45, 0.86])
GROUND = (236, 239, 242)
LAYOUT_COLOR = (222, 226, 230)
NO_COLOR = (170, 175, 182)


class RoomView:
    """A camera from which all of a scene can be seen."""

    def __init__(self, graph: ContactGraph) -> None:
        nodes = [node for node in graph.nodes.values() if not is_layout(node)] or list(graph.nodes.values())
        corners = np.concatenate([node.box.corners for node in nodes]) if nodes else np.array([[-1.0] * 3, [1.0] * 3])
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle = 0.5 * (low + high)
        radius = 0.5 * float(np.linalg.norm(high - low))
        towards = np.array([0.42, 0.62, -0.78])
        towards /= np.linalg.norm(towards)
        self.eye = middle - towards * max(1.02 * radius / np.tan(0.5 * FOV), 0.5)
        self.T_map_camera = look_at(self.eye, middle)
        f = 0.5 * SUPERSAMPLING * WIDTH / np.tan(0.5 * FOV)
        w, h = SUPERSAMPLING * WIDTH, SUPERSAMPLING * HEIGHT
        self.intrinsics = CameraIntrinsics(w, h, f, f, (w - 1) / 2, (h - 1) / 2)
        self.reach = 4.0 * float(np.linalg.norm(self.eye - middle)) + radius
        self.hidden = {name for name, node in graph.nodes.items() if is_layout(node) and self._in_the_way(node)}

    def _in_the_way(self, node: EntityNode) -> bool:
        """Whether a wall or ceiling stands between the camera and the room: its planes look away from the camera."""
        planes = sorted(node.planes, key=lambda plane: -plane.area)[:1]
        return any(float(plane.distance(self.eye[None])[0]) < 0.0 for plane in planes)

    def entities(self, graph: ContactGraph, colors: Mapping[str, str]) -> Uint8:
        """(H, W, 3), the meshes of the entities in the colours of their classes, slightly varied."""
        meshes = []
        for number, (name, node) in enumerate(graph.nodes.items()):
            if node.shape is None or name in self.hidden:
                continue
            color = LAYOUT_COLOR if is_layout(node) else varied(colors[node.semantic_class], number)
            mesh = transformed(node.shape.mesh, node.T_map_entity)
            meshes.append((mesh, np.tile(np.array(color, float), (len(mesh.faces), 1))))
        return self.image(meshes)

    def scene(self, tree: BodyTree, positions: Mapping[str, float] | None = None) -> Uint8:
        """(H, W, 3), the bodies of a scene in their own colours, joints at their positions."""
        meshes = []
        for name, T in tree.forward(positions).items():
            visual = tree.by_name[name].visual
            if visual is None or name in self.hidden:
                continue
            colors = visual.face_colors
            own = np.tile(np.array(NO_COLOR), (len(visual.faces), 1)) if colors is None else colors
            meshes.append((transformed(visual, T), own.astype(float)))
        return self.image(meshes)

    def image(self, meshes: Sequence[tuple[Mesh, Float64]]) -> Uint8:
        """(H, W, 3) RGB of meshes with (F, 3) colours; both sides of a face are seen."""
        return shaded(meshes, self.T_map_camera, self.intrinsics, self.reach)


def shaded(
    meshes: Sequence[tuple[Mesh, Float64]],
    T_map_camera: Float64,
    intrinsics: CameraIntrinsics,
    reach: float,
    *,
    backs: bool = True,
) -> Uint8:
    """(HEIGHT, WIDTH, 3) RGB of meshes with (F, 3) colours.

    Args:
        meshes: in the map, with their colours.
        T_map_camera: (4, 4).
        intrinsics: of an image that is reduced by `SUPERSAMPLING`.
        reach: metres along the optical axis beyond which nothing is drawn.
        backs: whether faces that look away from the camera are seen.
    """
    import cv2

    from simtrack.raycast import RayBundle, RayScene, TriangleMesh

    image = np.tile(np.array(GROUND, float), (intrinsics.height * intrinsics.width, 1))
    if not backs:
        meshes = [_front(mesh, colors, T_map_camera[:3, 3]) for mesh, colors in meshes]
    scene = RayScene()
    try:
        for number, (mesh, _) in enumerate(meshes):
            if not len(mesh.faces):
                continue
            scene.add(TriangleMesh(mesh.vertices, mesh.faces, str(number)), instance=number)
        bundle = RayBundle.from_camera(intrinsics)
        hits = scene.cast(bundle, T_map_camera, reach)
        rays = bundle.directions @ T_map_camera[:3, :3].T
        for number, (mesh, colors) in enumerate(meshes):
            own = np.flatnonzero(hits.hit & (hits.instances == number))
            if not len(own):
                continue
            faces = hits.faces[own]
            normals = face_normals(mesh)[faces]
            normals = normals * -np.sign(np.einsum("nd,nd->n", normals, rays[own]))[:, None]
            light = 0.62 + 0.38 * np.clip(normals @ (LIGHT / np.linalg.norm(LIGHT)), -0.4, 1.0)
            image[own] = colors[faces] * light[:, None]
    finally:
        scene.close()
    image = image.reshape(intrinsics.height, intrinsics.width, 3).clip(0, 255).astype(np.uint8)
    return np.asarray(cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), np.uint8)


def _front(mesh: Mesh, colors: Float64, eye: Float64) -> tuple[Mesh, Float64]:
    """The faces that look towards a point."""
    facing = np.einsum("fd,fd->f", eye - mesh.triangles.mean(axis=1), face_normals(mesh)) > 0.0
    return Mesh(mesh.vertices, mesh.faces[facing]), colors[facing]


def varied(color: str, number: int) -> tuple[float, float, float]:
    """A class's colour, a little lighter or darker from entity to entity."""
    rgb = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
    factor = 0.86 + 0.28 * ((number * 0.618) % 1.0)
    return rgb[0] * factor, rgb[1] * factor, rgb[2] * factor
