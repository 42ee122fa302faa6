"""Whether it is noticed that objects were moved, taken away or brought while the robot looked elsewhere.

Definitions
-----------
* Two states of a scene are compared class by class: things that stand within 5 cm of where one of their class stood are
  unchanged, pair by pair of least total distance; of what is left over, pairs of one class were *moved*, the others
  *removed* or *added*. The same function judges the believed tracks and the truth, so that two equal things which
  changed places did not change.
* The first state is that of the moment before anything happened, the second that of the end. Of the truth, only what
  could be known counts: things that were seen (visible fraction at least 0.3, for half a second in all) before; and of
  changes, those whose new place, or old place if there is none, was seen for as long since. A thing that stood there
  all the time but is first seen later is no change. Things smaller than 5 cm do not count.
* A believed change is right if it is of the kind and class of a true one, from and to places within 10 cm of its.
* *Time to notice* of a true change runs from when its place was seen again (for a tenth of a second) to the first
  moment from which on the belief has it, until the end.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from simtrack.contracts import NANOSECONDS, CameraIntrinsics, Float64, Track
from simtrack.evaluation.metrics import Metrics, measured, quantile, ratio, unmeasured
from simtrack.evaluation.tracking import GATE, VISIBLE
from simtrack.geometry.transforms import apply, inverse

if TYPE_CHECKING:
    from simtrack.simulation.changes import UnseenChange
    from simtrack.simulation.ground_truth import GroundTruth, Truth

STILL = 0.05
"""Metres within which a thing stands where it stood."""
SMALL = 0.05
"""Metres: smaller things do not count."""
KNOWN_AFTER, NOTICEABLE_AFTER = 0.5, 0.1
"""Seconds of sight after which something can be expected to be known, and from which on time to notice runs."""
LOOK_PERIOD = NANOSECONDS // 10
"""Nanoseconds between looks at places that things have left, and between beliefs that are kept."""


@dataclass(frozen=True, slots=True)
class Thing:
    """Something that stands somewhere."""

    class_name: str
    position: tuple[float, float, float]
    """Of the middle, metres, map frame."""


@dataclass(frozen=True, slots=True)
class ObjectChange:
    """A difference between two states of a scene."""

    class_name: str
    before: tuple[float, float, float] | None
    """Where it was, metres, map frame; None if it is new."""
    after: tuple[float, float, float] | None
    """Where it is; None if it is gone."""

    @property
    def kind(self) -> Literal["moved", "removed", "added"]:
        """What has happened."""
        if self.before is None:
            return "added"
        return "removed" if self.after is None else "moved"

    def agrees(self, other: "ObjectChange") -> bool:
        """Whether it tells of the same event: class, kind, and places within 10 cm."""
        return (
            self.class_name == other.class_name
            and self.kind == other.kind
            and all(
                a is None or b is None or _distance(a, b) <= GATE
                for a, b in ((self.before, other.before), (self.after, other.after))
            )
        )


def changes_between(before: Iterable[Thing], after: Iterable[Thing]) -> list[ObjectChange]:
    """What has changed from one state to another, class by class; see the definitions above."""
    classes: dict[str, tuple[list[Thing], list[Thing]]] = defaultdict(lambda: ([], []))
    for k, things in enumerate((before, after)):
        for thing in things:
            classes[thing.class_name][k].append(thing)
    changes: list[ObjectChange] = []
    for class_name in sorted(classes):
        old, new = classes[class_name]
        for a, b in _pairs(old, new, STILL):
            old.remove(a)
            new.remove(b)
        for a, b in _pairs(old, new, np.inf):
            changes.append(ObjectChange(class_name, a.position, b.position))
            old.remove(a)
            new.remove(b)
        changes += [ObjectChange(class_name, thing.position, None) for thing in old]
        changes += [ObjectChange(class_name, None, thing.position) for thing in new]
    return changes


def _pairs(old: Sequence[Thing], new: Sequence[Thing], within: float) -> list[tuple[Thing, Thing]]:
    """As many pairs as possible that are not further apart than `within` metres, of least total distance."""
    from scipy.optimize import linear_sum_assignment

    if not old or not new:
        return []
    distances = np.array([[_distance(a.position, b.position) for b in new] for a in old])
    rows, columns = linear_sum_assignment(np.where(distances <= within, distances, 1e6))
    return [(old[r], new[c]) for r, c in zip(rows, columns, strict=True) if distances[r, c] <= within]


def _distance(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    return float(np.linalg.norm(np.subtract(a, b)))


@dataclass(slots=True)
class _Sight:
    """For how long something has been seen since a moment."""

    seconds: float = 0.0
    noticeable: int | None = None
    """Stamp from which on it can be noticed."""

    def add(self, stamp: int, seconds: float) -> None:
        self.seconds += seconds
        if self.noticeable is None and self.seconds >= NOTICEABLE_AFTER:
            self.noticeable = stamp


@dataclass(slots=True)
class _Event:
    """One thing that happened, and what was seen of it since."""

    change: "UnseenChange"
    new_place: _Sight = field(default_factory=_Sight)
    old_place: _Sight = field(default_factory=_Sight)


class ChangeEvaluator:
    """Compares what is believed to have changed with what has."""

    def __init__(self, truth: "GroundTruth", camera: CameraIntrinsics, sizes: Mapping[str, Float64]) -> None:
        """`sizes`: object name -> side lengths (3,) of its box, metres, of the objects that count."""
        self._truth, self._camera = truth, camera
        self._sizes = {name: size for name, size in sizes.items() if float(np.max(size)) > SMALL}
        self._seen: defaultdict[str, _Sight] = defaultdict(_Sight)
        """Of each object since it stands where it stands, if it was ever in sight there."""
        self._events: dict[str, _Event] = {}
        """The last one of each object."""
        self._known: set[str] = set()
        """Objects that were seen before anything happened."""
        self._first: dict[str, Thing] = {}
        """Where they were then, and where those were that nobody had seen."""
        self._believed: list[Thing] | None = None
        """What was believed then."""
        self._latest: list[Thing] = []
        self._now: dict[str, Thing] = {}
        self._history: list[tuple[int, list[Thing]]] = []
        self._looked = self._stamp = self._kept = 0
        self._taken = 0

    def observe(
        self, tracks: Sequence[Track], truth: "Truth", visible: Mapping[str, float], done: Sequence["UnseenChange"]
    ) -> None:
        """Take a camera frame.

        Args:
            tracks: all of that stamp.
            truth: at the stamp.
            visible: object name -> visible fraction.
            done: all that has happened so far.
        """
        seconds, self._stamp = (truth.stamp - self._stamp) / NANOSECONDS, truth.stamp
        for change in done[self._taken :]:
            if self._believed is None:
                self._believed, self._first = self._latest, dict(self._now)
                self._known = {name for name in self._now if self._seen[name].seconds >= KNOWN_AFTER}
            self._events[change.name] = _Event(change)
            self._seen[change.name] = _Sight()
        self._taken = len(done)
        self._now = {
            name: Thing(thing.class_name, _position(thing.T_map_object))
            for name, thing in truth.objects.items()
            if name in self._sizes
        }
        for name in self._now:
            if visible.get(name, 0.0) >= VISIBLE:
                self._seen[name].add(truth.stamp, seconds)
        if self._events and truth.stamp - self._looked >= LOOK_PERIOD:
            self._look(truth)
            self._looked = truth.stamp
        classes = {self._truth.class_of(name) for name in self._sizes}
        self._latest = [
            Thing(t.class_name, _position(t.T_map_object)) for t in tracks if t.believed and t.class_name in classes
        ]
        if self._believed is not None and truth.stamp - self._kept >= LOOK_PERIOD:
            self._history.append((truth.stamp, self._latest))
            self._kept = truth.stamp

    def _look(self, truth: "Truth") -> None:
        """Note which of the places that things have left are in plain view."""
        elapsed = min(truth.stamp - self._looked, 2 * LOOK_PERIOD) / NANOSECONDS
        for name, event in self._events.items():
            if event.change.T_before is not None and self._sees_place(event.change.T_before, self._sizes[name], truth):
                event.old_place.add(truth.stamp, elapsed)

    def _sees_place(self, T_map_object: Float64, size: Float64, truth: "Truth") -> bool:
        """Whether most of where a thing was is open to the camera: its middle and the middles of its box's sides."""
        spots = np.vstack([np.zeros(3), 0.4 * np.diag(size), -0.4 * np.diag(size)])
        points = apply(T_map_object, spots)
        shown = apply(inverse(truth.T_map_camera), points)
        K = self._camera
        if shown[:, 2].min() < 0.05:
            return False
        u, v = K.fx * shown[:, 0] / shown[:, 2] + K.cx, K.fy * shown[:, 1] / shown[:, 2] + K.cy
        inside = (u > 0) & (u < K.width - 1) & (v > 0) & (v < K.height - 1)
        eye = truth.T_map_camera[:3, 3]
        ways = points - eye
        distances = np.linalg.norm(ways, axis=1)
        scene = self._truth.rays(truth.stamp).scene
        hits = scene.cast_rays(np.broadcast_to(eye, ways.shape), ways / distances[:, None], min_distance=0.03)
        return bool(np.mean(inside & (hits.distances > distances - 0.02)) > 0.5)

    # ---------------------------------------------------------------------------------------------------------- results

    def true_changes(self) -> dict[ObjectChange, int]:
        """What has changed and could be known, with the stamp from which on it could be noticed."""
        before = {name: self._first[name] for name in self._known}
        after = dict(before) | {name: thing for name, thing in self._now.items() if name in before}
        since: dict[ObjectChange, int] = {}
        stamps: dict[Thing, int] = {}
        for name, event in self._events.items():
            seen_there, left = self._seen[name], event.old_place
            if name in self._now and seen_there.seconds >= KNOWN_AFTER:
                after[name] = self._now[name]
                stamps[after[name]] = seen_there.noticeable or event.change.stamp
            elif name in before and left.seconds >= KNOWN_AFTER:
                stamps[before[name]] = left.noticeable or event.change.stamp
                after.pop(name, None)
            elif name in before:
                after[name] = before[name]
            else:
                after.pop(name, None)
        for change in changes_between(before.values(), after.values()):
            place = change.before if change.after is None else change.after
            assert place is not None
            since[change] = stamps.get(Thing(change.class_name, place), 0)
        return since

    def believed_changes(self, things: Sequence[Thing]) -> list[ObjectChange]:
        """What has changed by a belief; without things that stood there all the time, but are first seen now."""
        unseen = [thing for name, thing in self._first.items() if name not in self._known and name not in self._events]
        return [
            change
            for change in changes_between(self._believed or (), things)
            if not (
                change.kind == "added"
                and any(
                    thing.class_name == change.class_name and _distance(thing.position, change.after) <= GATE
                    for thing in unseen
                    if change.after is not None
                )
            )
        ]

    def noticed(self) -> dict[ObjectChange, tuple[int, int | None]]:
        """Each true change: when it could be noticed, and when it was, nanoseconds; None = not at the end."""
        known = {} if self._believed is None else self.true_changes()
        when: dict[ObjectChange, int | None] = dict.fromkeys(known)
        searching = set(known)
        for stamp, things in reversed(self._history):
            if not searching:
                break
            believed = self.believed_changes(things)
            for change in sorted(searching, key=repr):
                if any(change.agrees(other) for other in believed):
                    when[change] = stamp
                else:
                    searching.discard(change)
        return {change: (since, when[change]) for change, since in known.items()}

    def metrics(self, pending: int) -> Metrics:
        """``changes.*``; `pending` changes of the scene have not happened."""
        names = ("changes.f1", "changes.precision", "changes.recall")
        metrics: Metrics = {"changes.happened": measured(self._taken, "1"), "changes.pending": measured(pending, "1")}
        noticed = self.noticed()
        believed = self.believed_changes(self._latest) if self._believed is not None else []
        metrics["changes.knowable"] = measured(len(noticed), "1")
        if not noticed and not believed:
            why = "nothing that could be noticed has changed"
            return metrics | {name: unmeasured("1", why) for name in names}
        right = sum(when is not None for _, when in noticed.values())
        metrics["changes.f1"] = ratio(2 * right, len(noticed) + len(believed), "")
        metrics["changes.precision"] = ratio(right, len(believed), "no change is believed")
        metrics["changes.recall"] = ratio(right, len(noticed), "nothing that could be noticed has changed")
        times = [max(0.0, (when - since) / NANOSECONDS) for since, when in noticed.values() if when is not None]
        for share, label in ((0.5, "median"), (0.95, "p95")):
            metrics[f"changes.time_to_notice.{label}"] = quantile(times, share, "s", "no change was noticed")
        return metrics


def _position(T: Float64) -> tuple[float, float, float]:
    x, y, z = T[:3, 3].tolist()
    return x, y, z
