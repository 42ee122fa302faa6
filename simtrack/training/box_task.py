"""How the box network learns: samples, loss, and what is told of it on held-out scenes."""

import numpy as np
import torch  # pyright: ignore[reportMissingImports] - extra `train`
from torch import Tensor  # pyright: ignore[reportMissingImports] - extra `train`

from simtrack.objects import ObjectModel
from simtrack.perception.detection.boxes import decoded_boxes
from simtrack.perception.detection.views import shown_image
from simtrack.training.box_samples import sample
from simtrack.training.networks import BoxNetwork
from simtrack.training.scores import average_precision
from simtrack.training.shards import LEAST_VISIBLE, Shards

PASTED = 0.6
"""Share of samples with objects of other images in them, ..."""
MOST_PASTED = 3
"""... at most so many."""


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
        columns = zip(*(self._sample(rng) for _ in range(self.batch_size)), strict=True)
        shown, *rest = [torch.from_numpy(np.stack(column)) for column in columns]
        return shown.contiguous(memory_format=torch.channels_last), *rest

    def _sample(self, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        further = int(rng.integers(1, MOST_PASTED + 1)) if rng.random() < PASTED else 0
        record, *donors = (self._train[int(i)] for i in rng.integers(0, len(self._train), 1 + further))
        return sample(record, donors, len(self.models), rng)

    def loss(self, network: BoxNetwork, batch: tuple[Tensor, ...]) -> Tensor:
        """Penalty-reduced focal loss of the heat, generalised IoU of the boxes."""
        shown, heat, learned, sides, weight = batch
        logits, distances = network(shown)
        probability = torch.sigmoid(logits).clamp(1e-5, 1 - 1e-5)
        peak = (heat > 0.999).float()
        positive = -peak * (1 - probability) ** 2 * torch.log(probability)
        negative = -(1 - peak) * (1 - heat) ** 4 * probability**2 * torch.log(1 - probability)
        focal = ((positive + negative) * learned[:, None]).sum() / peak.sum().clamp(min=1)
        told = weight > 0.0  # (N, C, h, w); their sides as (K, 4)
        lengths = torch.exp(distances.unflatten(1, (-1, 4)).permute(0, 1, 3, 4, 2)[told])
        missed = 1.0 - _generalised_overlap(lengths, sides.permute(0, 1, 3, 4, 2)[told])
        return focal + 2.0 * (missed * weight[told]).sum() / weight.sum().clamp(min=1)

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


def _generalised_overlap(a: Tensor, b: Tensor) -> Tensor:
    """(K,), GIoU (Rezatofighi et al., CVPR 2019) of boxes given by the distances (K, 4) to their sides."""
    inner, outer = torch.minimum(a, b), torch.maximum(a, b)
    common = (inner[:, 0] + inner[:, 2]) * (inner[:, 1] + inner[:, 3])
    hull = (outer[:, 0] + outer[:, 2]) * (outer[:, 1] + outer[:, 3])
    union = (a[:, 0] + a[:, 2]) * (a[:, 1] + a[:, 3]) + (b[:, 0] + b[:, 2]) * (b[:, 1] + b[:, 3]) - common
    return common / union - (hull - union) / hull
