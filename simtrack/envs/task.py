"""What a task is: where it takes place, what it rewards, and when it has succeeded. All of it knows the truth."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Belief
from simtrack.simulation.ground_truth import Truth
from simtrack.simulation.scene_file import SceneFile

if TYPE_CHECKING:
    from simtrack.simulation.simulation import Simulation


@dataclass(frozen=True, slots=True)
class Moment:
    """One step of an episode, as a task judges it."""

    seconds: float
    """Simulated since the beginning."""
    truth: Truth
    """What is the case."""
    belief: Belief
    """What the robot believes: the stack's answer, or that of ideal perception where no stack runs."""


@dataclass(frozen=True, slots=True)
class Score:
    """A task's verdict on one step."""

    reward: float
    success: bool
    """Whether the goal is reached as things are now."""
    terminated: bool = False
    """Whether nothing that follows would matter."""
    metrics: Mapping[str, float] = field(default_factory=dict)
    """What a reader of curves wants to know; names are fixed for a task."""


class Task(ABC):
    """A scene, a reward and a notion of success.

    A task of your own is a class with a few attributes and `score`; hand an instance, or ``"module:Class"``, to
    `gymnasium.make` as ``task``.
    """

    scene: str = "workbench"
    """Name of the scene, see `simtrack scenes`."""
    seconds: float = 30.0
    """Length of an episode; then it is truncated."""

    def adapt(self, scene: SceneFile) -> SceneFile:
        """The scene as the task wants it, before the world is built."""
        return scene

    def prepare(self, simulation: "Simulation") -> None:  # noqa: B027
        """The world is built (once for many episodes): look up what `score` needs."""

    def begin(self, simulation: "Simulation", rng: np.random.Generator) -> None:  # noqa: B027
        """An episode begins, at stamp 0; whatever is random about it is drawn from `rng`."""

    def act(self, simulation: "Simulation", seconds: float) -> None:  # noqa: B027
        """What the world does besides its physics, before the step that begins `seconds` after the beginning."""

    @abstractmethod
    def score(self, moment: Moment) -> Score:
        """Judge the step that has just ended; called once at the beginning, too, where the reward is ignored."""
