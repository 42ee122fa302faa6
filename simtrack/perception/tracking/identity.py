"""Who is who: which known object a new track is of, and whether that can be told yet."""

from collections.abc import Iterable, Sequence

import numpy as np

from simtrack.contracts import NANOSECONDS, TrackStatus
from simtrack.objects import ObjectModel
from simtrack.perception.tracking.filter import PoseFilter
from simtrack.perception.tracking.target import Target, TrackerConfig


def reappeared(
    targets: Iterable[Target], model: ObjectModel, followed: PoseFilter, config: TrackerConfig
) -> Target | None:
    """The target that a reappearing object is: a lost one, or one that was being moved when last seen.

    Args:
        targets: all that are kept.
        model: of the object.
        followed: where it has turned up.
        config: settings.

    """
    alike = [t for t in targets if t.model is model]
    if lost := [t for t in alike if not t.alive]:
        return max(lost, key=lambda t: t.last_seen)
    for target in alike:
        unseen = target.status in (TrackStatus.OCCLUDED, TrackStatus.OUT_OF_VIEW) and target.moved_when_seen
        demoted = target.status is TrackStatus.TENTATIVE and target.known
        if not (unseen or demoted):
            continue
        age = (followed.state.stamp - target.last_seen) / NANOSECONDS
        distance = np.linalg.norm(followed.state.T_map_object[:3, 3] - target.filter.state.T_map_object[:3, 3])
        reach = 0.15 + config.same_object_speed * min(age, config.same_object_memory)
        # What is not believed any more where it was is not somewhere else for being long unseen.
        if (demoted or age < config.same_object_memory) and distance < reach:
            return target
    return None


def replaced(targets: Iterable[Target], new: Target, now: int, config: TrackerConfig) -> Target | None:
    """The known object of its class, not believed any more, that a new one is which turned up a moment before.

    `now` in nanoseconds.
    """
    young = new.newcomer and now - new.born <= config.reunite_time * NANOSECONDS
    if not young or new.status is not TrackStatus.CONFIRMED:
        return None
    gone = [t for t in targets if t.model is new.model and t.gone and t is not new]
    return max(gone, key=lambda t: t.last_seen, default=None)


def all_seen(targets: Sequence[Target], new: Target, stamp: int) -> bool:
    """Whether all known objects of its class are seen at a stamp, nanoseconds: one that is not may be the new one."""
    return all(t.last_seen >= stamp for t in _others(targets, new) if t.known)


def one_vanishes(targets: Sequence[Target], new: Target) -> bool:
    """Whether one of its kind is being seen to be gone: it may be the new one."""
    return new.newcomer and any(t.missing_since is not None for t in _others(targets, new))


def _others(targets: Sequence[Target], new: Target) -> list[Target]:
    return [t for t in targets if t is not new and t.model is new.model and t.alive]
