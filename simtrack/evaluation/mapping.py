"""Maps a source, and measures the map against the truth where that is known."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64, Status
from simtrack.evaluation.map_sources import MapSource
from simtrack.evaluation.metrics import Metrics, measured, ratio, unmeasured
from simtrack.evaluation.panoptic import (
    PAPER_CLASSES,
    STUFF,
    PanopticCount,
    PanopticEntity,
    ScoredClass,
    SeenSurface,
    TrueSurface,
    box_iou,
    compare,
    mean_precision,
    panoptic_counts,
    predicted_entity,
    scored_classes,
)
from simtrack.geometry.boxes import OrientedBox
from simtrack.perception.mapping.panoptic.entities import MapEntityMesh
from simtrack.perception.mapping.panoptic.panoptic_map import PanopticMap, PanopticMapConfig
from simtrack.perception.segmentation.geometric import depth_segments
from simtrack.simulation.building.rooms.physics import SettledRoom

SURFACE_NEAR = 0.02
"""Metres within which true surface counts as mapped."""


@dataclass(frozen=True, slots=True, eq=False)
class MappedScene:
    """A map and how it came about."""

    name: str
    map: PanopticMap
    entities: tuple[MapEntityMesh, ...]
    seen: SeenSurface | None
    """What the camera saw, where the truth is known."""
    seconds: float
    """CPU time of mapping, segmentation of images and rendering excepted."""
    T_map_first: Float64 | None = None
    """(4, 4), where the camera began."""

    @property
    def frames_per_second(self) -> float:
        """Frames mapped in a second of one core."""
        return self.map.frames / self.seconds if self.seconds > 0.0 else 0.0


def map_scene(
    source: MapSource,
    config: PanopticMapConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
    onto: PanopticMap | None = None,
) -> MappedScene:
    """Fuse all frames of a source into a map.

    Args:
        source: of the frames; it is released afterwards.
        config: of the map.
        progress: hears how many frames of how many are done.
        onto: a map that is carried on, in the place of a new one.
    """
    maps = [PanopticMap(config or PanopticMapConfig()) if onto is None else onto]
    return _fused(source, maps, progress)[0]


def map_scenes(
    source: MapSource, configs: Sequence[PanopticMapConfig], progress: Callable[[int, int], None] | None = None
) -> tuple[MappedScene, ...]:
    """Fuse all frames of a source into several maps, which get the same segments; see `map_scene`."""
    return _fused(source, [PanopticMap(config) for config in configs], progress)


def _fused(
    source: MapSource, maps: Sequence[PanopticMap], progress: Callable[[int, int], None] | None
) -> tuple[MappedScene, ...]:
    seconds = np.zeros(len(maps))
    seen = None if source.room is None else SeenSurface(source.room, maps[0].config.max_depth)
    T_map_first: Float64 | None = None
    with source.held:
        for number, entry in enumerate(source.frames(), start=1):
            segments = source.segmenter.segment(entry.frame)
            T_map_first = entry.T_map_camera if T_map_first is None else T_map_first
            geometric, first = None, 0.0
            if len(maps) > 1:  # all take the same
                start, far = time.process_time(), entry.frame.depth > maps[0].config.max_depth
                depth = np.where(far, np.float32(0.0), entry.frame.depth)
                geometric = depth_segments(depth, entry.frame.intrinsics, maps[0].config.geometric)
                first = time.process_time() - start
            used = False
            for k, panoptic_map in enumerate(maps):
                start = time.process_time()
                update = panoptic_map.integrate(entry.frame, entry.T_map_camera, segments, geometric)
                seconds[k] += time.process_time() - start + first
                used = used or update.status is Status.OK
            if seen is not None and entry.truth is not None and used:
                seen.add(entry.truth)
            if progress is not None:
                progress(number, source.count)
    made = []
    for panoptic_map, spent in zip(maps, seconds.tolist(), strict=True):
        start = time.process_time()
        entities = panoptic_map.entities()
        spent += time.process_time() - start
        made.append(MappedScene(source.name, panoptic_map, entities, seen, spent, T_map_first))
    return tuple(made)


@dataclass(frozen=True, slots=True)
class MapScores:
    """How a map of one room compares with the truth; counts of several rooms add up."""

    panoptic: dict[str, PanopticCount]
    """By class, against what was seen."""
    panoptic_all: dict[str, PanopticCount]
    """Against all surface."""
    panoptic_lenient: dict[str, PanopticCount]
    """As the paper's code counts."""
    instances: dict[str, ScoredClass]
    boxes: dict[str, ScoredClass]
    refined: dict[str, ScoredClass]
    """Boxes refined by support."""
    accuracy: tuple[float, float]
    """Metres: median and 95 % quantile of the distance from the mapped to the true surface."""
    completeness: float
    """Share of the surface that was seen that lies within `SURFACE_NEAR` of the map."""
    distance: int
    """Edit distance of the contact graph as the paper counts it, see `ContactGraphErrors.total`; 0 where it was not
    built."""
    nodes: int
    """Of the true contact graph, of things that were seen; 0 where it was not built."""
    edits: int = 0
    """The five operations at cost 1, edges of missing and extra nodes among them."""
    distance_by_class: int = 0
    """As `distance`, where nodes of another class are no match: one missing and one extra."""


