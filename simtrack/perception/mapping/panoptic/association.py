"""Which global segment each segment of a frame is part of, by overlap in 3D, and which global segments are one.

Section 3.2, first paragraph, and the first half of 3.3 of the reconstruction paper, after Grinvald et al., RA-L 2019.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Int32
from simtrack.errors import InvalidValueError


@dataclass(frozen=True, slots=True)
class AssociationConfig:
    """Settings of `SegmentLabels`."""

    least_readings: int = 20
    """Readings of a segment that must lie in voxels of a label, of those looked at in an image of 640 x 480."""
    least_share: float = 0.2
    """Share, of the readings that lie in voxels of any label, that must lie in those of this one."""
    merge_share: float = 0.2
    """Share of a segment that two labels must each have for the segment to say that they are one."""
    merge_frames: int = 3
    """Frames that must say so before they are merged, and one more."""

    def __post_init__(self) -> None:
        for name in ("least_share", "merge_share"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InvalidValueError(f"AssociationConfig.{name}", getattr(self, name), "a share, above 0, up to 1")
        if self.least_readings < 1 or self.merge_frames < 0:
            value = (self.least_readings, self.merge_frames)
            raise InvalidValueError("AssociationConfig.least_readings, merge_frames", value, ">= 1 and >= 0")


class SegmentLabels:
    """The labels l of global segments; those that were merged lead to what they are part of now."""

    def __init__(self, config: AssociationConfig | None = None) -> None:
        self.config = config or AssociationConfig()
        self.canonical: Int32 = np.zeros(1, np.int32)
        """(L,), the label that each one is part of; label 0 is none."""
        self._together: dict[tuple[int, int], int] = defaultdict(int)

    def associate(self, met: Int32, counts: Int32, least: int) -> Int32:
        """Greedily, the largest overlap first; a segment has one label, and a label one segment a frame.

        Args:
            met: (K,) labels, from `Volume.overlaps`.
            counts: (S + 1, K + 1), from there.
            least: readings of an association.

        Returns:
            (S + 1,) labels of the segments, new ones where none fits; entry 0 is 0.
        """
        labels = np.zeros(len(counts), np.int32)
        shares = counts[:, 1:] / np.maximum(counts[:, 1:].sum(axis=1, keepdims=True), 1)
        rows, columns = np.nonzero((counts[:, 1:] >= least) & (shares >= self.config.least_share))
        taken: set[int] = set()
        for at in np.lexsort((columns, rows, -counts[rows, columns + 1])).tolist():
            row, label = int(rows[at]), int(met[columns[at]])
            if labels[row] == 0 and label not in taken:
                labels[row] = label
                taken.add(label)
        fresh = np.flatnonzero(labels[1:] == 0) + 1
        labels[fresh] = len(self.canonical) + np.arange(len(fresh), dtype=np.int32)
        self.canonical = np.concatenate([self.canonical, labels[fresh]]).astype(np.int32)
        return labels

    def count_overlaps(self, met: Int32, counts: Int32, least: int) -> list[tuple[int, int]]:
        """Note which labels share segments of a frame, and tell the pairs (a, b), a < b, that have long enough."""
        shares = counts[:, 1:] / np.maximum(counts[:, 1:].sum(axis=1, keepdims=True), 1)
        both = (counts[:, 1:] >= least) & (shares > self.config.merge_share)
        ready = []
        for row in np.flatnonzero(both.sum(axis=1) > 1).tolist():
            labels = sorted(met[np.flatnonzero(both[row])].tolist())
            for first, label in enumerate(labels):
                for other in labels[first + 1 :]:
                    self._together[label, other] += 1
                    if self._together[label, other] > self.config.merge_frames:
                        ready.append((label, other))
        return ready

    def merge(self, label: int, into: int) -> None:
        """Make a label part of another."""
        self.canonical[self.canonical == label] = into
        for pair in [pair for pair in self._together if label in pair]:
            count = self._together.pop(pair)
            rest = into if pair[0] == label else pair[0]
            other = pair[1] if pair[0] == label else into
            if rest != other:
                self._together[min(rest, other), max(rest, other)] += count

    def state(self) -> list[list[int]]:
        """Which labels shared segments in how many frames, as plain data: rows of label, label, count."""
        return [[*pair, count] for pair, count in sorted(self._together.items())]

    def restore(self, state: Iterable[Sequence[int]]) -> None:
        """Take what `state` told; TypeError or ValueError if it is something else."""
        together: dict[tuple[int, int], int] = defaultdict(int)
        for label, other, count in state:
            together[int(label), int(other)] = int(count)
        self._together = together
