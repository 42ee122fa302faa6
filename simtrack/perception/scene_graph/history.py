"""When which relation held."""

from collections.abc import Iterable, Iterator, Mapping, Set
from typing import Any, NamedTuple

from simtrack.contracts import Relation


class Interval(NamedTuple):
    """Time during which a relation held: half-open, ``begin <= stamp < end``."""

    begin: int
    """Nanoseconds: stamp of the first update in which the relation held."""
    end: int | None
    """Nanoseconds: stamp of the first update in which it held no more; None while it holds."""

    def covers(self, stamp: int) -> bool:
        """Whether the relation held at `stamp`, nanoseconds."""
        return self.begin <= stamp and (self.end is None or stamp < self.end)


class Event(NamedTuple):
    """A relation that began or ceased to hold."""

    stamp: int
    relation: Relation
    begins: bool


class RelationSet(Set[Relation]):
    """The relations that held at one time: a set that looks into the history and copies nothing.

    It stays as it is while the history goes on. Membership and size cost next to nothing, whatever the number of
    relations; only who iterates pays for all of them. Combined with other sets it gives a `frozenset`.
    """

    __slots__ = ("_history", "_size", "_stamp")

    def __init__(self, history: "History", stamp: int, size: int) -> None:
        self._history = history
        self._stamp = stamp
        self._size = size

    def __contains__(self, relation: object) -> bool:
        return isinstance(relation, Relation) and self._history.held(relation, self._stamp)

    def __iter__(self) -> Iterator[Relation]:
        return iter(self._history.at(self._stamp))

    def __len__(self) -> int:
        return self._size

    def about(self, subject: str) -> list[Relation]:
        """Those of one subject; takes as long as it has ever had relations, however many others there are."""
        history, stamp = self._history, self._stamp
        return [relation for relation in history.ever_about(subject) if history.held(relation, stamp)]

    def __repr__(self) -> str:
        return f"<{self._size} relations at {self._stamp} ns>"

    def __reduce__(self) -> tuple[Any, ...]:
        return frozenset, (tuple(self),)

    @classmethod
    def _from_iterable(cls, relations: Iterable[Any]) -> frozenset[Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return frozenset(relations)


class History:
    """For each relation its intervals, in order and disjoint, and all changes in order of time."""

    def __init__(self, intervals: Mapping[Relation, Iterable[Interval]] | None = None) -> None:
        self._intervals: dict[Relation, list[Interval]] = {}
        self._about: dict[str, dict[Relation, None]] = {}
        """Subject -> what has ever held of it, in the order in which it began."""
        self._current: set[Relation] = set()
        self._frozen: frozenset[Relation] | None = None
        self.events: list[Event] = []
        for relation, spans in (intervals or {}).items():
            self._intervals[relation] = list(spans)
            self._about.setdefault(relation.subject, {})[relation] = None
            for begin, end in self._intervals[relation]:
                self.events.append(Event(begin, relation, True))
                if end is None:
                    self._current.add(relation)
                else:
                    self.events.append(Event(end, relation, False))
        self.events.sort(key=lambda event: event.stamp)

    @property
    def current(self) -> RelationSet:
        """Relations that hold now; not changed by what begins or ends at a later stamp."""
        return RelationSet(self, self._last, len(self._current))

    @property
    def _last(self) -> int:
        return self.events[-1].stamp if self.events else -1

    def begin(self, stamp: int, relation: Relation) -> None:
        """Note that a relation holds from `stamp`, nanoseconds; no effect if it holds already.

        One that ended at the same stamp did not end.
        """
        if relation in self._current:
            return
        self._current.add(relation)
        self._frozen = None
        spans = self._intervals.setdefault(relation, [])
        self._about.setdefault(relation.subject, {})[relation] = None
        if spans and spans[-1].end == stamp:
            spans[-1] = Interval(spans[-1].begin, None)
            self._forget(Event(stamp, relation, False))
        else:
            spans.append(Interval(stamp, None))
            self.events.append(Event(stamp, relation, True))

    def end(self, stamp: int, relation: Relation) -> None:
        """Note that a relation holds no more from `stamp`, nanoseconds; no effect if it does not hold.

        One that began at the same stamp did not begin.
        """
        if relation not in self._current:
            return
        self._current.remove(relation)
        self._frozen = None
        spans = self._intervals[relation]
        begin = spans.pop().begin
        if begin == stamp:
            self._forget(Event(stamp, relation, True))
        else:
            spans.append(Interval(begin, stamp))
            self.events.append(Event(stamp, relation, False))
        if not spans:
            del self._intervals[relation], self._about[relation.subject][relation]

    def _forget(self, event: Event) -> None:
        """Strike out an event of the present stamp, one of the last."""
        for index in range(len(self.events) - 1, -1, -1):
            if self.events[index] == event:
                del self.events[index]
                return

    def intervals(self, relation: Relation) -> tuple[Interval, ...]:
        """Intervals during which a relation held, earliest first; empty if it never did."""
        return tuple(self._intervals.get(relation, ()))

    def ever_about(self, subject: str) -> Iterable[Relation]:
        """What has held of a subject at any time."""
        return self._about.get(subject, ())

    def held(self, relation: Relation, stamp: int) -> bool:
        """Whether a relation held at `stamp`, nanoseconds."""
        if stamp >= self._last:  # what has ended ended before, and what holds began before
            return relation in self._current
        return any(span.covers(stamp) for span in reversed(self._intervals.get(relation, ())))

    def at(self, stamp: int) -> frozenset[Relation]:
        """Relations that held at `stamp`, nanoseconds."""
        if stamp >= self._last:
            if self._frozen is None:
                self._frozen = frozenset(self._current)
            return self._frozen
        return frozenset(r for r, spans in self._intervals.items() if any(span.covers(stamp) for span in spans))

    def __iter__(self) -> Iterator[tuple[Relation, tuple[Interval, ...]]]:
        return ((relation, tuple(spans)) for relation, spans in self._intervals.items())

    def __len__(self) -> int:
        return len(self._intervals)


def about(relations: Set[Relation], subject: str) -> list[Relation]:
    """Those of some relations that have a subject; fast for what a history tells."""
    if isinstance(relations, RelationSet):
        return relations.about(subject)
    return [relation for relation in relations if relation.subject == subject]
