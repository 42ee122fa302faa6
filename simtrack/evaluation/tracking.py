"""How well objects are tracked: errors, recall, identities, ghosts, and how much of the world is known.

Definitions
-----------
* An *object-frame* is one catalogue object at one camera stamp. It is *scored* if the object's visible fraction is at
  least 0.3. Errors are those of ``T_camera_object`` against the true pose in the true camera frame at the stamp of the
  depth image, symmetries respected.
* Tracks are matched to objects of their class frame by frame: the assignment of least distance among pairs within 10
  cm. Only believed tracks (confirmed, occluded, out of view) take part.
* An object is *occluded* (``tracking.occluded.*``) in scored object-frames with a visible fraction below 0.7.
* An object is *moving* while its true speed exceeds 1 cm/s or 2 deg/s.
* A *false track* is a confirmed one that matches no object for 1 s; a second track of the same object is one, too.
* An *identity switch* is a match with another track than the one that the object was matched with last, however long
  ago (CLEAR MOT: Bernardin & Stiefelhagen, 2008).
* *Reacquisition* is the time from an object's visible fraction rising above 0.3 again, after at least 0.2 s below, to a
  confirmed track with ADD(-S) within 10 % of its diameter. One that does not come before the object hides again or the
  run ends counts with the time waited, if that is more than 1 s.
* The *first track* of an object comes with the first confirmed track that has ADD(-S) within 10 % of its diameter. What
  counts is the time for which the object could be seen until then, with a visible fraction of at least 0.3 and from at
  most 3.5 m, for which makers of structured-light cameras vouch (ASUS Xtion Pro Live, data sheet): time out of sight or
  reach does not. An object without one counts with the time waited, if that is more than 1 s.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import NANOSECONDS, Bool, Float64, Track, TrackStatus
from simtrack.evaluation.metrics import Metrics, measured, quantile, ratio, unmeasured
from simtrack.evaluation.pose_errors import PoseScorer, auc
from simtrack.geometry.transforms import inverse

if TYPE_CHECKING:
    from simtrack.simulation.ground_truth import ObjectTruth, Truth

GATE = 0.10
"""Metres: a track farther away from every object of its class matches none."""
VISIBLE = 0.3
"""Visible fraction from which on an object-frame is scored."""
OCCLUDED = 0.7
"""Visible fraction below which a scored object counts as occluded."""
MOVING_LINEAR, MOVING_ANGULAR = 0.01, np.radians(2.0)
"""m/s and rad/s from which on an object is moving."""
KNOWN_TRANSLATION, KNOWN_ROTATION = 0.02, np.radians(10.0)
"""Metres and radians within which a believed map pose counts as knowledge."""
FALSE_AFTER = 1.0
"""Seconds."""
HIDDEN_AT_LEAST = 0.2
"""Seconds."""
REACH = 3.5
"""Metres from the camera."""
PATIENCE = 1.0
"""Seconds: who waits for longer in vain is counted."""


@dataclass(frozen=True, slots=True)
class ObjectFrame:
    """One catalogue object at one camera stamp: what is believed against what is."""

    stamp: int
    name: str
    class_name: str
    visible_fraction: float
    moving: bool
    T_camera_object: Float64
    """(4, 4), true."""
    track: Track | None
    """The matched one."""
    translation_error: float = np.inf
    """Metres, camera frame; infinite if untracked, as all the following."""
    rotation_error: float = np.inf
    """Radians."""
    add: float = np.inf
    """Metres, ADD or ADD-S."""
    map_translation_error: float = np.inf
    map_rotation_error: float = np.inf
    correct: bool = False
    """ADD(-S) is below 10 % of the diameter."""

    @property
    def scored(self) -> bool:
        """Whether enough of it can be seen."""
        return self.visible_fraction >= VISIBLE

    @property
    def known(self) -> bool:
        """Whether its pose in the map is believed within 2 cm and 10 degrees."""
        return self.map_translation_error <= KNOWN_TRANSLATION and self.map_rotation_error <= KNOWN_ROTATION


def is_moving(velocity: Float64) -> bool:
    """Whether a (6,) velocity, m/s and rad/s, is that of a moving object."""
    return bool(np.linalg.norm(velocity[:3]) > MOVING_LINEAR or np.linalg.norm(velocity[3:]) > MOVING_ANGULAR)


def match_tracks(tracks: Iterable[Track], truth: "Truth") -> dict[str, Track]:
    """Object name -> its believed track: class by class the assignment of least distance within 10 cm."""
    T_camera_map = inverse(truth.T_map_camera)
    R = T_camera_map[:3, :3]
    objects: defaultdict[str, list[ObjectTruth]] = defaultdict(list)
    for thing in truth.objects.values():
        if thing.kind == "catalogue":
            objects[thing.class_name].append(thing)
    believed: defaultdict[str, list[Track]] = defaultdict(list)
    for track in tracks:
        if track.believed:
            believed[track.class_name].append(track)
    matches: dict[str, Track] = {}
    for class_name, things in objects.items():
        candidates = believed[class_name]
        if not candidates:
            continue
        true = np.array([thing.T_map_object[:3, 3] for thing in things]) @ R.T + T_camera_map[:3, 3]
        estimated = np.array([track.T_camera_object[:3, 3] for track in candidates])
        distances = np.sqrt(((true[:, None] - estimated[None]) ** 2).sum(axis=2))
        for row, column in _assign(distances):
            matches[things[row].name] = candidates[column]
    return matches


def _assign(distances: Float64) -> list[tuple[int, int]]:
    """Pairs (row, column) within the gate: as many as possible, then as close as possible."""
    if distances.size == 1:
        return [(0, 0)] if distances[0, 0] <= GATE else []
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(np.where(distances <= GATE, distances, 1e3))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if distances[r, c] <= GATE]


class _Reacquisition:
    """Follows one object in and out of sight."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._ever_seen = False
        self._hidden_since: int | None = None
        self._waiting_since: int | None = None
        self._last_wait = 0.0

    def observe(self, frame: ObjectFrame) -> None:
        if not frame.scored:
            self._hide(frame.stamp)
            return
        if self._hidden_since is not None:
            if frame.stamp - self._hidden_since >= HIDDEN_AT_LEAST * NANOSECONDS:
                self._waiting_since = frame.stamp
            self._hidden_since = None
        self._ever_seen = True
        if self._waiting_since is not None:
            self._last_wait = (frame.stamp - self._waiting_since) / NANOSECONDS
            if _confirmed(frame):
                self._times.append(self._last_wait)
                self._waiting_since = None

    def times(self) -> list[float]:
        """Seconds, as if the run ended now."""
        return [*self._times, self._last_wait] if self._in_vain else list(self._times)

    @property
    def _in_vain(self) -> bool:
        return self._waiting_since is not None and self._last_wait > PATIENCE

    def _hide(self, stamp: int) -> None:
        if self._in_vain:
            self._times.append(self._last_wait)
        self._waiting_since = None
        if self._hidden_since is None and self._ever_seen:
            self._hidden_since = stamp


