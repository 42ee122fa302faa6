"""From a contact graph to a functional scene: every entity gets a model, every model its place, the scene its joints.

    reconstruction = reconstruct(graph)
    write_scene(reconstruction.tree, "scene")

Section 4 of the reconstruction paper: matching and alignment (4.2, 4.3), the global check (4.4), the kinematic tree
(4.5). What is free settles before the tree is final, which the paper lacks. No entity is lost: what no CAD model fits
stays as its own mesh, and a finding says so.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import MeshError, UnknownNameError
from simtrack.objects.cad import CadModel, cad_classes, cad_models
from simtrack.perception.reconstruction.body_tree import BodyTree
from simtrack.perception.reconstruction.candidates import CadCandidate
from simtrack.perception.reconstruction.kinematic_tree import kinematic_tree
from simtrack.perception.reconstruction.own_model import is_own, own_candidate
from simtrack.perception.reconstruction.resting import ReconstructionConfig, Rest, come_to_rest
from simtrack.perception.reconstruction.selection import Rejection, Selection, select
from simtrack.perception.reconstruction.snapping import Snapped, eq1_residuals
from simtrack.perception.scene_graph.contact.graph import ContactGraph, is_far_above, is_layout
from simtrack.perception.scene_graph.contact.nodes import FLOOR, SCENE, EntityKind, EntityNode

Shortlist = Callable[[EntityNode, ContactGraph, Sequence[CadModel]], Sequence[CadCandidate]]
"""Aligned candidates of a node among models of its class, by rising alignment error."""
Progress = Callable[[str, float], None]
"""Hears what is being done and the share of the work that is done, 0 to 1."""


class NoteCode(StrEnum):
    """What the reconstruction has to say of an entity, beside the findings of the contact graph."""

    NO_MODEL = "no-model"
    """The catalogue lacks its class: it is its own mesh."""
    NO_CANDIDATE = "no-candidate"
    """No model of its class could be aligned: it is its own mesh."""
    APPROXIMATED = "approximated"
    """Its shape in physics is coarser than it was meant to be."""
    LEFT_OUT = "left-out"
    """Nothing can be made of it."""
    SUPPORT_LOST = "support-lost"
    """The model supports less of a child's bottom than Eq. 2 asks."""
    IN_LAYOUT = "in-layout"
    """All candidates stand in a wall."""
    CONFLICT = "conflict"
    """No selection keeps it out of another entity."""
    INTERPENETRATING = "interpenetrating"
    """It is in another entity, also after snapping."""
    AFLOAT = "afloat"
    """There is nothing of its supporter below it."""
    GROUND_INFERRED = "ground-inferred"
    """No floor was seen: a level ground lies below the lowest entity."""
    HELD = "held"
    """Nothing supports it: it is fixed where it was seen."""
    SHRUNK = "shrunk"
    """Its model is smaller than it was seen to be, so that it fits between the others."""
    UNSTABLE = "unstable"
    """It would topple, slide or be pushed out of another one: it is fixed where it was seen."""


@dataclass(frozen=True, slots=True)
class Note:
    """Something about a reconstruction that a user should know."""

    code: NoteCode
    entity: str
    """Name, or empty for the scene."""
    message: str


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The model that an entity got."""

    candidate: CadCandidate
    """At its final pose."""
    rank: int
    """Its place in the shortlist by alignment error."""
    offered: int
    """Length of the shortlist."""
    shift: Float64
    """(3,), translation from where alignment had it, by snapping and settling, metres."""
    residual: float
    """D of Eq. 1 after snapping, metres; NaN where Eq. 1 does not apply."""
    rejected: tuple[Rejection, ...]

    @property
    def own_mesh(self) -> bool:
        """Whether the entity kept its own mesh."""
        return is_own(self.candidate)


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """A functional scene cg' and how it came about."""

    name: str
    graph: ContactGraph
    choices: Mapping[str, Choice]
    """Entity -> model; layout has none."""
    tree: BodyTree
    notes: tuple[Note, ...]


