"""Detections that need a registration of their own: of a new object, or of a known one that they see otherwise.

Such a registration tries many starts and takes longer than a frame lasts, some far longer than others. It is done
beside the frames (`simtrack.perception.beside`), and taken to need as long as it has casts; answers are taken up in the
order of the claims.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

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
"""Claims that are handed to the thread at most; it works at one after the other. Only one where frames do not wait."""
BEHIND, ROUNDS = 2, 3
"""Where frames do not wait, one follows a candidate through so many images at most, and the thread through the others;
but if the thread is still behind after so many times, the frame does what is left."""
Views: TypeAlias = list[tuple[View, Occluders]]
"""Depth images, each with what is believed to stand around."""


class ClaimQueue:
    """Claims in the order of their detections; the first ones are worked at in a thread of its own."""

    def __init__(self, prober: Prober, models: Mapping[str, TrackedModel], config: TrackerConfig) -> None:
        """`prober` belongs to the thread from now on."""
        self._prober, self._models, self._config = prober, models, config
        self._waiting: deque[Claim] = deque()
        self._working: deque[tuple[Claim, int, Paced[Candidate | None]]] = deque()
        """Claims, stamps at which they were handed to the thread, and what it does about them."""
        self._rounds = 0
        """How often the thread has followed the first claim's candidate since."""
        self._free = 0
        """Stamp at which the thread is taken to have ended the claim that was settled last, nanoseconds."""
        self._thread = worker("claims", config.wait, config.threads)

    def add(self, claim: Claim) -> None:
        """Queue a claim. It takes the turn of an older one about the same thing, or is dropped if that is at work."""
        if any(self._same(claim, other) for other, _, _ in self._working):
            return
        for k, other in enumerate(self._waiting):
            if self._same(claim, other):
                self._waiting[k] = claim
                return
        self._waiting.append(claim)

    def settle(self, stamp: int, later: Callable[[Claim, int], Views]) -> tuple[Claim, Candidate | None] | None:
        """The first claim at work and what was found, once its time is up; waits if need be, and may.

        Args:
            stamp: now, nanoseconds.
            later: images after a stamp, for a claim.
        """
        if not self._working:
            return None
        claim, begun, work = self._working[0]
        end = work.end(max(begun, self._free), stamp)
        if end is None:
            return None
        candidate = work.settle()
        if candidate is not None and not self._config.wait:
            missed = later(claim, candidate.reached)
            if len(missed) > BEHIND and self._rounds < ROUNDS:
                self._rounds += 1
                self._working[0] = claim, stamp, self._paced(partial(self._led_on, candidate, missed))
                return None
        self._working.popleft()
        self._free, self._rounds = end, 0
        return claim, candidate

    def work(self, stamp: int, oldest: int, later: Callable[[Claim, int], Views]) -> None:
        """Begin with the next claims, as far as there is room.

        Args:
            stamp: now, nanoseconds.
            oldest: claims whose images are older are dropped, nanoseconds.
            later: images after a stamp, for a claim.
        """
        while self._waiting and len(self._working) < (AT_WORK if self._config.wait else 1):
            claim = self._waiting.popleft()
            if claim.view.stamp < oldest or (claim.target is not None and not claim.target.alive):
                continue
            work = self._paced(partial(self._candidate, claim, later(claim, claim.view.stamp - 1)))
            self._working.append((claim, stamp, work))

    def _paced(self, work: Callable[[Callable[[], None]], Candidate | None]) -> Paced[Candidate | None]:
        return Paced(self._thread, self._config.cast_time, work, self._config.wait)

    def _candidate(self, claim: Claim, views: Views, step: Callable[[], None]) -> Candidate | None:
        """Register a claim to its own image, and follow what is found through the later ones."""
        self._prober.count_casts(step)
        (view, around), later = views[0], views[1:]
        model = self._models[claim.class_name]
        fit = self._prober.best(claim.group, model, view.depth, view.intrinsics, around, view.noise)
        if fit is None:
            return None
        candidate = Candidate.found(model, fit, view, self._config)
        candidate.follow(self._prober, later, self._config)
        return candidate

    def _led_on(self, candidate: Candidate, views: Views, step: Callable[[], None]) -> Candidate:
        """Follow a candidate through images that came while it was worked at."""
        self._prober.count_casts(step)
        candidate.follow(self._prober, views, self._config)
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
