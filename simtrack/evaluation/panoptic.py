"""Panoptic maps against the truth: PQ, SQ, RQ, average precision of instances and boxes, surface accuracy.

Definitions
-----------
* The common domain is the true surface, one point a cell of `CELL`: all of it, or what the camera saw. A true point
  belongs to the entity whose surface is nearest within `REACH`, or to none; predicted surface farther than that from
  any true one counts as points of its entity that are wrong.
* PQ, SQ, RQ (Kirillov et al., CVPR 2019; Eq. 15 of the reconstruction paper): entities of equal class match at an IoU
  above 0.5. Stuff is one entity a class. A true thing of which less than `LEAST_SEEN` was seen is void: not missed
  if it is not found, and what lies mostly on it is not wrong.
* AP: best precision at 11 recalls and beyond, 0 where they are not reached (PASCAL VOC 2007); classes that are there
  and never predicted have 0.
* The lenient definition, which is the one of the paper's code: labels are carried to the nearest predicted point
  however far, so unseen surface counts for nothing; in AP the last precision counts for all recalls that were not
  reached; classes never predicted are left out.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Bool, Float64, Int32
from simtrack.geometry.boxes import OrientedBox
from simtrack.geometry.meshes import Mesh, area, sample_surface
from simtrack.geometry.upright_boxes import upright_box
from simtrack.simulation.building.rooms.film import FilmFrame
from simtrack.simulation.building.rooms.physics import SettledRoom

CELL = 0.02
"""Metres: side of the cells of which each has one true point an entity."""
REACH = 0.05
"""Metres within which predicted surface stands for true surface."""
LEAST_SEEN = 0.1
"""Share of the surface of a thing that must be seen."""
STUFF = frozenset({"floor", "wall", "ceiling"})
PAPER_CLASSES = ("wall", "floor", "bed", "table", "chair", "monitor", "sofa", "bag", "cabinet", "fridge")
"""The ten classes that the reconstruction paper evaluates."""
_KEY = np.int64(1 << 14)
_PIXELS = 4


@dataclass(frozen=True, slots=True, eq=False)
class PanopticEntity:
    """A labelled surface."""

    name: str
    semantic_class: str
    score: float
    points: Float64
    """(N, 3), map frame, metres, evenly over the surface."""
    box: OrientedBox
    """Upright, around all of it."""
    mesh: Mesh | None = None
    """What the points are of, where it is known: it is what is near to other points."""


@dataclass(frozen=True, slots=True, eq=False)
class TrueSurface:
    """The truth that maps are compared with."""

    entities: tuple[PanopticEntity, ...]
    """Stuff is one entity a class."""
    void: Bool
    """(E,), of which too little was seen."""


class SeenSurface:
    """Collects what a camera saw of a room: one point a cell and entity."""

    def __init__(self, room: SettledRoom, max_depth: float = 4.0) -> None:
        """Of a room; readings farther than `max_depth` metres, which maps do not use, are not taken."""
        self.room, self._max_depth = room, max_depth
        self._full: list[Float64] = []
        self._keys = np.empty(0, np.int64)
        self._points = np.empty((0, 3))

    def add(self, seen: FilmFrame) -> None:
        """Take the readings of a frame, where they truly hit."""
        K = seen.frame.intrinsics
        rows = slice(None, None, _PIXELS)
        depth, owners = seen.depth[rows, rows].astype(float), seen.instances[rows, rows]
        readings = seen.frame.depth[rows, rows]
        read = (readings > 0.0) & (readings <= self._max_depth) & (owners >= 0)
        v, u = np.nonzero(read)
        z = depth[read]
        local = np.stack([(_PIXELS * u - K.cx) / K.fx * z, (_PIXELS * v - K.cy) / K.fy * z, z], axis=1)
        points = local @ seen.T_map_camera[:3, :3].T + seen.T_map_camera[:3, 3]
        keys = np.concatenate([self._keys, _cells(points, owners[read])])
        self._keys, first = np.unique(keys, return_index=True)
        self._points = np.concatenate([self._points, points])[first]

    def surface(self, whole: bool = False) -> TrueSurface:
        """The truth: what was seen, or all of it."""
        room = self.room
        owners = self._keys % _KEY
        seen = [self._points[owners == k] for k in range(len(room.entities))]
        rng = np.random.default_rng(0)
        if not self._full:
            self._full = [_spread(entity.mesh, k, rng) for k, entity in enumerate(room.entities)]
        full = self._full
        shares = np.array([len(a) / max(len(b), 1) for a, b in zip(seen, full, strict=True)])
        entities, void, stuff = [], [], set()
        for number, entity in enumerate(room.entities):
            name = entity.semantic_class
            members = [number]
            if name in STUFF:
                if name in stuff:
                    continue
                stuff.add(name)
                members = [k for k, other in enumerate(room.entities) if other.semantic_class == name]
            points = np.concatenate([(full if whole else seen)[k] for k in members])
            box = upright_box(np.concatenate([room.entities[k].mesh.vertices for k in members]))
            entities.append(PanopticEntity(name if name in STUFF else entity.name, name, 1.0, points, box))
            void.append(name not in STUFF and bool(shares[number] < LEAST_SEEN))
        return TrueSurface(tuple(entities), np.array(void, np.bool_))


def _cells(points: Float64, owners: np.ndarray) -> np.ndarray:
    """(N,) int64 numbers of the pairs of a point's cell and owner; within 160 m of the origin."""
    # Shifted, so that floors and walls at round coordinates do not lie between two cells.
    cells = np.floor(points / CELL + 0.187).astype(np.int64) + (1 << 13)
    return ((cells[:, 0] * _KEY + cells[:, 1]) * _KEY + cells[:, 2]) * _KEY + owners


