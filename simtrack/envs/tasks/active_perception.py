"""Look around so that every object is known as well as possible, while a hand moves some of them."""

from typing import TYPE_CHECKING

from simtrack.envs.knowledge import KnowledgeMeter
from simtrack.envs.task import Moment, Score, Task
from simtrack.evaluation.evaluator import true_models

if TYPE_CHECKING:
    import numpy as np

    from simtrack.simulation.simulation import Simulation

STEP = 0.1
"""Seconds that a step stands for in the reward."""
UNEXPLAINED = 2.0
"""Weight of the share of measurements that nothing explains, against that of the objects' errors."""
SUCCESS = 0.8
"""Mean share of known objects over an episode from which on it counts as a success."""


class ActivePerception(Task):
    """Drive and look on the workbench.

    The reward of a step is the drop of ``D = error + 2 unexplained`` since the last one, and 0.1 times the share of
    objects that are known. `error` is the mean translation error of the objects in the map as a share of 10 cm (1 for
    an object that is not believed anywhere), `unexplained` the share of the camera's measurements that neither map nor
    objects explain.
    """

    scene = "workbench"
    script = "active-perception"
    seconds = 30.0

    def prepare(self, simulation: "Simulation") -> None:
        """Load the true models."""
        self._meter = KnowledgeMeter(true_models(simulation))

    def begin(self, simulation: "Simulation", rng: "np.random.Generator") -> None:
        """Nothing is known yet."""
        self._deficit: float | None = None
        self._unexplained = 0.0
        self._sum, self._steps = 0.0, 0

    def score(self, moment: Moment) -> Score:
        """See the class."""
        knowledge = self._meter.measure(moment.belief.tracks, moment.truth)
        if moment.belief.camera is not None:
            self._unexplained = 1.0 - moment.belief.camera.reduction
        deficit = knowledge.error + UNEXPLAINED * self._unexplained
        drop = 0.0 if self._deficit is None else self._deficit - deficit
        self._deficit = deficit
        self._sum, self._steps = self._sum + knowledge.known, self._steps + 1
        share = self._sum / self._steps
        metrics = {
            "known": knowledge.known,
            "known_share": share,
            "error": knowledge.error,
            "median_error": knowledge.median_error,
            "unexplained": self._unexplained,
        }
        return Score(drop + STEP * knowledge.known, share >= SUCCESS, metrics=metrics)
