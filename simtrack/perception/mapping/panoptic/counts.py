"""What was observed of global segments: Phi(l, c, p) of the reconstruction paper, and what follows from it.

`JointCounts` counts semantic class c and instance p of a segment l together (sections 3.2 to 3.4). `SeparateCounts` is
what the paper compares with: Phi(l, c) and Phi(l, p) by themselves, as in Voxblox++ (Grinvald et al., RA-L 2019).
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Protocol

import numpy as np

from simtrack.contracts import Int32
from simtrack.perception.mapping.panoptic.shell import OnShell

BACKGROUND = ""
"""Class of what no panoptic segment covers."""
NOBODY = 0
"""Instance of the background."""


@dataclass(frozen=True, slots=True)
class Observation:
    """One panoptic segment of a frame, or one piece of background, on the global segments that it lies on."""

    semantic_class: str
    labels: tuple[int, ...]
    """Global segments l, the largest first."""


@dataclass(frozen=True, slots=True)
class SegmentEntity:
    """What a global segment is part of."""

    semantic_class: str
    instance: int
    agreeing: int
    """Observations of the segment that say so ..."""
    observed: int
    """... of so many."""


class PanopticCounts(Protocol):
    """Keeps and interprets counts."""

    def observe(self, observations: Sequence[Observation]) -> None:
        """Find the instances that the things of a frame are, and count."""
        ...

    def merge(self, label: int, into: int) -> None:
        """Two global segments are one."""
        ...

    def alike(self, label: int, other: int) -> bool:
        """Whether nothing that was observed speaks against two global segments being one."""
        ...

    def same(self, canonical: Int32) -> Int32:
        """(L,) numbers, equal for global segments that are the same as far as is known.

        Args:
            canonical: (L,), the global segment that each one is part of.
        """
        ...

    def regularize(self) -> None:
        """Merge instances that are one."""
        ...

    def entities(self, shell: Mapping[int, OnShell] | None = None) -> Mapping[int, SegmentEntity]:
        """Global segment -> what it is part of; background is missing.

        Args:
            shell: what of a room's shell global segments lie on, see `shell.shell_labels`, where that weighs in.
        """
        ...

    def state(self) -> dict[str, Any]:
        """All that was counted, as plain data."""
        ...

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take what `state` told; KeyError, TypeError or ValueError if it is something else."""
        ...


@dataclass(frozen=True, slots=True)
class CountsConfig:
    """Settings of the counts."""

    stuff: frozenset[str] = frozenset({"floor", "wall", "ceiling"})
    """Classes that are one instance each, whatever is seen of them, where counts are joint."""
    merge_share: float = 0.5
    """m_th of Eq. 5."""
    merge_count: int = 10
    """Counts that two instances must have on common segments to be merged."""
    common: float = 0.25
    """Share of a segment's counts for a class that each of two instances needs for the segment to be common to both.
    The paper has 0: then one frame that takes two chairs for one makes their segments common."""
    together: int = 3
    """Things of frames that lay on segments of two instances for these to be one ..."""
    apart: float = 2.0
    """... and how many times the frames it must be in which each was a thing of its own."""
    labelled: float = 0.35
    """Share of the frames that see a segment in which something must cover it, for it not to be background."""


