"""A kitchen of a few boxes: doors open by what the arm does, and the task judges by what is the case."""

from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from simtrack.contracts import Float64
from simtrack.envs.actions import Outcome, Request
from simtrack.envs.environment import SimtrackEnv
from simtrack.envs.wrappers import simtrack_env
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import apply, inverse
from simtrack.simulation.mjcf_world import mjcf_building
from simtrack.simulation.scene_file import load_scene


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> str:
    a, b = np.array(low), np.array(high)
    pos, size = " ".join(map(str, (a + b) / 2)), " ".join(map(str, (b - a) / 2))
    return f'<geom type="box" pos="{pos}" size="{size}" contype="1" conaffinity="2" group="2"/>'


def case(low: tuple[float, float, float], high: tuple[float, float, float], board: float, wall: float = 0.02) -> str:
    """A case that is open towards -x, with a board."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return "".join(
        [
            box((x0, y0, z0), (x1, y0 + wall, z1)), box((x0, y1 - wall, z0), (x1, y1, z1)),
            box((x1 - wall, y0, z0), (x1, y1, z1)), box((x0, y0, z1 - wall), (x1, y1, z1)),
            box((x0, y0, board - 0.02), (x1, y1, board)),
        ]
    )  # fmt: skip


def door(name: str, y: tuple[float, float], z: tuple[float, float]) -> str:
    leaf = box((-0.025, y[0] - y[1], z[0]), (-0.003, 0.0, z[1]))
    return (
        f'<body name="{name}/door" pos="0 {y[1]} 0"><inertial mass="4" pos="0 -0.25 1" diaginertia="0.1 0.1 0.1"/>'
        f'<joint name="{name}/hinge" axis="0 0 -1" pos="-0.003 0 0" range="0 1.75" damping="0.3" frictionloss="0.5"/>'
        f"{leaf}</body>"
    )


KITCHEN = f"""<mujoco><compiler angle="radian"/><worldbody>
<body name="floor">{box((-2.5, -1.5, -0.1), (1.0, 3.0, 0.0))}</body>
<body name="fridge1">{case((0.0, -0.3, 0.0), (0.5, 0.3, 1.4), 0.88)}{door("fridge1", (-0.3, 0.3), (0.1, 1.4))}</body>
<body name="microwave1">{case((0.0, 1.2, 0.86), (0.4, 1.7, 1.2), 0.93)}
{box((0.0, 1.0, 0.0), (0.5, 1.9, 0.86))}{door("microwave1", (1.2, 1.7), (0.93, 1.2))}</body>
</worldbody><custom><text name="class:floor" data="floor"/><text name="class:fridge1" data="fridge"/>
<text name="class:microwave1" data="microwave"/><text name="class:fridge1/door" data="fridge"/>
<text name="class:microwave1/door" data="microwave"/></custom></mujoco>"""


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("kitchen") / "scene.xml"
    path.write_text(KITCHEN)
    return path


@pytest.fixture(scope="module")
def env(kitchen: Path) -> Iterator[SimtrackEnv]:
    made = gym.make(
        "simtrack/FetchMeal-v0", scene=str(kitchen), observation="state", render_mode="rgb_array", seconds=60
    )
    yield simtrack_env(made)
    made.close()


def stand(env: SimtrackEnv, x: float, y: float) -> None:
    """Put the robot there, looking along x."""
    assert env.loop is not None
    env.loop.simulation.carry_robot(x, y, 0.0)
    for _ in range(3):
        env.step(np.zeros(env.action_space.shape or (0,), np.float32))


def ask(env: SimtrackEnv, request: Request) -> tuple[Outcome, float]:
    """Until the arm is done; how it fared, and the rewards meanwhile."""
    _, reward, *_ = env.step(request.action(env.task.macros))
    while env.snapshot is not None and env.snapshot.felt.macro is Outcome.BUSY:
        reward += env.step(np.zeros(env.action_space.shape or (0,), np.float32))[1]
    assert env.snapshot is not None
    return env.snapshot.felt.macro, reward


def in_base(env: SimtrackEnv, place: Float64) -> Float64:
    assert env.snapshot is not None
    return apply(inverse(env.snapshot.truth.T_map_base), place[None])[0]


def test_doors_are_no_part_of_the_building_but_have_joints(kitchen: Path) -> None:
    world = mjcf_building(load_scene(kitchen))
    assert [moving.part.name for moving in world.moving] == ["fridge1/door", "microwave1/door"]
    assert not {"fridge1/door", "microwave1/door"} & {part.name for part in world.parts}
    fridge = world.moving[0]
    np.testing.assert_allclose(fridge.axis, (0.0, 0.0, -1.0), atol=1e-9)
    np.testing.assert_allclose(fridge.anchor[:2], (-0.003, 0.3), atol=1e-9)
    assert (fridge.lower, fridge.upper) == (0.0, 1.75)


def test_check_env_finds_nothing(env: SimtrackEnv) -> None:
    check_env(env, skip_render_check=True)


@pytest.mark.slow
def test_check_env_finds_nothing_in_what_is_believed_and_seen(kitchen: Path) -> None:
    made = gym.make(
        "simtrack/FetchMeal-v0", scene=str(kitchen), observation=("belief", "rgbd"), render_mode="rgb_array", seconds=60
    )
    with made:
        check_env(simtrack_env(made))


def test_the_arm_opens_the_fridge_and_takes_the_item_through_physics(env: SimtrackEnv) -> None:
    env.reset(seed=3)
    stand(env, -0.8, 0.0)
    assert env.snapshot is not None
    outcome, reward = ask(env, Request("articulate", in_base(env, np.array([-0.02, -0.2, 0.95])), 1.4))
    assert outcome is Outcome.DONE and reward == 1.0
    assert abs(env.snapshot.truth.joints["fridge1/door"] - 1.4) < 0.15
    assert env.snapshot.truth.joints["microwave1/door"] == pytest.approx(0.0, abs=1e-3)
    item = env.snapshot.truth.objects["relay"].T_map_object[:3, 3]
    stand(env, item[0] - 0.9, item[1])
    outcome, reward = ask(env, Request("take", in_base(env, item)))
    assert outcome is Outcome.DONE and reward == 1.0 and env.snapshot.holding == "relay"
    assert env.snapshot.truth.objects["relay"].T_map_object[2, 3] > item[2] + 0.01


def test_what_an_episode_held_to_its_end_settles_in_the_next_like_other_things(
    env: SimtrackEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    env.reset(seed=3)
    assert env.loop is not None
    simulation = env.loop.simulation
    policy, restart, seen = simulation.world.model.tree_sleep_policy, simulation.restart, list[list[int]]()
    usual = policy.tolist()
    stand(env, -0.8, 0.0)
    env.step(Request("articulate", in_base(env, np.array([-0.02, -0.2, 0.95])), 1.4).action(env.task.macros))
    while env.snapshot is not None and env.snapshot.holding is None:
        assert env.snapshot.felt.macro is Outcome.BUSY
        env.step(np.zeros(env.action_space.shape or (0,), np.float32))
    assert policy.tolist() != usual
    monkeypatch.setattr(simulation, "restart", lambda seed: (seen.append(policy.tolist()), restart(seed)))
    env.reset(seed=3)
    assert seen and all(each == usual for each in seen)


def test_nothing_moves_where_no_door_is_believed_to_be(env: SimtrackEnv) -> None:
    env.reset(seed=4)
    stand(env, -1.2, -0.8)
    outcome, _ = ask(env, Request("articulate", np.array([0.5, 0.0, 0.9]), 1.0))
    assert outcome is Outcome.UNKNOWN
    outcome, _ = ask(env, Request("insert", np.array([0.7, 0.0, 0.9])))
    assert outcome is Outcome.EMPTY


def test_scenes_without_a_fridge_are_refused_by_name() -> None:
    with pytest.raises(InvalidValueError, match="a kitchen"):
        gym.make("simtrack/FetchMeal-v0", scene="workbench")
