"""Entities of a panoptic map as meshes: section 3.4 of the reconstruction paper."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float32, Int32, Uint8
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh, face_areas
from simtrack.perception.mapping.panoptic import surface_kernels as kernels
from simtrack.perception.mapping.panoptic.counts import SegmentEntity
from simtrack.perception.mapping.panoptic.volume import Volume

STUFF_FIRST = ("floor", "wall", "ceiling")


@dataclass(frozen=True, slots=True)
class EntityConfig:
    """Settings of `extract_entities`."""

    least_weight: float = 0.05
    """1/m^2: voxels of less weight (one reading at a metre has 1) count as unseen."""
    least_held: float = 0.4
    """m^2: support of the surface of a thing over its weight (medians) below which it is dropped. Where a surface was
    often seen and seldom told to be this, masks reached over it; at 2 m it is a tenth of the readings."""
    least_support: float = 0.25
    """Share of the support that the surface of a thing has in the middle (median) below which a part of it is dropped:
    masks that reached over its border leave a fringe ..."""
    enough_support: float = 2.5
    """... unless it has so much."""
    least_observed: int = 3
    """Observations of one of its segments that must agree on what a thing is; what fewer say is dropped ..."""
    doubt: float = 0.05
    """... unless fewer are enough for this chance that all are wrong, each as often as observations disagree with what
    their segments are taken for."""
    least_area: float = 0.006
    """Square metres; smaller entities are dropped."""
    gap: float = 0.06
    """Metres between pieces of a thing that hang together."""
    least_piece: float = 0.15
    """Pieces of a thing with less than this share of the area of its largest are dropped: they are other things'."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.least_held < 1e6:
            raise InvalidValueError("EntityConfig.least_held", self.least_held, "0 or more")
        if not 1 <= self.least_observed <= 1000:
            raise InvalidValueError("EntityConfig.least_observed", self.least_observed, "1 to 1000")
        for name in ("least_weight", "least_area", "gap", "enough_support"):
            if not 0.0 < getattr(self, name) < 1e6:
                raise InvalidValueError(f"EntityConfig.{name}", getattr(self, name), "a finite number > 0")
        for name in ("least_support", "least_piece", "doubt"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidValueError(f"EntityConfig.{name}", getattr(self, name), "a share, 0 to 1")

    @staticmethod
    def of_counts_alone() -> "EntityConfig":
        """Entities are what the counts say (Eq. 6, and Voxblox++): nothing doubtful is dropped, no part of them."""
        return EntityConfig(least_held=0.0, least_support=0.0, least_observed=1, least_piece=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class MapEntityMesh:
    """One entity <o, c, M> of a map."""

    name: str
    """Unique instance label o: the class and a running number."""
    semantic_class: str
    instance: int
    """Global instance p."""
    score: float
    """0 to 1: share of the observations of its best founded segment that say that it is this; the lower bound of that
    share (Wilson's, at 97.5 %), since few observations are easily of one mind."""
    mesh: Mesh
    """Map frame, faces coloured."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """The zero set of a volume."""

    vertices: Float32
    """(V, 3), map frame, metres."""
    colors: Uint8
    """(V, 3) RGB."""
    faces: Int32
    """(F, 3), counter-clockwise seen from the free side."""
    labels: Int32
    """(F,), of segments as voxels carry them; 0 = none."""
    support: npt.NDArray[np.int16]
    """(F,), observations for the label less those for others."""
    weights: Float32
    """(F,), 1/m^2 summed over images."""

    @property
    def mesh(self) -> Mesh:
        """The surface in the colours of its faces' first corners."""
        return Mesh(self.vertices.astype(np.float64), self.faces, self.colors[self.faces[:, 0]])


def extract_surface(volume: Volume, least_weight: float) -> Surface:
    """The zero set of a volume where it was seen with at least that weight, 1/m^2."""
    count, voxel = volume.count, volume.config.voxel
    around = kernels.neighbours(volume.keys, volume.table, count)
    cells = np.full(volume.distances[:count].shape, -1, np.int32)
    arguments = around, volume.keys, volume.distances, volume.weights, volume.colors, voxel, least_weight, cells
    points, tints = np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8)
    found = kernels.vertices(*arguments, points, tints)
    points, tints = np.empty((found, 3), np.float32), np.empty((found, 3), np.uint8)
    kernels.vertices(*arguments, points, tints)
    corners, owners = np.empty((3 * found, 4), np.int32), np.empty(3 * found, np.int32)
    backing, seen = np.empty(3 * found, np.int16), np.empty(3 * found, np.float32)
    found = kernels.quads(
        around, volume.distances, volume.labels, volume.support, volume.weights, cells, corners, owners, backing, seen
    )
    corners, owners, backing, seen = corners[:found], owners[:found], backing[:found], seen[:found]
    faces = np.stack([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]], axis=1).reshape(-1, 3)
    return Surface(points, tints, faces, np.repeat(owners, 2), np.repeat(backing, 2), np.repeat(seen, 2))