class JointCounts:
    """Phi(l, c, p)."""

    def __init__(self, config: CountsConfig | None = None) -> None:
        self.config = config or CountsConfig()
        self.phi: dict[int, dict[tuple[str, int], int]] = defaultdict(dict)
        """l -> (c, p) -> count."""
        self._stuff: dict[str, int] = {}
        self._fresh = 1
        self._together: dict[tuple[int, int], int] = defaultdict(int)
        """Pairs of instances, the older first -> things of frames that lay on segments of both ..."""
        self._apart: dict[tuple[int, int], int] = defaultdict(int)
        """... and frames in which each was a thing of its own."""
        self._entities: dict[int, SegmentEntity | None] = {}
        """What was found of `phi` as it is."""

    def observe(self, observations: Sequence[Observation]) -> None:
        """Section 3.2 and Eq. 4.

        The instance of a thing maximises Phi(l, c, p), summed over the segments that the thing lies on; no two things
        of a frame are the same instance, the better founded one has it.
        """
        found: dict[int, int] = {}
        votes: list[tuple[int, int, int]] = []
        for number, seen in enumerate(observations):
            if seen.semantic_class == BACKGROUND:
                found[number] = NOBODY
            elif seen.semantic_class in self.config.stuff:
                found[number] = self._stuff_instance(seen.semantic_class)
            else:
                totals: dict[int, int] = defaultdict(int)
                for label in seen.labels:
                    for (name, p), count in self.phi[label].items():
                        if name == seen.semantic_class:
                            totals[p] += count
                votes += [(-count, number, p) for p, count in totals.items()]
        taken: set[int] = set()
        for _, number, p in sorted(votes):
            if number not in found and p not in taken:
                found[number] = p
                taken.add(p)
        self._compare(observations, {number: p for number, p in found.items() if p in taken})
        for number, seen in enumerate(observations):
            p = found[number] if number in found else self._new()
            for label in seen.labels:
                self._entities.pop(label, None)
                counts = self.phi[label]
                counts[seen.semantic_class, p] = counts.get((seen.semantic_class, p), 0) + 1

    def merge(self, label: int, into: int) -> None:
        """Add the counts of one segment to those of another."""
        counts = self.phi[into]
        for key, count in self.phi.pop(label, {}).items():
            counts[key] = counts.get(key, 0) + count
        self._entities.pop(label, None)
        self._entities.pop(into, None)

    def same(self, canonical: Int32) -> Int32:
        """Global segments of one entity are the same."""
        numbers: dict[tuple[str, int], int] = {}
        own = np.arange(len(canonical), dtype=np.int32)
        for label in self.phi:
            entity = self._entity(label)
            if entity is not None:
                own[label] = len(canonical) + numbers.setdefault(_key(entity), len(numbers))
        return own[canonical]

    def alike(self, label: int, other: int) -> bool:
        """Whether both are the same entity, or one of them none."""
        first, second = self._entity(label), self._entity(other)
        return first is None or second is None or _key(first) == _key(second)

    def regularize(self) -> None:
        """Eq. 5: merge two instances of a class that were long associated with common segments."""
        config = self.config
        classes = {name for counts in self.phi.values() for name, p in counts if p != NOBODY}
        for name in sorted(classes - config.stuff):
            while True:
                instances, table = self._table(name)
                if len(instances) < 2:
                    break
                shared = table >= np.maximum(config.common * table.sum(axis=1, keepdims=True), 1.0)
                # Counts of p1 where p2 is associated too, and of p2 where p1 is.
                common = (shared * table).T @ shared
                common = common + common.T
                total = table.sum(axis=0)
                share = common / np.maximum(total[:, None] + total[None, :], 1.0)
                share[(common <= config.merge_count) | np.eye(len(instances), dtype=bool)] = 0.0
                first, second = np.unravel_index(int(share.argmax()), share.shape)
                if share[first, second] < config.merge_share:
                    break
                self._merge_instances(name, instances[max(first, second)], instances[min(first, second)])
        self._merge_seen_as_one()

    def entities(self, shell: Mapping[int, OnShell] | None = None) -> Mapping[int, SegmentEntity]:
        """Eq. 6; stuff is weighed by whether a segment lies on the shell of the room."""
        lies_on = {} if shell is None else shell
        found = (
            (label, self._found_entity(label, lies_on[label]) if label in lies_on else self._entity(label))
            for label in sorted(self.phi)
        )
        return {label: entity for label, entity in found if entity is not None}

    def state(self) -> dict[str, Any]:
        """All that was counted, as plain data."""
        rows = [[label, c, p, n] for label, counts in sorted(self.phi.items()) for (c, p), n in sorted(counts.items())]
        pairs = {
            name: [[*pair, n] for pair, n in sorted(table.items())]
            for name, table in (("together", self._together), ("apart", self._apart))
        }
        return {"phi": rows, "stuff": dict(self._stuff), "fresh": self._fresh, **pairs}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take what `state` told."""
        phi: dict[int, dict[tuple[str, int], int]] = defaultdict(dict)
        for label, name, p, count in state["phi"]:
            phi[int(label)][str(name), int(p)] = int(count)
        self._stuff = {str(name): int(p) for name, p in state["stuff"].items()}
        self._together, self._apart = (
            defaultdict(int, {(int(p), int(q)): int(n) for p, q, n in state.get(name, ())})
            for name in ("together", "apart")
        )
        self.phi, self._fresh, self._entities = phi, int(state["fresh"]), {}

    def _compare(self, observations: Sequence[Observation], found: Mapping[int, int]) -> None:
        """Note which known instances a thing of the frame lies on, and which are things of their own."""
        of_class: dict[str, list[int]] = defaultdict(list)
        for number, p in found.items():
            name = observations[number].semantic_class
            of_class[name].append(p)
            best = {p}
            for label in observations[number].labels:
                counts = [(count, -q) for (c, q), count in self.phi[label].items() if c == name]
                if counts:
                    best.add(-max(counts)[1])
            _add_pairs(self._together, best)
        for members in of_class.values():
            _add_pairs(self._apart, members)

    def _merge_seen_as_one(self) -> None:
        """Merge instances that things of frames were both of, and that were seldom things of their own at a time."""
        while True:
            ready = [
                (n, pair)
                for pair, n in self._together.items()
                if n >= self.config.together and n >= self.config.apart * self._apart.get(pair, 0)
            ]
            if not ready:
                return
            _, (into, p) = max(ready, key=lambda each: (each[0], [-k for k in each[1]]))
            names = {c for counts in self.phi.values() for c, q in counts if q == p}
            for name in names:
                self._merge_instances(name, p, into)

    def _entity(self, label: int) -> SegmentEntity | None:
        if label not in self._entities:
            self._entities[label] = self._found_entity(label)
        return self._entities[label]

    def _found_entity(self, label: int, lies_on: OnShell | None = None) -> SegmentEntity | None:
        classes: dict[str, float] = defaultdict(float)
        counts = self.phi.get(label, {})
        for (name, _), count in counts.items():
            weight = 1.0
            if lies_on is not None and name in self.config.stuff:
                weight = lies_on.weight if name == lies_on.kind else 1.0 / lies_on.weight
            classes[name] += weight * count
        name = _winner(classes, self.config.labelled)
        if name is None:
            return None
        count, negative = max((count, -p) for (c, p), count in counts.items() if c == name)
        return SegmentEntity(name, -negative, count, sum(counts.values()))

    def _table(self, name: str) -> tuple[list[int], np.ndarray]:
        """Instances of a class, and (L, P) float64 their counts on its segments."""
        labels = sorted(label for label, counts in self.phi.items() if any(c == name for c, _ in counts))
        instances = sorted({p for label in labels for c, p in self.phi[label] if c == name})
        column = {p: k for k, p in enumerate(instances)}
        table = np.zeros((len(labels), len(instances)))
        for row, label in enumerate(labels):
            for (c, p), count in self.phi[label].items():
                if c == name:
                    table[row, column[p]] = count
        return instances, table

    def _merge_instances(self, name: str, p: int, into: int) -> None:
        for counts in self.phi.values():
            count = counts.pop((name, p), 0)
            if count:
                counts[name, into] = counts.get((name, into), 0) + count
        self._entities.clear()
        for table in (self._together, self._apart):
            for pair in [pair for pair in table if p in pair]:
                count, other = table.pop(pair), pair[0] + pair[1] - p
                if other != into:
                    table[min(other, into), max(other, into)] += count

    def _stuff_instance(self, name: str) -> int:
        if name not in self._stuff:
            self._stuff[name] = self._new()
        return self._stuff[name]

    def _new(self) -> int:
        self._fresh += 1
        return self._fresh - 1


class SeparateCounts:
    """Phi(l, c) and Phi(l, p)."""

    def __init__(self, config: CountsConfig | None = None) -> None:
        self.config = config or CountsConfig()
        self.classes: dict[int, dict[str, int]] = defaultdict(dict)
        """l -> c -> count."""
        self.instances: dict[int, dict[int, int]] = defaultdict(dict)
        """l -> p -> count."""
        self._fresh = 1

    def observe(self, observations: Sequence[Observation]) -> None:
        """Greedily: a thing is the likeliest instance of its largest segment that is not yet taken in this frame."""
        taken: set[int] = set()
        for seen in observations:
            p = NOBODY
            if seen.semantic_class != BACKGROUND:
                p = self._likeliest(seen.labels[:1], taken)
                taken.add(p)
            for label in seen.labels:
                _add(self.classes[label], seen.semantic_class)
                _add(self.instances[label], p)

    def merge(self, label: int, into: int) -> None:
        """Add the counts of one segment to those of another."""
        for key, count in self.classes.pop(label, {}).items():
            _add(self.classes[into], key, count)
        for key, count in self.instances.pop(label, {}).items():
            _add(self.instances[into], key, count)

    def alike(self, label: int, other: int) -> bool:
        """Always: geometry alone decides."""
        return True

    def same(self, canonical: Int32) -> Int32:
        """Only what was merged is the same."""
        return canonical

    def regularize(self) -> None:
        """Nothing: instances are not merged."""

    def entities(self, shell: Mapping[int, OnShell] | None = None) -> Mapping[int, SegmentEntity]:
        """The likeliest instance of each segment; its class is the one that most was counted for on its segments.

        The shell does not weigh in: Voxblox++ knows of none.
        """
        own: dict[int, int] = {}
        votes: dict[int, dict[str, int]] = defaultdict(lambda: defaultdict(int))
        for label in sorted(self.instances):
            name = _winner(self.classes[label], self.config.labelled)
            real = [(count, -p) for p, count in self.instances[label].items() if p != NOBODY]
            if name is None or not real:
                continue
            own[label] = -max(real)[1]
            votes[own[label]][name] += sum(self.classes[label].values())
        return {
            label: SegmentEntity(
                max(sorted(votes[p]), key=votes[p].__getitem__), p, self.instances[label][p],
                sum(self.instances[label].values()),
            )
            for label, p in own.items()
        }  # fmt: skip

    def state(self) -> dict[str, Any]:
        """All that was counted, as plain data."""
        return {
            "classes": [[label, c, n] for label, row in sorted(self.classes.items()) for c, n in sorted(row.items())],
            "instances": [
                [label, p, n] for label, row in sorted(self.instances.items()) for p, n in sorted(row.items())
            ],
            "fresh": self._fresh,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take what `state` told."""
        classes: dict[int, dict[str, int]] = defaultdict(dict)
        instances: dict[int, dict[int, int]] = defaultdict(dict)
        for label, name, count in state["classes"]:
            classes[int(label)][str(name)] = int(count)
        for label, p, count in state["instances"]:
            instances[int(label)][int(p)] = int(count)
        self.classes, self.instances, self._fresh = classes, instances, int(state["fresh"])

    def _likeliest(self, labels: Iterable[int], taken: Set[int]) -> int:
        for label in labels:
            free = [(count, -p) for p, count in self.instances[label].items() if p != NOBODY and p not in taken]
            if free:
                return -max(free)[1]
        self._fresh += 1
        return self._fresh - 1


def _key(entity: SegmentEntity) -> tuple[str, int]:
    return entity.semantic_class, entity.instance


def _add_pairs(table: dict[tuple[int, int], int], members: Iterable[int]) -> None:
    for pair in combinations(sorted(members), 2):
        table[pair] += 1


def _winner(classes: Mapping[str, float], labelled: float) -> str | None:
    """The class with the greatest count, of equal ones the first by name; None for background."""
    total, named = sum(classes.values()), {name: count for name, count in classes.items() if name != BACKGROUND}
    if not named or sum(named.values()) < labelled * total:
        return None
    return max(sorted(named), key=named.__getitem__)


def _add(counts: dict, key: object, count: int = 1) -> None:
    counts[key] = counts.get(key, 0) + count
