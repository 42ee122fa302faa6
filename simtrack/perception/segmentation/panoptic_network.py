"""What a panoptic network is shown of an RGB-D image, and what its answers mean.

Training and segmentation share this module, so that a network meets in a map what it was trained on. The answers are
those of Panoptic-DeepLab (Cheng et al., CVPR 2020): the class of every cell, a heat map of the middles of things, and
from every cell the way to the middle of its thing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Float64, Int32, Uint8
from simtrack.errors import InvalidValueError
from simtrack.perception.segmentation.panoptic import PanopticSegments

CHANNELS = 10
"""Red, green, blue (-1 to 1); x, y, z of the point in the camera frame over `FAR`; its normal; whether it was read."""
STRIDE = 4
"""Pixels a side of a cell."""
MULTIPLE = 32
"""Height and width of what the network is shown are multiples of this, with nothing below and right of the image."""
COLUMNS = 320
"""The network is shown images of about so many columns."""
FAR = 3.0
OFFSET = 32.0
"""Pixels that an offset of 1 stands for."""
STUFF = ("floor", "wall", "ceiling")


@dataclass(frozen=True, slots=True)
class DecodingConfig:
    """Settings of `decoded_segments`; pixels are those of the image that the network is shown."""

    peak: float = 0.15
    """Least heat of the middle of a thing."""
    apart: int = 1
    """Cells on either side of a middle in which there is no other."""
    min_pixels: int = 20
    """Smaller segments are none."""
    least_score: float = 0.3
    """Segments of which the network is less sure are none."""
    most_things: int = 100

    def __post_init__(self) -> None:
        for name in ("peak", "least_score"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidValueError(f"DecodingConfig.{name}", getattr(self, name), "0 to 1")
        for name in ("apart", "min_pixels", "most_things"):
            if not 1 <= getattr(self, name) <= 10_000:
                raise InvalidValueError(f"DecodingConfig.{name}", getattr(self, name), "1 to 10000")


def shown_scene(rgb: Uint8 | None, depth: Float32, intrinsics: CameraIntrinsics) -> Float32:
    """(CHANNELS, H', W'), what the network is shown; H' and W' are padded to multiples of `MULTIPLE`.

    Args:
        rgb: (H, W, 3); grey if None.
        depth: (H, W), metres, 0 = no reading.
        intrinsics: of the image.
    """
    from simtrack.perception.segmentation.depth_kernels import smoothed, surface_normals

    height, width = depth.shape
    camera = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
    read = (depth > 0.0) & np.isfinite(depth)
    z = np.where(read, depth, np.float32(0.0)).astype(np.float32)
    normals = surface_normals(smoothed(z, 2, np.float32(0.05)), camera, 3, np.float32(0.05))
    shown = np.zeros((CHANNELS, -(-height // MULTIPLE) * MULTIPLE, -(-width // MULTIPLE) * MULTIPLE), np.float32)
    inner = shown[:, :height, :width]
    if rgb is not None:
        inner[:3] = np.moveaxis(rgb, 2, 0).astype(np.float32) / 127.5 - 1.0
    x = ((np.arange(width) - intrinsics.cx) / intrinsics.fx).astype(np.float32)
    y = ((np.arange(height) - intrinsics.cy) / intrinsics.fy).astype(np.float32)
    inner[3], inner[4], inner[5] = z * x / FAR, z * y[:, None] / FAR, z / FAR
    inner[6:9] = np.moveaxis(normals, 2, 0)
    inner[9] = read
    return shown


def mirrored(shown: Float32) -> Float32:
    """What the network is shown of the mirror image of a scene; the image fills all of it."""
    other = shown[:, :, ::-1].copy()
    other[[3, 6]] *= -1.0
    return other


def decoded_segments(
    stamp: int,
    answers: tuple[Float32, Float32, Float32],
    classes: Sequence[str],
    shape: tuple[int, int],
    config: DecodingConfig | None = None,
) -> PanopticSegments:
    """The segments that a network's answers tell of.

    Args:
        stamp: nanoseconds, of the image.
        answers: logits (C, h, w) of classes, heat (1, h, w) 0 to 1, offsets (2, h, w) in x and y to the middles, in
            units of `OFFSET` pixels.
        classes: C of them.
        shape: (H, W) of the image that the network was shown, at most `STRIDE` times (h, w).
        config: settings, the defaults if None.
    """
    import cv2

    config = config or DecodingConfig()
    logits, heat, offsets = answers
    h, w = heat.shape[1:]
    whole = (w * STRIDE, h * STRIDE)
    logits = np.stack([cv2.resize(layer, whole, interpolation=cv2.INTER_LINEAR) for layer in logits])
    logits = logits[:, : shape[0], : shape[1]]
    best = logits.argmax(axis=0)
    top = logits.max(axis=0)
    sure = 1.0 / np.exp(logits - top).sum(axis=0)
    ways = [cv2.resize(layer, whole, interpolation=cv2.INTER_LINEAR)[: shape[0], : shape[1]] for layer in offsets]
    owner = _owners(best, _peaks(heat[0], config), ways, np.isin(classes, STUFF))
    image = np.zeros(shape, np.int32)
    names: list[str] = []
    scores: list[float] = []
    for number in np.unique(owner[owner >= 0]).tolist():
        mask = owner == number
        # A thing has one class: the one that most of it looks like.
        name = int(np.bincount(best[mask], minlength=len(classes)).argmax())
        score = float(sure[mask & (best == name)].mean())
        if mask.sum() >= config.min_pixels and score >= config.least_score:
            names.append(classes[name])
            scores.append(score)
            image[mask] = len(names)
    return PanopticSegments(stamp, image, tuple(names), np.array(scores, np.float32))


def _peaks(heat: Float32, config: DecodingConfig) -> Float64:
    """(N, 2), x and y of the middles of things in pixels, the hottest first."""
    import cv2

    around = np.ones((2 * config.apart + 1,) * 2, np.uint8)
    high = (heat >= config.peak) & (heat >= cv2.dilate(heat, around))
    rows, columns = np.nonzero(high)
    order = np.argsort(-heat[rows, columns], kind="stable")[: config.most_things]
    return ((np.stack([columns[order], rows[order]], axis=1) + 0.5) * STRIDE - 0.5).astype(np.float64)


def _owners(best: np.ndarray, peaks: Float64, ways: Sequence[Float32], stuff: np.ndarray) -> Int32:
    """(H, W): class of stuff, or number of classes + number of the middle that a pixel of a thing points to; -1."""
    owner = np.where(stuff[best], best, -1).astype(np.int32)
    if not len(peaks):
        return owner
    rows, columns = np.nonzero(~stuff[best])
    x, y = columns + OFFSET * ways[0][rows, columns], rows + OFFSET * ways[1][rows, columns]
    nearest = np.full(len(rows), -1, np.int32)
    least = np.full(len(rows), np.inf)
    for number, (u, v) in enumerate(peaks):
        off = (x - u) ** 2 + (y - v) ** 2
        closer = off < least
        nearest[closer], least[closer] = number, off[closer]
    owner[rows, columns] = len(stuff) + nearest
    return owner
