"""Objects of one image put before those of another (Ghiasi et al.: Simple Copy-Paste, CVPR 2021).

Things that fall onto a heap seldom lie in boxes, or side by side: how they look there is learned from these.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from simtrack.contracts import Float32, Float64

ON_OBJECT = 0.7
"""Share of pasted things that are put before another object; the others may come anywhere."""
WHOLE = 0.9
"""Only objects of which at least this is seen are taken."""
LEAST_SIDE, LARGEST_SIDE = 8.0, 300.0
"""Of what is pasted, pixels."""
NEARER = 0.12
"""A pasted thing is nearer than what it is put before by up to this, as a logarithm of the distance."""
MAGNIFIED = 2.0
"""At most."""


@dataclass(slots=True, eq=False)
class LabelledView:
    """An image with what is seen in it; all arrays may be written."""

    rgb: np.ndarray
    """(H, W, 3)."""
    depth: Float32
    """(H, W), metres, 0 = no reading."""
    index: np.ndarray
    """(H, W), which object a pixel shows, from 1; 0 = none."""
    boxes: Float64
    """(N, 4), x min, y min, x max, y max, pixels."""
    classes: np.ndarray
    """(N,), -1 = no object."""
    visible: np.ndarray
    """(N,), 0 to 1."""

    @classmethod
    def of(cls, record: Any) -> "LabelledView":
        """A copy of one of `simtrack.training.shards.IMAGES`."""
        return cls(
            np.array(record["rgb"]),
            np.array(record["depth"], np.float32),
            np.array(record["index"]),
            record["boxes"].astype(float),
            np.array(record["classes"]),
            np.array(record["visible"]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Cutout:
    """What is seen of an object, cut out of an image by its box."""

    rgb: np.ndarray
    depth: Float32
    mask: np.ndarray
    class_index: int
    visible: float

    @property
    def distance(self) -> float:
        """Metres, 0 = unknown."""
        return _typical(self.depth[self.mask > 0])

    def resized(self, scale: float) -> "_Cutout":
        """As it looks from nearer or farther, so many times as large."""
        import cv2

        height, width = (round(side * scale) for side in self.mask.shape)
        mask = np.asarray(cv2.resize(self.mask, (width, height), interpolation=cv2.INTER_NEAREST))
        rgb = np.asarray(cv2.resize(self.rgb, (width, height), interpolation=cv2.INTER_AREA))
        depth = np.asarray(cv2.resize(self.depth, (width, height), interpolation=cv2.INTER_NEAREST))
        return _Cutout(rgb, depth / np.float32(scale), mask, self.class_index, self.visible)


def paste(view: LabelledView, donor: Any, rng: np.random.Generator) -> bool:
    """Put an object of another image into a view, as large as it is at the distance of what it is put before.

    What it hides is counted: it makes less of the other objects visible.

    Args:
        view: is changed.
        donor: one of `simtrack.training.shards.IMAGES`.
        rng: of everything random.

    Returns:
        Whether there was an object to be taken, and room.
    """
    cutout = _cut_out(donor, rng)
    if cutout is None or not (view.classes < 0).any():
        return False
    place = _place(view, rng)
    distance, its_distance = cutout.distance, _typical(_around(view.depth, place))
    scale = distance / its_distance if distance > 0.0 and its_distance > 0.0 else 1.0
    scale *= float(np.exp(rng.uniform(0.0, NEARER)))
    sides = sorted(round(side * scale) for side in cutout.mask.shape)
    if scale > MAGNIFIED or sides[0] < LEAST_SIDE or sides[1] > LARGEST_SIDE:
        return False
    return _put(view, cutout.resized(scale), place)


def _put(view: LabelledView, cutout: _Cutout, place: Float64) -> bool:
    """Draw a cutout with its middle at a pixel (u, v) into a view; False if nothing of it is inside."""
    height, width = cutout.mask.shape
    left, top = (int(value) for value in np.round(place - 0.5 * np.array([width, height])))
    rows, columns = np.nonzero(cutout.mask)
    v, u = rows + top, columns + left
    inside = (v >= 0) & (u >= 0) & (v < view.depth.shape[0]) & (u < view.depth.shape[1])
    if not inside.any():
        return False
    at, taken = (v[inside], u[inside]), (rows[inside], columns[inside])
    hidden = np.bincount(view.index[at], minlength=len(view.classes) + 1)[1:]
    pixels = np.bincount(view.index.ravel(), minlength=len(view.classes) + 1)[1:]
    view.visible *= (1.0 - hidden / np.maximum(pixels, 1)).astype(view.visible.dtype)
    slot = int(np.flatnonzero(view.classes < 0)[0])
    view.rgb[at], view.depth[at], view.index[at] = cutout.rgb[taken], cutout.depth[taken], slot + 1
    view.boxes[slot] = left, top, left + width - 1, top + height - 1
    view.classes[slot], view.visible[slot] = cutout.class_index, cutout.visible * np.mean(inside)
    return True


def _cut_out(donor: Any, rng: np.random.Generator) -> _Cutout | None:
    """One of the objects that are seen whole."""
    boxes, limit = donor["boxes"], np.array(donor["depth"].shape[::-1], float)
    inside = (boxes[:, :2] > 0.5).all(axis=1) & (boxes[:, 2:] < limit - 1.5).all(axis=1)
    usable = np.flatnonzero((donor["classes"] >= 0) & (donor["visible"] >= WHOLE) & inside)
    if not len(usable):
        return None
    number = int(rng.choice(usable))
    u0, v0, u1, v1 = (int(value) for value in np.round(boxes[number]))
    part = np.s_[v0 : v1 + 1, u0 : u1 + 1]
    mask = (donor["index"][part] == number + 1).astype(np.uint8)
    depth = np.asarray(donor["depth"][part], np.float32)
    return _Cutout(donor["rgb"][part], depth, mask, int(donor["classes"][number]), float(donor["visible"][number]))


def _place(view: LabelledView, rng: np.random.Generator) -> Float64:
    """Where a thing is put: pixels (u, v)."""
    size = np.array(view.depth.shape[::-1], float)
    seen = np.flatnonzero((view.classes >= 0) & (view.visible > 0.0))
    if len(seen) and rng.random() < ON_OBJECT:
        box = view.boxes[rng.choice(seen)]
        return rng.uniform(box[:2], box[2:] + 1.0)
    return rng.uniform(np.zeros(2), size)


def _around(depth: Float32, place: Float64) -> Float32:
    u, v = (int(value) for value in np.clip(place, 0.0, np.array(depth.shape[::-1]) - 1.0))
    return depth[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3]


def _typical(depth: Float32) -> float:
    """Median of the readings, metres; 0 if there is none."""
    readings = depth[depth > 0.0]
    return float(np.median(readings)) if len(readings) else 0.0
