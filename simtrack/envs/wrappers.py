"""Wrappers: discrete actions, one flat vector, videos of what is believed, recordings of episodes.

Beliefs are stacked over time with Gymnasium's own `FrameStackObservation`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, SupportsFloat, cast

import gymnasium as gym
import numpy as np

from simtrack.contracts import Float32, Uint8
from simtrack.envs.actions import MOVES, vector
from simtrack.envs.environment import SimtrackEnv
from simtrack.envs.observations import MODES
from simtrack.envs.skills import Skills, skill_names
from simtrack.errors import InvalidValueError, RenderingError, UnknownNameError

EGOCENTRIC = 4.0
"""Metres that stand for 1 in a flat observation: of places relative to the robot, which are cut off at 3."""
FLAT = (
    "mask", "class", "position", "velocity", "deviation", "status", "age", "visible", "moving", "unexplained",
    "regions", "regions_mask", "base_deviation", "localization", "joints", "speed", "time", "macro", "holding",
)  # fmt: skip
"""Entries of a flat observation, as far as there are such; ``deviation`` are standard deviations of covariance."""


def simtrack_env(env: gym.Env) -> SimtrackEnv:
    """The environment below all wrappers; raises InvalidValueError if it is not one of simtrack's."""
    inner = env.unwrapped
    if not isinstance(inner, SimtrackEnv):
        raise InvalidValueError("env", type(inner).__name__, "an environment of simtrack")
    return inner


