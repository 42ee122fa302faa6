"""A laser survey of a static world: the map that estimators get instead of the truth.

The survey differs from the world as real maps do: its surfaces are off by some millimetres, its mesh has another
tessellation, undersides that no scanner sees are missing, small things were left out, and since it was made some
furniture was moved, carried away or brought in.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from simtrack.contracts import Articulation, Float64, MapEntity, StaticMap
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import (
    Mesh,
    area,
    concatenate,
    decimate,
    face_normals,
    sample_surface,
    subdivide_to,
    transformed,
)
from simtrack.geometry.transforms import apply, exp_so3, inverse, transform
from simtrack.simulation.building.cache import cached_map, world_digest
from simtrack.simulation.building.parts import StaticPart, StaticWorld
from simtrack.simulation.retessellation import retessellated
from simtrack.simulation.survey_scans import scanned_parts

SCANNER_HEIGHT = 1.0
"""Metres: what faces down below this height was seen by no scanner."""
SMALLEST_PIECE = 0.022
"""Metres: separate pieces whose second largest side is smaller (handles, rails) were not resolved."""

DOORWAY = 0.9
"""Metres around doors that nothing was put into."""
DENSE, KEPT = 600, 0.7
"""Solids with more triangles than `DENSE` are decimated to the share `KEPT`; coarser ones have none to spare."""


@dataclass(frozen=True, slots=True)
class SurveyConfig:
    """How good and how old the survey is."""

    noise: float = 0.005
    """Standard deviation of the surface along its normal, metres."""
    correlation: float = 0.25
    """Length over which that error changes (standard deviation of its Gaussian correlation), metres."""
    edge: float | None = None
    """Typical length of triangle edges on walls, metres; by default 0.2, and more on floors above `max_faces`."""
    max_faces: int = 220_000
    """About the largest number of triangles."""
    moved: float = 0.15
    """Share of the movable furniture that stood elsewhere when the survey was made."""
    brought: float = 0.05
    """Share of the movable furniture that was not yet there."""
    removed: float = 0.05
    """Furniture that was there and is gone, as a share of the movable furniture."""
    shift: tuple[float, float] = (0.1, 0.6)
    """Least and largest distance that moved furniture was moved, metres."""
    turn: float = 1.0
    """Largest angle that it was turned by, radians."""
    method: Literal["displaced", "scans"] = "displaced"
    """The true surface, displaced; or one that simulated scans were fused to (`simtrack.simulation.survey_scans`)."""

    def __post_init__(self) -> None:
        if self.method not in ("displaced", "scans"):
            raise InvalidValueError("SurveyConfig.method", self.method, "displaced, scans")
        for name in ("moved", "brought", "removed"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidValueError(f"SurveyConfig.{name}", getattr(self, name), "0 to 1")
        if self.moved + self.brought > 1.0:
            raise InvalidValueError("SurveyConfig.moved + brought", self.moved + self.brought, "at most 1")
        if not 0.0 <= self.noise <= 0.1:
            raise InvalidValueError("SurveyConfig.noise", self.noise, "0 to 0.1 metres")
        if not 0.02 <= self.correlation <= 100.0:
            raise InvalidValueError("SurveyConfig.correlation", self.correlation, "0.02 to 100 metres")
        if self.edge is not None and not 0.03 <= self.edge <= 10.0:
            raise InvalidValueError("SurveyConfig.edge", self.edge, "0.03 to 10 metres, or none")
        if self.max_faces < 1000:
            raise InvalidValueError("SurveyConfig.max_faces", self.max_faces, "1000 or more")
        if not 0.0 <= self.shift[0] <= self.shift[1]:
            raise InvalidValueError("SurveyConfig.shift", self.shift, "(least, largest), not negative")


def survey(world: StaticWorld, config: SurveyConfig | None = None, rng: np.random.Generator | None = None) -> StaticMap:
    """Survey a world.

    Surfaces are displaced by a smooth random vector field of 3-space (random Fourier features, Rahimi and Recht 2007),
    so that neighbouring surfaces stay joined; it is scaled so that the error along the normals, taken over the whole
    surface and not only at the vertices, has the standard deviation `config.noise`.

    Args:
        world: the truth.
        config: how the map differs from it.
        rng: decides the errors and what was moved; by default a generator seeded with 0.

    Returns:
        The mesh with an entity for every part that was surveyed, at its surveyed place. No vertex is shared with the
        world (unless `noise` is 0, where outlines coincide). Kept in the user's cache folder, by content. What joints
        let move is no part of the mesh.
    """
    config = SurveyConfig() if config is None else config
    rng = np.random.default_rng(0) if rng is None else rng
    seed = int(rng.integers(2**63))
    key = world_digest(world, seed, config)
    static_map = cached_map(key, lambda: _surveyed(world, config, np.random.default_rng(seed)))
    return replace(static_map, articulations=_articulations(world, config, np.random.default_rng([seed, 1])))


def _articulations(world: StaticWorld, config: SurveyConfig, rng: np.random.Generator) -> tuple[Articulation, ...]:
    """Doors and drawers as surveyed, each by itself: their surfaces and axes are off as the rest of the map is."""
    surveyed = []
    for moving in world.moving:
        mesh = _displaced(_scanned(moving.part, config.edge or 0.2, rng), config, rng)
        surveyed.append(
            Articulation(
                name=moving.part.name,
                semantic_class=moving.part.semantic_class,
                kind=moving.kind,
                anchor=moving.anchor + rng.normal(0.0, config.noise, 3),
                axis=moving.axis,
                lower=moving.lower,
                upper=moving.upper,
                vertices=mesh.vertices.astype(np.float32),
                faces=mesh.faces,
            )
        )
    return tuple(surveyed)


def _surveyed(world: StaticWorld, config: SurveyConfig, rng: np.random.Generator) -> StaticMap:
    parts = as_surveyed(world, config, rng)
    if config.method == "scans":
        scanned = scanned_parts(world, parts, rng, config.max_faces)
        return _static_map(world, [part for part, _ in scanned], [mesh for _, mesh in scanned], config.noise)
    edge = config.edge if config.edge is not None else _edge_for(parts, config.max_faces)
    meshes = [_scanned(part, edge, rng) for part in parts]
    counts = np.cumsum([len(mesh.vertices) for mesh in meshes])[:-1]
    whole = _displaced(concatenate(meshes), config, rng)
    displaced = [
        _simplified(replace_vertices(mesh, vertices), part)
        for mesh, vertices, part in zip(meshes, np.split(whole.vertices, counts), parts, strict=True)
    ]
    return _static_map(world, parts, displaced, config.noise)


def _static_map(world: StaticWorld, parts: list[StaticPart], meshes: list[Mesh], noise: float) -> StaticMap:
    """The map of parts as their meshes show them."""
    result = concatenate(meshes)
    return StaticMap(
        vertices=result.vertices.astype(np.float32),
        faces=result.faces,
        entities=tuple(_entity(part, mesh) for part, mesh in zip(parts, meshes, strict=True)),
        rooms=world.rooms,
        noise=noise,
    )


def replace_vertices(mesh: Mesh, vertices: Float64) -> Mesh:
    """The same faces over other vertices."""
    return Mesh(vertices, mesh.faces, mesh.face_colors)


def _edge_for(parts: list[StaticPart], max_faces: int) -> float:
    """Edge length on sheets with which the whole survey has about `max_faces` triangles, at least 0.2 m."""
    sheets = sum(area(part.mesh) for part in parts if _is_sheet(part))
    solids = sum(len(part.mesh.faces) for part in parts if not _is_sheet(part))
    return float(max(0.2, np.sqrt(2.3 * sheets / max(max_faces - solids, max_faces // 4))))


def _is_sheet(part: StaticPart) -> bool:
    return part.semantic_class in ("wall", "floor", "ceiling")


# ------------------------------------------------------------------------------------------ what changed since then


def as_surveyed(world: StaticWorld, config: SurveyConfig, rng: np.random.Generator) -> list[StaticPart]:
    """The parts as they stood when the survey was made, without what is too small for it."""
    movable = [k for k, part in enumerate(world.parts) if part.survey == "movable"]
    order = rng.permutation(movable)
    counts = np.round(np.array([config.moved, config.brought, config.removed]) * len(movable)).astype(int)
    moved, brought = set(order[: counts[0]].tolist()), set(order[counts[0] : counts[0] + counts[1]].tolist())
    floor = _FloorSpace(world)
    parts = []
    for k, part in enumerate(world.parts):
        if part.survey == "omitted" or k in brought:
            continue
        parts.append(floor.moved(part, config, rng) if k in moved else part)
    for number, k in enumerate(rng.permutation(movable)[: counts[2]].tolist()):
        gone = floor.elsewhere(world.parts[k], rng)
        if gone is not None:
            parts.append(replace(gone, name=f"{gone.name}-{number + 1}"))
    return parts


class _FloorSpace:
    """Finds places where a piece of furniture can have stood: inside its room, clear of everything else."""

    def __init__(self, world: StaticWorld) -> None:
        import shapely

        self.rooms = {room.name: shapely.Polygon(room.polygon) for room in world.rooms}
        standing = [part for part in world.parts if part.semantic_class not in ("wall", "floor", "ceiling")]
        self.names = [part.name for part in standing]
        frames = [part for part in world.parts if part.semantic_class == "door-frame"]
        self.doorways = shapely.union_all([shapely.Polygon(part.footprint()).buffer(DOORWAY) for part in frames])
        self.tree = shapely.STRtree([shapely.Polygon(part.footprint()) for part in standing])

    def _free(self, part: StaticPart) -> bool:
        import shapely

        footprint = shapely.Polygon(part.footprint())
        if part.room in self.rooms and not self.rooms[part.room].contains(footprint):
            return False
        if self.doorways.intersects(footprint):
            return False
        return all(self.names[k] == part.name for k in self.tree.query(footprint, predicate="intersects"))

    def moved(self, part: StaticPart, config: SurveyConfig, rng: np.random.Generator) -> StaticPart:
        """The part at a free place nearby; where it is if there is none."""
        for _ in range(60):
            heading, distance = rng.uniform(-np.pi, np.pi), rng.uniform(*config.shift)
            turn = transform(exp_so3(np.array([0.0, 0.0, rng.uniform(-config.turn, config.turn)])))
            T = part.T_map_part @ turn
            T[:2, 3] += distance * np.array([np.cos(heading), np.sin(heading)])
            candidate = replace(part, T_map_part=T)
            if self._free(candidate):
                return candidate
        return part

    def elsewhere(self, part: StaticPart, rng: np.random.Generator) -> StaticPart | None:
        """A copy of the part at a free place anywhere in its room, if there is one."""
        if part.room not in self.rooms:
            return None
        x0, y0, x1, y1 = self.rooms[part.room].bounds
        for _ in range(60):
            T = part.T_map_part @ transform(exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])))
            T[:2, 3] = rng.uniform(x0, x1), rng.uniform(y0, y1)
            # under another name, so that it keeps clear of the original as well
            candidate = replace(part, T_map_part=T, name=f"{part.name}-gone")
            if self._free(candidate):
                return replace(candidate, name=part.name)
        return None


# --------------------------------------------------------------------------------------------- how it was measured


def _scanned(part: StaticPart, edge: float, rng: np.random.Generator) -> Mesh:
    """What scanners saw of a part, in the map frame and with another tessellation, free of noise."""
    mesh = transformed(Mesh(part.mesh.vertices, part.mesh.faces), part.T_map_part)
    if _is_sheet(part):
        return retessellated(mesh, edge, rng)
    seen = _without_small_pieces(mesh)
    normals, height = face_normals(seen), seen.triangles[:, :, 2].max(axis=1)
    hidden = (normals[:, 2] < -0.7) & (height < SCANNER_HEIGHT)
    used, faces = np.unique(seen.faces[~hidden], return_inverse=True)
    seen = Mesh(seen.vertices[used], faces.reshape(-1, 3).astype(np.int32))
    return subdivide_to(seen, int(2.0 * area(seen) / edge**2))


def _without_small_pieces(mesh: Mesh) -> Mesh:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    i, j = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(i)), (i, j)), (len(mesh.vertices),) * 2)
    count, piece = connected_components(graph, directed=False)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, piece, mesh.vertices)
    np.maximum.at(high, piece, mesh.vertices)
    large = np.sort(high - low, axis=1)[:, 1] >= SMALLEST_PIECE
    keep = large[piece[mesh.faces[:, 0]]]
    return mesh if keep.all() or not keep.any() else Mesh(mesh.vertices, mesh.faces[keep])


def _displaced(mesh: Mesh, config: SurveyConfig, rng: np.random.Generator) -> Mesh:
    """The mesh under a smooth random displacement whose part along the normals has the stated deviation."""
    if config.noise == 0.0:
        return mesh
    waves = rng.normal(0.0, 1.0 / config.correlation, (96, 3))
    phases = rng.uniform(0.0, 2.0 * np.pi, (96,))
    amplitudes = rng.normal(0.0, 1.0, (96, 3))
    blocks = np.array_split(mesh.vertices, max(1, len(mesh.vertices) // 4096))
    field = np.concatenate([np.cos(block @ waves.T + phases) @ amplitudes for block in blocks])
    _, faces = sample_surface(mesh, 20_000, rng)
    weights = rng.dirichlet(np.ones(3), len(faces))
    along = np.einsum("nk,nkd,nd->n", weights, field[mesh.faces[faces]], face_normals(mesh)[faces])
    return replace_vertices(mesh, mesh.vertices + field * (config.noise / np.sqrt(np.mean(along**2))))


def _simplified(mesh: Mesh, part: StaticPart) -> Mesh:
    """Dense solids lose the triangles that matter least; collapses would eat into the outlines of sheets."""
    return mesh if _is_sheet(part) or len(mesh.faces) <= DENSE else decimate(mesh, int(KEPT * len(mesh.faces)))


def _entity(part: StaticPart, mesh: Mesh) -> MapEntity:
    """The part as the surveyed mesh shows it: box and support faces measured there."""
    local = Mesh(apply(inverse(part.T_map_part), mesh.vertices), mesh.faces)
    low, high = local.bounds
    supports = []
    normals, middle = (
        (face_normals(local), local.triangles.mean(axis=1)) if part.supports else (np.empty(0), np.empty(0))
    )
    for T_part_face, size in part.supports:
        flat = apply(inverse(T_part_face), middle)
        near = (
            (np.abs(flat[:, 2]) < 0.03) & (np.abs(flat[:, :2]) <= size / 2 + 0.02).all(axis=1) & (normals[:, 2] > 0.8)
        )
        if near.any():
            level = float(np.median(flat[near, 2]))
            supports.append((part.T_map_part @ T_part_face @ transform(None, (0.0, 0.0, level)), size))
    return MapEntity(
        name=part.name,
        semantic_class=part.semantic_class,
        T_map_entity=part.T_map_part @ transform(None, (low + high) / 2),
        extents=high - low,
        room=part.room,
        supports=tuple(supports),
    )
