"""Triangle meshes as values, and what is computed from them: areas, masses, tessellations, samples.

Everything is metres. A closed mesh winds counter-clockwise seen from outside.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from threading import Lock

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float64, Int32, Uint8
from simtrack.errors import InvalidValueError, MeshError

_SIMPLIFYING = Lock()
"""`fast_simplification` keeps its mesh in global variables and lets other threads run meanwhile."""

MAX_FILE_BYTES = 200_000_000
"""Largest mesh file that `load_mesh` reads."""
MAX_FACES = 5_000_000
"""Largest number of faces that `load_mesh` accepts."""
MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb")
"""File name endings that `load_mesh` reads."""


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle mesh; the arrays are converted to their dtype when it is made and are not to be written to."""

    vertices: Float64
    """(V, 3), metres."""
    faces: Int32
    """(F, 3), indices into `vertices`, counter-clockwise seen from outside."""
    face_colors: Uint8 | None = None
    """(F, 3) RGB, or None."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", np.ascontiguousarray(self.vertices, np.float64).reshape(-1, 3))
        object.__setattr__(self, "faces", np.ascontiguousarray(self.faces, np.int32).reshape(-1, 3))
        if self.face_colors is not None:
            colors = np.ascontiguousarray(self.face_colors, np.uint8)
            if colors.shape != (len(self.faces), 3):
                raise InvalidValueError("face_colors", colors.shape, f"shape ({len(self.faces)}, 3): RGB of every face")
            object.__setattr__(self, "face_colors", colors)

    @property
    def bounds(self) -> Float64:
        """(2, 3), lower and upper corner of the axis-aligned box."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def extents(self) -> Float64:
        """(3,), side lengths of the axis-aligned box."""
        return np.ptp(self.vertices, axis=0)

    @property
    def triangles(self) -> Float64:
        """(F, 3, 3), corner positions of every face."""
        return self.vertices[self.faces]


# --------------------------------------------------------------------------------------------------------------- making


def box_mesh(extents: Sequence[float] | Float64, color: Sequence[int] | None = None) -> Mesh:
    """Closed box of 12 faces with side lengths `extents` (3,), centred at the origin."""
    corners = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    quads = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]], np.int32)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return painted(Mesh(corners * np.asarray(extents, float), faces), color)


def cylinder_mesh(radius: float, height: float, segments: int = 48, color: Sequence[int] | None = None) -> Mesh:
    """Closed prism over a regular polygon inscribed in the circle of `radius`, axis z, centred at the origin."""
    angles = 2.0 * np.pi * np.arange(segments) / segments
    ring = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(segments, -0.5 * height)], axis=1)
    top = ring * [1.0, 1.0, -1.0]
    caps = np.array([[0.0, 0.0, -0.5 * height], [0.0, 0.0, 0.5 * height]])
    i = np.arange(segments, dtype=np.int32)
    j = (i + 1) % segments
    low, high = np.full_like(i, 2 * segments), np.full_like(i, 2 * segments + 1)
    faces = np.concatenate(
        [np.stack(f, axis=1) for f in ((i, j, j + segments), (i, j + segments, i + segments), (low, j, i))]
        + [np.stack((high, i + segments, j + segments), axis=1)]
    )
    return painted(Mesh(np.concatenate([ring, top, caps]), faces), color)


def painted(mesh: Mesh, color: Sequence[int] | None) -> Mesh:
    """The mesh in one RGB colour, or without colours if None."""
    colors = None if color is None else np.tile(np.asarray(color, np.uint8), (len(mesh.faces), 1))
    return Mesh(mesh.vertices, mesh.faces, colors)


def concatenate(meshes: Sequence[Mesh]) -> Mesh:
    """All meshes in one, without merging; uncoloured ones turn grey if any of the others has colours."""
    if not meshes:
        return Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    colors = None
    if any(m.face_colors is not None for m in meshes):
        grey = [m if m.face_colors is not None else painted(m, (160, 160, 160)) for m in meshes]
        colors = np.concatenate([m.face_colors for m in grey if m.face_colors is not None])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=True)]),
        colors,
    )


def transformed(mesh: Mesh, T: Float64) -> Mesh:
    """The mesh moved by an affine (4, 4) transform; mirroring ones keep outside outside by turning the winding."""
    faces = mesh.faces[:, ::-1] if np.linalg.det(T[:3, :3]) < 0.0 else mesh.faces
    return Mesh(mesh.vertices @ T[:3, :3].T + T[:3, 3], faces, mesh.face_colors)


