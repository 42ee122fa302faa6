"""Gymnasium's contracts, executed."""

import gc
import hashlib
import json
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numba
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from simtrack.envs.environment import SimtrackEnv
from simtrack.errors import InvalidValueError, RenderingError, SimtrackError
from tests.envs.conftest import FEW

Make = Callable[..., SimtrackEnv]


@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("ActivePerception", "state"),
        ("ActivePerception", "rgbd"),
        ("ActivePerception", ["belief", "rgbd"]),
        ("Localize", "state"),
        ("Localize", ["belief", "rgbd"]),
        ("Tidy", ["state", "belief", "rgbd"]),
    ],
    ids=str,
)
def test_check_env_finds_nothing(make: Make, name: str, mode: Any) -> None:
    """Warnings are errors in these tests."""
    own = {"scene": None, "objects": None} if name == "Tidy" else {}  # its goals name more than those few
    env = make(name, observation=mode, render_mode="rgb_array", **own)
    check_env(env, skip_render_check=name == "Localize")


def fingerprint(env: SimtrackEnv, seed: int, steps: int) -> str:
    """Hash of all that an episode of random actions shows."""
    sha, rng = hashlib.sha256(), np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    for _ in range(steps):
        for mode in sorted(observation):
            part = observation[mode]
            for key in sorted(part):
                sha.update(np.asarray(part[key]).tobytes())
        sha.update(json.dumps(info["metrics"], sort_keys=True).encode())
        observation, reward, *_, info = env.step(rng.uniform(-1, 1, 5).astype(np.float32))
        sha.update(np.float64(reward).tobytes())
    return sha.hexdigest()


def test_a_step_keeps_to_one_thread_and_leaves_the_caller_his(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make(observation="belief")
    env.reset(seed=0)
    assert env.loop is not None
    advance, seen = env.loop.simulation.advance, []

    def watched(*arguments: Any, **named: Any) -> Any:
        seen.append(numba.get_num_threads())
        return advance(*arguments, **named)

    monkeypatch.setattr(env.loop.simulation, "advance", watched)
    before = numba.get_num_threads()
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    try:
        env.step(np.zeros(5, np.float32))
        assert seen == [1]
        assert numba.get_num_threads() == numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    finally:
        numba.set_num_threads(before)


MODES = ("state", "belief")


def test_one_seed_gives_one_episode_in_every_process_and_whatever_came_before(make: Make) -> None:
    code = (
        "import simtrack, gymnasium as gym\n"
        "from tests.envs.test_conventions import MODES, fingerprint\n"
        f"env = gym.make('simtrack/ActivePerception-v0', observation=MODES, objects={FEW!r}).unwrapped\n"
        "print(fingerprint(env, 7, 6)); env.close()"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    env = make(observation=MODES)
    assert fingerprint(env, 8, 3) != fingerprint(env, 7, 3)
    assert fingerprint(env, 7, 6) == other.stdout.split()[-1]


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vectors_of_environments(mode: str) -> None:
    context = {"context": "spawn"} if mode == "async" else {}
    arguments = {"observation": "state", "objects": FEW, "seconds": 0.4}
    envs = gym.make_vec(
        "simtrack/ActivePerception-v0", 2 if mode == "async" else 4, mode, vector_kwargs=context, **arguments
    )
    try:
        first, _ = envs.reset(seed=3)
        assert not np.array_equal(first["position"][0], first["position"][1])
        ended = 0
        for _ in range(6):
            observation, reward, terminated, truncated, _ = envs.step(np.zeros((envs.num_envs, 5), np.float32))
            assert observation in envs.observation_space and np.isfinite(reward).all()
            ended += int(np.count_nonzero(truncated | terminated))
        assert ended == envs.num_envs  # and went on with new episodes
    finally:
        envs.close()


def test_an_episode_is_forgotten_when_the_next_begins(make: Make) -> None:
    env = make(observation="belief")
    env.reset(seed=0)
    env.step(np.zeros(5, np.float32))
    assert env.loop is not None and env.loop.has_stack
    stack = weakref.ref(env.loop._stack)
    gc.disable()  # its scenes are large, and none of their memory is known to the collector
    try:
        env.reset(seed=1)
        assert stack() is None
    finally:
        gc.enable()


def test_closing_twice_leaves_no_thread(make: Make) -> None:
    before = threading.active_count()
    env = make(observation="rgbd", image_size=(16, 12))
    env.reset(seed=0)
    env.close()
    env.close()
    assert threading.active_count() <= before
    with pytest.raises(InvalidValueError, match="closed"):
        env.reset(seed=0)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"observation": "pixels"}, "state"),
        ({"observation": ["state", "state"]}, "each once"),
        ({"scene": "moon"}, "workbench"),
        ({"objects": ["unicorn"]}, "relay"),
        ({"objects": ["mug"]}, "relay"),
        ({"objects": []}, "one or more"),
        ({"detector": "yolo"}, "oracle"),
        ({"detector_errors": {"mis_rate": 0.1}}, "miss_rate"),
        ({"detector_errors": {"miss_rate": 2.0}}, "0 to 1"),
        ({"renderer": "vulkan"}, "embree"),
        ({"image_size": (4, 4)}, "pixels"),
        ({"seconds": 0.0}, "3600"),
        ({"lidar_columns": 3}, "1809"),
        ({"colour": True}, "image_size"),
        ({"task": "juggle"}, "localize"),
    ],
    ids=str,
)
def test_wrong_arguments_raise_when_made_and_name_the_valid_ones(make: Make, arguments: dict, told: str) -> None:
    with pytest.raises(SimtrackError, match=told):
        make(**arguments)


def test_a_window_needs_a_display(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    with pytest.raises(RenderingError, match="rgb_array"):
        SimtrackEnv("active-perception", "state", render_mode="human")
    assert make().metadata["render_modes"] == ["rgb_array"]


def test_wrong_actions_are_refused(make: Make) -> None:
    env = make()
    with pytest.raises(InvalidValueError, match="reset"):
        env.step(np.zeros(5, np.float32))
    env.reset(seed=0)
    for action in (np.zeros(4, np.float32), np.array([0, 0, np.nan, 0, 0], np.float32)):
        with pytest.raises(InvalidValueError, match="action"):
            env.step(action)
