"""How well identities are kept over a run: fragmentation, and detection and association in one number.

*Fragmentation* counts how often an object that was tracked is not, while it can be seen, and is again later (Milan et
al., "MOT16", 2016). *HOTA* is the geometric mean of detection and association accuracy, averaged over thresholds of
localization (Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", IJCV 2021, eqs. 10-15),
with the similarity ``1 - distance / 10 cm``. It is like HOTA and not the same: tracks are matched once, as for all
other metrics, not for each threshold anew, and only objects that can be seen (scored ones) count.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from simtrack.contracts import Track, TrackStatus
from simtrack.evaluation.metrics import Metrics, measured, unmeasured
from simtrack.evaluation.tracking import GATE, ObjectFrame

ALPHAS = np.arange(1, 20) / 20.0
"""Similarities from which on a match counts, 0.05 to 0.95."""


class IdentityEvaluator:
    """Collects who was matched with whom, frame by frame."""

    def __init__(self) -> None:
        self._tracked: defaultdict[str, list[bool]] = defaultdict(list)
        self._seen: Counter[str] = Counter()
        self._shown: Counter[int] = Counter()
        """Track id -> frames in which it stood for an object that can be seen, or for none."""
        self._pairs: defaultdict[tuple[str, int], list[float]] = defaultdict(list)
        """(object, track id) -> similarities of their matches."""

    def observe(self, frames: Sequence[ObjectFrame], tracks: Sequence[Track]) -> None:
        """Take the object-frames of one stamp and all tracks at it."""
        matched = {frame.track.id for frame in frames if frame.track is not None}
        for frame in frames:
            if not frame.scored:
                continue
            self._seen[frame.name] += 1
            self._tracked[frame.name].append(frame.track is not None)
            if frame.track is not None:
                self._shown[frame.track.id] += 1
                similarity = max(0.0, 1.0 - frame.translation_error / GATE)
                self._pairs[frame.name, frame.track.id].append(similarity)
        for track in tracks:
            if track.status is TrackStatus.CONFIRMED and track.id not in matched:
                self._shown[track.id] += 1

    def fragments(self) -> int:
        """How often tracking of an object was interrupted, and taken up again."""
        return sum(
            sum(after and not before for before, after in pairwise(flags[flags.index(True) :]))
            for flags in self._tracked.values()
            if True in flags
        )

    def hota(self) -> tuple[float, float, float]:
        """HOTA, detection accuracy and association accuracy, each the mean over the thresholds; objects were seen."""
        results = []
        for alpha in ALPHAS:
            counts = {pair: sum(s >= alpha for s in values) for pair, values in self._pairs.items()}
            hits = sum(counts.values())
            misses, ghosts = self._seen.total() - hits, self._shown.total() - hits
            detection = hits / (hits + misses + ghosts)
            association = sum(
                n * n / (self._seen[name] + self._shown[track] - n) for (name, track), n in counts.items()
            ) / max(hits, 1)
            results.append((np.sqrt(detection * association), detection, association))
        hota, detection, association = np.mean(results, axis=0)
        return float(hota), float(detection), float(association)

    def metrics(self) -> Metrics:
        """``tracking.fragmentations``, ``tracking.hota`` and its parts."""
        metrics: Metrics = {"tracking.fragmentations": measured(self.fragments(), "1")}
        names = ("tracking.hota", "tracking.detection_accuracy", "tracking.association_accuracy")
        if not self._seen:
            return metrics | {name: unmeasured("1", "no object was visible enough") for name in names}
        return metrics | {name: measured(value, "1") for name, value in zip(names, self.hota(), strict=True)}
