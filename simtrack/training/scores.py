"""Average precision of boxes, as COCO defines it at one overlap."""

from collections.abc import Sequence

import numpy as np

from simtrack.contracts import Float64
from simtrack.perception.detection.boxes import Box, overlap


def average_precision(
    found: Sequence[Sequence[Box]],
    there: Sequence[tuple[Float64, np.ndarray, np.ndarray]],
    classes: int,
    least_overlap: float = 0.5,
    least_visible: float = 0.5,
) -> Float64:
    """(classes,) area under the curve of precision over recall, NaN for a class that is nowhere.

    Args:
        found: boxes in each image.
        there: boxes (K, 4), class indices (K,) and visible fractions (K,) of the objects in each image.
        classes: number of them.
        least_overlap: from which a box is that of an object.
        least_visible: objects of which less is seen neither count as missed nor as a mistake if found.

    """
    values = np.full(classes, np.nan)
    for c in range(classes):
        scores: list[float] = []
        right: list[bool] = []
        total = 0
        for boxes, (places, names, visible) in zip(found, there, strict=True):
            own = [k for k in range(len(names)) if names[k] == c]
            total += sum(visible[k] > least_visible for k in own)
            taken: set[int] = set()
            for box in sorted((b for b in boxes if b.class_index == c), key=lambda b: -b.score):
                # Objects that count are matched before those that are let pass.
                matches = [
                    (visible[k] > least_visible, overlap(box.corners, places[k]), k) for k in own if k not in taken
                ]
                counted, _, k = max((m for m in matches if m[1] >= least_overlap), default=(True, 0.0, -1))
                if k >= 0:
                    taken.add(k)
                if counted or k < 0:
                    scores.append(box.score)
                    right.append(k >= 0)
        if total:
            hits = np.cumsum(np.array(right)[np.argsort(-np.array(scores), kind="stable")]) if scores else np.zeros(0)
            recall, precision = hits / total, hits / np.arange(1, len(hits) + 1)
            envelope = np.maximum.accumulate(precision[::-1])[::-1]
            steps = np.searchsorted(recall, np.linspace(0.0, 1.0, 101), side="left")
            values[c] = float(np.append(envelope, 0.0)[steps].mean())
    return values
