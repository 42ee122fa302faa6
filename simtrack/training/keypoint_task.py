"""How the keypoint network learns: samples, loss, and what is told of it on held-out scenes."""

from dataclasses import dataclass

import numpy as np
import torch  # pyright: ignore[reportMissingImports] - extra `train`
from torch import Tensor, nn  # pyright: ignore[reportMissingImports] - extra `train`
from torch.nn import functional  # pyright: ignore[reportMissingImports] - extra `train`

from simtrack.objects import ObjectModel
from simtrack.perception.detection.bins import BINS, LEAST_SIGMA, decoded, position_of
from simtrack.perception.detection.views import WINDOW, window_about
from simtrack.training.keypoint_samples import Sample, sample
from simtrack.training.networks import KeypointNetwork
from simtrack.training.shards import BACKGROUND, Shards

SOFTNESS = 1.3
"""Standard deviation of the labels' distributions, bins."""
POINT_WEIGHT, PRESENT_WEIGHT = 2.0, 0.3
CHI_SQUARE_MEDIAN = 0.4549
"""Median of the square of a standard normal number."""


@dataclass(frozen=True, slots=True)
class _Errors:
    """Of held-out windows."""

    errors: list[float]
    """Of each keypoint, in shares of the object's projected size."""
    normalised: list[float]
    """Of each coordinate, over the standard deviation that the network tells."""
    believed: list[bool]
    """Of each window: whether the network says that the object is there."""

    def sigma_scale(self) -> float:
        """From the median, since some windows are taken for another view altogether."""
        return float(np.sqrt(np.median(np.square(self.normalised)) / CHI_SQUARE_MEDIAN))


class KeypointTask:
    """Training of `KeypointNetwork`; see `simtrack.training.loop.Task`."""

    name = "keypoints"
    batch_size = 48
    learning_rate = 1.5e-3

    def __init__(self, models: tuple[ObjectModel, ...], train: Shards, held_out: Shards, validated: int = 600) -> None:
        self.models, self._train, self._held_out = models, train, held_out
        classes = held_out.column("class_index")
        clear = np.flatnonzero((classes != BACKGROUND) & (held_out.column("visible") > 0.5))
        self._validated = clear[:: max(1, len(clear) // validated)]
        counts = np.bincount(train.column("class_index")[train.column("class_index") >= 0], minlength=len(models))
        self.missing = tuple(models[i].name for i in np.flatnonzero(counts == 0))

    def network(self) -> KeypointNetwork:
        """A new one."""
        return KeypointNetwork(len(self.models), BINS)

    def batch(self, rng: np.random.Generator) -> tuple[Tensor, ...]:
        """Random samples."""
        picks = rng.integers(0, len(self._train), self.batch_size)
        return self._tensors([sample(self._train[int(i)], self.models, rng) for i in picks])

    def loss(self, network: KeypointNetwork, batch: tuple[Tensor, ...]) -> Tensor:
        """Cross entropy of the coordinates, L1 of the object points, and of what is there at all."""
        shown, told, keypoints, points, present = batch
        logits, there, answered = network.taught(shown, told)
        place = position_of(keypoints)
        bins = torch.arange(BINS)
        target = torch.exp(-0.5 * ((bins - place[..., None]) / SOFTNESS) ** 2)
        inside = (place > -0.5) & (place < BINS - 0.5) & (present[:, None, None] > 0)
        target = target / target.sum(-1, keepdim=True).clamp(min=1e-6)
        entropy = -(target * functional.log_softmax(logits, -1)).sum(-1)
        loss = (entropy * inside).sum() / inside.sum().clamp(min=1)
        known = points[:, 3:]
        loss = loss + POINT_WEIGHT * (
            functional.smooth_l1_loss(answered[:, :3], points[:, :3], reduction="none", beta=0.1) * known
        ).sum() / known.sum().clamp(min=1)
        mask = functional.binary_cross_entropy_with_logits(answered[:, 3:], known)
        return loss + 0.3 * mask + PRESENT_WEIGHT * functional.binary_cross_entropy_with_logits(there, present)

    def validate(self, network: KeypointNetwork) -> dict[str, float]:
        """Median keypoint error as a share of the object's projected size, and shares of windows rightly believed."""
        found = self._held_out_errors(network)
        median, third, ninth = np.percentile(found.errors, [50, 75, 90])
        return {
            "median error, % of size": 100 * median,
            "p75": 100 * third,
            "p90": 100 * ninth,
            "believed": float(np.mean(found.believed)),
            "sigma scale": found.sigma_scale(),
        }

    def sigma_scale(self, network: nn.Module) -> float:
        """Standard deviation of the coordinates' errors over the one that the network tells, on held-out windows."""
        with torch.no_grad():
            return self._held_out_errors(network).sigma_scale()

    def _held_out_errors(self, network: nn.Module) -> "_Errors":
        rng = np.random.default_rng(0)
        found = _Errors([], [], [])
        for first in range(0, len(self._validated), 64):
            records = [self._held_out[int(i)] for i in self._validated[first : first + 64]]
            samples = [sample(record, self.models, rng, plain=True) for record in records]
            shown, told, *_ = self._tensors(samples)
            logits, there = network(shown, told)
            places, spreads = decoded(logits.numpy())
            found.believed.extend((there > 0).tolist())
            for record, told_of, place, spread in zip(records, samples, places, spreads, strict=True):
                error = place - told_of.keypoints
                distance = np.linalg.norm(error, axis=1) * window_about(record["box"], WINDOW).side
                size = record["intrinsics"][0] * self.models[record["class_index"]].diameter
                found.errors.extend((distance / (size / record["T_camera_object"][2, 3])).tolist())
                sigma = np.maximum(np.sqrt(np.mean(spread**2, axis=1)), LEAST_SIGMA)
                found.normalised.extend((error / sigma[:, None]).ravel().tolist())
        return found

    @staticmethod
    def _tensors(samples: list[Sample]) -> tuple[Tensor, ...]:
        columns = [np.stack([getattr(s, name) for s in samples]) for name in ("shown", "told", "keypoints", "points")]
        present = np.array([s.present for s in samples], np.float32)
        shown, *rest = [torch.from_numpy(np.ascontiguousarray(column, np.float32)) for column in columns]
        return shown.contiguous(memory_format=torch.channels_last), *rest, torch.from_numpy(present)