class _FirstTrack:
    """How long one object could be seen until it was tracked for the first time."""

    def __init__(self) -> None:
        self._waited = 0
        self._found = False
        self._seen: int | None = None
        """Stamp of the last frame, if the object could be seen in it."""

    def observe(self, frame: ObjectFrame) -> None:
        if self._found:
            return
        seen = frame.scored and float(np.linalg.norm(frame.T_camera_object[:3, 3])) <= REACH
        if seen and self._seen is not None:
            self._waited += frame.stamp - self._seen
        self._seen = frame.stamp if seen else None
        self._found = frame.scored and _confirmed(frame)

    @property
    def time(self) -> float | None:
        """Seconds; None for an object that has hardly been in sight."""
        waited = self._waited / NANOSECONDS
        return waited if self._found or waited > PATIENCE else None


def _confirmed(frame: ObjectFrame) -> bool:
    """Whether an object is tracked where it is."""
    return frame.track is not None and frame.track.status is TrackStatus.CONFIRMED and frame.correct


class TrackingEvaluator:
    """Collects object-frames and what happens to tracks."""

    def __init__(self, scorers: Mapping[str, PoseScorer]) -> None:
        """`scorers`: class name -> scorer with the true model, lengths in metres."""
        self.frames: list[ObjectFrame] = []
        self._scorers = scorers
        self._last_match: dict[str, int] = {}
        self._switches: list[tuple[int, str]] = []
        self._unmatched: dict[int, int] = {}
        self._false: dict[int, int] = {}
        self._reacquisition: defaultdict[str, _Reacquisition] = defaultdict(_Reacquisition)
        self._first: defaultdict[str, _FirstTrack] = defaultdict(_FirstTrack)
        self._previous_stamp: int | None = None

    @property
    def switches(self) -> Sequence[tuple[int, str]]:
        """(stamp, object) of each identity switch."""
        return self._switches

    @property
    def false_tracks(self) -> Mapping[int, int]:
        """Track id -> stamp at which it became a false one."""
        return self._false

    def observe(
        self, tracks: Sequence[Track], truth: "Truth", visible_fraction: Mapping[str, float]
    ) -> list[ObjectFrame]:
        """Take the tracks of one frame; returns its object-frames, in the order of the true objects."""
        matches = match_tracks(tracks, truth)
        frames = [
            self._score(truth, thing, visible_fraction.get(name, 0.0), matches.get(name))
            for name, thing in truth.objects.items()
            if thing.kind == "catalogue"
        ]
        for frame in frames:
            self._reacquisition[frame.name].observe(frame)
            self._first[frame.name].observe(frame)
            if frame.track is not None:
                last = self._last_match.setdefault(frame.name, frame.track.id)
                if last != frame.track.id:
                    self._switches.append((frame.stamp, frame.name))
                    self._last_match[frame.name] = frame.track.id
        self._count_false(tracks, {track.id for track in matches.values()}, truth.stamp)
        self._previous_stamp = truth.stamp
        self.frames.extend(frames)
        return frames

    def _score(self, truth: "Truth", thing: "ObjectTruth", visible: float, track: Track | None) -> ObjectFrame:
        T_true = inverse(truth.T_map_camera) @ thing.T_map_object
        moving = is_moving(thing.velocity)
        if track is None:
            return ObjectFrame(truth.stamp, thing.name, thing.class_name, visible, moving, T_true, None)
        scorer = self._scorers[thing.class_name]
        translation, rotation = scorer.errors(track.T_camera_object, T_true)
        map_translation, map_rotation = scorer.errors(track.T_map_object, thing.T_map_object)
        distance = scorer.add(track.T_camera_object, T_true)
        return ObjectFrame(
            truth.stamp, thing.name, thing.class_name, visible, moving, T_true, track,
            translation_error=translation, rotation_error=rotation, add=distance,
            map_translation_error=map_translation, map_rotation_error=map_rotation,
            correct=distance < 0.1 * scorer.diameter,
        )  # fmt: skip

    def _count_false(self, tracks: Sequence[Track], matched: set[int], stamp: int) -> None:
        elapsed = 0 if self._previous_stamp is None else stamp - self._previous_stamp
        for track in tracks:
            if track.id in matched:
                self._unmatched.pop(track.id, None)
            elif track.status is TrackStatus.CONFIRMED:
                self._unmatched[track.id] = self._unmatched.get(track.id, -elapsed) + elapsed
                if self._unmatched[track.id] >= FALSE_AFTER * NANOSECONDS:
                    self._false.setdefault(track.id, stamp)

    def metrics(self) -> Metrics:
        """The ``tracking.*`` and ``world.*`` metrics; `tracking.floor_ratio` is `simtrack.evaluation.floor`'s."""
        table = _Table(self.frames)
        seen, tracked = table.scored, table.tracked
        missing = "no such object-frame was tracked"
        metrics: Metrics = {}
        for kind, chosen in (("static", ~table.moving), ("moving", table.moving)):
            errors = table.translation[chosen & seen & tracked]
            for name, share in (("median", 0.5), ("p95", 0.95)):
                metrics[f"tracking.{kind}.translation_error.{name}"] = quantile(errors, share, "m", missing)
            rotations = table.rotation[chosen & seen & tracked]
            metrics[f"tracking.{kind}.rotation_error.median"] = quantile(rotations, 0.5, "rad", missing)
            metrics[f"tracking.{kind}.object_frames"] = measured(np.count_nonzero(chosen & seen), "1")
        metrics["tracking.rotation_error.median"] = quantile(table.rotation[seen & tracked], 0.5, "rad", missing)
        metrics["tracking.map.translation_error.median"] = quantile(table.map_translation[tracked], 0.5, "m", missing)
        hidden = table.occluded
        errors = table.translation[hidden & tracked]
        metrics["tracking.occluded.translation_error.median"] = quantile(errors, 0.5, "m", missing)
        metrics["tracking.occluded.object_frames"] = measured(np.count_nonzero(hidden), "1")
        missing = "no object was visible enough"
        recalled = np.count_nonzero(table.correct & hidden)
        metrics["tracking.occluded.recall"] = ratio(recalled, np.count_nonzero(hidden), "no object was occluded")
        scored = int(np.count_nonzero(seen))
        metrics["tracking.recall"] = ratio(np.count_nonzero(table.correct & seen), scored, missing)
        metrics["tracking.add_s_auc"] = measured(auc(table.add[seen]), "1") if scored else unmeasured("1", missing)
        metrics["tracking.false_tracks"] = measured(len(self._false), "1")
        metrics["tracking.id_switches"] = measured(len(self._switches), "1")
        times = [time for each in self._reacquisition.values() for time in each.times()]
        missing = "no object came into sight again"
        metrics["tracking.reacquisition_time.p95"] = quantile(times, 0.95, "s", missing)
        metrics["tracking.reacquisitions"] = measured(len(times), "1")
        times = [each.time for each in self._first.values() if each.time is not None]
        missing = "no object was in sight for long enough"
        metrics["tracking.first_track_time.median"] = quantile(times, 0.5, "s", missing)
        metrics["tracking.first_track_time.max"] = quantile(times, 1.0, "s", missing)
        metrics["tracking.first_tracks"] = measured(len(times), "1")
        metrics["world.known_share"] = ratio(np.count_nonzero(table.known), len(self.frames), "no catalogue object")
        return metrics


class _Table:
    """Columns of a list of object-frames."""

    def __init__(self, frames: Sequence[ObjectFrame]) -> None:
        def flags(values: Iterable[bool]) -> Bool:
            return np.fromiter(values, bool, len(frames))

        def numbers(values: Iterable[float]) -> Float64:
            return np.fromiter(values, float, len(frames))

        self.scored = flags(f.scored for f in frames)
        self.occluded = flags(f.scored and f.visible_fraction < OCCLUDED for f in frames)
        self.moving = flags(f.moving for f in frames)
        self.tracked = flags(f.track is not None for f in frames)
        self.correct = flags(f.correct for f in frames)
        self.known = flags(f.known for f in frames)
        self.translation = numbers(f.translation_error for f in frames)
        self.rotation = numbers(f.rotation_error for f in frames)
        self.add = numbers(f.add for f in frames)
        self.map_translation = numbers(f.map_translation_error for f in frames)
