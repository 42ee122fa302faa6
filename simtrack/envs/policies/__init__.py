"""Policies that come along. They see observations and what an agent may know before it starts, never the truth."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from simtrack.contracts import Command, Float32, Relation, StaticMap
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.kinematics import KinematicTree
from simtrack.objects import ObjectModel

if TYPE_CHECKING:
    from simtrack.envs.observations import Layout


@dataclass(frozen=True, slots=True)
class Briefing:
    """What an agent may know before it starts."""

    static_map: StaticMap
    """The survey."""
    robot: KinematicTree
    start: Command
    """Posture in which the robot starts."""
    layout: "Layout"
    """What the arrays of an observation stand for."""
    modes: tuple[str, ...]
    """Observation modes; with more than one, an observation is a mapping by mode."""
    models: Mapping[str, ObjectModel]
    """Class name -> model, as the tracker has it."""
    goals: tuple[Relation, ...]
    """What shall hold, between classes of objects and furniture."""

    def arrays(self, observation: Any, mode: str) -> dict[str, np.ndarray]:
        """The arrays of one mode; raises InvalidValueError if it is not observed."""
        if mode not in self.modes:
            raise InvalidValueError("observation", self.modes, f"modes among which is '{mode}', which the policy needs")
        return observation if len(self.modes) == 1 and mode not in observation else observation[mode]


class Policy(Protocol):
    """Acts on observations, one episode after the other."""

    def begin(self, rng: np.random.Generator) -> None:
        """A new episode begins."""
        ...

    def act(self, observation: Any) -> Float32:
        """(A,) the action that answers an observation."""
        ...


class RandomPolicy:
    """Draws every action anew, uniformly."""

    def __init__(self, size: int) -> None:
        self._size = size
        self.begin(np.random.default_rng(0))

    def begin(self, rng: np.random.Generator) -> None:
        """See `Policy`."""
        self._rng = rng

    def act(self, observation: Any) -> Float32:
        """See `Policy`."""
        return self._rng.uniform(-1.0, 1.0, self._size).astype(np.float32)


class StillPolicy:
    """Never moves: what a fixed gaze is worth."""

    def __init__(self, size: int) -> None:
        self._size = size

    def begin(self, rng: np.random.Generator) -> None:
        """See `Policy`."""

    def act(self, observation: Any) -> Float32:
        """See `Policy`."""
        return np.zeros(self._size, np.float32)


SCRIPTED = {
    "active-perception": "simtrack.envs.policies.agents:explorer",
    "localize": "simtrack.envs.policies.agents:tour",
    "tidy": "simtrack.envs.policies.tidy:TidyPolicy",
    "fetch-meal": "simtrack.envs.policies.fetch_meal:FetchMealPolicy",
}
"""Task -> function that makes its scripted policy from (briefing, mode)."""
POLICIES = ("random", "still", "scripted")
LEARNED = "active-perception"
"""Task that `simtrack train agent` learns."""


def make_policy(name: str, task: str, briefing: Briefing, size: int, mode: str = "belief") -> Policy:
    """A policy by name.

    Args:
        name: one of `POLICIES`, or the folder in which `simtrack train agent` has left a network.
        task: name of the task; scripted policies are written for one.
        briefing: what it may know.
        size: of an action.
        mode: ``belief``, or ``state`` for a scripted policy that is fed with the truth.

    Raises:
        UnknownNameError: no such policy, or none was scripted for this task.
        InvalidValueError: the mode is not observed, or the network is for another task.
        FileFormatError: the folder holds no network.
    """
    if name not in POLICIES and not Path(name).is_dir():
        raise UnknownNameError("policy", name, (*POLICIES, "a folder of `simtrack train agent`"))
    if name == "random":
        return RandomPolicy(size)
    if name == "still":
        return StillPolicy(size)
    if name in POLICIES and task not in SCRIPTED:
        raise UnknownNameError("task with a scripted policy", task, SCRIPTED)
    if mode not in briefing.modes:
        raise InvalidValueError("observation", briefing.modes, f"modes among which is '{mode}', which the policy needs")
    if name not in POLICIES:
        from simtrack.envs.policies.gaze import GazePolicy

        if task != LEARNED:
            raise InvalidValueError("policy", name, f"a network for the task {task}; this one is for {LEARNED}")
        return GazePolicy(briefing, mode, Path(name))
    module, _, function = SCRIPTED[task].partition(":")
    make: Callable[[Briefing, str], Policy] = getattr(import_module(module), function)
    return make(briefing, mode)
