"""How the panoptic network learns: images of filmed rooms, loss, and its quality on rooms that are held out."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch  # pyright: ignore[reportMissingImports] - extra `train`
from torch import Tensor  # pyright: ignore[reportMissingImports] - extra `train`
from torch.nn import functional  # pyright: ignore[reportMissingImports] - extra `train`

from simtrack.datasets.room_films import FilmedImage, filmed_image, filmed_rooms, room_classes
from simtrack.errors import DatasetError
from simtrack.perception.segmentation.panoptic_network import decoded_segments, shown_scene
from simtrack.training.scores import panoptic_quality
from simtrack.training.segment_network import SegmentNetwork
from simtrack.training.segment_samples import IGNORED, segment_sample

HELD_OUT = 20
"""Every so many-th room is held out."""
WEIGHED = 150
"""Images that the weights of the classes are measured on."""


class SegmentTask:
    """Training of `SegmentNetwork`; see `simtrack.training.loop.Task`."""

    name = "segments"
    batch_size = 8
    learning_rate = 2e-3

    def __init__(self, data: Path, validated: int = 60) -> None:
        """Learn from a folder that `simtrack generate rooms_panoptic` made; raises DatasetError if it has one room."""
        rooms = filmed_rooms(data)
        held, learned = rooms[::HELD_OUT], [room for k, room in enumerate(rooms) if k % HELD_OUT]
        if not learned:
            raise DatasetError(data, f"has one room; every {HELD_OUT}th is held out, so at least 2 are needed")
        self.classes = tuple(sorted({name for room in rooms for name in room_classes(room)}))
        self._index = {name: k for k, name in enumerate(self.classes)}
        groups: dict[tuple[int, int], list[Path]] = defaultdict(list)
        for room in learned:
            images = sorted(room.glob("*.jpg"))
            groups[filmed_image(images[0]).depth.shape] += images
        self._groups = list(groups.values())
        shown = [path for room in held for path in sorted(room.glob("*.jpg"))]
        self._validated = shown[:: max(1, len(shown) // validated)]
        self._weights = torch.from_numpy(self._measured_weights())

    def network(self) -> SegmentNetwork:
        """A new one."""
        return SegmentNetwork(len(self.classes))

    def batch(self, rng: np.random.Generator) -> tuple[Tensor, ...]:
        """Random images of one size."""
        sizes = np.array([len(group) for group in self._groups], float)
        group = self._groups[int(rng.choice(len(sizes), p=sizes / sizes.sum()))]
        picks = rng.integers(0, len(group), self.batch_size)
        columns = zip(*(segment_sample(filmed_image(group[int(i)]), self._index, rng) for i in picks), strict=True)
        shown, *rest = [torch.from_numpy(np.stack(column)) for column in columns]
        return shown.contiguous(memory_format=torch.channels_last), *rest

    def loss(self, network: SegmentNetwork, batch: tuple[Tensor, ...]) -> Tensor:
        """Cross entropy of the classes, penalty-reduced focal loss of the heat, absolute error of the offsets."""
        shown, classes, heat, offsets = batch
        logits, hot, ways = network(shown)
        entropy = functional.cross_entropy(logits, classes, self._weights, ignore_index=IGNORED)
        probability = torch.sigmoid(hot).clamp(1e-5, 1 - 1e-5)
        peak = (heat > 0.999).float()
        positive = -peak * (1 - probability) ** 2 * torch.log(probability)
        negative = -(1 - peak) * (1 - heat) ** 4 * probability**2 * torch.log(1 - probability)
        focal = (positive + negative).sum() / peak.sum().clamp(min=1)
        taught = torch.isfinite(offsets)
        off = (ways - torch.nan_to_num(offsets)).abs()[taught]
        return entropy + 0.5 * focal + (off.mean() if len(off) else off.sum())

    def validate(self, network: SegmentNetwork) -> dict[str, float]:
        """PQ of images of held-out rooms, the mean over classes and of each."""
        pairs = []
        for path in self._validated:
            image = filmed_image(path)
            shown = torch.from_numpy(shown_scene(image.rgb, image.depth, image.intrinsics))[None]
            logits, heat, offsets = network(shown)
            answers = (logits[0].numpy(), torch.sigmoid(heat)[0].numpy(), offsets[0].numpy())
            found = decoded_segments(0, answers, self.classes, image.depth.shape)
            pairs.append((found.image, found.classes, image.entities, image.classes))
        quality = panoptic_quality(pairs)
        return {"PQ": float(np.mean(list(quality.values()))) if quality else 0.0} | quality

    def _measured_weights(self) -> np.ndarray:
        """(C,) float32: rare classes count more, by the root of how rare they are."""
        images: Sequence[Path] = [path for group in self._groups for path in group]
        counts = np.zeros(len(self.classes))
        for path in images[:: max(1, len(images) // WEIGHED)]:
            counts += _class_pixels(filmed_image(path), self._index, len(self.classes))
        rarity = (counts + 1e-3 * counts.sum()) ** -0.5
        return (rarity / np.average(rarity, weights=counts + 1.0)).astype(np.float32)


def _class_pixels(image: FilmedImage, index: dict[str, int], classes: int) -> np.ndarray:
    seen = image.entities[image.entities >= 0]
    return np.bincount(np.array([index[name] for name in image.classes])[seen], minlength=classes)
