"""The two networks: boxes and classes in an image, keypoints in a window about one box.

Plain convolutions with residual connections: on a CPU they train faster than separable ones of equal accuracy.
"""

from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from typing import Any

import torch  # pyright: ignore[reportMissingImports] - extra `train`
from torch import Tensor, nn  # pyright: ignore[reportMissingImports] - extra `train`
from torch.nn import functional  # pyright: ignore[reportMissingImports] - extra `train`

from simtrack.perception.detection.boxes import STRIDE
from simtrack.perception.detection.views import CHANNELS
from simtrack.training.keypoint_samples import SIZE

KEYPOINTS = 9
_CPU_FLAGS = Path("/proc/cpuinfo")


@cache
def bfloat16_is_native() -> bool:
    """Whether this processor multiplies bfloat16 in hardware; elsewhere it is slower than float32."""
    flags = _CPU_FLAGS.read_text(encoding="utf-8") if _CPU_FLAGS.is_file() else ""
    return "avx512_bf16" in flags or "amx_bf16" in flags


def in_bfloat16(answer: Callable[..., tuple[Tensor, ...]]) -> Callable[..., Any]:
    """Let a network compute an answer in bfloat16 while it learns, where that is faster; what it tells is float32."""

    @wraps(answer)
    def computed(network: nn.Module, *inputs: Tensor) -> tuple[Tensor, ...]:
        if not (network.training and bfloat16_is_native()):
            return answer(network, *inputs)
        with torch.autocast("cpu", torch.bfloat16):
            outputs = answer(network, *inputs)
        return tuple(output.float() for output in outputs)

    return computed


def convolved(channels_in: int, channels_out: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution, batch normalisation, ReLU."""
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(channels_out),
        nn.ReLU(inplace=True),
    )


class Residual(nn.Module):
    """Two convolutions beside the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = convolved(channels, channels)
        self.second = nn.Conv2d(channels, channels, 3, 1, 1, bias=False)
        self.norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) to the same shape."""
        return functional.relu(x + self.norm(self.second(self.first(x))))


def halved(channels_in: int, channels_out: int, blocks: int) -> nn.Sequential:
    """Half the resolution, then residual blocks."""
    return nn.Sequential(
        convolved(channels_in, channels_out, stride=2), *(Residual(channels_out) for _ in range(blocks))
    )


class BoxNetwork(nn.Module):
    """Heat maps of objects' centres and distances to the sides of their boxes, in cells of 4 pixels.

    CenterNet's heat maps (Zhou, Wang, Kraehenbuehl: Objects as Points, 2019) over a feature pyramid. Every class has
    sides of its own: a thing in a box and the box may have their centres in one cell.
    """

    stride = STRIDE

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.stem, self.quarter = convolved(CHANNELS, 16, stride=2), halved(16, 32, 1)
        self.fine, self.middle, self.coarse = halved(32, 64, 2), halved(64, 128, 2), halved(128, 192, 1)
        self.from_coarse, self.from_middle = nn.Conv2d(192, 64, 1), nn.Conv2d(128, 64, 1)
        self.joined, self.from_joined = nn.Sequential(convolved(64, 64), Residual(64)), nn.Conv2d(64, 32, 1)
        self.last = nn.Sequential(convolved(32, 32), convolved(32, 32))
        self.heat, self.sides = nn.Conv2d(32, classes, 1), nn.Conv2d(32, 4 * classes, 1)
        nn.init.constant_(self.heat.bias, -4.0)  # type: ignore[arg-type]
        nn.init.constant_(self.sides.bias, 1.5)  # type: ignore[arg-type]

    @in_bfloat16
    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 5, H, W) to logits (N, C, H / 4, W / 4) and log distances (N, 4 C, H / 4, W / 4), in cells.

        Distances to the left, upper, right and lower side of class c are the channels from 4 c on.
        """
        quarter = self.quarter(self.stem(image))
        fine = self.fine(quarter)
        middle = self.middle(fine)
        coarse = self.from_coarse(self.coarse(middle))
        middle = self.from_middle(middle) + _enlarged(coarse, middle)
        joined = self.from_joined(self.joined(fine + _enlarged(middle, fine)))
        last = self.last(quarter + _enlarged(joined, quarter))
        return self.heat(last), self.sides(last).clamp(-4.0, 5.5)


def _enlarged(features: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(features, size=like.shape[2:], mode="nearest")


class KeypointNetwork(nn.Module):
    """Where the nine keypoints of an object of a given class lie in a window, and whether there is such an object.

    Each coordinate is a distribution over bins (Li et al.: SimCC, ECCV 2022). In training only, the network also tells
    which point of the object each cell of 4 pixels shows, which teaches it shapes.
    """

    size = SIZE

    def __init__(self, classes: int, bins: int) -> None:
        super().__init__()
        self.bins = bins
        self.stem = nn.Sequential(convolved(CHANNELS, 24, stride=2), Residual(24))
        self.fine, self.middle, self.coarse = halved(24, 48, 2), halved(48, 96, 2), halved(96, 160, 2)
        self.told_middle, self.told_coarse = nn.Linear(classes + 2, 96), nn.Linear(classes + 2, 160)
        cells = (self.size // 16) ** 2
        self.hidden = nn.Sequential(nn.Linear(160 * cells + classes + 2, 320), nn.ReLU(inplace=True))
        self.coordinates, self.present = nn.Linear(320, KEYPOINTS * 2 * bins), nn.Linear(320, 1)
        self.from_coarse, self.from_middle = nn.Conv2d(160, 48, 1), nn.Conv2d(96, 48, 1)
        self.points = nn.Sequential(convolved(48, 48), nn.Conv2d(48, 4, 1))

    def features(self, window: Tensor, told: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Feature maps at 4, 8 and 16 pixels a cell."""
        fine = self.fine(self.stem(window))
        middle = self.middle(fine)
        middle = functional.relu(middle + self.told_middle(told)[:, :, None, None])
        coarse = self.coarse(middle)
        return fine, middle, functional.relu(coarse + self.told_coarse(told)[:, :, None, None])

    def answers(self, coarse: Tensor, told: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (N, 9, 2, bins) of the coordinates, and (N,) of there being an object."""
        hidden = self.hidden(torch.cat([coarse.flatten(1), told], 1))
        return self.coordinates(hidden).view(-1, KEYPOINTS, 2, self.bins), self.present(hidden)[:, 0]

    def forward(self, window: Tensor, told: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 5, 64, 64) and (N, classes + 2) to `answers`."""
        return self.answers(self.features(window, told)[2], told)

    @in_bfloat16
    def taught(self, window: Tensor, told: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`answers`, and (N, 4, 16, 16): object points in shares of its half extents, and logits of its mask."""
        fine, middle, coarse = self.features(window, told)
        up = self.from_middle(middle) + functional.interpolate(self.from_coarse(coarse), scale_factor=2.0)
        points = self.points(fine + functional.interpolate(up, scale_factor=2.0))
        return (*self.answers(coarse, told), points)
