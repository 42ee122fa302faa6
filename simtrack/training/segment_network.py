"""The network that tells panoptic segments: one trunk, and three small heads on cells of four pixels."""

import torch  # pyright: ignore[reportMissingImports] - extra `train`
from torch import Tensor, nn  # pyright: ignore[reportMissingImports] - extra `train`
from torch.nn import functional  # pyright: ignore[reportMissingImports] - extra `train`

from simtrack.perception.segmentation.panoptic_network import CHANNELS
from simtrack.training.networks import Residual, convolved, halved, in_bfloat16

_WIDTHS = (32, 64, 128, 192)
"""Channels at 4, 8, 16 and 32 pixels a cell."""
_JOINED = 48


class SegmentNetwork(nn.Module):
    """Panoptic-DeepLab's heads (Cheng et al., CVPR 2020) on a feature pyramid."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        first, second, third, fourth = _WIDTHS
        self.stem = convolved(CHANNELS, 16, stride=2)
        self.stages = nn.ModuleList(
            [halved(16, first, 1), halved(first, second, 2), halved(second, third, 2), halved(third, fourth, 1)]
        )
        self.sideways = nn.ModuleList([nn.Conv2d(width, _JOINED, 1) for width in _WIDTHS])
        self.joined = nn.Sequential(convolved(_JOINED, _JOINED), Residual(_JOINED))
        self.classes = nn.Conv2d(_JOINED, classes, 1)
        self.places = nn.Sequential(convolved(_JOINED, 32), nn.Conv2d(32, 3, 1))
        nn.init.constant_(self.places[1].bias, 0.0)  # type: ignore[arg-type]

    @in_bfloat16
    def forward(self, shown: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(N, CHANNELS, H, W) to logits (N, classes, H/4, W/4), heat logits (N, 1, ...) and offsets (N, 2, ...)."""
        x = self.stem(shown)
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        joined = self.sideways[-1](levels[-1])
        for level, sideways in zip(levels[-2::-1], list(self.sideways)[-2::-1], strict=True):
            joined = sideways(level) + functional.interpolate(joined, scale_factor=2.0, mode="nearest")
        joined = self.joined(joined)
        places = self.places(joined)
        return self.classes(joined), places[:, :1] - 3.0, places[:, 1:]


class Answering(nn.Module):
    """The network as it is written: heat from 0 to 1."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, shown: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As `SegmentNetwork`, with a sigmoid over the heat."""
        logits, heat, offsets = self.network(shown)
        return logits, torch.sigmoid(heat), offsets
