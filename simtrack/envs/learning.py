"""PPO learns where to look: `simtrack train agent`; needs the extra ``rl``."""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np

from simtrack.contracts import Float32
from simtrack.envs.policies.gaze import FEATURES, HOLD, NETWORK, Gaze
from simtrack.envs.wrappers import simtrack_env
from simtrack.errors import FileFormatError, StageError

FIRST_SEED = 1_000_000
"""Of the episodes that are learned from."""
CHECKPOINT, CURVE = "checkpoint.pt", "learning.json"
EPISODES = 4
"""Whole episodes that each step of learning is made from."""


@dataclass(frozen=True, slots=True)
class LearnedEpisode:
    """An episode of the training."""

    minutes: float
    """Of CPU time since the training began."""
    steps: int
    """Control steps since then."""
    total: float
    """Sum of the rewards."""
    known_share: float


class Looking(gym.Wrapper):
    """Actions are postures that are held for some steps, observations are features of the belief; see `Gaze`."""

    def __init__(self, env: gym.Env, episodes: int = 0) -> None:
        """`episodes` were played before: seeds carry on after theirs."""
        super().__init__(env)
        self._gaze = Gaze(simtrack_env(env).layout.seconds)
        self.observation_space = gym.spaces.Box(-3.0, 3.0, (FEATURES,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.episodes, self.steps = episodes, 0
        self.finished: list[tuple[float, float]] = []
        """Return and known share of the episodes that are over."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, dict[str, Any]]:
        """Begin the next episode; which it is, decides this wrapper."""
        self._arrays, info = self.env.reset(seed=FIRST_SEED + self.episodes, options=options)
        self._gaze.reset()
        self._total = 0.0
        return self._gaze.features(self._arrays), info

    def step(self, action: Float32) -> tuple[Float32, SupportsFloat, bool, bool, dict[str, Any]]:
        """Hold a posture for some steps."""
        gained, over, cut, info = 0.0, False, False, {}
        for _ in range(HOLD):
            self._arrays, reward, over, cut, info = self.env.step(self._gaze.speeds(action, self._arrays))
            gained, self.steps = gained + float(reward), self.steps + 1
            if over or cut:
                break
        self._total += gained
        if over or cut:
            self.episodes += 1
            self.finished.append((self._total, info["metrics"]["known_share"]))
        return self._gaze.features(self._arrays), gained, over, cut, info


class GazeTraining:
    """A training in a folder: where it stands, and what carries it on."""

    def __init__(self, out: Path, seed: int = 0) -> None:
        """Take up what the folder holds already.

        Raises:
            StageError: the extra ``rl`` is not installed.
            FileFormatError: what the folder holds is no training of this kind.
        """
        try:
            import stable_baselines3  # noqa: F401  # pyright: ignore[reportMissingImports] - extra `rl`
        except ImportError as error:
            raise StageError("train agent", str(out), f"{error}; pip install 'simtrack[rl]'") from error
        self.out, self._seed = Path(out), seed
        self.episodes: list[LearnedEpisode] = []
        file = self.out / CURVE
        if file.exists():
            try:
                self.episodes = [LearnedEpisode(**entry) for entry in json.loads(file.read_text())["episodes"]]
            except (ValueError, TypeError, KeyError) as error:
                raise FileFormatError(file, "episodes", f"not a training ({error}); name another folder") from error

    def run(self, minutes: float, say: Callable[[LearnedEpisode], None]) -> None:
        """Learn until so many minutes of CPU time have been spent, those of earlier calls included."""
        import torch  # pyright: ignore[reportMissingImports] - extra `rl`
        from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports] - extra `rl`
        from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports] - extra `rl`
        from stable_baselines3.common.vec_env import DummyVecEnv  # pyright: ignore[reportMissingImports] - extra `rl`

        torch.set_num_threads(1)
        env = Looking(gym.make("simtrack/ActivePerception-v0", disable_env_checker=True), len(self.episodes))
        decisions = -(-simtrack_env(env).steps // HOLD)
        last = self.episodes[-1] if self.episodes else LearnedEpisode(0.0, 0, 0.0, 0.0)
        began, training = time.process_time(), self

        class Keeper(BaseCallback):
            def _on_step(self) -> bool:
                while env.finished:
                    spent = last.minutes + (time.process_time() - began) / 60.0
                    training.episodes.append(LearnedEpisode(spent, last.steps + env.steps, *env.finished.pop(0)))
                    say(training.episodes[-1])
                return last.minutes + (time.process_time() - began) / 60.0 < minutes

            def _on_rollout_start(self) -> None:  # after what was learned from the last one
                training.keep(self.model)

        try:
            model = PPO(
                "MlpPolicy", DummyVecEnv([lambda: env]), seed=self._seed + len(self.episodes), device="cpu",
                n_steps=EPISODES * decisions, batch_size=decisions, n_epochs=10, learning_rate=7e-4, gamma=0.95,
                gae_lambda=0.9, target_kl=0.05,
                policy_kwargs={"net_arch": {"pi": [64, 64], "vf": [64, 64]}, "log_std_init": -0.7},
            )  # fmt: skip
            self._take_up(model)
            model.learn(10**9, callback=Keeper())
        finally:
            env.close()

    def _take_up(self, model: Any) -> None:
        import torch  # pyright: ignore[reportMissingImports] - extra `rl`

        file = self.out / CHECKPOINT
        if not file.exists():
            return
        try:
            stored = torch.load(file, weights_only=True)
            model.policy.load_state_dict(stored["policy"])
            model.policy.optimizer.load_state_dict(stored["optimizer"])
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            raise FileFormatError(file, "policy", f"cannot be carried on ({error}); name another folder") from error

    def keep(self, model: Any) -> None:
        """Write the checkpoint, the network for `GazePolicy`, and the curve; each file is whole at any time."""
        import torch  # pyright: ignore[reportMissingImports] - extra `rl`

        self.out.mkdir(parents=True, exist_ok=True)
        policy = model.policy
        _whole(
            self.out / CHECKPOINT,
            lambda path: torch.save({"policy": policy.state_dict(), "optimizer": policy.optimizer.state_dict()}, path),
        )
        _whole(self.out / NETWORK, lambda path: _save(path, layers_of(policy.state_dict())))
        curve = {"episodes": [asdict(episode) for episode in self.episodes]}
        _whole(self.out / CURVE, lambda path: path.write_text(json.dumps(curve, indent=1) + "\n"))


def layers_of(weights: Mapping[str, Any]) -> dict[str, Float32]:
    """The actor's layers, ``weight0``, ``bias0`` and so on, from the weights of a policy of stable-baselines3."""
    names = [f"mlp_extractor.policy_net.{k}" for k in (0, 2)] + ["action_net"]
    return {
        f"{kind}{k}": weights[f"{name}.{kind}"].numpy().copy()
        for k, name in enumerate(names)
        for kind in ("weight", "bias")
    }


def _save(path: Path, arrays: Mapping[str, Any]) -> None:
    with path.open("wb") as file:
        np.savez(file, **arrays)


def _whole(path: Path, write: Callable[[Path], object]) -> None:
    unfinished = path.with_name(f"{path.name}.part")
    write(unfinished)
    unfinished.replace(path)