def convex_hull(points: Float64) -> Mesh:
    """Closed convex hull of (N, 3) points.

    Raises:
        MeshError: the points lie in one plane.
    """
    import manifold3d

    hull = manifold3d.Manifold.hull_points(np.ascontiguousarray(points, np.float64))
    data = hull.to_mesh64()
    if hull.volume() <= 1e-12 * np.linalg.norm(np.ptp(points, axis=0)) ** 3:
        raise MeshError("convex hull", "the points lie in one plane; at least four that span a volume are needed")
    return Mesh(np.asarray(data.vert_properties)[:, :3], np.asarray(data.tri_verts, np.int32))


def split_by_color(mesh: Mesh) -> list[tuple[tuple[int, int, int], Mesh]]:
    """One (open) mesh a colour, sorted by colour, for renderers that know one material a mesh."""
    if mesh.face_colors is None:
        return [((160, 160, 160), mesh)]
    palette, index = np.unique(mesh.face_colors, axis=0, return_inverse=True)
    out = []
    for k, color in enumerate(palette):
        used, faces = np.unique(mesh.faces[index.reshape(-1) == k], return_inverse=True)
        part = Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32))
        out.append(((int(color[0]), int(color[1]), int(color[2])), part))
    return out


# ------------------------------------------------------------------------------------------------------------ measuring


def _scaled_normals(mesh: Mesh) -> Float64:
    """(F, 3), normals of twice the faces' areas in length."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    u, v = (b - a).T, (c - a).T
    # `np.cross` takes four times as long.
    return np.stack([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]], axis=1)


def face_normals(mesh: Mesh) -> Float64:
    """(F, 3), unit normals; zero for faces without area."""
    normals = _scaled_normals(mesh)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def face_areas(mesh: Mesh) -> Float64:
    """(F,), square metres."""
    return 0.5 * np.linalg.norm(_scaled_normals(mesh), axis=1)


def vertex_normals(mesh: Mesh) -> Float64:
    """(V, 3), unit area-weighted means of the adjacent faces' normals; zero for unused vertices."""
    scaled = _scaled_normals(mesh)
    sums = np.stack(
        [np.bincount(mesh.faces.ravel(), np.repeat(scaled[:, k], 3), len(mesh.vertices)) for k in range(3)], axis=1
    )
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)


def area(mesh: Mesh) -> float:
    """Surface area, square metres."""
    return float(face_areas(mesh).sum())


def volume(mesh: Mesh) -> float:
    """Enclosed volume of a closed mesh, cubic metres; negative if it winds inside out."""
    a, b, c = np.moveaxis(mesh.triangles, 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def is_closed(mesh: Mesh) -> bool:
    """Whether every edge is run through exactly as often in one direction as in the other (watertight, consistent)."""
    start = mesh.faces.astype(np.int64)
    end = np.roll(start, -1, axis=1)
    count = len(mesh.vertices)
    forward, backward = np.sort((start * count + end).ravel()), np.sort((end * count + start).ravel())
    return len(mesh.faces) > 0 and bool(np.array_equal(forward, backward))


def diameter(mesh: Mesh) -> float:
    """Largest distance between two vertices, metres (as in BOP's models_info)."""
    points = mesh.vertices
    if len(points) > 500:
        points = convex_hull(points).vertices
    return float(max(np.linalg.norm(points[i:] - points[i], axis=1).max() for i in range(len(points))))


def mass_properties(
    mesh: Mesh, *, density: float | None = None, mass: float | None = None
) -> tuple[float, Float64, Float64]:
    """Mass, centre of mass and inertia of the homogeneous solid that a closed mesh encloses.

    Exactly one of `density` (kg/m^3) and `mass` (kg) is given. Sums signed tetrahedra from a point inside the box.

    Returns:
        mass in kg, centre of mass (3,) in the mesh frame, inertia (3, 3) in kg m^2 about the centre of mass.

    Raises:
        MeshError: the mesh is not closed or encloses no positive volume.
        InvalidValueError: density and mass are both given, both missing or not positive.
    """
    given = mass if density is None else density
    if (density is None) == (mass is None) or given is None or not (np.isfinite(given) and given > 0.0):
        raise InvalidValueError("density, mass", (density, mass), "exactly one of them, positive and finite")
    if not is_closed(mesh):
        raise MeshError("mass properties", "the mesh is open; only a closed one encloses a volume")
    origin = mesh.bounds.mean(axis=0)
    corners = mesh.triangles - origin
    volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    total = float(volumes.sum())
    if total <= 1e-15:
        raise MeshError("mass properties", f"encloses {total:.3g} m^3; the faces must wind outwards around a volume")
    sums = corners.sum(axis=1)
    centre = volumes @ sums / (4.0 * total)
    # second moments of a tetrahedron with one corner at the origin: V / 20 (sum_i p_i p_i^T + s s^T), s = sum_i p_i
    second = np.einsum("f,fki,fkj->ij", volumes, corners, corners) + np.einsum("f,fi,fj->ij", volumes, sums, sums)
    second = 0.5 * (second + second.T) / 20.0 - total * np.outer(centre, centre)
    scale = density if density is not None else given / total
    return scale * total, centre + origin, scale * (np.trace(second) * np.eye(3) - second)


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[Float64, npt.NDArray[np.int64]]:
    """(count, 3) points uniform over the surface, and the (count,) faces they lie on."""
    cumulative = np.cumsum(face_areas(mesh))
    faces = np.minimum(np.searchsorted(cumulative, rng.random(count) * cumulative[-1], "right"), len(cumulative) - 1)
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=1)
    return np.einsum("nk,nkd->nd", weights, mesh.triangles[faces]), faces


