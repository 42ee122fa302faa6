"""Detections that need a registration of their own: of a new object, or of a known one that they see otherwise.

Such a registration tries many starts and takes longer than a frame lasts, some far longer than others. It is done
beside the frames (`simtrack.perception.beside`), and taken to need as long as it has casts; answers are taken up in the
order of the claims.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from simtrack.contracts import Float64, PoseHypothesis
from simtrack.perception.beside import Paced, worker
from simtrack.perception.tracking.birth import Occluders, Prober
from simtrack.perception.tracking.follow_up import Candidate
from simtrack.perception.tracking.registration import TrackedModel
from simtrack.perception.tracking.target import Target, TrackerConfig, View


@dataclass(frozen=True, slots=True, eq=False)
class Claim:
    """What a detection says, and whom it contradicts."""

    group: list[PoseHypothesis]
    """The detection's pose hypotheses, the best first."""
    view: View
    """Its image."""
    target: Target | None
    """The track whose pose it contests; None for a new object."""

    @property
    def class_name(self) -> str:
        """Of the detected object."""
        return self.group[0].class_name

    @property
    def place(self) -> Float64:
        """(3,), where the detection sees the object, map frame, metres."""
        T = self.view.T_map_camera @ self.group[0].T_camera_object
        return T[:3, 3]


AT_WORK = 8
"""Claims that are handed to the thread at most; it works at one after the other."""


class ClaimQueue:
    """Claims in the order of their detections; the first ones are worked at in a thread of its own."""

    def __init__(self, prober: Prober, models: Mapping[str, TrackedModel], config: TrackerConfig) -> None:
        """`prober` belongs to the thread from now on."""
        self._prober, self._models, self._config = prober, models, config
        self._waiting: deque[Claim] = deque()
        self._working: deque[tuple[Claim, int, Paced[Candidate | None]]] = deque()
        """Claims, stamps at which they were handed to the thread, and what it does about them."""
        self._free = 0
        """Stamp at which the thread is taken to have ended the claim that was settled last, nanoseconds."""
        self._thread = worker("claims", config.wait)

    def add(self, claim: Claim) -> None:
        """Queue a claim. It takes the turn of an older one about the same thing, or is dropped if that is at work."""
        if any(self._same(claim, other) for other, _, _ in self._working):
            return
        for k, other in enumerate(self._waiting):
            if self._same(claim, other):
                self._waiting[k] = claim
                return
        self._waiting.append(claim)

    def settle(self, stamp: int) -> tuple[Claim, Candidate | None] | None:
        """The first claim at work and what was found, once its time is up at `stamp`; waits if need be, and may."""
        if not self._working:
            return None
        claim, begun, work = self._working[0]
        end = work.end(max(begun, self._free), stamp)
        if end is None:
            return None
        self._working.popleft()
        self._free = end
        return claim, work.settle()

    def work(self, stamp: int, oldest: int, views: Callable[[Claim], list[tuple[View, Occluders]]]) -> None:
        """Begin with the next claims, as far as there is room.

        Args:
            stamp: now, nanoseconds.
            oldest: claims whose images are older are dropped, nanoseconds.
            views: a claim's image and all later ones, with what is believed to stand around in each.
        """
        while self._waiting and len(self._working) < AT_WORK:
            claim = self._waiting.popleft()
            if claim.view.stamp < oldest or (claim.target is not None and not claim.target.alive):
                continue
            work = Paced[Candidate | None](
                self._thread, self._config.cast_time, partial(self._candidate, claim, views(claim)), self._config.wait
            )
            self._working.append((claim, stamp, work))

    def _candidate(
        self, claim: Claim, views: list[tuple[View, Occluders]], step: Callable[[], None]
    ) -> Candidate | None:
        """Register a claim to its own image, and follow what is found through the later ones."""
        self._prober.count_casts(step)
        (view, around), later = views[0], views[1:]
        model = self._models[claim.class_name]
        fit = self._prober.best(claim.group, model, view.depth, view.intrinsics, around)
        if fit is None:
            return None
        candidate = Candidate.found(model, fit, view, self._config)
        candidate.follow(self._prober, later, self._config)
        return candidate

    def close(self) -> None:
        """End the thread, when it is done with its claim."""
        self._waiting.clear()
        self._working.clear()
        self._thread.shutdown(cancel_futures=True)

    def _same(self, a: Claim, b: Claim) -> bool:
        if a.target is not None and b.target is not None:
            return a.target is b.target
        reach = self._models[a.class_name].radius
        return a.class_name == b.class_name and float(np.linalg.norm(a.place - b.place)) < reach
