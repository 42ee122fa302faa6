"""An entity's own mesh as a model: for classes of which there is no CAD model, and for what none fits.

The mesh may lack what nobody saw. Below it, the lowest outline is drawn down to the entity's support plane, as the box
is (section 2.2 of the reconstruction paper); what noise left below the plane is pressed up to it.
"""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from simtrack import paths
from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError, MeshError
from simtrack.geometry.meshes import Mesh, concatenate, convex_hull, decimate, transformed
from simtrack.geometry.transforms import inverse, transform
from simtrack.objects.cache import UNUSABLE, digest, mesh_arrays, open_arrays, read_mesh, write_arrays
from simtrack.objects.cad.model import CadModel, CadPart, CadSupport
from simtrack.objects.decomposition import DecompositionConfig, convex_parts
from simtrack.perception.reconstruction.candidates import CadCandidate
from simtrack.perception.reconstruction.convex_pieces import convex_pieces, levelled
from simtrack.perception.reconstruction.physical import physical_properties
from simtrack.perception.scene_graph.contact.nodes import EntityNode

PART = "body"
PREFIX = "own-"
"""Of the names of such models."""
SHOWN_FACES = 6000
FOOT = 0.02
"""Metres above the lowest point from which the outline is drawn down."""
DECOMPOSITION = DecompositionConfig(0.06, 24, 40, 1000, 12, 60)
"""Finer than that of users' objects: furniture is larger, and what stands on it has to find it."""
FACES = 2000
"""Faces of a mesh that is decomposed."""
TIME_LIMIT = 240.0
"""Seconds."""
THICKNESS = 0.002
"""Metres that a flat entity is given."""
LEVEL = 0.9
"""Cosine off the vertical up to which a plane can be stood on."""


def is_own(candidate: CadCandidate) -> bool:
    """Whether the candidate is the entity's own mesh."""
    return candidate.model.name.startswith(PREFIX)


def own_candidate(node: EntityNode) -> tuple[CadCandidate, str]:
    """The node's mesh as a rigid model in the frame of its box, and what is to be said of it (or nothing).

    Raises:
        InvalidValueError: the node has no mesh (it was read from a file).
        MeshError: nothing can be made of the mesh.
    """
    if node.shape is None:
        raise InvalidValueError("node.shape", None, f"a mesh; '{node.name}' was read from a file without one")
    T_box_map = inverse(node.box.T_map_box)
    seen = levelled(transformed(node.shape.mesh, T_box_map @ node.T_map_entity), node.planes, T_box_map)
    mesh, flat = _solidified(seen)
    low = -0.5 * float(node.box.extents[2])
    hulls, rest = convex_pieces(mesh)
    pieces, failure = _decomposed(rest, node) if rest is not None else ((), "")
    parts = [_pressed(part, low) for part in (*hulls, *pieces)]
    foot = _foot(mesh, low)
    if foot is not None:
        parts.append(foot)
    physical = physical_properties(parts, node.semantic_class)
    shown = decimate(
        Mesh(np.maximum(mesh.vertices, [-np.inf, -np.inf, low]), mesh.faces, mesh.face_colors), SHOWN_FACES
    )
    part = CadPart(
        name=PART,
        mesh=shown if foot is None else concatenate([shown, foot]),
        convex=tuple(parts),
        mass=physical.mass,
        centre_of_mass=physical.centre_of_mass,
        inertia=physical.inertia,
        friction=physical.friction,
        material=physical.substance,
    )
    model = CadModel(
        name=f"{PREFIX}{node.name}",
        semantic_class=node.semantic_class,
        parts=(part,),
        joints=(),
        extents=node.box.extents,
        planes=(),
        supports=tuple(_supports(node)),
        hollows=(),
        handles=(),
        affordances=frozenset(),
        yaw_symmetries=np.zeros(1),
        description="the entity's own mesh",
    )
    said = [f"{failure}: its convex hull stands for it in physics"] if failure else []
    said += [f"it is flat and was given {1e3 * THICKNESS:g} mm of thickness"] if flat else []
    return CadCandidate(model, node.box.T_map_box, 1.0), "; ".join(said)


