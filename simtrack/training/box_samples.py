"""Samples of the box network: parts of images, scaled and coloured, with further objects, and what is to be said."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from simtrack.contracts import Float64
from simtrack.perception.detection.boxes import STRIDE
from simtrack.perception.detection.views import shown_image
from simtrack.training.pasting import LabelledView, paste
from simtrack.training.shards import LEAST_VISIBLE

SHOWN_WIDTH, SHOWN_HEIGHT = 256, 192
"""Pixels of a sample."""
LEAST_SIDE = 6.0
"""Pixels of a sample: smaller boxes are neither learned nor counted."""
SPREAD = 0.12
"""Standard deviation of a centre's heat, in shares of the box's sides."""
LEARNED_FROM = 0.25
"""Cells with at least this heat learn the box's sides."""
WITHOUT_DEPTH = 0.1
"""Share of samples without any depth."""
SCALES = 0.45, 1.3
"""Of samples, beside the stored image: as if it were seen from farther or nearer."""
ABOUT_OBJECT = 0.7
"""Share of samples that have an object near their middle."""


def sample(record: Any, donors: Sequence[Any], classes: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Input (5, H, W) of one sample, and its `targets`.

    Args:
        record: one of `simtrack.training.shards.IMAGES`.
        donors: the same, one for each object that is put before those of the image.
        classes: number of them.
        rng: of everything random.
    """
    view = LabelledView.of(record)
    for donor in donors:
        paste(view, donor, rng)
    rgb, depth, boxes, visible = _part(view, rng)
    gains = np.exp(rng.normal(0.0, 0.22)) * np.exp(rng.normal(0.0, 0.06, 3))
    rgb = (rgb * gains.astype(np.float32)).clip(0, 255).astype(np.uint8)
    if rng.random() < WITHOUT_DEPTH:
        depth = np.zeros_like(depth)
    return shown_image(rgb, depth), *targets(boxes, view.classes, visible, classes)


def targets(boxes: Float64, classes: np.ndarray, visible: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    """What is to be said of a sample.

    Args:
        boxes: (N, 4), pixels of the sample.
        classes: (N,), -1 = no object.
        visible: (N,), 0 to 1; what is hardly seen is neither learned nor counted.
        count: of the classes, C.

    Returns:
        Heat (C, h, w), where it is learned (h, w), sides (C, 4, h, w) in cells, their weight (C, h, w).
    """
    h, w = SHOWN_HEIGHT // STRIDE, SHOWN_WIDTH // STRIDE
    limit = np.array([SHOWN_WIDTH - 0.5, SHOWN_HEIGHT - 0.5] * 2)
    heat, sides = np.zeros((count, h, w), np.float32), np.ones((count, 4, h, w), np.float32)
    learned, weight = np.ones((h, w), np.float32), np.zeros((count, h, w), np.float32)
    u, v = np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32)[:, None]
    order = np.argsort(-(boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]))
    for k in order:  # the smallest last: cells that several boxes of a class want are theirs
        c = int(classes[k])
        if c < 0:
            continue
        u0, v0, u1, v1 = ((np.clip(boxes[k], -0.5, limit) + 0.5) / STRIDE - 0.5).tolist()
        if min(u1 - u0, v1 - v0) <= 0.0:
            continue
        if visible[k] < LEAST_VISIBLE or min(u1 - u0, v1 - v0) * STRIDE < LEAST_SIDE:
            learned[(u >= u0 - 0.5) & (u <= u1 + 0.5) & (v >= v0 - 0.5) & (v <= v1 + 0.5)] = 0.0
            continue
        cu, cv = round(min(max(0.5 * (u0 + u1), 0), w - 1)), round(min(max(0.5 * (v0 + v1), 0), h - 1))
        su, sv = max(SPREAD * (u1 - u0), 0.6), max(SPREAD * (v1 - v0), 0.6)
        glow = np.exp(-0.5 * ((v - cv) / sv) ** 2) * np.exp(-0.5 * ((u - cu) / su) ** 2)
        np.maximum(heat[c], glow, out=heat[c])
        learned[cv, cu] = 1.0
        own = glow > LEARNED_FROM
        weight[c][own] = glow[own]
        for side, distance in zip(sides[c], (u - u0, v - v0, u1 - u, v1 - v), strict=True):
            side[own] = np.broadcast_to(np.maximum(distance, 0.1), (h, w))[own]
    return heat, learned, sides, weight


def _part(view: LabelledView, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, Float64, np.ndarray]:
    """A part from nearer or farther: colours, depth, boxes, visible; what comes into view has one colour, no depth."""
    import cv2

    scale = float(np.exp(rng.uniform(*np.log(SCALES))))
    size, shown = np.array(view.depth.shape[::-1], float), np.array([SHOWN_WIDTH, SHOWN_HEIGHT], float)
    seen = np.flatnonzero((view.classes >= 0) & (view.visible >= LEAST_VISIBLE))
    middle = rng.uniform(np.zeros(2), size)
    if len(seen) and rng.random() < ABOUT_OBJECT:
        box = view.boxes[rng.choice(seen)]
        middle = 0.5 * (box[:2] + box[2:]) + rng.uniform(-0.4, 0.4, 2) * shown / scale
    nearest = 0.5 * shown / scale - 0.1 * size  # to the image's border: a part may reach somewhat over it
    middle = np.clip(middle, np.minimum(nearest, size - nearest), np.maximum(nearest, size - nearest))
    shift = 0.5 * shown - scale * middle
    A = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    fill = tuple(float(c) for c in rng.integers(0, 256, 3))
    flags, out = cv2.BORDER_CONSTANT, (SHOWN_WIDTH, SHOWN_HEIGHT)
    rgb = np.asarray(cv2.warpAffine(view.rgb, A, out, flags=cv2.INTER_LINEAR, borderMode=flags, borderValue=fill))
    depth = np.asarray(cv2.warpAffine(view.depth, A, out, flags=cv2.INTER_NEAREST, borderMode=flags, borderValue=0.0))
    boxes = view.boxes * scale + np.tile(shift, 2)
    inside = np.clip(boxes, 0.0, np.tile(shown, 2))
    areas = [np.prod(np.maximum(b[:, 2:] - b[:, :2], 0.0), axis=1) for b in (inside, boxes)]
    return rgb, depth / scale, boxes, view.visible * areas[0] / np.maximum(areas[1], 1e-6)
