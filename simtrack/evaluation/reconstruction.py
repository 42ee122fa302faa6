"""Contact graph, CAD models and physics of one room against what is true of it, and figures over many rooms.

The true contact graph is made of MuJoCo's contacts in the settled room, the true pose of a thing is that of the room's
own model. See `contact_graph` for the edit distances and `cad_errors` for orientations.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from simtrack.evaluation.cad_errors import chamfer_distance, rotation_error
from simtrack.evaluation.contact_graph import SupportTree, contact_graph_errors
from simtrack.evaluation.metrics import Metrics, measured, quantile, ratio
from simtrack.objects.cad import CAD_CLASSES
from simtrack.perception.reconstruction.reconstruct import Choice, Reconstruction
from simtrack.perception.scene_graph.contact import ContactGraph, EntityMesh
from simtrack.perception.scene_graph.contact.nodes import SCENE
from simtrack.plausibility.check import ENGINES
from simtrack.plausibility.verdict import CheckConfig, CheckReport, JointResult
from simtrack.simulation.building.rooms.physics import RoomEntity, SettledRoom

Entities: TypeAlias = Literal["true", "partial"]
ENTITIES: tuple[Entities, ...] = ("true", "partial")
WELL_SEEN = 0.6
"""Share of the surface that can be seen at all from which a thing's yaw and height are asked for."""
UP, YAW, HEIGHT = np.radians(15.0), np.radians(15.0), 0.1
"""Radians, radians, share: errors up to which up-axis, yaw and height count as right."""
SEEN_SHARES = ((WELL_SEEN, 1.01), (0.3, WELL_SEEN), (0.0, 0.3))
"""Ranges of the same share in which errors are told apart."""


@dataclass(frozen=True, slots=True)
class ModelOutcome:
    """The model that stands for one thing whose class the catalogue has."""

    name: str
    semantic_class: str
    seen: float
    """Share that the entity mesh covers of the surface that can be seen from outside at all (`visible_faces`)."""
    model: str
    kept: bool
    """Whether the model is one of its class, not its own mesh."""
    up: float | None
    """Radians; None for own meshes, as the next two."""
    yaw: float | None
    scale: float | None
    height: float
    """Height of the model over the true height."""
    alignment_error: float | None
    """AE, metres; None for own meshes."""
    chamfer: float
    """Metres, to the true surface."""


@dataclass(frozen=True, slots=True)
class BodyOutcome:
    """How a free body fared in the engine that decides; margins of the engine are subtracted."""

    name: str
    stable: bool
    """It drifted and tilted less than the limits."""
    penetration: float
    """Metres, before it settled."""
    gap: float | None
    """Metres, likewise; None if nothing is near."""


@dataclass(frozen=True, slots=True)
class JointOutcome:
    """How a joint of a model fared in the engines, the worse of both."""

    name: str
    sound: bool
    """No engine holds anything against it: it leads where it says, and not into its own object."""
    alone: float
    """Share of its range that its own object leaves it."""
    free: float
    """Share of its range that is free with everything else in its place, what can be lifted excepted."""


@dataclass(frozen=True, slots=True)
class RoomOutcome:
    """Everything that is found in one room from one kind of entities."""

    room: str
    kind: str
    entities: Entities
    nodes: int
    """Of the true graph."""
    wrong_support: tuple[str, ...]
    missing: tuple[str, ...]
    extra: tuple[str, ...]
    general: int
    """Edit distance under the five operations, given the matching by name."""
    leaning: tuple[int, int, int]
    """Leaning pairs that are true, of those found, found in all."""
    models: tuple[ModelOutcome, ...]
    bodies: tuple[BodyOutcome, ...]
    """Empty if the physics was not checked."""
    joints: tuple[JointOutcome, ...]
    """Likewise."""
    fixed: tuple[str, ...]
    """Entities that find no rest where they were seen, and are fixed there rather than free."""
    verdict: str
    problems: tuple[str, ...]
    """What speaks against the scene, as the check words it."""
    margin: float
    """Metres that the deciding engine's shapes are thicker than drawn, a side; subtracted."""
    agreement: float | None
    """Share of free bodies on whose verdict both engines agree."""
    graph_seconds: float
    """Wall clock: planes, boxes and contact graph."""
    seconds: float
    """Wall clock from entities to written files; the check is not in it."""
    cpu_seconds: float
    """The same as time of the processor, which other work on the machine does not lengthen."""

    @property
    def distance(self) -> int:
        """2 W + M + E of the paper's Table 5."""
        return 2 * len(self.wrong_support) + len(self.missing) + len(self.extra)

    @property
    def stable(self) -> bool:
        """Whether every free body stays."""
        return bool(self.bodies) and all(body.stable for body in self.bodies)