def extract_entities(
    surface: Surface,
    canonical: Int32,
    entities: Mapping[int, SegmentEntity],
    config: EntityConfig | None = None,
) -> tuple[MapEntityMesh, ...]:
    """One mesh an entity.

    Args:
        surface: of the map.
        canonical: (L,), what each label was merged into.
        entities: global segment -> class and instance (Eq. 6).
        config: settings, the defaults if None.
    """
    config = config or EntityConfig()
    parts: dict[tuple[str, int], list[SegmentEntity]] = defaultdict(list)
    for each in entities.values():
        parts[each.semantic_class, each.instance].append(each)
    agreeing = {key: max(each.agreeing for each in found) for key, found in parts.items()}
    least = _least_observed(entities, config)
    sure = {key for key, most in agreeing.items() if key[0] in STUFF_FIRST or most >= least}
    parts = {key: found for key, found in parts.items() if key in sure}
    entities = {label: each for label, each in entities.items() if (each.semantic_class, each.instance) in sure}
    keys = sorted(parts, key=lambda key: (key[0] not in STUFF_FIRST, *key))
    number = {key: k for k, key in enumerate(keys)}
    of_label = np.full(len(canonical), -1, np.int32)
    for label, each in entities.items():
        of_label[label] = number[each.semantic_class, each.instance]
    owner = of_label[canonical][surface.labels]
    order = np.argsort(owner, kind="stable")
    bounds = np.searchsorted(owner[order], np.arange(len(keys) + 1))
    found: list[MapEntityMesh] = []
    running: dict[str, int] = {}
    for k, (name, p) in enumerate(keys):
        faces = order[bounds[k] : bounds[k + 1]]
        if name not in STUFF_FIRST and len(faces):
            support = surface.support[faces]
            if np.median(support) < config.least_held * np.median(surface.weights[faces]):
                continue
            faces = faces[support >= min(config.least_support * np.median(support), config.enough_support)]
        mesh = _part(surface, faces)
        if name not in STUFF_FIRST and config.least_piece > 0.0:
            mesh = _large_pieces(mesh, config.gap, config.least_piece)
        if len(mesh.faces) and face_areas(mesh).sum() >= config.least_area:
            running[name] = running.get(name, 0) + 1
            score = max(_lower_bound(each.agreeing, each.observed) for each in parts[name, p])
            found.append(MapEntityMesh(f"{name}{running[name]}", name, p, score, mesh))
    return tuple(found)


def _least_observed(entities: Mapping[int, SegmentEntity], config: EntityConfig) -> int:
    """Observations that a thing needs, see `EntityConfig.doubt`."""
    things = [each for each in entities.values() if each.semantic_class not in STUFF_FIRST]
    # Of those that a segment is taken for one speaks for itself, and tells nothing.
    others, disagreeing = sum(e.observed - 1 for e in things), sum(e.observed - e.agreeing for e in things)
    wrong = (disagreeing + 1) / (others + 2)  # rule of succession: of few, little is known
    if config.doubt <= 0.0:
        return config.least_observed
    return int(np.clip(np.ceil(np.log(config.doubt) / np.log(wrong)), 1, config.least_observed))


def _lower_bound(agreeing: int, observed: int, z: float = 1.96) -> float:
    """Wilson's lower bound of a share (JASA 22, 1927), of which the true one is above at z standard deviations."""
    share, spread = agreeing / observed, z * z / observed
    root = np.sqrt(spread * (share * (1.0 - share) + 0.25 * spread))
    return float((share + 0.5 * spread - root) / (1.0 + spread))


def _part(surface: Surface, chosen: np.ndarray) -> Mesh:
    used, faces = np.unique(surface.faces[chosen], return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    mesh = Mesh(surface.vertices[used].astype(np.float64), faces, surface.colors[used][faces[:, 0]])
    keep = face_areas(mesh) > 0.0
    return mesh if keep.all() else Mesh(mesh.vertices, faces[keep], surface.colors[used][faces[keep, 0]])


def _large_pieces(mesh: Mesh, gap: float, least: float) -> Mesh:
    """A mesh without its pieces that have less than a share of the area of the largest; `gap` metres hold together."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if not len(mesh.faces):
        return mesh
    middles = mesh.triangles.mean(axis=1)
    _, first, cell = np.unique(np.floor(middles / (0.5 * gap)), axis=0, return_index=True, return_inverse=True)
    pairs = KDTree(middles[first]).query_pairs(gap, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), (len(first),) * 2)
    count, piece = connected_components(links, directed=False)
    of_face = piece[cell.ravel()]
    areas = np.bincount(of_face, face_areas(mesh), minlength=count)
    keep = (areas >= least * areas.max())[of_face]
    if keep.all():
        return mesh
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    colors = None if mesh.face_colors is None else mesh.face_colors[keep]
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), colors)
