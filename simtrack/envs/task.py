"""What a task is: where it takes place, what it rewards, and when it has succeeded. All of it knows the truth."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Belief, Relation
from simtrack.errors import InvalidValueError, UnknownNameError
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
    holding: str | None = None
    """Name of the object that the gripper truly holds."""


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
    macros: tuple[str, ...] = ()
    """Of `simtrack.envs.actions.MACROS`: what the arm can be asked for; the scene's robot needs ``suction`` for any."""
    eye: tuple[float, float, float] = (-1.7, 0.8, 2.0)
    focus: tuple[float, float, float] = (1.0, 0.0, 0.75)
    """From where pictures of the robot at work are taken, and what they show: base frame, metres."""
    script: str = ""
    """Name of the scripted policy that can play it (`simtrack.envs.policies.SCRIPTED`), if there is one."""
    goals: tuple[Relation, ...] = ()
    """What the agent is told that shall hold, between objects and furniture of the scene."""

    def adapt(self, scene: SceneFile) -> SceneFile:
        """The scene as the task wants it, before the world is built."""
        return scene

    def prepare(self, simulation: "Simulation") -> None:  # noqa: B027
        """The world is built (once for many episodes): look up what `score` needs."""

    def playable(self, simulation: "Simulation") -> bool:
        """Whether an episode can begin with what was drawn for it; if not, it is drawn anew."""
        return True

    def begin(self, simulation: "Simulation", rng: np.random.Generator) -> None:  # noqa: B027
        """An episode begins, at stamp 0; whatever is random about it is drawn from `rng`."""

    def act(self, simulation: "Simulation", seconds: float) -> None:  # noqa: B027
        """What the world does besides its physics, before the step that begins `seconds` after the beginning."""

    def check(self, scene: SceneFile) -> None:
        """Whether the scene has what `macros` and `goals` need.

        Raises:
            InvalidValueError: the arm shall do something and the scene's robot has no cup, or a goal names one of
                several things that look the same.
            UnknownNameError: a goal names nothing that the scene has.
        """
        if self.macros and not scene.robot.suction:
            raise InvalidValueError("scene", scene.name, "one whose robot has a suction cup (robot.suction: true)")
        models = {thing.id: thing.model for thing in scene.objects}
        for goal in self.goals:
            if goal.subject not in models:
                raise UnknownNameError("object of the scene", goal.subject, models)
            if goal.reference not in models and goal.name != "on":
                raise UnknownNameError("object of the scene", goal.reference, models)
            for name in {goal.subject, goal.reference} & set(models):
                if list(models.values()).count(models[name]) > 1:
                    raise InvalidValueError("goal", goal, f"things of which there is one; '{name}' is one of several")

    @abstractmethod
    def score(self, moment: Moment) -> Score:
        """Judge the step that has just ended; called once at the beginning, too, where the reward is ignored."""
