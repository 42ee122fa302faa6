"""Masks as formats store them, decoded, and what is measured on them."""

import numpy as np

from simtrack.contracts import Bool

MAX_PIXELS = 2**25


def decoded(size: tuple[int, int], counts: str | list[int]) -> Bool:
    """(H, W) mask of COCO run lengths, compressed or not; ValueError if they do not fill the image."""
    height, width = size
    if not 0 < height * width <= MAX_PIXELS:
        raise ValueError(f"size {size} is not that of an image")
    runs = np.array(_numbers(counts) if isinstance(counts, str) else counts, np.int64)
    if (runs < 0).any() or runs.sum() != height * width:
        raise ValueError(f"run lengths add up to {runs.sum()}, not to {height} x {width} pixels")
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, runs).reshape(width, height).T


def _numbers(text: str) -> list[int]:
    """COCO's string: five bits a character, the lowest first, and from the third on the change to the one before last.

    https://github.com/cocodataset/cocoapi, common/maskApi.c, rleFrString.
    """
    out: list[int] = []
    value = shift = 0
    for character in text.encode("ascii"):
        bits = character - 48
        if not 0 <= bits < 64:
            raise ValueError(f"'{chr(character)}' is no character of run lengths")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        out.append(value + (out[-2] if len(out) > 2 else 0))
        value = shift = 0
    return out


def box(mask: Bool) -> tuple[int, int, int, int] | None:
    """(u0, v0, u1, v1), first and last pixel; None of an empty mask."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])


def edge_free(mask: Bool, margin: int) -> Bool:
    """The mask without what lies within `margin` pixels of its edge; the image's border is no edge."""
    import cv2

    if not mask.any():
        return mask
    size = 2 * margin + 1
    border = cv2.BORDER_REPLICATE
    return cv2.erode(mask.astype(np.uint8), np.ones((size, size), np.uint8), borderType=border) > 0
