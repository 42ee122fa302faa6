from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from simtrack.contracts import Relation
from simtrack.envs.environment import SimtrackEnv
from simtrack.envs.goals import Goals, parse_goal
from simtrack.errors import SimtrackError
from simtrack.geometry.transforms import transform

Make = Callable[..., SimtrackEnv]


def test_goals_are_words() -> None:
    assert parse_goal("relay in materialbox") == Relation("relay", "in", "materialbox")


@pytest.mark.parametrize(("text", "told"), [("relay in", "three words"), ("relay into box", "left-of")])
def test_other_words_are_refused(text: str, told: str) -> None:
    with pytest.raises(SimtrackError, match=told):
        parse_goal(text)


def test_goals_are_judged_by_where_things_truly_are_and_rest(make: Make) -> None:
    env = make()
    env.reset(seed=0)
    assert env.loop is not None and env.snapshot is not None
    world, truth = env.loop.simulation.world, env.snapshot.truth
    goals = Goals(world, [parse_goal(text) for text in ("relay in materialbox", "relay left-of materialbox")])
    box, relay = truth.objects["materialbox"], truth.objects["relay"]

    def holds(offset: tuple[float, float, float], speed: float = 0.0) -> list[bool]:
        T = box.T_map_object @ transform(np.eye(3), offset)
        moved = replace(relay, T_map_object=T, velocity=np.array([speed, 0, 0, 0, 0, 0]))
        return [s.holds for s in goals.states(replace(truth, objects={**truth.objects, "relay": moved}))]

    assert holds((0.0, 0.0, 0.02)) == [True, False]
    assert holds((0.0, 0.25, 0.0)) == [False, True]
    assert holds((0.0, -0.25, 0.0)) == [False, False]
    assert holds((0.0, 0.25, 0.0), speed=0.1) == [False, False]
    (on,) = Goals(world, [parse_goal("relay on workbench")]).states(truth)
    assert on.holds and not Goals(world, [parse_goal("relay on shelf")]).states(truth)[0].holds


@pytest.mark.parametrize(
    ("text", "told"),
    [("unicorn in materialbox", "relay"), ("relay in moon", "workbench"), ("relay left-of workbench", "furniture")],
)
def test_goals_name_what_there_is(make: Make, text: str, told: str) -> None:
    env = make()
    env.reset(seed=0)
    assert env.loop is not None
    with pytest.raises(SimtrackError, match=told):
        Goals(env.loop.simulation.world, [parse_goal(text)])