def true_tree(room: SettledRoom) -> SupportTree:
    """The room's contact graph from MuJoCo's contacts; layout hangs on the scene."""
    carriers: dict[str, list[str]] = {entity.name: [] for entity in room.entities}
    for carried, carrier in room.supports:
        carriers[carried].append(carrier)
    classes = {entity.name: entity.semantic_class for entity in room.entities}
    return SupportTree(classes, {name: tuple(found) or (SCENE,) for name, found in carriers.items()})


def leaning_pairs(room: SettledRoom) -> set[frozenset[str]]:
    """Pairs that touch, neither carrying the other, of which one is a tilted thing."""
    carrying = {frozenset(pair) for pair in room.supports}
    tilted = {entity.name for entity in room.entities if entity.placed is not None and _tilted(entity)}
    return {frozenset(pair) for pair in room.touches if frozenset(pair) not in carrying and tilted & {*pair}}


def _tilted(entity: RoomEntity) -> bool:
    """Whether no axis of the thing's model is upright within 4 degrees."""
    assert entity.placed is not None
    return bool(np.abs(entity.placed.T_map_model[2, :3]).max() < np.cos(np.radians(4.0)))


def room_entities(
    room: SettledRoom, kind: Entities, rng: np.random.Generator
) -> tuple[list[EntityMesh], dict[str, float]]:
    """Entity meshes of a room, whole or as seen on a walk, and the share of each one's surface that they cover."""
    if kind == "true":
        return [EntityMesh(e.name, e.semantic_class, e.mesh) for e in room.entities], dict.fromkeys(
            (e.name for e in room.entities), 1.0
        )
    from simtrack.simulation.building.rooms.walk import partial_entities

    seen = [entity for entity in partial_entities(room, rng) if len(entity.mesh.faces)]
    meshes = [EntityMesh(entity.name, entity.semantic_class, entity.mesh) for entity in seen]
    return meshes, {entity.name: entity.seen for entity in seen}


def evaluate_room(
    seed: int,
    entities: Entities,
    folder: Path | None = None,
    *,
    kind: Literal["kitchen"] | None = None,
    stages: Literal["graph", "models", "physics"] = "physics",
) -> RoomOutcome:
    """Reconstruct one room and compare with the truth.

    Args:
        seed: of the room.
        entities: whole meshes, or what a camera sees on a walk.
        folder: where the scene's files go; a temporary one if None.
        kind: of the room; drawn from the seed if None.
        stages: how far to go: the contact graph alone, CAD models too, or the check of physics as well.
    """
    import tempfile

    from simtrack.perception.reconstruction.files import write_scene
    from simtrack.perception.reconstruction.reconstruct import NoteCode, reconstruct
    from simtrack.perception.scene_graph.contact import build_contact_graph, entity_nodes
    from simtrack.plausibility.check import check_urdf
    from simtrack.simulation.building.rooms.physics import settled_room

    room = settled_room(seed, kind)
    meshes, seen = room_entities(room, entities, np.random.default_rng(np.random.SeedSequence([seed, 0])))
    start, processor = time.perf_counter(), time.process_time()
    nodes, findings = entity_nodes(meshes, np.random.default_rng(0))
    graph = build_contact_graph(nodes, findings=findings)
    graph_seconds = seconds = time.perf_counter() - start
    cpu_seconds = time.process_time() - processor
    models: tuple[ModelOutcome, ...] = ()
    fixed: tuple[str, ...] = ()
    report: CheckReport | None = None
    if stages != "graph":
        made = reconstruct(graph, name=f"room {seed}")
        fixed = tuple(note.entity for note in made.notes if note.code is NoteCode.UNSTABLE)
        with tempfile.TemporaryDirectory(prefix="simtrack-evaluate-") as temporary:
            files = write_scene(made.tree, temporary if folder is None else folder)
            seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - processor
            models = model_outcomes(made, room, seen)
            if stages == "physics":
                report = check_urdf(files.urdf)
    return outcome(
        f"{kind or 'rooms'}:{seed}", room, entities, graph, models, fixed, report, (graph_seconds, seconds, cpu_seconds)
    )


