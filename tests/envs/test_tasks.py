"""Rewards and worlds: what the tasks make of truth and belief."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from simtrack.contracts import Command, Odometry
from simtrack.envs.environment import SimtrackEnv
from simtrack.envs.task import Moment, Score, Task
from simtrack.envs.tasks import make_task
from simtrack.envs.truth import true_belief
from simtrack.errors import FileFormatError, InvalidValueError, UnknownNameError
from simtrack.geometry.transforms import difference, inverse

Make = Callable[..., SimtrackEnv]
STILL = np.zeros(5, np.float32)


class Stay(Task):
    """Somebody's own task."""

    scene, seconds = "workbench", 1.0

    def score(self, moment: Moment) -> Score:
        return Score(1.0, True, terminated=moment.seconds > 0.25)


def test_a_task_of_ones_own(make: Make) -> None:
    env = make(task=Stay(), seconds=None)
    env.reset(seed=0)
    ends = [env.step(STILL)[1:4] for _ in range(3)]
    assert ends == [(1.0, False, False), (1.0, False, False), (1.0, True, False)]


def test_what_cannot_be_played_is_drawn_again_but_not_for_ever(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    env, answers = make(seconds=0.2), iter([False, True])
    monkeypatch.setattr(env.task, "playable", lambda simulation: next(answers))
    env.reset(seed=1)
    assert next(answers, None) is None
    monkeypatch.setattr(env.task, "playable", lambda simulation: False)
    with pytest.raises(FileFormatError, match="can be played"):
        env.reset(seed=1)


def test_tasks_by_name_and_by_path() -> None:
    assert type(make_task("tests.envs.test_tasks:Stay")).__name__ == "Stay"
    with pytest.raises(UnknownNameError, match="localize"):
        make_task("tests.envs.test_tasks:Nothing")
    with pytest.raises(InvalidValueError, match="Task"):
        make_task("collections:OrderedDict")


def test_knowing_more_is_rewarded_by_what_the_error_drops(make: Make) -> None:
    env = make()
    env.reset(seed=1)
    task, snapshot = env.task, env.snapshot
    assert snapshot is not None and env.loop is not None
    truth, all_known = snapshot.truth, true_belief(snapshot.truth)
    first = all_known.tracks[0]
    T = first.T_map_object.copy()
    T[0, 3] += 0.05
    off = replace(first, T_map_object=T, T_camera_object=inverse(truth.T_map_camera) @ T)
    beliefs = [
        replace(all_known, tracks=()), replace(all_known, tracks=(off,)), replace(all_known, tracks=(first,)), all_known
    ]  # fmt: skip
    task.begin(env.loop.simulation, np.random.default_rng(0))
    scores = [task.score(Moment(0.1 * k, truth, belief)) for k, belief in enumerate(beliefs)]
    errors = [score.metrics["error"] for score in scores]
    np.testing.assert_allclose(errors, [1.0, 0.75, 0.5, 0.0], atol=1e-9)
    np.testing.assert_allclose([s.metrics["known"] for s in scores], [0.0, 0.0, 0.5, 1.0])
    drops = [s.reward - 0.1 * s.metrics["known"] for s in scores]
    np.testing.assert_allclose(drops, [0.0, 0.25, 0.25, 0.5], atol=1e-9)


def test_ideal_perception_remembers_what_it_saw_and_nothing_else(make: Make) -> None:
    env = make()
    env.reset(seed=2)
    looking = env.snapshot
    assert looking is not None
    names = {track.class_name for track in looking.belief.tracks}
    assert names == {"materialbox", "relay"}
    away = np.array([0.0, 0.0, 0.0, 1.0, 0.0], np.float32)  # up, to where there is nothing
    for _ in range(8):
        env.step(away)
    after = env.snapshot
    assert after is not None
    kept = {track.class_name: track for track in after.belief.tracks}
    assert set(kept) == names and not any(track.visible_fraction for track in kept.values())
    for old in looking.belief.tracks:
        np.testing.assert_array_equal(kept[old.class_name].T_map_object, old.T_map_object)


def test_wheels_do_not_feel_that_the_robot_is_carried(make: Make) -> None:
    env = make("Localize", observation="state")
    env.reset(seed=0)
    assert env.loop is not None
    simulation = env.loop.simulation
    before = [f for f in simulation.advance(Command()) if isinstance(f, Odometry)][-1]
    x, y, yaw = simulation.world.controller.base(simulation.world.data.qpos)
    simulation.carry_robot(x + 0.4, y - 0.2, yaw + 1.0)
    after = [f for f in simulation.advance(Command()) if isinstance(f, Odometry)][-1]
    assert np.abs(difference(after.T_odom_base, before.T_odom_base)).max() < 2e-3
    moved = simulation.truth.at(simulation.now).T_map_base
    np.testing.assert_allclose(moved[:2, 3], [x + 0.4, y - 0.2], atol=1e-3)


def test_localize_counts_what_is_claimed_and_excuses_the_moment_of_the_kidnapping(make: Make) -> None:
    env = make("Localize", observation="state")
    env.reset(seed=0)
    task, snapshot = env.task, env.snapshot
    assert snapshot is not None and env.loop is not None
    truth, right = snapshot.truth, snapshot.belief
    T = truth.T_map_base.copy()
    T[0, 3] += 1.0
    wrong = replace(right, localization=replace(right.localization, T_map_base=T))
    task.begin(env.loop.simulation, np.random.default_rng(0))
    assert task.score(Moment(0.0, truth, right)).metrics["ate"] == 0.0
    task.act(env.loop.simulation, 1e6)
    excused = task.score(Moment(1e6 + 0.5, truth, wrong))
    assert excused.reward == 0.0 and excused.metrics["ate"] == 0.0 and excused.metrics["translation_error"] == 1.0
    claimed = task.score(Moment(1e6 + 1.5, truth, wrong))
    assert claimed.reward < 0.0 and claimed.metrics["ate"] == pytest.approx(np.sqrt(0.5)) and not claimed.success
