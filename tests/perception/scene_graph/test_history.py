"""The set of relations that hold is a view of the history, and a set like any other."""

import pickle
from collections.abc import Hashable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import Relation
from simtrack.perception.scene_graph.history import History, RelationSet, about

NAMES = ("a", "b", "c")
relations = st.builds(Relation, st.sampled_from(NAMES), st.sampled_from(["on", "near"]), st.sampled_from(NAMES))
changes = st.lists(st.tuples(relations, st.booleans()), max_size=6)


@settings(max_examples=80)
@given(st.lists(changes, min_size=1, max_size=8))
def test_what_held_stays_as_it_was_while_the_history_goes_on(updates: list[list[tuple[Relation, bool]]]) -> None:
    history, held = History(), set[Relation]()
    taken: list[tuple[RelationSet, frozenset[Relation]]] = [(history.current, frozenset())]
    for stamp, update in enumerate(updates, start=1):
        for relation, begins in update:
            if begins:
                history.begin(stamp, relation)
                held.add(relation)
            else:
                history.end(stamp, relation)
                held.discard(relation)
        taken.append((history.current, frozenset(held)))
    for current, expected in taken:
        assert current == expected
        assert expected == current
        assert set(current) == expected
        assert len(current) == len(expected)
        for name in NAMES:
            assert set(about(current, name)) == set(about(expected, name)) == {r for r in expected if r.subject == name}
        assert all((Relation(s, name, r) in current) == (Relation(s, name, r) in expected)
                   for s in NAMES for name in ("on", "near") for r in NAMES)  # fmt: skip


def test_it_combines_with_other_sets() -> None:
    history = History()
    first, second, third = (Relation("a", "on", name) for name in ("b", "c", "d"))
    history.begin(1, first)
    history.begin(1, second)
    current = history.current
    assert current & {first, third} == {first} == {first, third} & current
    assert current | {third} == {first, second, third} == frozenset({third}) | current
    assert current - {first} == {second}
    assert {first} <= current <= {first, second, third}
    assert {first} < current
    assert current.isdisjoint({third})
    assert isinstance(current & {first}, frozenset)
    assert current != {first, third}
    assert "a" not in current
    assert not isinstance(current, Hashable)
    assert pickle.loads(pickle.dumps(current)) == current


@pytest.mark.parametrize("stamps", [(3, 5), (3, 3)])
def test_the_past_is_asked_by_its_stamp(stamps: tuple[int, int]) -> None:
    history, relation = History(), Relation("a", "near", "b")
    history.begin(stamps[0], relation)
    history.end(stamps[1], relation)
    for stamp in np.arange(0, 8).tolist():
        held = stamps[0] <= stamp < stamps[1]
        assert history.held(relation, stamp) == held
        assert history.at(stamp) == ({relation} if held else set())
