"""Steps a second of two well-known environments, beside `simtrack bench envs`: ``python env_peers.py kitchen|lift``.

They need an older MuJoCo than simtrack, so each has a virtual environment of its own:

    python -m venv kitchen && kitchen/bin/pip install gymnasium-robotics==1.4.2 mujoco==3.2.7
    python -m venv lift && lift/bin/pip install robosuite==1.5.2
    lift/bin/pip uninstall -y mujoco mujoco-core mujoco-studio && lift/bin/pip install --no-deps mujoco==3.2.7
    kitchen/bin/python env_peers.py kitchen
    MUJOCO_GL=egl lift/bin/python env_peers.py lift

Like there, CPU time of all threads counts, the mean of some hundred steps with random actions, and physics has 2 ms.
"""

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np

WARM_UP, STEPS = 30, 300


def kitchen() -> tuple[str, Callable[[], object]]:
    """FrankaKitchen of Gymnasium-Robotics, observed as it is: 40 steps of physics, 0.08 s, a step."""
    import gymnasium
    import gymnasium_robotics  # pyright: ignore[reportMissingImports] - see above

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make("FrankaKitchen-v1", tasks_to_complete=["microwave"], disable_env_checker=True)
    env.reset(seed=0)
    env.action_space.seed(0)

    def step() -> None:
        *_, over, cut, _ = env.step(env.action_space.sample())
        if over or cut:
            env.reset()

    return f"FrankaKitchen-v1, state (gymnasium-robotics {version('gymnasium-robotics')})", step


def lift() -> tuple[str, Callable[[], object]]:
    """Lift of robosuite, colour and depth images of 84x84 pixels, at 10 Hz: 50 steps of physics a step."""
    os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp()  # from a cache, its kernels are five times as slow
    import robosuite  # pyright: ignore[reportMissingImports] - see above

    env: Any = robosuite.make(
        "Lift", robots="Panda", use_camera_obs=True, camera_names="agentview", camera_heights=84, camera_widths=84,
        camera_depths=True, has_renderer=False, has_offscreen_renderer=True, control_freq=10, horizon=100_000,
    )  # fmt: skip
    env.reset()
    low, high = env.action_spec
    rng = np.random.default_rng(0)
    return f"Lift, rgbd 84x84 (robosuite {version('robosuite')})", lambda: env.step(rng.uniform(low, high))


def main() -> None:
    """Measure the one that is named."""
    environments = {"kitchen": kitchen, "lift": lift}
    if len(sys.argv) != 2 or sys.argv[1] not in environments:
        raise SystemExit("usage: env_peers.py kitchen|lift")
    name, step = environments[sys.argv[1]]()
    seconds = []
    for _ in range(WARM_UP + STEPS):
        started = time.process_time()
        step()
        seconds.append(time.process_time() - started)
    mean = statistics.fmean(seconds[WARM_UP:])
    print(f"{name}, mujoco {version('mujoco')}: {1.0 / mean:.0f} steps a second, {1e3 * mean:.2f} ms CPU each")


if __name__ == "__main__":
    main()
