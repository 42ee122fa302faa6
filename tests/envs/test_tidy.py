"""Grasping and placing as part of an environment, and goals as a task."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simtrack.contracts import Relation
from simtrack.envs.actions import AXES, MACROS, WHERE, Outcome, Request, axes, request_of, vector
from simtrack.envs.environment import SimtrackEnv
from simtrack.envs.observations import OUTCOMES
from simtrack.envs.play import play
from simtrack.envs.task import Moment
from simtrack.envs.tasks.tidy import Tidy
from simtrack.envs.truth import true_belief
from simtrack.envs.wrappers import DiscreteActions, FlatBelief, simtrack_env
from simtrack.errors import SimtrackError
from simtrack.geometry.transforms import apply, inverse

Make = Callable[..., SimtrackEnv]
OWN: dict[str, Any] = {"scene": None, "objects": None, "seconds": None}
ONE_GOAL = "relay in materialbox"


@pytest.fixture(scope="module")
def tidy() -> Iterator[SimtrackEnv]:
    """A table to be tidied, with one goal; the tests reset it."""
    env = gym.make("simtrack/Tidy-v0", observation="state", task=Tidy((ONE_GOAL,)), disable_env_checker=True)
    yield simtrack_env(env)
    env.close()


@given(
    st.sampled_from(MACROS),
    st.tuples(*(st.floats(low, high) for low, high in WHERE.values())),
)
def test_the_action_of_a_request_asks_for_it(macro: str, where: tuple[float, ...]) -> None:
    action = Request(macro, np.array(where[:3]), where[3]).action(MACROS)
    assert action.shape == (len(axes(MACROS)),) and not action[: len(AXES)].any() and np.abs(action).max() <= 1.0
    asked = request_of(action, MACROS)
    assert asked is not None and asked.macro == macro
    np.testing.assert_allclose(asked.position, where[:3], atol=1e-5)
    assert abs(np.exp(1j * asked.heading) - np.exp(1j * where[3])) < 1e-5


def test_nothing_is_asked_for_below_the_trigger_and_the_strongest_wish_wins() -> None:
    assert request_of(vector({"grasp": 0.4, "place": 0.5}, MACROS), MACROS) is None
    asked = request_of(vector({"grasp": 0.8, "place": 0.9}, MACROS), MACROS)
    assert asked is not None and asked.macro == "place"


def at(env: SimtrackEnv, name: str) -> np.ndarray:
    """(3,) place of an object in the base frame."""
    assert env.snapshot is not None
    truth = env.snapshot.truth
    return apply(inverse(truth.T_map_base), truth.objects[name].T_map_object[None, :3, 3])[0]


def outcome(env: SimtrackEnv, request: Request | None, steps: int = 1) -> Outcome:
    action = vector({}, Tidy.macros) if request is None else request.action(Tidy.macros)
    observation: Any = {}
    for _ in range(steps):
        observation = env.step(action)[0]
        action = vector({}, Tidy.macros)
    return OUTCOMES[int(np.argmax(observation["macro"]))]


def test_what_cannot_be_done_is_told_at_once(tidy: SimtrackEnv) -> None:
    tidy.reset(seed=1)
    relay = at(tidy, "relay")
    assert outcome(tidy, None) is Outcome.IDLE
    assert outcome(tidy, Request("place", relay)) is Outcome.EMPTY
    assert outcome(tidy, Request("grasp", relay + (0.0, 0.0, 0.3))) is Outcome.UNKNOWN
    assert outcome(tidy, Request("grasp", at(tidy, "screwdriver"))) is Outcome.OUT_OF_REACH
    before = tidy.steering.command
    assert outcome(tidy, Request("grasp", relay)) is Outcome.BUSY
    drive = vector({"linear": 1.0, "torso": -1.0, "pan": 0.5}, Tidy.macros)
    tidy.step(drive)
    after = tidy.steering.command
    assert (after.linear, after.torso) == (0.0, before.torso) and after.head_pan > before.head_pan


def test_named_things_are_grasped_and_put_where_they_belong(tidy: SimtrackEnv) -> None:
    env = DiscreteActions(tidy)
    flat = FlatBelief(tidy)
    observation, info = env.reset(seed=1)
    assert {"grasp relay", "put in materialbox", "put left-of screwdriver"} < set(env.names)
    rewards = []
    for skill in ("grasp relay", "put in materialbox"):
        *_, info = env.step(env.names.index(skill))
        for _ in range(200):
            observation, reward, terminated, _, info = env.step(env.names.index("stay"))
            rewards.append(float(reward))
            if terminated or observation["macro"][OUTCOMES.index(Outcome.BUSY)] == 0:
                break
        if skill == "grasp relay":
            assert observation["holding"].tolist() == [name == "relay" for name in tidy.layout.classes]
            assert flat.observation(observation) in flat.observation_space and not info["success"]
    assert info["success"] and info["metrics"]["goals"] == 1.0 and max(rewards) > 0.5


def test_the_script_turns_and_tidies_by_what_it_believes(make: Make) -> None:
    env = make("Tidy", task=Tidy(("multimeter left-of screwdriver",)), **OWN)
    (result,) = play(env, "scripted", [3], "state")
    assert result.success and result.steps < 400, result


def test_goals_are_rewarded_by_how_near_they_are(tidy: SimtrackEnv) -> None:
    tidy.reset(seed=1)
    assert tidy.loop is not None and tidy.snapshot is not None
    truth, task = tidy.snapshot.truth, tidy.task
    box, relay = truth.objects["materialbox"], truth.objects["relay"]

    def moment(offset: tuple[float, float, float], holding: str | None = None) -> Moment:
        T = box.T_map_object.copy()
        T[:3, 3] += offset
        moved = replace(truth, objects={**truth.objects, "relay": replace(relay, T_map_object=T, velocity=np.zeros(6))})
        return Moment(0.0, moved, true_belief(moved), holding)

    task.begin(tidy.loop.simulation, np.random.default_rng(0))
    far, near, held, done = (
        task.score(m)
        for m in (moment((0.0, 0.0, 0.2)), moment((0.0, 0.0, 0.15)), moment((0.0, 0.0, 0.02), "relay"),
                  moment((0.0, 0.0, 0.02)))
    )  # fmt: skip
    assert far.reward < near.reward < held.reward and near.reward == pytest.approx(0.05 - task.haste, abs=1e-6)  # type: ignore[attr-defined]
    assert not held.success and done.success and done.terminated


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"scene": "workbench"}, "suction"),
        ({"task": Tidy(("unicorn in materialbox",))}, "relay"),
        ({"task": Tidy(("relay in shelf",))}, "materialbox"),
        ({"objects": ["relay"]}, "object of the scene"),
    ],
    ids=["no cup", "unknown subject", "unknown reference", "missing object"],
)
def test_tasks_that_a_scene_does_not_allow_raise_when_made(make: Make, arguments: dict[str, Any], told: str) -> None:
    with pytest.raises(SimtrackError, match=told):
        make("Tidy", **{**OWN, **arguments})


def test_the_agent_is_told_the_goals_by_class(tidy: SimtrackEnv) -> None:
    assert tidy.briefing().goals == (Relation("relay", "in", "materialbox"),)
