"""How the box network learns: samples, loss, and what is told of it on held-out scenes."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from simtrack.contracts import Float64
from simtrack.objects import ObjectModel
from simtrack.perception.detection.boxes import decoded_boxes
from simtrack.perception.detection.views import shown_image
from simtrack.training.networks import BoxNetwork
from simtrack.training.scores import average_precision
from simtrack.training.shards import IMAGE_HEIGHT, IMAGE_WIDTH, LEAST_VISIBLE, Shards

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


class BoxTask:
    """Training of `BoxNetwork`; see `simtrack.training.loop.Task`."""

    name = "boxes"
    batch_size = 10
    learning_rate = 1.5e-3

    def __init__(self, models: tuple[ObjectModel, ...], train: Shards, held_out: Shards, validated: int = 100) -> None:
        self.models, self._train, self._held_out = models, train, held_out
        shown = train.column("classes")[train.column("visible") > LEAST_VISIBLE]
        counts = np.bincount(shown[shown >= 0], minlength=len(models))
        self.missing = tuple(models[i].name for i in np.flatnonzero(counts == 0))
        self._validated = np.arange(0, len(held_out), max(1, len(held_out) // validated))

    def network(self) -> BoxNetwork:
        """A new one."""
        return BoxNetwork(len(self.models))

    def batch(self, rng: np.random.Generator) -> tuple[Tensor, ...]:
        """Random samples."""
        picks = rng.integers(0, len(self._train), self.batch_size)
        columns = zip(*(self.sample(self._train[int(i)], rng) for i in picks), strict=True)
        shown, *rest = [torch.from_numpy(np.stack(column)) for column in columns]
        return shown.contiguous(memory_format=torch.channels_last), *rest

    def sample(self, record: Any, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        """Input, heat (classes, h, w), where it is learned (h, w), sides (4, h, w) in cells, their weight (h, w)."""
        rgb, depth = np.asarray(record["rgb"]), np.asarray(record["depth"], np.float32)
        boxes, classes, visible = record["boxes"].astype(float), record["classes"], record["visible"]
        if rng.random() < ZOOMED:
            rgb, depth, boxes = _zoomed(rgb, depth, boxes, rng)
        gains = np.exp(rng.normal(0.0, 0.22)) * np.exp(rng.normal(0.0, 0.06, 3))
        rgb = (rgb * gains.astype(np.float32)).clip(0, 255).astype(np.uint8)
        if rng.random() < WITHOUT_DEPTH:
            depth = np.zeros_like(depth)
        return shown_image(rgb, depth), *targets(boxes, classes, visible, len(self.models))

    def loss(self, network: BoxNetwork, batch: tuple[Tensor, ...]) -> Tensor:
        """Penalty-reduced focal loss of the heat, generalised IoU of the boxes."""
        shown, heat, learned, sides, weight = batch
        logits, distances = network(shown)
        probability = torch.sigmoid(logits).clamp(1e-5, 1 - 1e-5)
        peak = (heat > 0.999).float()
        positive = -peak * (1 - probability) ** 2 * torch.log(probability)
        negative = -(1 - peak) * (1 - heat) ** 4 * probability**2 * torch.log(1 - probability)
        focal = ((positive + negative) * learned[:, None]).sum() / peak.sum().clamp(min=1)
        return focal + 2.0 * (
            (1.0 - _generalised_overlap(torch.exp(distances), sides)) * weight
        ).sum() / weight.sum().clamp(min=1)

    def validate(self, network: BoxNetwork) -> dict[str, float]:
        """Average precision at an overlap of 0.5 of objects that are seen by more than half."""
        found, there = [], []
        for i in self._validated:
            record = self._held_out[int(i)]
            shown = shown_image(np.asarray(record["rgb"]), np.asarray(record["depth"], np.float32))
            logits, distances = network(torch.from_numpy(shown)[None])
            found.append(decoded_boxes(logits[0].numpy(), distances[0].numpy(), threshold=0.05))
            valid = record["classes"] >= 0
            there.append((record["boxes"][valid].astype(float), record["classes"][valid], record["visible"][valid]))
        precision = average_precision(found, there, len(self.models))
        return {"AP50": float(np.nanmean(precision))} | {
            model.name: float(value) for model, value in zip(self.models, precision, strict=True)
        }


def targets(boxes: Float64, classes: np.ndarray, visible: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    """Heat, where it is learned, sides and their weight; as `BoxTask.sample`."""
    stride = BoxNetwork.stride
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


def _generalised_overlap(a: Tensor, b: Tensor) -> Tensor:
    """(N, h, w), GIoU (Rezatofighi et al., CVPR 2019) of boxes given by the distances (N, 4, h, w) to their sides."""
    inner, outer = torch.minimum(a, b), torch.maximum(a, b)
    common = (inner[:, 0] + inner[:, 2]) * (inner[:, 1] + inner[:, 3])
    hull = (outer[:, 0] + outer[:, 2]) * (outer[:, 1] + outer[:, 3])
    union = (a[:, 0] + a[:, 2]) * (a[:, 1] + a[:, 3]) + (b[:, 0] + b[:, 2]) * (b[:, 1] + b[:, 3]) - common
    return common / union - (hull - union) / hull
