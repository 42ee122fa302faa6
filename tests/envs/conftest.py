from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import pytest

import simtrack  # noqa: F401  # registers the environments
from simtrack.envs.environment import SimtrackEnv
from simtrack.envs.wrappers import simtrack_env

FEW = ("materialbox", "relay")
"""Objects of the workbench that the tests' environments have."""


@pytest.fixture
def make() -> Iterator[Callable[..., SimtrackEnv]]:
    """Makes a small environment by the name of its task; all are closed at the end."""
    made: list[gym.Env] = []

    def one(name: str = "ActivePerception", **arguments: Any) -> SimtrackEnv:
        defaults: dict[str, Any] = {"scene": "workbench", "objects": FEW, "seconds": 2.0, "observation": "state"}
        env = gym.make(f"simtrack/{name}-v0", **{**defaults, **arguments})
        made.append(env)
        return simtrack_env(env)

    yield one
    for env in made:
        env.close()
