"""Boxes from the box network's answer."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64

STRIDE = 4
"""Pixels of the network's input in a cell of its answer."""
SAME = 0.65
"""Boxes of one class that overlap by more than this are one object's: less, they may be those of two side by side."""
MAX_BOXES = 40
LEAST_SIDE = 8.0
"""Regions that are narrower or lower than this are no boxes, pixels of the image."""


@dataclass(frozen=True, slots=True)
class Box:
    """One answer."""

    class_index: int
    corners: Float64
    """(4,), pixels of the network's input: x min, y min, x max, y max."""
    score: float
    """0 to 1."""


def decoded_boxes(logits: np.ndarray, distances: np.ndarray, threshold: float) -> list[Box]:
    """Boxes with a score above `threshold`, best first.

    Args:
        logits: (C, h, w), of objects' centres.
        distances: (4 C, h, w), logarithms of the distances to the left, upper, right and lower side, in cells; those of
            class c are the channels from 4 c on.
        threshold: 0 to 1.
    """
    scores = _probability(logits)
    peaks = np.argwhere((scores >= _highest_around(scores)) & (scores > threshold))
    order = np.argsort([-scores[tuple(peak)] for peak in peaks], kind="stable") if len(peaks) else []
    found: list[Box] = []
    for k in order:
        c, v, u = (int(value) for value in peaks[k])
        left, up, right, down = np.exp(distances[4 * c : 4 * c + 4, v, u].astype(float))
        corners = (np.array([u - left, v - up, u + right, v + down]) + 0.5) * STRIDE - 0.5
        if all(box.class_index != c or overlap(box.corners, corners) < SAME for box in found):
            found.append(Box(c, corners, float(scores[c, v, u])))
        if len(found) == MAX_BOXES:
            break
    return found


def _probability(logits: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-logits.astype(float)))


def _highest_around(scores: np.ndarray) -> np.ndarray:
    """The highest of every cell and its eight neighbours."""
    padded = np.pad(scores, ((0, 0), (1, 1), (1, 1)))
    h, w = scores.shape[1:]
    rows = np.maximum(np.maximum(padded[:, :h], padded[:, 1 : h + 1]), padded[:, 2:])
    return np.maximum(np.maximum(rows[..., :w], rows[..., 1 : w + 1]), rows[..., 2:])


def boxes_of_regions(logits: np.ndarray, regions: Sequence[Float64], scale: Float64, threshold: float) -> list[Box]:
    """Regions of an image as boxes of the classes that have a centre in them, best first.

    Where objects overlap, the network's centres of them may be one, and its boxes hold both.

    Args:
        logits: (classes, h, w), of objects' centres.
        regions: (4,) each, pixels of the image: x min, y min, x max, y max, half-open.
        scale: (2,), pixels of the image in one of the network's input.
        threshold: 0 to 1.
    """
    scores = _probability(logits)
    found: list[Box] = []
    for corners in regions:
        if min(corners[2] - corners[0], corners[3] - corners[1]) < LEAST_SIDE:
            continue
        u0, v0 = np.maximum(np.floor(corners[:2] / (scale * STRIDE)).astype(int), 0)
        u1, v1 = np.maximum(np.ceil(corners[2:] / (scale * STRIDE)).astype(int), 0)
        best = scores[:, v0:v1, u0:u1].max(axis=(1, 2), initial=0.0)
        found += [Box(int(c), corners - 0.5, float(best[c])) for c in np.flatnonzero(best > threshold)]
    return sorted(found, key=lambda box: -box.score)


def overlap(a: Float64, b: Float64) -> float:
    """Intersection over union of two boxes (x min, y min, x max, y max)."""
    size = np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0.0, None)
    common = float(size[0] * size[1])
    both = float(np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2])) - common
    return common / both if both > 0.0 else 0.0