def outcome(
    name: str,
    room: SettledRoom,
    entities: Entities,
    graph: ContactGraph,
    models: tuple[ModelOutcome, ...],
    fixed: tuple[str, ...],
    report: CheckReport | None,
    seconds: tuple[float, float, float],
) -> RoomOutcome:
    """The figures of one room; `seconds` are those of the graph, of everything up to the written files, and as CPU."""
    estimate = SupportTree(
        {name: node.semantic_class for name, node in graph.nodes.items()},
        {name: tuple(graph.supporters(name)) for name in graph.nodes},
    )
    errors = contact_graph_errors(estimate, true_tree(room))
    actual = leaning_pairs(room)
    found = {frozenset((lean.child, lean.against)) for lean in graph.leaning}
    deciding = None if report is None or not report.engines else report.engines[0]
    bodies: tuple[BodyOutcome, ...] = ()
    if report is not None and deciding is not None:
        limits = report.config
        bodies = tuple(
            BodyOutcome(b.name, bool(b.drift < limits.drift and b.tilt < limits.tilt), b.penetration_start, b.gap)
            for b in deciding.bodies
            if not b.static
        )
    return RoomOutcome(
        room=name,
        kind=room.plan.kind,
        entities=entities,
        nodes=errors.nodes,
        wrong_support=errors.wrong_support,
        missing=errors.missing,
        extra=errors.extra,
        general=errors.general,
        leaning=(len(actual), len(actual & found), len(found)),
        models=models,
        bodies=bodies,
        joints=() if report is None else joint_outcomes(report),
        fixed=fixed,
        verdict="not checked" if report is None else report.verdict,
        problems=()
        if report is None
        else tuple(str(f) for f in report.findings if f.severity in ("problem", "unreadable")),
        margin=0.0 if deciding is None else deciding.margin,
        agreement=None if report is None else report.agreement,
        graph_seconds=seconds[0],
        seconds=seconds[1],
        cpu_seconds=seconds[2],
    )


def joint_outcomes(report: CheckReport) -> tuple[JointOutcome, ...]:
    """Every joint in the engine in which it fares worse; one that an engine did not move is not sound."""
    found: dict[str, list[JointResult]] = {}
    for joint in (joint for engine in report.engines for joint in engine.joints):
        found.setdefault(joint.name, []).append(joint)
    return tuple(
        JointOutcome(
            name=name,
            sound=len(rows) == len(ENGINES) and not any(row.problems for row in rows),
            alone=min(row.reached_alone for row in rows),
            free=min(row.reached for row in rows),
        )
        for name, rows in found.items()
    )


def model_outcomes(made: Reconstruction, room: SettledRoom, seen: Mapping[str, float]) -> tuple[ModelOutcome, ...]:
    """How the models of things whose class the catalogue has compare with what stands there."""
    rng = np.random.default_rng(0)
    return tuple(
        _model_outcome(made.choices[entity.name], entity, seen[entity.name], rng)
        for entity in room.entities
        if entity.placed is not None and entity.name in made.choices and entity.semantic_class in CAD_CLASSES
    )


def _model_outcome(choice: Choice, entity: RoomEntity, seen: float, rng: np.random.Generator) -> ModelOutcome:
    assert entity.placed is not None
    candidate, own = choice.candidate, choice.own_mesh
    mesh = candidate.mesh()
    turn = None
    if not own:
        turn = rotation_error(
            entity.placed.model, entity.placed.T_map_model, candidate.model, np.asarray(candidate.T_map_model)
        )
    return ModelOutcome(
        name=entity.name,
        semantic_class=entity.semantic_class,
        seen=seen,
        model=candidate.model.name,
        kept=not own and candidate.model.semantic_class == entity.semantic_class,
        up=None if turn is None else turn.up,
        yaw=None if turn is None else turn.yaw,
        scale=None if own else float(candidate.scale),
        height=float(mesh.extents[2] / entity.mesh.extents[2]),
        alignment_error=None if own else float(candidate.alignment_error),
        chamfer=chamfer_distance(mesh, entity.mesh, rng),
    )


def summary(outcomes: Sequence[RoomOutcome]) -> Metrics:
    """Figures over rooms of one kind of entities."""
    nodes = sum(room.nodes for room in outcomes)
    figures = {
        "rooms": measured(len(outcomes), "1"),
        "nodes": measured(nodes, "1"),
        "graph.distance.mean": measured(np.mean([room.distance for room in outcomes]), "1"),
        "graph.general.mean": measured(np.mean([room.general for room in outcomes]), "1"),
        "graph.distance_of_nodes": ratio(sum(room.distance for room in outcomes), nodes, "no nodes"),
        "graph.wrong_support": ratio(sum(len(room.wrong_support) for room in outcomes), nodes, "no nodes"),
        "graph.missing": ratio(sum(len(room.missing) for room in outcomes), nodes, "no nodes"),
        "graph.extra": ratio(sum(len(room.extra) for room in outcomes), nodes, "no nodes"),
        "graph.leaning.recall": ratio(
            sum(r.leaning[1] for r in outcomes), sum(r.leaning[0] for r in outcomes), "nothing leans"
        ),
        "graph.leaning.precision": ratio(
            sum(r.leaning[1] for r in outcomes), sum(r.leaning[2] for r in outcomes), "nothing was found to lean"
        ),
        "seconds.graph": quantile([room.graph_seconds for room in outcomes], 0.5, "s", "no rooms"),
        "seconds.median": quantile([room.seconds for room in outcomes], 0.5, "s", "no rooms"),
        "seconds.cpu.median": quantile([room.cpu_seconds for room in outcomes], 0.5, "s", "no rooms"),
        "seconds.worst": quantile([room.seconds for room in outcomes], 1.0, "s", "no rooms"),
    }
    return figures | _model_figures([model for room in outcomes for model in room.models]) | _physics_figures(outcomes)