def score_map(entities: tuple[MapEntityMesh, ...], seen: SeenSurface, graph: bool = True) -> MapScores:
    """Compare the entities of a map with the room that they were seen in.

    Args:
        entities: of the map.
        seen: what the camera saw of the room.
        graph: whether the contact graph is built, which refines boxes.
    """
    predicted = [predicted_entity(e.name, e.semantic_class, e.score, e.mesh) for e in entities]
    true = seen.surface()
    found = compare(predicted, true)
    refined, edits = predicted, (0, 0, 0, 0)
    if graph:
        refined, edits = _contact_graph(entities, predicted, seen.room, true, found.iou)
    off = _off_surface(entities, seen.room)
    return MapScores(
        panoptic=panoptic_counts(found),
        panoptic_all=panoptic_counts(compare(predicted, seen.surface(whole=True))),
        panoptic_lenient=panoptic_counts(compare(predicted, true, lenient=True)),
        instances=scored_classes(predicted, true, found.iou),
        boxes=scored_classes(predicted, true, box_iou(predicted, true)),
        refined=scored_classes(refined, true, box_iou(refined, true)),
        accuracy=(float(np.median(off)), float(np.quantile(off, 0.95))) if len(off) else (np.inf, np.inf),
        completeness=float((found.completeness <= SURFACE_NEAR).mean()),
        distance=edits[0],
        nodes=edits[1],
        edits=edits[2],
        distance_by_class=edits[3],
    )


def _off_surface(entities: tuple[MapEntityMesh, ...], room: SettledRoom) -> Float64:
    """(N,) metres from the vertices of a map to the true surface."""
    from simtrack.raycast import RayScene, TriangleMesh

    points = np.concatenate([np.empty((0, 3)), *(entity.mesh.vertices for entity in entities)])
    with RayScene() as scene:
        for number, entity in enumerate(room.entities):
            scene.add(TriangleMesh(entity.mesh.vertices, entity.mesh.faces, entity.name), instance=number)
        return scene.closest_points(points).distances.astype(float)


def _contact_graph(
    entities: tuple[MapEntityMesh, ...],
    predicted: list[PanopticEntity],
    room: SettledRoom,
    true: TrueSurface,
    iou: Float64,
) -> tuple[list[PanopticEntity], tuple[int, int, int, int]]:
    """Entities with boxes refined by support; distance of the contact graph and nodes of the true one, then `edits` and
    `distance_by_class`.
    """
    from dataclasses import replace

    from simtrack.evaluation.contact_graph import SupportTree, contact_graph_errors, match_by_overlap
    from simtrack.evaluation.reconstruction import true_tree
    from simtrack.geometry.upright_boxes import upright_box
    from simtrack.perception.mapping.panoptic.layout import split_layout
    from simtrack.perception.scene_graph.contact import EntityMesh, build_contact_graph, entity_nodes

    split = split_layout(entities, np.random.default_rng(0))
    meshes = [EntityMesh(e.name, e.semantic_class, e.mesh) for e in split]
    nodes, findings = entity_nodes(meshes, np.random.default_rng(0))
    graph = build_contact_graph(nodes, findings=findings)
    refined = [replace(e, box=graph.nodes[e.name].box) if e.name in graph.nodes else e for e in predicted]
    whole = true_tree(room)
    unseen = {e.name for e, void in zip(true.entities, true.void, strict=True) if void}
    kept = {name: c for name, c in whole.classes.items() if name not in unseen}
    parents = {n: tuple(p for p in whole.parents[n] if p in kept or p == "") or ("",) for n in kept}
    actual = SupportTree(kept, parents)
    estimate = SupportTree(
        {name: node.semantic_class for name, node in graph.nodes.items()},
        {name: tuple(graph.supporters(name)) for name in graph.nodes},
    )
    matches = {}
    # Things match where they share most of their surface and their class; floors and walls by their boxes.
    for k, entity in enumerate(true.entities):
        same = [p for p, e in enumerate(predicted) if e.semantic_class == entity.semantic_class]
        best = max(same, key=lambda p, k=k: iou[p, k], default=None)
        if entity.name in kept and entity.semantic_class not in STUFF and best is not None and iou[best, k] > 0.25:
            matches[entity.name] = predicted[best].name
    layout = {n: upright_box(room.entity(n).mesh.vertices) for n, c in kept.items() if c in STUFF}
    boxes = {n: node.box for n, node in graph.nodes.items() if node.semantic_class in STUFF}
    for name, other in match_by_overlap(_thick(boxes), _thick(layout)).items():
        if estimate.classes[other] == kept[name]:
            matches[name] = other
    taken: set[str] = set()
    unique = {}
    for name, other in matches.items():
        if other in estimate.classes and other not in taken:
            unique[name] = other
            taken.add(other)
    strict = contact_graph_errors(estimate, actual, unique)
    # What has the shape of a thing and another class is that thing under a wrong label.
    left = [
        (-float(iou[p, k]), p, entity.name)
        for k, entity in enumerate(true.entities)
        if entity.name in kept and entity.name not in unique and entity.semantic_class not in STUFF
        for p, other in enumerate(predicted)
        if iou[p, k] > 0.25 and other.name in estimate.classes and other.semantic_class not in STUFF
    ]
    for _, p, name in sorted(left):
        if name not in unique and predicted[p].name not in taken:
            unique[name] = predicted[p].name
            taken.add(predicted[p].name)
    errors = contact_graph_errors(estimate, actual, unique)
    return refined, (errors.total, errors.nodes, errors.general, strict.total)


