"""Entity nodes of a contact graph: <o, c, M, B(p, q, s), Pi> of the reconstruction paper, section 2.1.

A node is a shape at a pose. The shape holds what is expensive and does not change when the entity moves: mesh, planes,
hull. Entities of one model (tracked objects) share theirs.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from simtrack.contracts import Float64, Int32
from simtrack.errors import InvalidValueError, MeshError, SimtrackError
from simtrack.geometry.boxes import OrientedBox
from simtrack.geometry.meshes import Mesh, convex_hull, face_areas, is_closed, mass_properties, validate, volume
from simtrack.geometry.planes import PlaneConfig, SurfacePlane, detect_planes
from simtrack.geometry.transforms import apply, is_rigid
from simtrack.geometry.upright_boxes import horizontal_hull, upright_box
from simtrack.perception.scene_graph.contact.coarse import coarse_surface

if TYPE_CHECKING:
    from simtrack.raycast import TriangleMesh

SCENE = ""
"""Name of the scene node v_s, the root of the tree."""
FLOOR = "floor"
"""Semantic class of floors."""


class EntityKind(StrEnum):
    """What a node is; the scene node itself is implicit."""

    LAYOUT = "layout"
    """Floor, ceiling, wall: V^L."""
    RIGID = "rigid"
    """V^R."""
    ARTICULATED = "articulated"
    """V^A."""


class FindingCode(StrEnum):
    """What can be wrong with the entities that a contact graph is made of."""

    INVALID_ENTITY = "invalid-entity"
    """Left out: an empty or broken mesh, a pose that is none, or a name that is taken."""
    NO_PLANES = "no-planes"
    """Nothing on the entity is flat; it stays, and can support things by hidden planes alone."""
    NO_FLOOR = "no-floor"
    """No entity is a floor: what nothing else supports hangs in the air."""
    UNSUPPORTED = "unsupported"
    """Nothing supports the entity; it becomes a child of the scene node."""
    SUPPORT_GUESSED = "support-guessed"
    """The entity touches nothing that could support it; its parent is the likeliest (Eq. 3)."""
    SUPPORT_CYCLE = "support-cycle"
    """Entities would have supported one another; the weakest support was dropped."""
    SUNK = "sunk"
    """The entity lies below its support plane altogether; its box was not refined."""
    IN_MOTION = "in-motion"
    """Left out: it moved, or stood on what moved, when the scene was taken; nothing at rest holds it."""
    MODEL_MISSING = "model-missing"
    """An object whose model is not to be found; its box stands for it."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Something about the input that a user should know."""

    code: FindingCode
    entity: str
    """Name of the entity, or empty for the scene."""
    message: str


@dataclass(frozen=True, slots=True)
class EntityMesh:
    """What perception hands over: a labelled mesh, whole or in part, in the map or at a pose."""

    name: str
    """Unique instance label o."""
    semantic_class: str
    """Semantic label c."""
    mesh: Mesh
    """In the entity's own frame, z up."""
    T_map_entity: Float64 = field(default_factory=lambda: np.eye(4))
    """(4, 4); the identity for meshes that are given in the map."""


@dataclass(frozen=True, slots=True, eq=False)
class EntityShape:
    """The part of a node that moves rigidly with the entity; all in the entity's frame."""

    mesh: Mesh
    planes: tuple[SurfacePlane, ...]
    outlines: tuple[Float64, ...]
    """(K, 3) corners of the convex hull of what lies on each plane."""
    coarse: Mesh
    """The mesh, or of a finer one a copy with about `coarse.COARSE_FACES` faces: what contact is judged by."""
    coarse_planes: tuple[Int32, ...]
    """(K, 3) faces of `coarse` that lie on each plane."""
    hull: Float64
    """(K, 3), corners of the convex hull."""
    centre_of_mass: Float64
    """(3,), of the homogeneous solid; of the surface's hull where the mesh is open."""
    closed: bool
    """Whether the mesh encloses a volume."""
    surface: "TriangleMesh"
    """The mesh for distance queries."""
    solid: Any
    """The `manifold3d.Manifold` of the mesh, or of its hull where that is open; None if flat."""


def entity_shape(
    mesh: Mesh, rng: np.random.Generator, config: PlaneConfig | None = None, *, source: str = "entity"
) -> EntityShape:
    """Planes, hull and solid of a mesh.

    Raises:
        MeshError: the mesh is empty, not finite or without area; names `source`.
    """
    from simtrack.raycast import TriangleMesh

    planes = detect_planes(mesh, rng, config, source=source)
    used = np.unique(mesh.faces)
    try:
        whole = convex_hull(mesh.vertices[used])
        hull = whole.vertices
    except MeshError:
        whole, hull = None, mesh.vertices[used]
    closed = is_closed(mesh) and volume(mesh) > 1e-12
    solid = _manifold(mesh) if closed else None
    closed = solid is not None
    if solid is None and whole is not None:
        solid = _manifold(whole)
    if closed or whole is not None:
        centre = mass_properties(mesh if closed or whole is None else whole, density=1.0)[1]
    else:
        weights = face_areas(mesh)
        centre = weights @ mesh.triangles.mean(axis=1) / weights.sum()
    outlines = tuple(_outline(mesh, plane) for plane in planes)
    coarse, coarse_planes = coarse_surface(mesh, planes)
    return EntityShape(
        mesh=mesh,
        planes=planes,
        outlines=outlines,
        coarse=coarse,
        coarse_planes=coarse_planes,
        hull=hull,
        centre_of_mass=centre,
        closed=closed,
        surface=TriangleMesh(mesh.vertices, mesh.faces, source),
        solid=solid,
    )


