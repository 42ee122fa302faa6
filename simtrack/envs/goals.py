"""Goals as relations that shall hold: ``relay in materialbox``, judged by the graph's definitions on the truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from simtrack.contracts import Relation
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.perception.scene_graph import RELATIONS, MarginMeter, RelationConfig, model_shapes
from simtrack.simulation.ground_truth import Truth

if TYPE_CHECKING:
    from simtrack.objects import ObjectModel
    from simtrack.simulation.world import World

AT_REST = 0.02
"""m/s below which a thing has been put down."""


def parse_goal(text: str) -> Relation:
    """A goal from words: subject, relation, reference.

    Raises:
        InvalidValueError: there are not three words.
        UnknownNameError: no such relation.
    """
    words = text.split()
    if len(words) != 3:
        raise InvalidValueError("goal", text, "three words such as 'relay in materialbox'")
    if words[1] not in RELATIONS:
        raise UnknownNameError("relation", words[1], RELATIONS)
    return Relation(*words)


@dataclass(frozen=True, slots=True)
class GoalState:
    """How far a goal is fulfilled."""

    goal: Relation
    holds: bool
    """It holds, and its subject is at rest."""
    margin: float
    """Metres, at least 0 where the relation holds; 0 or -1 for ``on``, which contacts decide."""


class Goals:
    """Relations between objects of a world, judged by what is true."""

    def __init__(self, world: "World", goals: Sequence[Relation], config: RelationConfig | None = None) -> None:
        """Look up shapes.

        Args:
            world: whose objects and furniture the goals name.
            goals: what shall hold.
            config: thresholds of the relations; those of the scene graph if None.

        Raises:
            UnknownNameError: a goal names nothing that there is.
            InvalidValueError: a goal other than ``on`` refers to furniture.
        """
        self.goals = tuple(goals)
        self._config = config or RelationConfig()
        models: Mapping[str, ObjectModel] = world.objects
        furniture = {part.name for part in world.static.parts if part.supports}
        for goal in goals:
            if goal.subject not in models:
                raise UnknownNameError("object", goal.subject, models)
            if goal.reference not in {*models, *furniture}:
                raise UnknownNameError("object or furniture", goal.reference, {*models, *furniture})
            if goal.reference not in models and goal.name != "on":
                raise InvalidValueError("goal", goal, "'on' for furniture; other relations between objects")
        shapes = model_shapes({model.name: model for model in models.values()})
        of = {name: shapes[model.name] for name, model in models.items()}
        self._meters = {
            goal: MarginMeter(of[goal.subject], goal.name, of[goal.reference], self._config)
            for goal in goals
            if goal.name != "on"
        }

    def states(self, truth: Truth) -> list[GoalState]:
        """Each goal at one moment, in their order."""
        return [self._state(goal, truth) for goal in self.goals]

    def _state(self, goal: Relation, truth: Truth) -> GoalState:
        subject = truth.objects[goal.subject]
        resting = bool((subject.velocity[:3] ** 2).sum() < AT_REST**2)
        if goal.name == "on":
            carriers = {below for above, below in truth.contacts if above == goal.subject}
            holds = goal.reference in {name.partition("/")[0] for name in carriers} | carriers
            return GoalState(goal, holds and resting, 0.0 if holds else -1.0)
        margin = self._meters[goal].margin(subject.T_map_object, truth.objects[goal.reference].T_map_object)
        return GoalState(goal, margin >= 0.0 and resting, margin)
