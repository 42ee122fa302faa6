"""The end of the global check: a selection of candidates that comes to rest. Beyond the reconstruction paper.

A selection is snapped and settled. What finds no rest gets other candidates, and so does what it is stuck in; what is
in others all the same gets a smaller model. What even so would topple, slide or be pushed out is fixed where it was
seen, as nobody knows what holds it: that is reported for each of them, and it no longer floats in the kinematic tree.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from simtrack.errors import InvalidValueError
from simtrack.perception.reconstruction.candidates import CadCandidate
from simtrack.perception.reconstruction.kinematic_tree import body_names, kinematic_tree
from simtrack.perception.reconstruction.own_model import is_own
from simtrack.perception.reconstruction.selection import Selection, SelectionConfig, select
from simtrack.perception.reconstruction.settling import Known, Settled, SettlingConfig, settle
from simtrack.perception.reconstruction.snapping import Snapped, SnappingConfig, snap
from simtrack.perception.scene_graph.contact.graph import ContactGraph

Shortlists = Mapping[str, Sequence[CadCandidate]]
"""Entity -> its candidates by rising alignment error."""


@dataclass(frozen=True, slots=True)
class ReconstructionConfig:
    """Settings of the stages; those of matching and alignment go with the shortlist."""

    selection: SelectionConfig = field(default_factory=SelectionConfig)
    snapping: SnappingConfig = field(default_factory=SnappingConfig)
    settling: SettlingConfig = field(default_factory=SettlingConfig)
    attempts: int = 4
    """Selections that are tried until everything comes to rest."""
    shrunk: tuple[float, ...] = (0.95, 0.9)
    """Factors by which models are made smaller one after the other that are in others all the same."""
    fixing: int = 6
    """Times that the worst of what finds no rest is fixed and the others settle again; then all of it is fixed."""

    def __post_init__(self) -> None:
        if self.attempts < 1:
            raise InvalidValueError("ReconstructionConfig.attempts", self.attempts, "1 or more")
        if not all(0.0 < factor <= 1.0 for factor in self.shrunk):
            raise InvalidValueError("ReconstructionConfig.shrunk", self.shrunk, "factors in (0, 1]")
        if self.fixing < 0:
            raise InvalidValueError("ReconstructionConfig.fixing", self.fixing, "0 or more")


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """A selection, and how it comes to rest."""

    selection: Selection
    chosen: Mapping[str, CadCandidate]
    """Entity -> model where alignment had it."""
    snapped: Snapped
    settled: Settled
    """The last one, after everything was fixed that had to be."""
    placed: Mapping[str, CadCandidate]
    """Entity -> model where it comes to rest."""
    fixed: Mapping[str, str] = field(default_factory=dict)
    """Entities that find no rest where they were seen and are fixed there, and what they would do otherwise."""

    @property
    def unrest(self) -> tuple[int, float]:
        """Number of bodies that find no rest, and how bad that is; the less, the better."""
        return len(self.settled.restless), sum(self.settled.stuck.values())


def come_to_rest(
    graph: ContactGraph,
    shortlists: Shortlists,
    selection: Selection,
    config: ReconstructionConfig,
    ground: float | None = None,
) -> Rest:
    """The selection, or one like it, at rest.

    Args:
        graph: what supports what.
        shortlists: what can be selected.
        selection: the first choice.
        config: thresholds of the stages and numbers of attempts.
        ground: height in metres of a level ground that nobody saw; none if None.
    """
    return _Resting(graph, shortlists, config, ground).run(selection)


class _Resting:
    def __init__(
        self, graph: ContactGraph, shortlists: Shortlists, config: ReconstructionConfig, ground: float | None
    ) -> None:
        self.graph, self.shortlists, self.config, self.ground = graph, shortlists, config, ground
        self.bodies = body_names(graph)
        self.known: Known = {}
        self.entities = {body: entity for entity, body in self.bodies.items()}

    def run(self, selection: Selection) -> Rest:
        return self._with_fixed(self._with_smaller(self._with_others(selection)))

    def _tried(self, selection: Selection, chosen: Mapping[str, CadCandidate]) -> Rest:
        snapped = snap(self.graph, chosen, self.config.snapping, self.ground)
        return self._settled(Rest(selection, chosen, snapped, Settled({}, {}, {}), snapped.candidates))

    def _settled(self, rest: Rest) -> Rest:
        """At the poses that the bodies settle at from where they are placed."""
        snapped = rest.snapped
        tree = kinematic_tree("scene", self.graph, rest.placed, self.ground, snapped.parts, snapped.resting, rest.fixed)
        settled = settle(tree, self.config.settling, self.known)
        placed = {
            entity: replace(candidate, T_map_model=settled.poses.get(self.bodies[entity], candidate.T_map_model))
            for entity, candidate in rest.placed.items()
        }
        return replace(rest, settled=settled, placed=placed)

    def _with_others(self, selection: Selection) -> Rest:
        """What finds no rest gets other candidates, as long as there are any; from the second time on also what it is
        stuck in.
        """
        barred: dict[str, set[int]] = {}
        tried: list[Rest] = []
        for number in range(self.config.attempts):
            chosen = {entity: self.shortlists[entity][rank] for entity, rank in selection.chosen.items()}
            tried.append(self._tried(selection, chosen))
            settled = tried[-1].settled
            restless = {self.entities[body] for body in settled.restless}
            if number > 0:
                restless |= {p for body in settled.stuck for p in self.graph.supporters(self.entities[body])}
            changing = sorted(e for e in restless if len(self.shortlists.get(e, ())) > 1)
            if not changing or number + 1 == self.config.attempts:
                break
            for entity in changing:
                barred.setdefault(entity, set()).add(selection.chosen[entity])
            selection = select(self.graph, self.shortlists, self.config.selection, barred)
        return min(tried, key=lambda rest: rest.unrest)

    def _with_smaller(self, best: Rest) -> Rest:
        """What is in others gets smaller, if that brings it out of them."""
        for factor in self.config.shrunk:
            stuck = {self.entities[body] for body in best.settled.stuck}
            tight = [entity for entity in best.chosen if entity in stuck and not is_own(best.chosen[entity])]
            if not tight:
                break
            ranks = best.selection.chosen
            smaller = {e: replace(best.chosen[e], scale=factor * self.shortlists[e][ranks[e]].scale) for e in tight}
            tried = self._tried(best.selection, {**best.chosen, **smaller})
            best = min(best, tried, key=lambda rest: rest.unrest)
        return best

    def _with_fixed(self, rest: Rest) -> Rest:
        """What still finds no rest is fixed, the worst first: others may rest only when it does."""
        for number in range(self.config.fixing + 1):
            restless = rest.settled.restless
            if not restless:
                break
            worst = list(rest.settled.held) or [max(restless, key=lambda body: restless[body])]
            found = list(restless) if number == self.config.fixing else worst
            fixed = {self.entities[body]: rest.settled.trouble(body) for body in found}
            rest = self._settled(replace(rest, fixed={**rest.fixed, **fixed}))
        return rest