def reconstruct(
    graph: ContactGraph,
    config: ReconstructionConfig | None = None,
    *,
    name: str = "scene",
    shortlist: Shortlist | None = None,
    known: Mapping[str, Sequence[CadCandidate]] | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Replace entities by CAD models and make the scene one of bodies and joints.

    Args:
        graph: contact graph of entities with meshes.
        config: thresholds.
        name: of the scene.
        shortlist: matches and aligns, called from several threads; sections 4.2 and 4.3 if None.
        known: entity -> its candidates where they are known beforehand, as of tracked objects.
        progress: called between steps.

    Raises:
        InvalidValueError: a node has no mesh (the graph was read from a file).
    """
    config = config or ReconstructionConfig()
    say = progress or (lambda what, share: None)
    notes: list[Note] = []
    shortlists = _shortlists(graph, shortlist or _default_shortlist(), known or {}, say, notes)
    say("checking candidates against each other", 0.8)
    selection = select(graph, shortlists, config.selection)
    if _offer_own_meshes(graph, shortlists, selection, say, notes):
        selection = select(graph, shortlists, config.selection)
    ground = _ground(graph, selection.chosen, notes)
    say("snapping and settling", 0.9)
    rest = come_to_rest(graph, shortlists, selection, config, ground)
    selection, snapped, placed = rest.selection, rest.snapped, rest.placed
    _selection_notes(selection, notes)
    _held_notes(graph, snapped, notes)
    _snapping_notes(graph, snapped, notes)
    _shrinking_notes(rest, shortlists, notes)
    _fixing_notes(rest, notes)
    say("kinematic tree", 0.98)
    tree = kinematic_tree(name, graph, placed, ground, snapped.parts, snapped.resting, rest.fixed)
    residuals = eq1_residuals(graph, placed, config.snapping)
    choices = {
        entity: Choice(
            candidate=placed[entity],
            rank=rank,
            offered=len(shortlists[entity]),
            shift=placed[entity].T_map_model[:3, 3] - rest.chosen[entity].T_map_model[:3, 3],
            residual=residuals.get(entity, np.nan),
            rejected=tuple(selection.rejected.get(entity, ())),
        )
        for entity, rank in selection.chosen.items()
    }
    return Reconstruction(name, graph, choices, tree, tuple(notes))


def _default_shortlist() -> Shortlist:
    from simtrack.perception.reconstruction.shortlist import shortlist

    return shortlist


def _shortlists(
    graph: ContactGraph,
    shortlist: Shortlist,
    known: Mapping[str, Sequence[CadCandidate]],
    say: Progress,
    notes: list[Note],
) -> dict[str, Sequence[CadCandidate]]:
    """Candidates of every entity but layout, parents before children; its own mesh for what has none.

    Entities are matched beside each other, on as many threads as numba has: none needs another's candidates.
    """
    import numba

    lacking: list[str] = []
    entities = [name for name in graph.descendants() if not is_layout(graph.nodes[name])]
    begun: dict[str, Future[Sequence[CadCandidate]]] = {}
    with ThreadPoolExecutor(numba.get_num_threads(), initializer=numba.set_num_threads, initargs=(1,)) as workers:
        for name in entities:
            node = graph.nodes[name]
            if known.get(name):
                continue
            try:
                begun[name] = workers.submit(shortlist, node, graph, cad_models(node.semantic_class))
            except UnknownNameError:
                lacking.append(name)
                message = f"there is no model of the class '{node.semantic_class}'; its own mesh stands for it"
                notes.append(Note(NoteCode.NO_MODEL, name, message))
        try:
            for number, name in enumerate(begun):
                say(f"matching {name}", 0.8 * number / len(begun))
                begun[name].result()
        except BaseException:  # Ctrl-C too: what is not begun shall not be waited for
            workers.shutdown(wait=False, cancel_futures=True)
            raise
    out: dict[str, Sequence[CadCandidate]] = {}
    for name in entities:
        node = graph.nodes[name]
        out[name] = tuple(begun[name].result()) if name in begun else known.get(name, ())
        if name in begun and not out[name]:
            message = f"no model of the class '{node.semantic_class}' could be aligned; its own mesh stands for it"
            notes.append(Note(NoteCode.NO_CANDIDATE, name, message))
        out[name] = out[name] or _own(node, notes)
    if lacking:
        message = f"there are models of the classes {', '.join(cad_classes())}; see $SIMTRACK_CAD for more"
        notes.append(Note(NoteCode.NO_MODEL, "", message))
    return out


def _offer_own_meshes(
    graph: ContactGraph,
    shortlists: dict[str, Sequence[CadCandidate]],
    selection: Selection,
    say: Progress,
    notes: list[Note],
) -> bool:
    """Where no model out of the walls has a place for what stands on an entity, offer its own mesh; whether any was."""
    found = False
    for name, children in selection.homeless.items():
        walled = name in selection.in_layout
        if graph.nodes[name].kind is EntityKind.ARTICULATED:
            continue
        if not (children or walled) or any(is_own(candidate) for candidate in shortlists[name]):
            continue
        say(f"decomposing {name}", 0.85)
        own = _own(graph.nodes[name], notes)
        shortlists[name] = (*shortlists[name], *own)
        lacks = f"has a place for {', '.join(children)}" if children else "stands out of the walls"
        message = f"no model of its class {lacks}; its own mesh is tried"
        notes.append(Note(NoteCode.NO_CANDIDATE, name, message))
        found = found or bool(own)
    return found


def _own(node: EntityNode, notes: list[Note]) -> Sequence[CadCandidate]:
    try:
        candidate, said = own_candidate(node)
    except MeshError as error:
        notes.append(Note(NoteCode.LEFT_OUT, node.name, f"nothing can be made of it: {error}"))
        return ()
    if said:
        notes.append(Note(NoteCode.APPROXIMATED, node.name, said))
    return (candidate,)


def _held_notes(graph: ContactGraph, snapped: Snapped, notes: list[Note]) -> None:
    for name, support in graph.supports.items():
        if is_far_above(graph.nodes[name], support) and name not in snapped.resting:
            message = (
                f"what holds it was not seen, and '{support.parent}' is too far below; it is fixed where it was seen"
            )
            notes.append(Note(NoteCode.HELD, name, message))


def _selection_notes(selection: Selection, notes: list[Note]) -> None:
    for name, children in selection.lost.items():
        message = f"none of its candidates has room for all that it supports; too little is under {', '.join(children)}"
        notes.append(Note(NoteCode.SUPPORT_LOST, name, message))
    for name, depth in selection.in_layout.items():
        notes.append(Note(NoteCode.IN_LAYOUT, name, f"every candidate stands {1e3 * depth:.0f} mm or more in a wall"))
    for first, second, depth in selection.conflicts:
        message = f"no candidates of it and of '{second}' stay apart: {1e3 * depth:.0f} mm deep before snapping"
        notes.append(Note(NoteCode.CONFLICT, first, message))


def _ground(graph: ContactGraph, chosen: Collection[str], notes: list[Note]) -> float | None:
    """Height of a floor that nobody saw, if it is needed."""
    loose = [name for name in graph.children(SCENE) if name in chosen]
    if any(node.semantic_class == FLOOR for node in graph.nodes.values()):
        for name in loose:
            notes.append(Note(NoteCode.HELD, name, "nothing supports it; it is fixed where it was seen"))
        return None
    if not loose:
        return None
    height = min(graph.nodes[name].bottom for name in loose)
    message = f"no floor was seen: a level ground is put at z = {height:.3f} m, under {', '.join(loose)}"
    notes.append(Note(NoteCode.GROUND_INFERRED, "", message))
    return height


def _shrinking_notes(rest: Rest, shortlists: Mapping[str, Sequence[CadCandidate]], notes: list[Note]) -> None:
    for name, rank in rest.selection.chosen.items():
        share = rest.chosen[name].scale / shortlists[name][rank].scale
        if share < 1.0:
            message = (
                f"is made {100.0 * (1.0 - share):.0f} % smaller than it was seen to be: it would not fit in its place"
            )
            notes.append(Note(NoteCode.SHRUNK, name, message))


def _snapping_notes(graph: ContactGraph, snapped: Snapped, notes: list[Note]) -> None:
    for name in snapped.afloat:
        message = f"nothing of '{graph.parent(name)}' is below it"
        notes.append(Note(NoteCode.AFLOAT, name, message))
    for first, second, depth in snapped.stuck:
        message = f"is still {1e3 * depth:.1f} mm deep in '{second}' after snapping"
        notes.append(Note(NoteCode.INTERPENETRATING, first, message))


def _fixing_notes(rest: Rest, notes: list[Note]) -> None:
    for name, trouble in rest.fixed.items():
        notes.append(Note(NoteCode.UNSTABLE, name, f"finds no rest: it {trouble}; it is fixed where it was seen"))