def validate(mesh: Mesh, source: str | Path) -> Mesh:
    """The mesh itself if it can be used.

    Raises:
        MeshError: empty, non-finite, faces that refer to no vertex, or no area; names `source`.
    """
    if len(mesh.vertices) == 0 or len(mesh.faces) == 0:
        raise MeshError(source, f"is empty ({len(mesh.vertices)} vertices, {len(mesh.faces)} faces)")
    if not np.isfinite(mesh.vertices).all():
        raise MeshError(source, f"{np.count_nonzero(~np.isfinite(mesh.vertices).all(axis=1))} vertices are not finite")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise MeshError(source, f"faces refer to vertices outside 0..{len(mesh.vertices) - 1}")
    if not area(mesh) > 0.0:
        raise MeshError(source, "has zero area")
    return mesh


# --------------------------------------------------------------------------------------------------------- tessellating


def subdivide_to(mesh: Mesh, faces: int) -> Mesh:
    """Tessellate the same surface with `faces` faces by bisecting longest edges (Rivara 1984), the longest first.

    Edges are bisected in all their faces at once, so a closed mesh stays closed (and ends at an even count, one less
    than an odd `faces`). A mesh that has as many faces already comes back unchanged.
    """
    vertices, triangles = mesh.vertices, mesh.faces
    origin = np.arange(len(triangles))
    length = 1.5 * np.sqrt(4.0 / np.sqrt(3.0) * area(mesh) / max(faces, 1))  # somewhat above the final edge length
    if is_closed(mesh):
        faces -= (faces - len(triangles)) % 2
    while len(triangles) < faces:
        split = _terminal_edges(vertices, triangles, length, faces - len(triangles))
        if split is None:
            if length < 1e-12:
                break
            length *= 0.9
            continue
        face_edge, ends = split
        vertices, triangles, origin = _bisected(vertices, triangles, origin, face_edge, ends)
    return Mesh(vertices, triangles, None if mesh.face_colors is None else mesh.face_colors[origin])


