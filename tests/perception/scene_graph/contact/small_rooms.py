"""Small rooms whose support is known: complete, or as a camera at one side of the room sees them, with noise."""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import (
    Mesh,
    box_mesh,
    concatenate,
    cylinder_mesh,
    face_normals,
    transformed,
)
from simtrack.geometry.transforms import rotation_from_rpy, transform, transform_xyz_rpy
from simtrack.perception.scene_graph.contact import EntityMesh

CAMERAS = np.array([[0.0, -2.5, 1.6], [2.0, -2.2, 1.4], [-2.0, -2.2, 1.8]])
"""(N, 3), where the room is seen from."""


@dataclass
class Room:
    """Entities and what supports each of them."""

    entities: list[EntityMesh]
    parents: dict[str, str]

    def entity(self, name: str) -> EntityMesh:
        return next(entity for entity in self.entities if entity.name == name)


def boxes(*parts: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Mesh:
    """A mesh of boxes, each (size, centre)."""
    return concatenate([transformed(box_mesh(size), transform(None, centre)) for size, centre in parts])


def table_mesh(width: float = 1.2, depth: float = 0.8, height: float = 0.75) -> Mesh:
    """Origin on the floor, z up."""
    x, y, leg = 0.5 * width - 0.05, 0.5 * depth - 0.05, height - 0.03
    legs = [((0.05, 0.05, leg), (sx * x, sy * y, 0.5 * leg)) for sx in (-1, 1) for sy in (-1, 1)]
    return boxes(((width, depth, 0.03), (0.0, 0.0, height - 0.015)), *legs)


def shelf_mesh(boards: int = 5, width: float = 0.8, depth: float = 0.3, height: float = 1.8) -> Mesh:
    """Sides, back and boards; open to -y; origin on the floor."""
    side = 0.5 * width - 0.01
    parts = [((0.02, depth, height), (s * side, 0.0, 0.5 * height)) for s in (-1, 1)]
    parts.append(((width - 0.04, 0.01, height), (0.0, 0.5 * depth - 0.005, 0.5 * height)))
    levels = np.linspace(0.1, height - 0.01, boards)
    parts += [((width - 0.04, depth - 0.01, 0.02), (0.0, -0.005, z - 0.01)) for z in levels]
    return boxes(*parts)


def shelf_levels(boards: int = 5, height: float = 1.8) -> Float64:
    """Heights of the boards' tops."""
    return np.linspace(0.1, height - 0.01, boards)


def bowl_mesh(radius: float = 0.09, height: float = 0.07, wall: float = 0.005, segments: int = 40) -> Mesh:
    """A turned solid: curved outside and inside, a rounded bottom inside; origin at the centre of its foot."""
    s = np.linspace(0.0, 1.0, 9)
    outer = np.stack([0.03 + (radius - 0.03) * s, height * s**2], axis=1)
    inner = np.stack([(radius - wall) * s[::-1], wall + (height - wall) * s[::-1] ** 2], axis=1)[:-1]
    profile = np.concatenate([outer, inner])
    angles = 2.0 * np.pi * np.arange(segments) / segments
    rings = np.stack([np.stack([r * np.cos(angles), r * np.sin(angles), np.full(segments, z)], 1) for r, z in profile])
    n = len(profile)
    vertices = np.concatenate([rings.reshape(-1, 3), [[0.0, 0.0, 0.0], [0.0, 0.0, wall]]])
    i = np.arange(segments)
    j = (i + 1) % segments
    faces = []
    for k in range(n - 1):
        a, b, c, d = k * segments + i, k * segments + j, (k + 1) * segments + i, (k + 1) * segments + j
        faces += [np.stack([a, b, d], 1), np.stack([a, d, c], 1)]
    faces.append(np.stack([np.full(segments, n * segments), j, i], 1))
    last = (n - 1) * segments
    faces.append(np.stack([np.full(segments, n * segments + 1), last + i, last + j], 1))
    return Mesh(vertices, np.concatenate(faces).astype(np.int32))


def plate(width: float, depth: float) -> Mesh:
    """A sheet of two faces that face up."""
    x, y = 0.5 * width, 0.5 * depth
    return Mesh(
        np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    )


def furnished_room() -> Room:
    """A room of 6 m x 6 m: walls, furniture, things on, in, under, against and beside them."""
    entities: list[EntityMesh] = []
    parents: dict[str, str] = {}

    def add(name: str, kind: str, mesh: Mesh, parent: str, xyz: tuple[float, float, float], rpy=(0.0, 0.0, 0.0)):
        entities.append(EntityMesh(name, kind, mesh, transform_xyz_rpy(xyz, rpy)))
        parents[name] = parent

    wall = transformed(plate(6.0, 2.6), transform(rotation_from_rpy(np.pi / 2, 0.0, 0.0)))  # faces -y
    add("floor", "floor", plate(6.0, 6.0), "", (0.0, 0.0, 0.0))
    add("wall", "wall", wall, "", (0.0, 3.0, 1.3))
    add("table", "table", table_mesh(), "floor", (-1.5, 1.0, 0.0), (0.0, 0.0, 0.4))
    add("desk", "table", table_mesh(1.6, 0.7, 0.72), "floor", (1.2, 0.5, 0.0))
    add("shelf", "cabinet", shelf_mesh(), "floor", (1.0, 2.8, 0.0))
    add("box", "box", box_mesh((0.5, 0.4, 0.3)), "floor", (-0.2, 2.0, 0.15), (0.0, 0.0, 0.2))
    add("crate", "box", box_mesh((0.3, 0.3, 0.25)), "box", (-0.2, 2.0, 0.425), (0.0, 0.0, 0.5))
    add("under", "bag", box_mesh((0.3, 0.25, 0.3)), "floor", (1.2, 0.5, 0.15))
    for k, level in enumerate(shelf_levels()[1:4]):
        add(f"book{k}", "book", box_mesh((0.04, 0.2, 0.25)), "shelf", (0.8 + 0.15 * k, 2.78, float(level) + 0.125))
    add("tome", "book", box_mesh((0.24, 0.17, 0.03)), "desk", (0.9, 0.5, 0.735), (0.0, 0.0, 0.3))
    add("novel", "book", box_mesh((0.19, 0.13, 0.02)), "tome", (0.9, 0.5, 0.76), (0.0, 0.0, 0.6))
    add("cup", "cup", cylinder_mesh(0.04, 0.1), "table", (-1.7, 1.0, 0.80))
    add("bowl", "bowl", bowl_mesh(), "table", (-1.3, 1.1, 0.75))
    add("egg-cup", "cup", cylinder_mesh(0.025, 0.09), "bowl", (-1.3, 1.1, 0.75 + 0.0095 + 0.045))
    add(
        "monitor",
        "monitor",
        boxes(((0.5, 0.03, 0.3), (0, 0, 0.25)), ((0.05, 0.03, 0.1), (0, 0, 0.05)), ((0.25, 0.18, 0.01), (0, 0, 0.005))),
        "desk",
        (1.5, 0.6, 0.72),
    )
    add("picture", "picture", box_mesh((0.6, 0.03, 0.4)), "wall", (-1.0, 2.985, 1.6))
    add("board", "board", box_mesh((0.5, 0.02, 1.2)), "floor", *_leaning(0.02, 1.2, 0.2, (2.3, 3.0)))
    return Room(entities, parents)


def _leaning(thickness: float, length: float, angle: float, at: tuple[float, float]):
    """Pose of a board whose lower edge stands on the floor and whose upper edge touches a wall at y = at[1]."""
    # turned about x by -angle, its top goes to +y
    corners = np.array([[0.0, sy * 0.5 * thickness, sz * 0.5 * length] for sy in (-1, 1) for sz in (-1, 1)])
    turned = corners @ rotation_from_rpy(-angle, 0.0, 0.0).T
    return (at[0], at[1] - float(turned[:, 1].max()), -float(turned[:, 2].min())), (-angle, 0.0, 0.0)


def dense(mesh: Mesh, side: float = 0.06) -> Mesh:
    """Tessellated until no edge is longer than `side` metres."""
    from trimesh.remesh import subdivide_to_size

    vertices, faces = subdivide_to_size(mesh.vertices, mesh.faces, side)[:2]
    return Mesh(vertices, np.asarray(faces, np.int32))


def seen(room: Room, noise: float, rng: np.random.Generator, side: float = 0.06) -> Room:
    """The faces that some camera sees, with noise on the vertices; entities of which too little is seen are dropped."""
    from simtrack.raycast import RayScene, TriangleMesh

    scene = RayScene()
    meshes = [transformed(dense(e.mesh, side), e.T_map_entity) for e in room.entities]
    for mesh in meshes:
        scene.add(TriangleMesh(mesh.vertices, mesh.faces), np.eye(4))
    entities = []
    for entity, mesh in zip(room.entities, meshes, strict=True):
        centres, normals = mesh.triangles.mean(axis=1), face_normals(mesh)
        visible = np.zeros(len(centres), bool)
        for camera in CAMERAS:
            rays = centres + 1e-3 * normals - camera
            length = np.linalg.norm(rays, axis=1)
            hits = scene.cast_rays(np.tile(camera, (len(rays), 1)), rays / length[:, None])
            visible |= (np.einsum("fd,fd->f", rays, normals) < 0.0) & (hits.distances > length - 2e-3)
        used, faces = np.unique(mesh.faces[visible], return_inverse=True)
        if len(used) < 20:
            continue
        vertices = mesh.vertices[used] + rng.normal(0.0, noise, (len(used), 3))
        entities.append(
            EntityMesh(entity.name, entity.semantic_class, Mesh(vertices, faces.reshape(-1, 3).astype(np.int32)))
        )
    scene.close()
    return Room(entities, room.parents)