def _spread(mesh: Mesh, number: int, rng: np.random.Generator) -> Float64:
    """(N, 3), a point of a mesh's surface for each cell that it passes."""
    points, _ = sample_surface(mesh, max(64, round(4.0 * area(mesh) / CELL**2)), rng)
    return points[np.unique(_cells(points, np.full(len(points), number)), return_index=True)[1]]


def predicted_entity(name: str, semantic_class: str, score: float, mesh: Mesh) -> PanopticEntity:
    """An entity of a map as it is compared: its points one a cell."""
    points = _spread(mesh, 0, np.random.default_rng(0))
    return PanopticEntity(name, semantic_class, score, points, upright_box(mesh.vertices), mesh)


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Predicted entities against true ones."""

    predicted: tuple[PanopticEntity, ...]
    true: TrueSurface
    common: Int32
    """(P, E), true points of an entity that a predicted one has."""
    predicted_sizes: Int32
    """(P,), true points that each has, and wrong ones of its own."""
    true_sizes: Int32
    """(E,), true points of each."""
    accuracy: Float64
    """(N,), metres from predicted points to the true surface."""
    completeness: Float64
    """(M,), metres from true points to the predicted surface."""

    @property
    def iou(self) -> Float64:
        """(P, E), intersection over union."""
        union = self.predicted_sizes[:, None] + self.true_sizes[None, :] - self.common
        return self.common / np.maximum(union, 1)


def compare(predicted: Sequence[PanopticEntity], true: TrueSurface, lenient: bool = False) -> Comparison:
    """Give every true point to a predicted entity, see above; or every predicted point to a true one."""

    def joined(entities: Sequence[PanopticEntity]) -> tuple[Float64, np.ndarray]:
        owner = np.repeat(np.arange(len(entities)), [len(e.points) for e in entities])
        return np.concatenate([np.empty((0, 3)), *(e.points for e in entities)]), owner

    points, of_point = joined(predicted)
    surface, of_surface = joined(true.entities)
    shape = (len(predicted), len(true.entities))
    if not len(points) or not len(surface):
        sizes = np.array([len(e.points) for e in predicted], np.int32), np.bincount(of_surface, minlength=shape[1])
        far = np.full(len(surface), np.inf)
        return Comparison(tuple(predicted), true, np.zeros(shape, np.int32), sizes[0], sizes[1].astype(np.int32),
                          np.full(len(points), np.inf), far)  # fmt: skip
    accuracy, nearest_true = _nearest(surface, points)
    completeness, owners = _nearest_entity(predicted, surface)
    if lenient:
        pairs = of_point * shape[1] + of_surface[nearest_true]
        sizes = np.bincount(of_point, minlength=shape[0])
        true_sizes = np.bincount(of_surface[nearest_true], minlength=shape[1])
    else:
        near = completeness <= REACH
        pairs = owners[near] * shape[1] + of_surface[near]
        wrong = np.bincount(of_point[accuracy > REACH], minlength=shape[0])
        sizes = np.bincount(owners[near], minlength=shape[0]) + wrong
        true_sizes = np.bincount(of_surface, minlength=shape[1])
    common = np.bincount(pairs, minlength=shape[0] * shape[1]).reshape(shape)
    return Comparison(
        tuple(predicted), true, common.astype(np.int32), sizes.astype(np.int32), true_sizes.astype(np.int32),
        accuracy, completeness,
    )  # fmt: skip


def _nearest_entity(entities: Sequence[PanopticEntity], queries: Float64) -> tuple[Float64, np.ndarray]:
    """(Q,) distances to the nearest surface, and whose it is; points stand for entities without a mesh."""
    from simtrack.raycast import RayScene, TriangleMesh

    distances, owners = np.full(len(queries), np.inf), np.zeros(len(queries), np.int64)
    meshes = {k: e.mesh for k, e in enumerate(entities) if e.mesh is not None and len(e.mesh.faces)}
    if meshes:
        with RayScene() as scene:
            for k, mesh in meshes.items():
                scene.add(TriangleMesh(mesh.vertices, mesh.faces, entities[k].name), instance=k)
            found = scene.closest_points(queries)
            distances, owners = found.distances.astype(float), found.instances.astype(np.int64)
    for k, entity in enumerate(entities):
        if k not in meshes and len(entity.points):
            off, _ = _nearest(entity.points, queries)
            owners[off < distances] = k
            distances = np.minimum(distances, off)
    return distances, owners


def _nearest(points: Float64, queries: Float64) -> tuple[Float64, np.ndarray]:
    """(Q,) distances to the nearest points, and which they are."""
    from scipy.spatial import KDTree

    distances, index = KDTree(points).query(queries)
    return np.asarray(distances, np.float64), np.asarray(index, np.int64)


@dataclass(frozen=True, slots=True)
class PanopticCount:
    """Matches of one class in one or several scenes; they add up."""

    matched: int = 0
    wrong: int = 0
    missed: int = 0
    overlap: float = 0.0
    """Sum of the IoU of the matches."""

    def __add__(self, other: "PanopticCount") -> "PanopticCount":
        return PanopticCount(
            self.matched + other.matched, self.wrong + other.wrong, self.missed + other.missed,
            self.overlap + other.overlap,
        )  # fmt: skip

    @property
    def sq(self) -> float:
        """Segmentation quality: mean IoU of the matches, 0 without any."""
        return self.overlap / self.matched if self.matched else 0.0

    @property
    def rq(self) -> float:
        """Recognition quality: F1 of the matches."""
        whole = self.matched + 0.5 * (self.wrong + self.missed)
        return self.matched / whole if whole else 0.0

    @property
    def pq(self) -> float:
        """Panoptic quality, Eq. 15."""
        return self.sq * self.rq


def panoptic_counts(found: Comparison) -> dict[str, PanopticCount]:
    """Matches of every class that is predicted or true."""
    iou, true = found.iou, found.true
    names = [e.semantic_class for e in true.entities]
    counts: dict[str, PanopticCount] = {}
    missed = {k for k in range(len(names)) if not true.void[k]}
    for number, entity in enumerate(found.predicted):
        own = [k for k in range(len(names)) if names[k] == entity.semantic_class and iou[number, k] > 0.5]
        name = entity.semantic_class
        if own:  # at most one has more than half
            if not true.void[own[0]]:
                counts[name] = counts.get(name, PanopticCount()) + PanopticCount(1, overlap=float(iou[number, own[0]]))
                missed.discard(own[0])
        elif 2 * int(found.common[number, true.void].sum()) <= int(found.predicted_sizes[number]):
            counts[name] = counts.get(name, PanopticCount()) + PanopticCount(wrong=1)
    for k in sorted(missed):
        counts[names[k]] = counts.get(names[k], PanopticCount()) + PanopticCount(missed=1)
    return counts


@dataclass(frozen=True, slots=True)
class ScoredClass:
    """What average precision of a class needs; over several scenes they add up."""

    hits: tuple[tuple[float, bool], ...] = ()
    """(score, whether it is right) of every prediction."""
    true: int = 0

    def __add__(self, other: "ScoredClass") -> "ScoredClass":
        return ScoredClass(self.hits + other.hits, self.true + other.true)

    def average_precision(self, lenient: bool = False) -> float | None:
        """AP; None where the class is not true anywhere, or leniently not predicted."""
        if not self.true or (lenient and not self.hits):
            return None
        if not self.hits:
            return 0.0
        order = np.argsort([-score for score, _ in self.hits], kind="stable")
        right = np.cumsum([self.hits[k][1] for k in order])
        precision, recall = right / np.arange(1, len(right) + 1), right / self.true
        beyond = float(precision[-1]) if lenient else 0.0
        levels = np.arange(11) / 10.0 - 1e-12
        best = [precision[recall >= level].max() if recall[-1] >= level else beyond for level in levels]
        return float(np.mean(best))


def scored_classes(
    predicted: Sequence[PanopticEntity], true: TrueSurface, iou: Float64, least: float = 0.5
) -> dict[str, ScoredClass]:
    """Predictions of things, the surest first, each right if it overlaps a true one of its class that is still free.

    Args:
        predicted: entities.
        true: likewise; void ones are neither missed nor wrong.
        iou: (P, E).
        least: smallest IoU.
    """
    names = [e.semantic_class for e in true.entities]
    counts = {
        name: ScoredClass(true=sum(n == name and not v for n, v in zip(names, true.void, strict=True)))
        for name in names
        if name not in STUFF
    }
    taken: set[int] = set()
    for number in np.argsort([-e.score for e in predicted], kind="stable").tolist():
        entity = predicted[number]
        if entity.semantic_class in STUFF:
            continue
        free = [k for k in range(len(names)) if names[k] == entity.semantic_class and k not in taken]
        best = max(free, key=lambda k: iou[number, k], default=None)
        right = best is not None and bool(iou[number, best] >= least)
        if right and best is not None:
            taken.add(best)
            if true.void[best]:
                continue
        counts[entity.semantic_class] = counts.get(entity.semantic_class, ScoredClass()) + ScoredClass(
            ((entity.score, right),)
        )
    return counts


def mean_precision(
    counts: Mapping[str, ScoredClass], lenient: bool = False, only: Collection[str] | None = None
) -> float | None:
    """Mean of the classes' average precision, of some classes if `only` names them; None if there is no class."""
    chosen = [c for name, c in counts.items() if only is None or name in only]
    values = [value for c in chosen if (value := c.average_precision(lenient)) is not None]
    return float(np.mean(values)) if values else None


def box_iou(predicted: Sequence[PanopticEntity], true: TrueSurface) -> Float64:
    """(P, E), 3D IoU of the upright boxes."""
    from simtrack.evaluation.contact_graph import upright_iou

    return np.array(
        [
            [upright_iou(p.box.T_map_box, p.box.extents, e.box.T_map_box, e.box.extents) for e in true.entities]
            for p in predicted
        ]
    ).reshape(len(predicted), len(true.entities))
