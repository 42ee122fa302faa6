"""The agents of the closed loop as policies: what they see are the arrays of an observation, put back into a belief."""

from collections.abc import Callable
from typing import Any

import numpy as np

from simtrack.contracts import Agent, CameraIntrinsics, Float32
from simtrack.envs.actions import Steering
from simtrack.envs.observations import decode
from simtrack.envs.policies import Briefing
from simtrack.envs.settings import CONTROL_HZ
from simtrack.sensors.camera import XTION


class AgentPolicy:
    """An agent that is made anew for every episode."""

    def __init__(self, briefing: Briefing, mode: str, make: Callable[[Briefing, np.random.Generator], Agent]) -> None:
        self._briefing, self._mode, self._make = briefing, mode, make
        self._steering = Steering(briefing.start, 1.0 / CONTROL_HZ)
        self.begin(np.random.default_rng(0))

    def begin(self, rng: np.random.Generator) -> None:
        """See `simtrack.envs.policies.Policy`."""
        self._agent = self._make(self._briefing, rng)
        self._steering.reset()

    def act(self, observation: Any) -> Float32:
        """See `simtrack.envs.policies.Policy`."""
        briefing = self._briefing
        arrays = briefing.arrays(observation, self._mode)
        belief, joints = decode(arrays, briefing.layout, briefing.robot)
        action = self._steering.towards(self._agent.act(belief, joints))
        self._steering.apply(action)
        return action


def explorer(briefing: Briefing, mode: str) -> AgentPolicy:
    """Explores, follows what moves, looks for what is lost."""
    from simtrack.simulation.agents.explorer import ExplorerAgent

    intrinsics = _as_large_as_the_xtion(briefing.layout.intrinsics)
    return AgentPolicy(briefing, mode, lambda b, rng: ExplorerAgent(b.static_map, intrinsics, b.start))


def tour(briefing: Briefing, mode: str) -> AgentPolicy:
    """Tours the building; turns in place while the localization is lost, creeps while it is ambiguous."""
    from simtrack.simulation.agents.route import RouteAgent

    return AgentPolicy(briefing, mode, lambda b, rng: RouteAgent(b.static_map, rng))


def _as_large_as_the_xtion(small: CameraIntrinsics) -> CameraIntrinsics:
    """The same view with as many rows as the agents' margins in pixels are meant for."""
    scale = XTION.intrinsics.height / small.height
    width, height = round(small.width * scale), XTION.intrinsics.height
    return CameraIntrinsics(width, height, small.fx * scale, small.fy * scale, (width - 1) / 2, (height - 1) / 2)
