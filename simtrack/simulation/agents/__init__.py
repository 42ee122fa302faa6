"""What drives the robot. Agents see the stack's beliefs, the survey and the robot's joints: never the truth."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Agent, CameraIntrinsics, Command, StaticMap
from simtrack.errors import UnknownNameError
from simtrack.geometry.kinematics import KinematicTree


@dataclass(frozen=True, slots=True)
class AgentContext:
    """What an agent may know before it starts."""

    static_map: StaticMap
    """The survey."""
    robot: KinematicTree
    intrinsics: CameraIntrinsics
    start: Command
    """Posture in which the robot starts."""
    rng: np.random.Generator


def _explorer(context: AgentContext) -> Agent:
    from simtrack.simulation.agents.explorer import ExplorerAgent

    return ExplorerAgent(context.static_map, context.intrinsics, context.start)


def _fixed_gaze(context: AgentContext) -> Agent:
    from simtrack.simulation.agents.fixed_gaze import FixedGazeAgent

    return FixedGazeAgent(context.start)


def _patrol(context: AgentContext) -> Agent:
    from simtrack.simulation.agents.patrol import ROUNDS, PatrolAgent

    return PatrolAgent(context.static_map, context.intrinsics, context.start, ROUNDS)


def _route(context: AgentContext) -> Agent:
    from simtrack.simulation.agents.route import RouteAgent

    return RouteAgent(context.static_map, context.rng)


AGENTS: dict[str, Callable[[AgentContext], Agent]] = {
    "explorer": _explorer,
    "fixed-gaze": _fixed_gaze,
    "patrol": _patrol,
    "route": _route,
}
"""Known agents by name."""


def make_agent(name: str, context: AgentContext) -> Agent:
    """Build an agent by name.

    Raises:
        UnknownNameError: there is no such agent.

    """
    if name not in AGENTS:
        raise UnknownNameError("agent", name, AGENTS)
    return AGENTS[name](context)
