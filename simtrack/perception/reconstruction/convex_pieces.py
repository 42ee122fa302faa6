"""Furniture is made of boards and blocks: connected pieces of a mesh that are convex, but for noise, are their hulls.

What a scanner cannot see (undersides) is missing from such a mesh, and its faces are wavy. Level faces that carry or
stand are made level first, so that what rests on them neither tilts nor rolls.
"""

from collections.abc import Sequence

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import MeshError
from simtrack.geometry.meshes import (
    Mesh,
    area,
    convex_hull,
    face_areas,
    face_normals,
    is_closed,
    sample_surface,
    volume,
)
from simtrack.geometry.planes import SurfacePlane

LEVEL = np.cos(np.radians(3.0))
"""From here on a plane is taken for level: it carries noise, and water finds no slope on furniture."""
TOLERANCE, SHARE = 0.015, 0.01
"""Metres, or share of its diagonal, by which a convex piece may lie off its hull: three times the noise of a survey."""
BULGE = 0.03
"""Metres that a hull may bulge beyond the wavy sides of a board."""
UNDERSIDE = -0.7
"""Normals with a lower z face down, where scanners see nothing."""
OPEN_SHARE = 0.05
"""Of the hull's area that may be open elsewhere."""
SAMPLES = 400
"""Points at which a hull is compared with its piece."""
THICKNESS = 0.002
"""Metres that a flat piece is given."""
SLIVER = 1e-4
"""Width over length below which a flat piece is a line."""
MAX_PIECES = 200
MAX_SHELL = 150
"""Faces up to which a hollow piece is plates behind its faces."""
WALL = 0.02
"""Metres of mean thickness from which a closed piece is solid."""


def levelled(mesh: Mesh, planes: Sequence[SurfacePlane], T_mesh_map: Float64) -> Mesh:
    """The mesh with its level planes made exactly level, at the height of their centres.

    Args:
        mesh: an entity's, in an upright frame.
        planes: of the entity in the map; their faces are those of the mesh.
        T_mesh_map: (4, 4), upright.
    """
    vertices = mesh.vertices.copy()
    for plane in sorted((p for p in planes if abs(p.normal[2]) > LEVEL and len(p.faces)), key=lambda p: p.area):
        own = np.unique(mesh.faces[plane.faces])
        areas, centres = face_areas(mesh)[plane.faces], mesh.vertices[mesh.faces[plane.faces]].mean(axis=1)
        middle = areas @ centres / areas.sum()
        x, y, _ = np.linalg.solve(T_mesh_map, [*middle, 1.0])[:3]
        vertices[own, 2] = plane.height_at(float(x), float(y)) + T_mesh_map[2, 3]
    return Mesh(vertices, mesh.faces, mesh.face_colors)


def convex_pieces(mesh: Mesh) -> tuple[list[Mesh], Mesh | None]:
    """Hulls of the connected pieces that are convex, plates behind the faces of hollow ones, and the rest of the mesh.

    The rest is None if nothing is left.
    """
    hulls: list[Mesh] = []
    left = np.arange(len(mesh.faces))
    for joined in (True, False):
        # Boards that meet corner to corner are one piece by their corners, but not by the numbers of their vertices.
        part = _part(mesh, left)
        pieces = connected_pieces(part, joined=joined)
        if len(pieces) > MAX_PIECES:
            break
        found = [hull_of_piece(_part(part, faces)) for faces in pieces]
        hulls += [hull for hull in found if hull is not None]
        rest = [faces for faces, hull in zip(pieces, found, strict=True) if hull is None]
        if not rest:
            return hulls, None
        left = left[np.sort(np.concatenate(rest))]
    rest = []
    for faces in connected_pieces(part := _part(mesh, left)):
        piece = _part(part, faces)
        if len(faces) <= MAX_SHELL and not _solid(piece):
            plates = [_thickened(_part(piece, np.array([face]))) for face in range(len(faces))]
            hulls += [plate for plate in plates if plate is not None]
        else:
            rest.append(faces)
    return hulls, _part(part, np.sort(np.concatenate(rest))) if rest else None


def _solid(piece: Mesh) -> bool:
    """Whether a piece is closed and too thick to be made of sheets."""
    return is_closed(piece) and 2.0 * volume(piece) > WALL * area(piece)


def _part(mesh: Mesh, faces: np.ndarray) -> Mesh:
    used, local = np.unique(mesh.faces[faces], return_inverse=True)
    colors = None if mesh.face_colors is None else mesh.face_colors[faces]
    return Mesh(mesh.vertices[used], local.reshape(-1, 3).astype(np.int32), colors)


def connected_pieces(mesh: Mesh, *, joined: bool = True) -> list[np.ndarray]:
    """Indices of the faces of each piece of the surface that hangs together at its vertices.

    Args:
        mesh: any mesh.
        joined: vertices at the same place are one.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces = mesh.faces
    if joined:
        _, same = np.unique(np.round(mesh.vertices, 7), axis=0, return_inverse=True)
        faces = same.reshape(-1)[faces]
    start, end = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_matrix((np.ones(len(start), np.int8), (start, end)), (len(mesh.vertices),) * 2)
    piece = connected_components(links, directed=False)[1][faces[:, 0]]
    order = np.argsort(piece, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(piece[order])) + 1)


def hull_of_piece(piece: Mesh) -> Mesh | None:
    """The hull of a piece that is convex but for noise and for what no scanner sees; None for any other."""
    from simtrack.raycast import RayScene, TriangleMesh

    try:
        hull = convex_hull(piece.vertices)
    except MeshError:
        return _thickened(piece)
    normals = face_normals(hull)
    offsets = np.einsum("fd,fd->f", normals, hull.triangles[:, 0])
    points = np.concatenate([piece.vertices, piece.triangles.mean(axis=1)])
    tolerance = max(TOLERANCE, SHARE * float(np.linalg.norm(hull.extents)))
    if (offsets - points @ normals.T).min(axis=1).max() > tolerance:
        return None
    seen, faces = sample_surface(hull, SAMPLES, np.random.default_rng(0))
    scene = RayScene()
    try:
        scene.add(TriangleMesh(piece.vertices, piece.faces))
        far = ~np.isfinite(scene.closest_points(seen, BULGE).distances)
    finally:
        scene.close()
    return hull if np.mean(far & (normals[faces, 2] > UNDERSIDE)) <= OPEN_SHARE else None


def _thickened(piece: Mesh) -> Mesh | None:
    """The hull of a flat sheet, made thick away from the side that it shows; None for a line or a point."""
    normal = face_areas(piece) @ face_normals(piece)
    length = float(np.linalg.norm(normal))
    if length < SLIVER * float(piece.extents @ piece.extents):
        return None
    try:
        return convex_hull(np.concatenate([piece.vertices, piece.vertices - THICKNESS * normal / length]))
    except MeshError:
        return None