def _decomposed(mesh: Mesh, node: EntityNode) -> tuple[Sequence[Mesh], str]:
    """Convex parts of a mesh, from the disk cache if it was decomposed before; its hull, and why, if that fails."""
    key = digest(mesh.vertices.tobytes(), mesh.faces.tobytes(), repr((DECOMPOSITION, FACES)).encode())
    path = paths.cache_dir() / "convex" / f"{key}.npz"
    with suppress(*UNUSABLE), open_arrays(path) as data:
        return [read_mesh(data, f"part{k}") for k in range(len(data) // 2)], ""
    try:
        parts = convex_parts(mesh, node.name, DECOMPOSITION, max_faces=FACES, time_limit=TIME_LIMIT)
    except MeshError as error:
        return [convex_hull(mesh.vertices)], error.reason
    arrays: dict[str, np.ndarray] = {}
    for k, part in enumerate(parts):
        arrays |= mesh_arrays(f"part{k}", part)
    with suppress(OSError):
        write_arrays(path, arrays)
    return parts, ""


def _solidified(mesh: Mesh) -> tuple[Mesh, bool]:
    """The mesh, or a thickened one if it spans no volume."""
    try:
        convex_hull(mesh.vertices)
    except MeshError:
        centred = mesh.vertices - mesh.vertices.mean(axis=0)
        normal = np.linalg.svd(centred, full_matrices=False)[2][-1]
        return concatenate([mesh, transformed(mesh, transform(None, THICKNESS * normal))]), True
    return mesh, False


def _pressed(part: Mesh, low: float) -> Mesh:
    """A convex part without what lies below a height; one that is below altogether stays."""
    if part.vertices[:, 2].min() >= low or part.vertices[:, 2].max() < low + THICKNESS:
        return part
    return convex_hull(np.maximum(part.vertices, [-np.inf, -np.inf, low]))


def _foot(mesh: Mesh, low: float) -> Mesh | None:
    """The convex prism from the lowest outline of a mesh down to a height; None if there is nothing to fill."""
    bottom = float(mesh.vertices[:, 2].min())
    if bottom - low < THICKNESS:
        return None
    outline = mesh.vertices[mesh.vertices[:, 2] < bottom + FOOT]
    try:
        return convex_hull(np.concatenate([outline, outline * [1.0, 1.0, 0.0] + [0.0, 0.0, low]]))
    except MeshError:  # it ends in a point or an edge
        return None


def _supports(node: EntityNode) -> list[CadSupport]:
    """The rectangles around the level planes that look up, in the frame of the box."""
    assert node.shape is not None
    T_box_map = inverse(node.box.T_map_box)
    supports = []
    for plane, outline in zip(node.planes, node.shape.outlines, strict=False):  # hidden ones come later and have none
        if plane.normal[2] >= LEVEL:
            supports.append(_rectangle(_moved(T_box_map @ node.T_map_entity, outline)))
    for plane in node.planes[len(node.shape.outlines) :]:
        height = plane.height_at(*node.box.T_map_box[:2, 3].tolist()) - node.box.T_map_box[2, 3]
        supports.append(CadSupport(PART, np.array([0.0, 0.0, height]), node.box.extents[:2], np.inf))
    return supports


def _rectangle(points: Float64) -> CadSupport:
    low, high = points.min(axis=0), points.max(axis=0)
    centre = np.array([*(low[:2] + high[:2]) / 2, np.median(points[:, 2])])
    return CadSupport(PART, centre, np.maximum(high - low, 1e-4)[:2], np.inf)


def _moved(T: Float64, points: Float64) -> Float64:
    return points @ T[:3, :3].T + T[:3, 3]