def _model_figures(models: Sequence[ModelOutcome]) -> Metrics:
    none = "no models"
    turned = [model for model in models if model.up is not None and model.yaw is not None]
    figures = {
        "cad.models": measured(len(models), "1"),
        "cad.class_kept": ratio(sum(model.kept for model in models), len(models), none),
        "cad.up_axis": ratio(sum(model.up <= UP for model in turned if model.up is not None), len(models), none),
        "cad.scale.median": quantile([m.scale for m in models if m.scale is not None], 0.5, "1", none),
        "cad.alignment_error.median": quantile(
            [m.alignment_error for m in models if m.alignment_error is not None], 0.5, "m", none
        ),
        "cad.chamfer.median": quantile([model.chamfer for model in models], 0.5, "m", none),
    }
    for low, high in SEEN_SHARES:
        inside = [model for model in models if low <= model.seen < high]
        name = f"cad.seen_{100 * low:.0f}_to_{100 * min(high, 1.0):.0f}"
        right = sum(model.yaw <= YAW for model in inside if model.yaw is not None)
        high_enough = sum(abs(model.height - 1.0) <= HEIGHT for model in inside)
        figures[f"{name}.models"] = measured(len(inside), "1")
        figures[f"{name}.yaw"] = ratio(right, len(inside), "no models seen so far")
        figures[f"{name}.height"] = ratio(high_enough, len(inside), "no models seen so far")
    return figures


def _physics_figures(outcomes: Sequence[RoomOutcome]) -> Metrics:
    checked = [room for room in outcomes if room.verdict != "not checked"]
    if not checked:
        return {}
    bodies = [body for room in checked for body in room.bodies]
    agreements = [(room.agreement, len(room.bodies)) for room in checked if room.agreement is not None]
    agreed = sum(share * count for share, count in agreements)
    joints = [joint for room in checked for joint in room.joints]
    least = CheckConfig().least_range
    none, no_joints = "no free bodies", "no joints"
    return {
        "physics.stable_scenes": ratio(sum(room.stable for room in checked), len(checked), "no scenes"),
        "physics.plausible_scenes": ratio(sum(r.verdict == "plausible" for r in checked), len(checked), "no scenes"),
        "physics.bodies": measured(len(bodies), "1"),
        "physics.fixed_for_want_of_rest": measured(sum(len(room.fixed) for room in checked), "1"),
        "physics.stable_bodies": ratio(sum(body.stable for body in bodies), len(bodies), none),
        "physics.penetration.p99": quantile([body.penetration for body in bodies], 0.99, "m", none),
        "physics.gap.p99": quantile([body.gap for body in bodies if body.gap is not None], 0.99, "m", none),
        "physics.joints": measured(len(joints), "1"),
        "physics.joints.full_range": ratio(sum(j.sound and j.alone >= 1.0 for j in joints), len(joints), no_joints),
        "physics.joints.can_open": ratio(sum(j.sound and j.free >= least for j in joints), len(joints), no_joints),
        "physics.joints.free": ratio(sum(j.free >= 1.0 for j in joints), len(joints), no_joints),
        "physics.agreement": ratio(agreed, sum(count for _, count in agreements), "one engine only"),
        "physics.margin": measured(max(room.margin for room in checked), "m"),
    }


def outcome_to_json(room: RoomOutcome) -> dict[str, Any]:
    """The outcome as JSON values."""
    return asdict(room)


def outcome_from_json(document: dict[str, Any]) -> RoomOutcome:
    """Inverse of `outcome_to_json`, through JSON; raises KeyError and TypeError for anything else."""
    fixed = dict(document)
    for name in ("wrong_support", "missing", "extra", "leaning", "fixed", "problems"):
        fixed[name] = tuple(fixed[name])
    fixed["models"] = tuple(ModelOutcome(**row) for row in fixed["models"])
    fixed["bodies"] = tuple(BodyOutcome(**row) for row in fixed["bodies"])
    fixed["joints"] = tuple(JointOutcome(**row) for row in fixed["joints"])
    return RoomOutcome(**fixed)
