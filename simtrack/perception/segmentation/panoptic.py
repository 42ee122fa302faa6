"""Panoptic segmentation of one image, and the Protocol of whoever makes it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Bool, Float32, Int32, RgbdFrame
from simtrack.errors import InvalidValueError

MOST_SEGMENTS = 10_000


@dataclass(frozen=True, slots=True, eq=False)
class PanopticSegments:
    """Masks that do not overlap (Kirillov et al., CVPR 2019), each with a semantic class and a score."""

    stamp: int
    """Nanoseconds, of the image."""
    image: Int32
    """(H, W): number of the segment that a pixel belongs to, from 1; 0 = none."""
    classes: tuple[str, ...]
    """Semantic class of each segment; those of stuff (floor, wall) have one segment at most."""
    scores: Float32
    """(N,), 0 to 1."""

    def __post_init__(self) -> None:
        if len(self.classes) != len(self.scores) or len(self.classes) > MOST_SEGMENTS:
            counts = (len(self.classes), len(self.scores))
            raise InvalidValueError("classes, scores", counts, f"as many of each, at most {MOST_SEGMENTS}")
        if self.image.ndim != 2:
            raise InvalidValueError("image", self.image.shape, "(H, W)")
        if self.image.size and not 0 <= int(self.image.min()) <= int(self.image.max()) <= len(self.classes):
            found = (int(self.image.min()), int(self.image.max()))
            raise InvalidValueError("image", found, f"numbers of segments, 0 to {len(self.classes)}")

    def __len__(self) -> int:
        return len(self.classes)

    def mask(self, segment: int) -> Bool:
        """(H, W), pixels of the segment of that number, from 1."""
        return self.image == segment

    @staticmethod
    def of_masks(stamp: int, masks: npt.ArrayLike, classes: Sequence[str], scores: npt.ArrayLike) -> "PanopticSegments":
        """Of masks that may overlap: a pixel belongs to the mask with the highest score.

        Args:
            stamp: nanoseconds, of the image.
            masks: (N, H, W) bool.
            classes: N of them.
            scores: (N,), 0 to 1.

        Raises:
            InvalidValueError: shapes or counts that do not fit.
        """
        stack, weights = np.asarray(masks, np.bool_), np.asarray(scores, np.float32)
        if stack.ndim != 3 or stack.shape[0] != len(classes) or weights.shape != (len(classes),):
            found = (stack.shape, len(classes), weights.shape)
            raise InvalidValueError("masks, classes, scores", found, "(N, H, W), N and (N,)")
        image = np.zeros(stack.shape[1:], np.int32)
        for number in np.argsort(weights, kind="stable").tolist():
            image[stack[number]] = number + 1
        return PanopticSegments(stamp, image, tuple(classes), weights)


@runtime_checkable
class Segmenter(Protocol):
    """Finds objects and layout in an RGB-D image."""

    def segment(self, frame: RgbdFrame) -> PanopticSegments | None:
        """Masks, classes and scores of one image; None where the segmenter failed on it."""
        ...