def _terminal_edges(vertices: Float64, triangles: Int32, length: float, budget: int) -> tuple[Int32, Int32] | None:
    """Edges longer than `length` that are the longest of all their faces, at most `budget` new faces' worth.

    Returns (F,) the number of the chosen edge in each face's neighbourhood (-1 none) and (E, 2) the edges' vertices.
    """
    start = triangles.astype(np.int64)
    end = np.roll(start, -1, axis=1)
    keys = np.minimum(start, end) * len(vertices) + np.maximum(start, end)
    lengths = np.linalg.norm(vertices[start] - vertices[end], axis=2)
    # ties are broken by the edge's key, so that "longest" is one order for all faces and some edge always qualifies
    slot = np.lexsort((keys, np.round(lengths, 12)), axis=1)[:, 2]
    rows = np.arange(len(triangles))
    longest = keys[rows, slot]
    candidate, index, votes = np.unique(longest, return_inverse=True, return_counts=True)
    all_keys = np.sort(keys.ravel())
    adjacent = np.searchsorted(all_keys, candidate, "right") - np.searchsorted(all_keys, candidate, "left")
    span = np.zeros(len(candidate))
    span[index] = lengths[rows, slot]
    chosen = np.flatnonzero((votes == adjacent) & (span > length))
    chosen = chosen[np.argsort(-span[chosen], kind="stable")]
    chosen = chosen[adjacent[chosen] <= budget]
    chosen = chosen[np.cumsum(adjacent[chosen]) <= budget]
    if len(chosen) == 0:
        return None
    number = np.full(len(candidate), -1, np.int32)
    number[chosen] = np.arange(len(chosen), dtype=np.int32)
    ends = np.stack([candidate[chosen] // len(vertices), candidate[chosen] % len(vertices)], axis=1)
    return number[index], ends.astype(np.int32)


def _bisected(
    vertices: Float64, triangles: Int32, origin: npt.NDArray[np.int64], face_edge: Int32, ends: Int32
) -> tuple[Float64, Int32, npt.NDArray[np.int64]]:
    """Split every face whose `face_edge` is not -1 at the middle of that edge."""
    rows = np.flatnonzero(face_edge >= 0)
    middle = face_edge[rows] + len(vertices)
    new_vertices = np.concatenate([vertices, 0.5 * (vertices[ends[:, 0]] + vertices[ends[:, 1]])])
    old = triangles[rows]
    # turn the face so that its first two corners are the edge's
    on_edge = (old[:, :, None] == ends[face_edge[rows]][:, None, :]).any(axis=2)
    apex = np.argmin(on_edge, axis=1)
    a, b, c = (old[np.arange(len(old)), (apex + k) % 3] for k in (1, 2, 0))
    kept = triangles.copy()
    kept[rows] = np.stack([a, middle, c], axis=1)
    return (
        new_vertices,
        np.concatenate([kept, np.stack([middle, b, c], axis=1)]).astype(np.int32),
        np.concatenate([origin, origin[rows]]),
    )


def decimate(mesh: Mesh, target_faces: int) -> Mesh:
    """Simplify to about `target_faces` by quadric edge collapse (Garland and Heckbert 1997); colours follow.

    A mesh that has no more faces already comes back unchanged.
    """
    if target_faces >= len(mesh.faces):
        return mesh
    import fast_simplification

    count = max(int(target_faces), 4)
    with _SIMPLIFYING:
        points, faces = fast_simplification.simplify(mesh.vertices, mesh.faces, target_count=count)[:2]
    out = Mesh(points, faces.astype(np.int32))
    if mesh.face_colors is None:
        return out
    from scipy.spatial import KDTree

    nearest = KDTree(mesh.triangles.mean(axis=1)).query(out.triangles.mean(axis=1))[1]
    return Mesh(out.vertices, out.faces, mesh.face_colors[nearest])


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh file (`MESH_SUFFIXES`), vertices merged, colours kept where the file has them.

    Nothing that the file refers to (materials, textures, external buffers) is followed.

    Raises:
        MeshError: missing, too large, of an unknown kind, unreadable, or not valid (see `validate`).
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(path, "no such file")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise MeshError(path, f"unknown kind '{path.suffix}'; known: {', '.join(MESH_SUFFIXES)}")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise MeshError(path, f"is larger than {MAX_FILE_BYTES} bytes")
    import trimesh
    from trimesh.visual.color import ColorVisuals

    try:
        loaded = trimesh.load_mesh(BytesIO(path.read_bytes()), file_type=path.suffix.lower()[1:], resolver=None)
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_mesh()
    except Exception as error:  # the readers raise whatever they stumble over
        raise MeshError(path, f"cannot be read: {type(error).__name__}: {error}") from error
    if not isinstance(loaded, trimesh.Trimesh):
        raise MeshError(path, "holds no triangles")
    if len(loaded.faces) > MAX_FACES:
        raise MeshError(path, f"has {len(loaded.faces)} faces; at most {MAX_FACES} are allowed")
    visual = loaded.visual
    colors = None
    if isinstance(visual, ColorVisuals) and visual.kind in ("face", "vertex"):
        colors = np.asarray(visual.face_colors)[:, :3]
    return validate(Mesh(np.asarray(loaded.vertices), np.asarray(loaded.faces, np.int32), colors), path)
