"""``simtrack bench envs``: steps a second of the environments by observation mode, and what a step is spent on.

Then vectors of environments, in this process and in one each: whether their memory grows over a thousand steps.

A step is a tenth of a second: 50 steps of physics. CPU time counts, because machines are shared; means do, because
lidar and detector have their turn in every second step. Physics is the same simulation with all sensors off, sensing
what the sensors add to it, and the rest of a step is perception (the stack, or ideal perception), reward and arrays.
"""

import multiprocessing
import statistics
import time
from collections.abc import Sequence

import gymnasium as gym
import numpy as np

from simtrack.benchmarks.harness import Benchmark, Options, Timing, resident
from simtrack.benchmarks.yardstick import REFERENCE, scaled, yardstick
from simtrack.contracts import Float32
from simtrack.envs.loop import BUILDING_SEED, KEY, MEMORY, SCAN_KEY, SERVO
from simtrack.envs.policies import make_policy
from simtrack.envs.wrappers import simtrack_env
from simtrack.simulation.simulation import Simulation

ASKED = {"state": 150.0, "belief": 60.0, "rgbd": 80.0}
"""Steps a second on one core, of a machine on which the yardstick takes `REFERENCE`."""
WARM_UP = 30
"""Steps that do not count: kernels are loaded, objects are born."""
MEMBERS, MEMBER_STEPS, EVERY = 4, 1000, 20
"""Of a vector: environments, steps of each, and steps between looks at the memory."""


def run(options: Options) -> Benchmark:
    """Measure; see the module."""
    result = Benchmark("envs")
    steps = 30 if options.quick else 200
    pace = scaled(1.0, yardstick(options.say))
    names = ("ActivePerception",) if options.quick else ("ActivePerception", "Localize")
    for name in names:
        for mode, asked in ASKED.items():
            options.say(f"{name}, {mode}")
            _measure(result, f"simtrack/{name}-v0", name, mode, asked / pace, steps, options.seed)
    for mode in ("rgbd",) if options.quick else ("belief", "rgbd"):
        for kind in ("sync",) if options.quick else ("sync", "async"):
            options.say(f"{mode}, {MEMBERS} members, {kind}")
            _play_vector(result, mode, kind, 4 * EVERY if options.quick else MEMBER_STEPS, options.seed)
    result.notes.append(
        f"asked are {', '.join(f'{rate:g} ({mode})' for mode, rate in ASKED.items())} where the yardstick (embreex, "
        f"640x480 rays) takes {1e3 * REFERENCE:g} ms; here it took {1e3 * REFERENCE * pace:.0f} ms, and that much less "
        "is asked"
    )
    result.notes.append("actions are those of the scripted policy fed with what the mode shows, random ones for rgbd")
    return result


def _measure(result: Benchmark, env_id: str, name: str, mode: str, asked: float, steps: int, seed: int) -> None:
    env = gym.make(env_id, observation=mode, disable_env_checker=True)
    try:
        whole, actions = _play(env, mode, steps, seed)
        sensing = _simulate(env, actions, seed, on=True)
        physics = _simulate(env, actions, seed, on=False)
    finally:
        env.close()
    prefix = f"{name}, {mode}"
    result.add(
        f"{prefix}: steps a second", whole, 1.0 / whole.cpu, unit="1/s CPU", asked=asked, sense="at least",
        note=f"mean of {steps} steps",
    )  # fmt: skip
    result.add(f"{prefix}: physics", value=1e3 * physics, unit="ms CPU")
    result.add(f"{prefix}: sensors and rendering", value=1e3 * (sensing - physics), unit="ms CPU")
    result.add(f"{prefix}: perception, reward, arrays", value=1e3 * (whole.cpu - sensing), unit="ms CPU")


def _play(env: gym.Env, mode: str, steps: int, seed: int) -> tuple[Timing, list[Float32]]:
    """CPU and wall time of a step, and the actions that were taken; choosing them does not count."""
    inner = simtrack_env(env)
    observation, _ = env.reset(seed=seed)
    scripted = mode in ("belief", "state")
    policy = make_policy(
        "scripted" if scripted else "random", inner.task_name, inner.briefing(), len(inner.steering.towards(
            inner.steering.start)), mode if scripted else "belief",
    )  # fmt: skip
    policy.begin(np.random.default_rng(seed))
    cpu, wall, actions = [], [], []
    for _ in range(WARM_UP + steps):
        actions.append(policy.act(observation))
        started, clock = time.process_time(), time.perf_counter()
        observation, _, terminated, truncated, _ = env.step(actions[-1])
        cpu.append(time.process_time() - started)
        wall.append(time.perf_counter() - clock)
        if terminated or truncated:
            observation, _ = env.reset(seed=seed)
            policy.begin(np.random.default_rng(seed))
    return Timing(statistics.fmean(cpu[WARM_UP:]), statistics.fmean(wall[WARM_UP:]), steps), actions


def _play_vector(result: Benchmark, mode: str, kind: str, steps: int, seed: int) -> None:
    """Random actions in a vector of environments whose episodes end and begin anew; memory of all its processes."""
    context = {"context": "spawn"} if kind == "async" else {}
    before = {child.pid for child in multiprocessing.active_children()}
    envs = gym.make_vec("simtrack/ActivePerception-v0", MEMBERS, kind, vector_kwargs=context, observation=mode)
    try:
        envs.action_space.seed(seed)
        envs.reset(seed=seed)
        children = [child.pid for child in multiprocessing.active_children() if child.pid not in before]
        memory, started = [], time.perf_counter()
        for step in range(steps):
            envs.step(envs.action_space.sample())
            if step % EVERY == EVERY - 1:
                memory.append(sum(resident(process) for process in (None, *children)))
        wall = (time.perf_counter() - started) / (MEMBERS * steps)
    finally:
        envs.close()
    half = len(memory) // 2
    growth = statistics.median(memory[half:]) / statistics.median(memory[:half])
    name = f"{mode}, {MEMBERS} members, {kind}"
    result.add(f"{name}: memory, second half to first", value=growth, unit="x", asked=1.05, note=f"{steps} steps each")
    result.add(f"{name}: memory", value=memory[-1] / 1e9, unit="GB")
    result.add(f"{name}: steps a second of all", value=1.0 / wall, unit="1/s")


def _simulate(env: gym.Env, actions: Sequence[Float32], seed: int, on: bool) -> float:
    """Mean CPU seconds of the simulation alone under the same actions, its sensors on or off."""
    inner = simtrack_env(env)
    settings, steering = inner.settings, inner.steering
    sensors = settings.sensors if on else ()
    colours = on and "rgbd" in settings.modes
    steering.reset()
    times = []
    with Simulation(
        inner.scene, BUILDING_SEED, settings.renderer, settings.camera, settings.lidar,
        sensors=sensors, sleep=True, memory=MEMORY, proprioception=settings.proprioception,
        scan_key=SCAN_KEY, servo=SERVO, key=KEY, threads=False,
    ) as simulation:  # fmt: skip
        simulation.restart(seed)
        for action in actions:
            command = steering.apply(action)
            started = time.process_time()
            simulation.advance(command, want_rgb=colours)
            times.append(time.process_time() - started)
    return statistics.fmean(times[WARM_UP:])