def _thick(boxes: Mapping[str, OrientedBox]) -> dict[str, tuple[Float64, Float64]]:
    """Boxes of sheets, made so thick that those of one wall overlap."""
    return {name: (box.T_map_box, np.maximum(box.extents, 0.3)) for name, box in boxes.items()}


def class_means(
    counts: Mapping[str, PanopticCount], only: frozenset[str] | None = None
) -> tuple[float, float, float] | None:
    """PQ, SQ, RQ as means over the classes that are true somewhere; None if there is none."""
    chosen = [c for name, c in counts.items() if c.matched + c.missed and (only is None or name in only)]
    if not chosen:
        return None
    pq, sq, rq = np.mean([(c.pq, c.sq, c.rq) for c in chosen], axis=0).tolist()
    return pq, sq, rq


def scene_metrics(mapped: MappedScene) -> Metrics:
    """Figures of one map, by name."""
    metrics: Metrics = {
        "map.frames": measured(mapped.map.frames, "1"),
        "map.skipped": measured(sum(mapped.map.skipped.values()), "1"),
        "map.entities": measured(len(mapped.entities), "1"),
        "map.bytes": measured(mapped.map.volume.nbytes, "bytes"),
        "map.frames_per_cpu_second": measured(mapped.frames_per_second, "Hz"),
    }
    if mapped.seen is None:
        return metrics | {"panoptic.pq": unmeasured("1", "the source has no truth")}
    return metrics | score_metrics(score_map(mapped.entities, mapped.seen))


def score_metrics(scores: MapScores) -> Metrics:
    """Figures of one or several rooms, by name; means over classes."""
    metrics: Metrics = {}
    groups: tuple[tuple[str, frozenset[str] | None], ...] = (
        ("", None),
        ("paper_classes.", frozenset(PAPER_CLASSES)),
        ("stuff.", STUFF),
        ("things.", frozenset(scores.panoptic) - STUFF),
    )
    for kind, counts in (
        ("panoptic", scores.panoptic),
        ("panoptic_all_surface", scores.panoptic_all),
        ("panoptic_lenient", scores.panoptic_lenient),
    ):
        for group, only in groups:
            means = class_means(counts, only)
            for k, name in enumerate(("pq", "sq", "rq")):
                found = unmeasured("1", "no class of this kind") if means is None else measured(means[k], "1")
                metrics[f"{kind}.{group}{name}"] = found
    for kind, table in (("instances", scores.instances), ("boxes", scores.boxes), ("boxes_refined", scores.refined)):
        for group, lenient in (("", False), ("", True), ("paper_classes.", False)):
            value = mean_precision(table, lenient, PAPER_CLASSES if group else None)
            missing = unmeasured("1", "nothing to be found")
            if kind == "boxes_refined" and not scores.nodes:
                value, missing = None, unmeasured("1", "the contact graph was not built")
            metrics[f"{kind}.{group}map50{'.lenient' * lenient}"] = missing if value is None else measured(value, "1")
    metrics["surface.accuracy.median"] = measured(scores.accuracy[0], "m")
    metrics["surface.accuracy.p95"] = measured(scores.accuracy[1], "m")
    metrics["surface.completeness"] = measured(scores.completeness, "1")
    for name, value in (
        ("graph.distance_per_node", scores.distance),
        ("graph.distance_by_class_per_node", scores.distance_by_class),
        ("graph.edits_per_node", scores.edits),
    ):
        metrics[name] = ratio(value, scores.nodes, "the contact graph was not built")
    return metrics
