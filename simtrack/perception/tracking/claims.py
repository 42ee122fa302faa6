"""Detections that need a registration of their own: of a new object, or of a known one that they see otherwise.

Such a registration tries many starts and takes longer than a frame lasts. It is done beside the frames, one at a time
(see `simtrack.perception.beside`).
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from simtrack.contracts import Float64, PoseHypothesis
from simtrack.perception.beside import Beside, worker
from simtrack.perception.tracking.birth import Occluders, Prober
from simtrack.perception.tracking.registration import RegistrationResult, TrackedModel
from simtrack.perception.tracking.target import Target, View


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


class ClaimQueue:
    """Claims in the order of their detections; the first one is worked at in a thread of its own."""

    def __init__(self, prober: Prober, models: Mapping[str, TrackedModel], seconds: float) -> None:
        """`prober` belongs to the thread while a claim is worked at; answers are used after `seconds`."""
        self._prober, self._models = prober, models
        self._waiting: deque[Claim] = deque()
        self._current: Claim | None = None
        self._thread = worker("claims")
        self._beside = Beside[RegistrationResult | None](self._thread, seconds)

    def add(self, claim: Claim) -> None:
        """Queue a claim. It takes the turn of an older one about the same thing, or is dropped if that is at work."""
        if self._current is not None and self._same(claim, self._current):
            return
        for k, other in enumerate(self._waiting):
            if self._same(claim, other):
                self._waiting[k] = claim
                return
        self._waiting.append(claim)

    def settle(self, stamp: int) -> tuple[Claim, RegistrationResult | None] | None:
        """The claim at work and the fit that was found, once its time is up at `stamp`; waits for it if need be."""
        if self._current is None or not self._beside.due(stamp):
            return None
        claim, self._current = self._current, None
        return claim, self._beside.settle()

    def work(self, stamp: int, oldest: int, occluders: Callable[[Claim], Occluders]) -> None:
        """Begin with the next claim whose image is not older than `oldest`, if none is at work."""
        while self._current is None and self._waiting:
            claim = self._waiting.popleft()
            if claim.view.stamp < oldest or (claim.target is not None and not claim.target.alive):
                continue
            view, model = claim.view, self._models[claim.class_name]
            arguments = claim.group, model, view.depth, view.intrinsics, occluders(claim)
            self._current = claim
            self._beside.begin(stamp, partial(self._prober.best, *arguments))

    def close(self) -> None:
        """End the thread, when it is done with its claim."""
        self._waiting.clear()
        self._current = None
        self._beside.drop()
        self._thread.shutdown()

    def _same(self, a: Claim, b: Claim) -> bool:
        if a.target is not None and b.target is not None:
            return a.target is b.target
        reach = self._models[a.class_name].radius
        return a.class_name == b.class_name and float(np.linalg.norm(a.place - b.place)) < reach
