import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from simtrack.contracts import Command
from simtrack.envs.actions import AXES, MOVES, Steering, vector

START = Command(head_tilt=-0.3, torso=0.2)
actions = st.lists(st.floats(-1.0, 1.0), min_size=5, max_size=5).map(lambda a: np.array(a, np.float32))


@given(st.lists(actions, max_size=30), actions)
def test_the_action_towards_a_command_leads_to_it(before: list[np.ndarray], action: np.ndarray) -> None:
    one, other = Steering(START, 0.1), Steering(START, 0.1)
    for earlier in before:
        one.apply(earlier)
        other.apply(earlier)
    wanted = one.apply(action)
    reached = other.apply(other.towards(wanted))
    for axis in ("linear", "angular", "head_pan", "head_tilt", "torso"):
        assert abs(getattr(reached, axis) - getattr(wanted, axis)) < 1e-6


@given(st.lists(actions, max_size=200))
def test_targets_stay_within_the_joints_limits(sequence: list[np.ndarray]) -> None:
    steering = Steering(START, 0.1)
    for action in sequence:
        command = steering.apply(action)
        assert -1.24 <= command.head_pan <= 1.24 and -0.98 <= command.head_tilt <= 0.72 and 0 <= command.torso <= 0.35
        assert abs(command.linear) <= AXES["linear"] and abs(command.angular) <= AXES["angular"]


def test_beyond_one_counts_as_one() -> None:
    assert Steering(START, 0.1).apply(np.full(5, 7.0, np.float32)) == Steering(START, 0.1).apply(np.ones(5, np.float32))


def test_reset_takes_back_every_move() -> None:
    steering = Steering(START, 0.1)
    steering.apply(np.ones(5, np.float32))
    steering.reset()
    assert steering.command == Command(head_tilt=-0.3, torso=0.2)


def test_discrete_moves_name_axes_and_differ() -> None:
    vectors = [vector(move) for move in MOVES.values()]
    assert all(set(move) <= set(AXES) for move in MOVES.values())
    assert len({v.tobytes() for v in vectors}) == len(MOVES) and max(np.abs(v).max() for v in vectors) <= 1.0