def _outline(mesh: Mesh, plane: SurfacePlane) -> Float64:
    """(K, 3) convex hull, within the plane, of the faces that lie on it."""
    points = mesh.vertices[np.unique(mesh.faces[plane.faces])]
    axes = np.linalg.svd(plane.normal[None])[2][1:]
    return horizontal_hull(points @ axes.T) @ axes - plane.offset * plane.normal


def _manifold(mesh: Mesh) -> Any:
    """A solid of a closed mesh, or None if manifold3d cannot make one of it."""
    import manifold3d

    # it takes no read-only arrays
    data = manifold3d.Mesh64(vert_properties=np.array(mesh.vertices), tri_verts=np.array(mesh.faces, np.uint64))
    data.merge()
    solid = manifold3d.Manifold(data)
    whole = solid.status() == manifold3d.Error.NoError and solid.volume() > 1e-12
    return solid if whole else None


@dataclass(frozen=True, slots=True, eq=False)
class EntityNode:
    """A node v = <o, c, M, B, Pi> of a contact graph; box and planes in the map."""

    name: str
    """o."""
    semantic_class: str
    """c."""
    kind: EntityKind
    T_map_entity: Float64
    """(4, 4)."""
    box: OrientedBox
    """B: upright, minimal; refined in a finished graph."""
    planes: tuple[SurfacePlane, ...]
    """Pi, with hidden support planes at the end in a finished graph."""
    shape: EntityShape | None
    """M and what follows from it; None in a graph that was read from a file."""

    @property
    def bottom(self) -> float:
        """Height of the box's lower side, metres."""
        return float(self.box.T_map_box[2, 3] - 0.5 * self.box.extents[2])

    @property
    def top(self) -> float:
        """Height of the box's upper side, metres."""
        return float(self.box.T_map_box[2, 3] + 0.5 * self.box.extents[2])

    def moved(self, T_map_entity: Float64) -> "EntityNode":
        """The node at another pose.

        Raises:
            InvalidValueError: not a rigid transform, or the node has no mesh.
        """
        if self.shape is None or not is_rigid(np.asarray(T_map_entity)):
            raise InvalidValueError("T_map_entity", T_map_entity, "a (4, 4) rigid transform of a node with a mesh")
        T = np.array(T_map_entity, dtype=float)
        box = upright_box(apply(T, self.shape.hull))
        return replace(self, T_map_entity=T, box=box, planes=tuple(p.moved(T) for p in self.shape.planes))


@dataclass(frozen=True, slots=True)
class NodeConfig:
    """Settings of the nodes."""

    planes: PlaneConfig = field(default_factory=PlaneConfig)
    layout_classes: frozenset[str] = frozenset({"ceiling", FLOOR, "wall"})
    articulated_classes: frozenset[str] = frozenset(
        {"cabinet", "dishwasher", "door", "drawer", "fridge", "laptop", "microwave", "oven", "washing-machine"}
    )

    def kind(self, semantic_class: str) -> EntityKind:
        """Layout, rigid or articulated (section 2.2)."""
        if semantic_class in self.layout_classes:
            return EntityKind.LAYOUT
        return EntityKind.ARTICULATED if semantic_class in self.articulated_classes else EntityKind.RIGID


def entity_node(
    name: str,
    semantic_class: str,
    shape: EntityShape,
    T_map_entity: Float64 | None = None,
    config: NodeConfig | None = None,
) -> EntityNode:
    """A node of a shape at a pose (the identity where the mesh is given in the map).

    Raises:
        InvalidValueError: an empty name, or not a rigid transform.
    """
    if not name or len(name) > 256:
        raise InvalidValueError("name", name, "1 to 256 characters")
    kind = (config or NodeConfig()).kind(semantic_class)
    T = np.eye(4) if T_map_entity is None else np.array(T_map_entity, dtype=float)
    box = upright_box(shape.hull)
    return EntityNode(name, semantic_class, kind, T, box, (), shape).moved(T)


def entity_nodes(
    entities: Iterable[EntityMesh], rng: np.random.Generator, config: NodeConfig | None = None
) -> tuple[list[EntityNode], list[Finding]]:
    """Nodes of labelled meshes; those that cannot be used are left out and said so. Equal meshes share their shape."""
    config = config or NodeConfig()
    nodes: dict[str, EntityNode] = {}
    findings: list[Finding] = []
    shapes: dict[int, EntityShape] = {}
    for entity in entities:
        try:
            if entity.name in nodes:
                raise InvalidValueError("name", entity.name, "a name that no other entity has")
            if id(entity.mesh) not in shapes:
                validate(entity.mesh, entity.name)
                shapes[id(entity.mesh)] = entity_shape(entity.mesh, rng, config.planes, source=entity.name)
            shape = shapes[id(entity.mesh)]
            node = entity_node(entity.name, entity.semantic_class, shape, entity.T_map_entity, config)
        except SimtrackError as error:
            findings.append(Finding(FindingCode.INVALID_ENTITY, entity.name, f"left out: {error}"))
            continue
        nodes[node.name] = node
        if not node.planes:
            message = "no plane was found on it: it can support others by hidden planes alone"
            findings.append(Finding(FindingCode.NO_PLANES, node.name, message))
    return list(nodes.values()), findings
