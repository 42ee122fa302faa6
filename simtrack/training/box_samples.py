"""Samples of the box network: small images shifted, scaled and coloured, and what is to be said of them."""

from typing import Any

import numpy as np

from simtrack.contracts import Float64
from simtrack.perception.detection.boxes import STRIDE
from simtrack.perception.detection.views import shown_image
from simtrack.training.shards import IMAGE_HEIGHT, IMAGE_WIDTH, LEAST_VISIBLE

LEAST_SIDE = 6.0
"""Pixels of the small image: smaller boxes are neither learned nor counted."""
SPREAD = 0.18
"""Standard deviation of a centre's heat, in shares of the box's sides."""
LEARNED_FROM = 0.25
"""Cells with at least this heat learn the box's sides."""
WITHOUT_DEPTH = 0.1
"""Share of samples without any depth."""
ZOOMED = 0.5
"""Share of samples that are shifted and scaled."""


def sample(record: Any, classes: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Input, heat (classes, h, w), where it is learned (h, w), sides (4, h, w) in cells, their weight (h, w)."""
    rgb, depth = np.asarray(record["rgb"]), np.asarray(record["depth"], np.float32)
    boxes, indices, visible = record["boxes"].astype(float), record["classes"], record["visible"]
    if rng.random() < ZOOMED:
        rgb, depth, boxes = _zoomed(rgb, depth, boxes, rng)
    gains = np.exp(rng.normal(0.0, 0.22)) * np.exp(rng.normal(0.0, 0.06, 3))
    rgb = (rgb * gains.astype(np.float32)).clip(0, 255).astype(np.uint8)
    if rng.random() < WITHOUT_DEPTH:
        depth = np.zeros_like(depth)
    return shown_image(rgb, depth), *targets(boxes, indices, visible, classes)


def targets(boxes: Float64, classes: np.ndarray, visible: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    """Heat, where it is learned, sides and their weight; as `sample`."""
    stride = STRIDE
    h, w = IMAGE_HEIGHT // stride, IMAGE_WIDTH // stride
    heat, sides = np.zeros((count, h, w), np.float32), np.ones((4, h, w), np.float32)
    learned, weight = np.ones((h, w), np.float32), np.zeros((h, w), np.float32)
    v, u = np.mgrid[:h, :w].astype(float)
    order = np.argsort(-(boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]))
    for k in order:  # the smallest last: cells that several boxes want are theirs
        if classes[k] < 0:
            continue
        u0, v0, u1, v1 = (np.clip(boxes[k], -0.5, [IMAGE_WIDTH - 0.5, IMAGE_HEIGHT - 0.5] * 2) + 0.5) / stride - 0.5
        if visible[k] < LEAST_VISIBLE or min(u1 - u0, v1 - v0) * stride < LEAST_SIDE:
            inside = (u >= u0 - 0.5) & (u <= u1 + 0.5) & (v >= v0 - 0.5) & (v <= v1 + 0.5)
            learned[inside] = 0.0
            continue
        cu, cv = round(float(np.clip(0.5 * (u0 + u1), 0, w - 1))), round(float(np.clip(0.5 * (v0 + v1), 0, h - 1)))
        su, sv = max(SPREAD * (u1 - u0), 0.6), max(SPREAD * (v1 - v0), 0.6)
        glow = np.exp(-0.5 * (((u - cu) / su) ** 2 + ((v - cv) / sv) ** 2)).astype(np.float32)
        heat[classes[k]] = np.maximum(heat[classes[k]], glow)
        learned[cv, cu] = 1.0
        own = glow > LEARNED_FROM
        weight[own] = glow[own]
        for side, distance in zip(sides, (u - u0, v - v0, u1 - u, v1 - v), strict=True):
            side[own] = np.maximum(distance, 0.1)[own]
    return heat, learned, sides, weight


def _zoomed(
    rgb: np.ndarray, depth: np.ndarray, boxes: Float64, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, Float64]:
    """The same from nearer or farther, and shifted; what comes into view has one colour and no depth."""
    import cv2

    scale = float(np.exp(rng.uniform(np.log(0.5), np.log(1.3))))
    size = np.array([IMAGE_WIDTH, IMAGE_HEIGHT], float)
    shift = rng.uniform(-0.15, 0.15, 2) * size + 0.5 * size * (1.0 - scale)
    A = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    fill = tuple(float(c) for c in rng.integers(0, 256, 3))
    flags, out = cv2.BORDER_CONSTANT, (IMAGE_WIDTH, IMAGE_HEIGHT)
    rgb = np.asarray(cv2.warpAffine(rgb, A, out, flags=cv2.INTER_LINEAR, borderMode=flags, borderValue=fill))
    depth = np.asarray(cv2.warpAffine(depth, A, out, flags=cv2.INTER_NEAREST, borderMode=flags, borderValue=0.0))
    return rgb, depth / scale, boxes * scale + np.tile(shift, 2)