class DiscreteActions(gym.ActionWrapper):
    """A handful of moves instead of speeds, and things to be grasped and put by name instead of by place.

    See `simtrack.envs.actions.MOVES` and `simtrack.envs.skills`. Names are looked up in what the robot believes; one
    that cannot be tried, such as to grasp what is not known, does nothing.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._inner = simtrack_env(env)
        self._macros = self._inner.task.macros
        self.names = (*MOVES, *skill_names(self._inner.layout.classes, self._macros))
        """What each action does."""
        self._moves = [vector(move, self._macros) for move in MOVES.values()]
        self._skills: Skills | None = None
        self.action_space = gym.spaces.Discrete(len(self.names))

    def action(self, action: Any) -> Float32:
        """The numbers that a move or a macro stands for."""
        if not 0 <= int(action) < len(self.names):
            raise InvalidValueError("action", action, f"0 to {len(self.names) - 1}")
        if int(action) < len(self._moves):
            return self._moves[int(action)].copy()
        request, snapshot, loop = None, self._inner.snapshot, self._inner.loop
        if snapshot is not None and loop is not None and loop.manipulator is not None and not loop.busy:
            self._skills = self._skills or Skills(self._inner.briefing())
            request = self._skills.request(self.names[int(action)], snapshot.belief, loop.manipulator.held)
        return self._moves[0].copy() if request is None else request.action(self._macros)


class FlatBelief(gym.ObservationWrapper):
    """A belief (or the state) as one vector of numbers of about unit size, places as the robot sees them.

    Positions and regions are in the base frame and in units of 4 m, velocities turned into it; ages in units of 10 s,
    standard deviations in units of 5 cm and 0.2 rad, time as a share of the episode. Empty slots are zero.
    """

    def __init__(self, env: gym.Env, mode: str | None = None) -> None:
        """Wrap an environment.

        Args:
            env: one that observes ``belief`` or ``state``.
            mode: which of them, if it observes both.
        """
        super().__init__(env)
        inner = simtrack_env(env)
        usable = [name for name in inner.settings.modes if name in ("belief", "state")]
        self._mode = mode or (usable[0] if usable else "")
        if self._mode not in usable:
            raise UnknownNameError("observation mode that can be flattened", self._mode, usable or MODES[:2])
        self._nested, self._seconds = not isinstance(inner.settings.observation, str), inner.layout.seconds
        size = len(self.observation(_zeros(env.observation_space)))
        self.observation_space = gym.spaces.Box(-3.0, 3.0, (size,), np.float32)

    def observation(self, observation: Any) -> Float32:
        """The vector of an observation."""
        arrays = dict(observation[self._mode] if self._nested else observation)
        x, y, c, s = arrays["base"]
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        mask, here = arrays["mask"][:, None], np.array([x, y, 0.0])
        seen = arrays["regions_mask"][:, None]
        arrays["position"] = mask * ((arrays["position"] - here) @ R) / EGOCENTRIC
        arrays["velocity"] = np.concatenate([arrays["velocity"][:, :3] @ R, arrays["velocity"][:, 3:] @ R], axis=1)
        arrays["regions"] = seen * ((arrays["regions"] - here) @ R) / EGOCENTRIC
        variances = np.diagonal(arrays["covariance"], axis1=1, axis2=2)
        arrays["deviation"] = np.sqrt(np.maximum(variances, 0.0)) / np.array([0.05] * 3 + [0.2] * 3)
        arrays["base_deviation"] = arrays["base_deviation"] / np.array([0.05, 0.05, 0.2])
        arrays["age"], arrays["time"] = arrays["age"] / 10.0, arrays["time"] / self._seconds
        flat = np.concatenate([np.asarray(arrays[name], dtype=np.float32).ravel() for name in FLAT if name in arrays])
        return np.clip(flat, -3.0, 3.0)


def _zeros(space: gym.Space) -> Any:
    if isinstance(space, gym.spaces.Dict):
        return {name: _zeros(part) for name, part in space.items()}
    assert isinstance(space, gym.spaces.Box)
    return np.zeros(space.shape, space.dtype)


class Video(gym.Wrapper):
    """Writes a video of the robot at work with what it believes drawn over it; several episodes into one file."""

    def __init__(self, env: gym.Env, path: str | Path) -> None:
        """Wrap an environment; raises RenderingError if the file cannot be written.

        Args:
            env: any of simtrack's; its render mode does not matter.
            path: of the video, e.g. ``run.mp4``.
        """
        super().__init__(env)
        self._inner, self._path = simtrack_env(env), Path(path)
        self._view = self._writer = None
        self._return = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._return = 0.0
        self._write(info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Act, and write a frame."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._return += float(reward)
        self._write(info)
        return observation, reward, terminated, truncated, info

    def picture(self, info: Mapping[str, Any]) -> Uint8:
        """(480, 640, 3) picture of the present moment with what is believed."""
        from simtrack.envs.overlay import draw_belief, write_lines
        from simtrack.envs.view import INTRINSICS, View

        loop, snapshot = self._inner.loop, self._inner.snapshot
        if loop is None or snapshot is None:
            raise RenderingError("there is nothing to be seen before the first reset")
        if self._view is None:
            self._view = View(loop.simulation, self._inner.task.eye, self._inner.task.focus)
        picture = self._view.picture(snapshot.truth)
        pose = self._view.pose(snapshot.truth)
        picture = draw_belief(picture, INTRINSICS, pose, snapshot.belief, loop.simulation.models)
        figures = [f"{name} {value:.3g}" for name, value in info["metrics"].items()]
        write_lines(picture, [f"{snapshot.truth.stamp / 1e9:.1f} s   return {self._return:.2f}", "   ".join(figures)])
        return picture

    def _write(self, info: Mapping[str, Any]) -> None:
        import cv2

        picture = self.picture(info)
        if self._writer is None:
            code = cv2.VideoWriter.fourcc(*"mp4v")
            size = picture.shape[1], picture.shape[0]
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = cv2.VideoWriter(str(self._path), code, float(self._inner.metadata["render_fps"]), size)
            if not self._writer.isOpened():
                raise RenderingError(f"the video {self._path} cannot be written; try a name that ends with .mp4")
        self._writer.write(np.ascontiguousarray(picture[:, :, ::-1]))

    def close(self) -> None:
        """Finish the file and release the world."""
        if self._writer is not None:
            self._writer.release()
            self._writer = None
        super().close()


class Recorder(gym.Wrapper):
    """Writes what the sensors sent in each episode to an MCAP log of its own, with true poses for people who read it.

    Such a log can be replayed: ``simtrack replay episode-0000.mcap``.
    """

    def __init__(self, env: gym.Env, folder: str | Path, overwrite: bool = False) -> None:
        """Wrap an environment.

        Args:
            env: one that observes ``belief`` or ``rgbd``: else there are no sensors to listen to.
            folder: gets ``episode-0000.mcap`` and so on.
            overwrite: replace such files.
        """
        super().__init__(env)
        self._inner, self._folder, self._overwrite = simtrack_env(env), Path(folder), overwrite
        if "camera" not in self._inner.settings.sensors:
            raise InvalidValueError("observation", self._inner.settings.modes, "'belief' or 'rgbd' among the modes")
        self._episode, self._log = 0, None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, and a file."""
        from simtrack.recordings import McapWriter

        self._finish()
        observation, info = self.env.reset(seed=seed, options=options)
        loop = self._inner.loop
        assert loop is not None
        simulation = loop.simulation
        self._folder.mkdir(parents=True, exist_ok=True)
        self._log = McapWriter(
            self._folder / f"episode-{self._episode:04d}.mcap",
            static_map=simulation.static_map,
            models=simulation.models,
            robot=simulation.robot,
            metadata={
                "scene": simulation.scene.name, "seed": simulation.seed, "T_map_base": simulation.start.ravel().tolist()
            },
            overwrite=self._overwrite,
        )  # fmt: skip
        self._episode += 1
        self._write()
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Act, and write what the sensors sent."""
        outcome = self.env.step(action)
        self._write()
        return cast("tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]", outcome)

    def _write(self) -> None:
        snapshot, log = self._inner.snapshot, self._log
        if snapshot is None or log is None:
            return
        for entry in snapshot.feed:
            log.write(entry, snapshot.truth.stamp)
        truth = snapshot.truth
        poses = {name: thing.T_map_object for name, thing in truth.objects.items()}
        log.write_labels(truth.stamp, {"base": truth.T_map_base, **poses})

    def _finish(self) -> None:
        if self._log is not None:
            self._log.close()
            self._log = None

    def close(self) -> None:
        """Finish the file and release the world."""
        self._finish()
        super().close()
