"""Average precision of boxes, as COCO defines it at one overlap."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from simtrack.contracts import Float64
from simtrack.perception.detection.boxes import Box, overlap
from simtrack.perception.segmentation.panoptic_network import STUFF


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


def panoptic_quality(
    pairs: Sequence[tuple[np.ndarray, Sequence[str], np.ndarray, Sequence[str]]], stuff: Sequence[str] = STUFF
) -> dict[str, float]:
    """Class -> PQ in percent (Kirillov et al., CVPR 2019) of segments in images, of classes that are truly there.

    Args:
        pairs: for every image found segments (H, W), from 1, 0 = none, with their classes, and entities (H, W) from 0,
            -1 = nothing, with theirs.
        stuff: classes of which an image has one segment.
    """
    overlap: dict[str, float] = defaultdict(float)
    matched: dict[str, int] = defaultdict(int)
    either: dict[str, int] = defaultdict(int)
    there: set[str] = set()
    for found, found_classes, entities, classes in pairs:
        first = {name: list(classes).index(name) for name in stuff if name in classes}
        merged = np.array([*(first.get(name, k) for k, name in enumerate(classes)), -1])[entities]
        known = merged >= 0  # where nothing is known, nothing is wrong
        table = np.bincount(
            found[known] * len(classes) + merged[known], minlength=(len(found_classes) + 1) * len(classes)
        ).reshape(-1, len(classes))
        sizes, true_sizes = table.sum(axis=1), table.sum(axis=0)
        for number, name in enumerate(found_classes, start=1):
            either[name] += int(sizes[number] > 0)
        for k in np.flatnonzero(true_sizes).tolist():
            name = classes[k]
            there.add(name)
            either[name] += 1
            for number in np.flatnonzero(table[1:, k]).tolist():
                union = sizes[number + 1] + true_sizes[k] - table[number + 1, k]
                if found_classes[number] == name and 2 * table[number + 1, k] > union:
                    overlap[name] += float(table[number + 1, k] / union)
                    matched[name] += 1
    return {name: 200.0 * overlap[name] / max(either[name], 1) for name in sorted(there)}
