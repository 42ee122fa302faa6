"""Episodes of a policy."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from simtrack.envs.policies import Policy, make_policy
from simtrack.envs.wrappers import simtrack_env


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """How an episode ended."""

    seed: int
    total: float
    """Sum of the rewards."""
    steps: int
    success: bool
    metrics: dict[str, float]

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def play(env: gym.Env, policy: str, seeds: Iterable[int], feed: str = "belief") -> Iterator[EpisodeResult]:
    """Play an episode for each seed with a policy by name (see `make_policy`); `feed` is what a scripted one sees."""
    inner = simtrack_env(env)
    actor: Policy | None = None
    for seed in seeds:
        observation, info = env.reset(seed=seed)
        if actor is None:
            size = int(np.prod(inner.action_space.shape or ()))
            actor = make_policy(policy, inner.task_name, inner.briefing(), size, feed)
        actor.begin(np.random.default_rng(seed))
        yield run_episode(env, actor, seed, observation, info)


def run_episode(env: gym.Env, policy: Policy, seed: int, observation: Any, info: dict[str, Any]) -> EpisodeResult:
    """Act until the episode that has just begun is over."""
    total, steps, over = 0.0, 0, False
    while not over:
        observation, reward, terminated, truncated, info = env.step(policy.act(observation))
        total, steps, over = total + float(reward), steps + 1, terminated or truncated
    return EpisodeResult(seed, total, steps, bool(info["success"]), dict(info["metrics"]))
