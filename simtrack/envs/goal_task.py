"""Tasks that are stated as relations: ``relay in materialbox``. One's own is a scene, goals, and a reward if wanted."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from simtrack.envs.goals import Goals, GoalState, parse_goal
from simtrack.envs.task import Moment, Score, Task
from simtrack.errors import InvalidValueError

if TYPE_CHECKING:
    import numpy as np

    from simtrack.simulation.simulation import Simulation

NEAR = 0.3
"""Metres that a goal may be from holding for that to matter."""


class GoalTask(Task):
    """Make relations true, with things let go and at rest.

    The sum of how near the goals are is a potential: 1 for each that holds, else minus the metres that are missing, at
    most `NEAR`. A step gives what the potential has gained, less `haste`. An episode ends when all goals hold.
    """

    macros = ("grasp", "place")
    script = "tidy"
    eye, focus = (0.35, 1.25, 1.35), (0.5, 0.0, 0.85)
    haste: float = 0.002
    """What a step costs."""

    def __init__(self, goals: Sequence[str] = ()) -> None:
        """`goals` in place of the task's own, in words; raises SimtrackError where they are none."""
        if goals:
            self.goals = tuple(parse_goal(text) for text in goals)
        if not self.goals:
            raise InvalidValueError("goals", goals, "one or more such as 'relay in materialbox'")

    def prepare(self, simulation: "Simulation") -> None:
        """Look up the shapes that the goals speak of."""
        self._judge = Goals(simulation.world, self.goals)

    def begin(self, simulation: "Simulation", rng: "np.random.Generator") -> None:
        """Nothing has been gained yet."""
        self._potential: float | None = None

    def score(self, moment: Moment) -> Score:
        """See the class."""
        states = self._judge.states(moment.truth)
        done = sum(state.holds for state in states)
        potential = done - sum(min(-state.margin, NEAR) for state in states if state.margin < 0.0)
        gain = 0.0 if self._potential is None else potential - self._potential
        self._potential = potential
        success = done == len(states) and moment.holding is None
        metrics = {"goals": done / len(states), "seconds": moment.seconds}
        return Score(self.reward(gain, states), success, success, metrics)

    def reward(self, gain: float, states: Sequence[GoalState]) -> float:
        """Of a step in which the potential rose by `gain`; override it for one of your own."""
        return gain - self.haste
