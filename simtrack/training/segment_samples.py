"""What the panoptic network learns from one labelled image."""

from collections.abc import Mapping

import numpy as np

from simtrack.contracts import Float32
from simtrack.datasets.room_films import FilmedImage
from simtrack.perception.segmentation.panoptic_network import MULTIPLE, OFFSET, STRIDE, STUFF, mirrored, shown_scene

IGNORED = -1
"""Class of cells that teach nothing."""
LEAST_PIXELS = 16
"""Things of which fewer pixels are seen teach nothing."""
_SPREAD = (1.0, 2.5)
"""Cells: least and largest standard deviation of the heat about a middle."""


def segment_sample(
    image: FilmedImage, index: Mapping[str, int], rng: np.random.Generator | None = None
) -> tuple[Float32, np.ndarray, Float32, Float32]:
    """Input and targets of one image.

    Args:
        image: with labels.
        index: class -> its number.
        rng: of mirroring and colours; None leaves the image as it is.

    Returns:
        Input (CHANNELS, H, W); classes (H/4, W/4) int64, `IGNORED` where nothing is learned; heat (1, ...); offsets
        (2, ...) in units of `OFFSET` pixels, NaN where there is no thing.
    """
    rgb = image.rgb
    if rng is not None:
        gains = rng.uniform(0.75, 1.25) * rng.uniform(0.9, 1.1, 3)
        rgb = np.clip(rgb * gains + rng.uniform(-15.0, 15.0), 0.0, 255.0).astype(np.uint8)
    shown = shown_scene(rgb, image.depth, image.intrinsics)
    entities = np.full(shown.shape[1:], -1, np.int32)
    entities[: image.entities.shape[0], : image.entities.shape[1]] = image.entities
    if rng is not None and image.intrinsics.width % MULTIPLE == 0 and rng.random() < 0.5:
        shown, entities = mirrored(shown), np.ascontiguousarray(entities[:, ::-1])
    cells = entities[1::STRIDE, 1::STRIDE]
    classes = np.array([*(index.get(name, IGNORED) for name in image.classes), IGNORED], np.int64)[cells]
    heat = np.zeros((1, *cells.shape), np.float32)
    offsets = np.full((2, *cells.shape), np.nan, np.float32)
    v, u = np.nonzero(entities >= 0)
    owners = entities[v, u]
    counts = np.bincount(owners, minlength=len(image.classes))
    middles = np.stack([np.bincount(owners, x, minlength=len(counts)) for x in (u, v)], axis=1)
    middles /= np.maximum(counts, 1)[:, None]
    rows, columns = np.arange(cells.shape[0])[:, None], np.arange(cells.shape[1])
    for number in np.flatnonzero(counts).tolist():
        if image.classes[number] in STUFF:
            continue
        mine = cells == number
        if counts[number] < LEAST_PIXELS or image.classes[number] not in index:
            classes[mine] = IGNORED
            continue
        x, y = middles[number]
        column, row = int((x + 0.5) // STRIDE), int((y + 0.5) // STRIDE)
        sigma = float(np.clip(0.12 * np.sqrt(counts[number]) / STRIDE, *_SPREAD))
        blob = np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / (2.0 * sigma**2))
        np.maximum(heat[0], blob, out=heat[0])
        at_v, at_u = np.nonzero(mine)
        offsets[0, at_v, at_u] = (x - (STRIDE * at_u + 1.5)) / OFFSET
        offsets[1, at_v, at_u] = (y - (STRIDE * at_v + 1.5)) / OFFSET
    return shown, classes, heat, offsets
