"""Masks of instances, as run lengths and as polygons."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from simtrack.contracts import Bool, Int32
from simtrack.datasets.frame import InstanceLabel, LabelledFrame


@dataclass(frozen=True, slots=True, eq=False)
class Mask:
    """A mask of an image, of which only a window is held."""

    pixels: Bool
    """(h, w), the window; (0, 0) for an empty mask."""
    at: tuple[int, int]
    """(u, v) of the window's first pixel."""
    shape: tuple[int, int]
    """(H, W) of the image."""

    @property
    def box(self) -> tuple[int, int, int, int]:
        """[u, v, width, height] of a window that is no larger than what is in it."""
        return *self.at, self.pixels.shape[1], self.pixels.shape[0]


def visible_mask(frame: LabelledFrame, label: InstanceLabel) -> Mask:
    """What is seen of an instance."""
    u0, v0, u1, v1 = label.box_visible or (0, 0, -1, -1)
    return Mask(frame.ids[v0 : v1 + 1, u0 : u1 + 1] == label.instance, (u0, v0), frame.ids.shape)


def whole_mask(label: InstanceLabel) -> Mask:
    """The part of an instance's silhouette that lies inside the image, seen or hidden."""
    rows = np.flatnonzero(label.amodal.any(axis=1))
    if not len(rows):
        return Mask(np.zeros((0, 0), np.bool_), (0, 0), label.amodal.shape)
    band = label.amodal[rows[0] : rows[-1] + 1]
    columns = np.flatnonzero(band.any(axis=0))
    return Mask(band[:, columns[0] : columns[-1] + 1], (int(columns[0]), int(rows[0])), label.amodal.shape)


def uncompressed_rle(mask: Mask) -> dict[str, Any]:
    """COCO's run lengths in a list: down the columns, beginning with how many pixels are not in the mask."""
    return {"size": list(mask.shape), "counts": _run_lengths(mask).tolist()}


def compressed_rle(mask: Mask) -> dict[str, Any]:
    """COCO's run lengths in a string, as its own tools write them."""
    from simtrack.datasets.writers.mask_kernels import characters

    return {"size": list(mask.shape), "counts": characters(_run_lengths(mask)).tobytes().decode("ascii")}


def _run_lengths(mask: Mask) -> np.ndarray:
    from simtrack.datasets.writers.mask_kernels import run_lengths

    return run_lengths(np.ascontiguousarray(mask.pixels), *mask.at, *mask.shape)


def polygon(mask: Mask) -> Int32:
    """One closed polygon around a mask with all its parts and holes: (N, 2) columns and rows of pixels, N >= 3.

    Parts and holes hang together by bridges that are walked there and back, from a pixel to the nearest one of what is
    connected already. Filling the polygon by the even-odd rule, its boundary included, gives the mask and the bridges.
    """
    import cv2

    found, _ = cv2.findContours(mask.pixels.view(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    rings = sorted((ring[:, 0, :].astype(np.int32) for ring in found), key=len, reverse=True)
    path, added = np.concatenate([rings[0], rings[0][:1]]), rings[0]
    waiting = [_Waiting(ring) for ring in rings[1:]]
    while waiting:
        for ring in waiting:
            ring.look_at(added)
        nearest = min(waiting, key=lambda ring: ring.gap)
        waiting.remove(nearest)
        added = np.roll(nearest.ring, -nearest.leave, axis=0)
        here = int(np.flatnonzero((path == nearest.reach).all(axis=1))[0])
        path = np.concatenate([path[: here + 1], added, added[:1], path[here:]])
    path = path[:-1] + np.array(mask.at, np.int32)
    return path if len(path) >= 3 else np.resize(path, (3, 2))


class _Waiting:
    """A ring that is to be connected, with the shortest bridge to what is connected already."""

    def __init__(self, ring: Int32) -> None:
        self.ring = ring
        self.gap = np.iinfo(np.int64).max
        self.leave = 0
        """Place of the bridge's end in the ring."""
        self.reach = ring[0]
        """(2,), pixel of the bridge's other end."""

    def look_at(self, other: Int32) -> None:
        """Take another connected ring into account."""
        from simtrack.datasets.writers.mask_kernels import closest

        gap, leave, reach = closest(self.ring, other)
        if gap < self.gap:
            self.gap, self.leave, self.reach = gap, leave, other[reach]
