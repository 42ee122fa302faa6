"""An oracle in the place of a panoptic network: true segments with the errors that networks make.

Errors are of two kinds: what a network gets wrong about a thing it goes on getting wrong while the view stays much the
same (its class, that it is there at all, where it ends), and what flickers from image to image. The former is drawn
for every thing and `SegmenterErrors.epoch` of time, the latter for every image. All shares and sizes are multiplied by
one `strength`; 0 answers the truth.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import NANOSECONDS, Int32, RgbdFrame
from simtrack.errors import InvalidValueError
from simtrack.perception.segmentation.panoptic import PanopticSegments

STUFF = ("floor", "wall", "ceiling")
"""Classes of which an image has one segment, whatever is visible of them."""
CONFUSED: Mapping[str, tuple[str, ...]] = {
    "bed": ("sofa", "table"), "sofa": ("bed", "chair"), "chair": ("table", "sofa"), "table": ("counter", "chair"),
    "counter": ("table", "cabinet"), "cabinet": ("fridge", "counter"), "fridge": ("cabinet", "microwave"),
    "microwave": ("box", "monitor"), "monitor": ("picture", "microwave"), "picture": ("monitor", "board"),
    "board": ("picture", "wall"), "shelf": ("board", "cabinet"), "bag": ("box", "plant"), "box": ("bag", "book"),
    "book": ("box", "keyboard"), "keyboard": ("book", "board"), "cup": ("bowl", "bottle"), "bowl": ("cup", "box"),
    "bottle": ("cup", "plant"), "plant": ("bag", "bottle"), "floor": ("table", "wall"), "wall": ("board", "cabinet"),
}  # fmt: skip
"""What a thing of a class is taken for, the likelier first; others are taken for a box."""


@dataclass(frozen=True, slots=True)
class SegmenterErrors:
    """Errors at strength 1. They were set once, by what the map without joint fusion reaches, and stay."""

    wrong_class: float = 0.21
    """Share of epochs in which a thing is taken for something else."""
    missed: float = 0.21
    """... in which it is not found; small ones are missed more often."""
    small: float = 30.0
    """Pixels: a thing that covers the square of it is missed in half of the rest of the images."""
    flicker: float = 0.21
    """Share of images in which a thing that was found is not, or is taken for something else."""
    split: float = 0.21
    """Share of epochs in which one thing is seen as two."""
    merged: float = 0.21
    """... in which a thing and one of the same class or size beside it are seen as one."""
    leak: float = 0.5
    """... in which a thing's mask reaches far over its border."""
    leak_size: float = 0.5
    """How far it does, as a share of the root of its area."""
    filled: float = 0.7
    """... in which the gaps of a thing, and what is seen through them, are taken for part of it."""
    filled_size: float = 0.5
    """How wide such gaps are, as a share of the root of its area."""
    stuff: float = 2.0
    """How many times as often walls and floors are wrong; a part of a split one is taken for something else."""
    ragged: float = 3.5
    """Pixels of 640: standard deviation of the borders."""
    epoch: float = 2.0
    """Seconds that an error lasts."""

    def __post_init__(self) -> None:
        for name in ("wrong_class", "missed", "flicker", "split", "merged", "leak", "filled"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidValueError(f"SegmenterErrors.{name}", getattr(self, name), "a share, 0 to 1")
        for name in ("small", "leak_size", "filled_size", "stuff", "ragged"):
            if not 0.0 <= getattr(self, name) < 1e4:
                raise InvalidValueError(f"SegmenterErrors.{name}", getattr(self, name), "0 or more, finite")
        if not 0.0 < self.epoch < 1e6:
            raise InvalidValueError("SegmenterErrors.epoch", self.epoch, "seconds > 0")


class OracleSegmenter:
    """Segments images by looking them up; implements `simtrack.perception.segmentation.panoptic.Segmenter`.

    Every image's randomness derives from the seed, its stamp and what is in it.
    """

    def __init__(
        self,
        labels: Callable[[int], Int32],
        classes: Sequence[str],
        strength: float = 1.0,
        seed: int = 0,
        errors: SegmenterErrors | None = None,
    ) -> None:
        """Look images up in `labels`.

        Args:
            labels: stamp -> (H, W) number of the entity that a pixel is of, -1 = nothing.
            classes: semantic class of each entity.
            strength: of the errors, 0 to 3.
            seed: of the errors.
            errors: at strength 1.

        Raises:
            InvalidValueError: the strength.
        """
        if not 0.0 <= strength <= 3.0:
            raise InvalidValueError("strength", strength, "0 to 3")
        self._labels, self._classes, self._strength, self._seed = labels, tuple(classes), strength, seed
        self.errors = errors or SegmenterErrors()

    def segment(self, frame: RgbdFrame) -> PanopticSegments:
        """Segments of the frame's image; neither its pixels nor its depth are looked at."""
        image = self._labels(frame.stamp)
        # One segment for all that is visible of a class of stuff.
        first = {name: self._classes.index(name) for name in STUFF if name in self._classes}
        merged = np.array([first.get(name, k) for k, name in enumerate(self._classes)] + [-1], np.int32)
        image = merged[image]
        names = list(self._classes)
        if self._strength > 0.0:
            image, names = self._confused(image, names, frame.stamp)
        return _panoptic(image, names, frame.stamp)

    def _confused(self, image: Int32, names: list[str], stamp: int) -> tuple[Int32, list[str]]:
        s, errors = self._strength, self.errors
        flicker = np.random.default_rng([self._seed, stamp % (1 << 62), 1])
        scale = image.shape[1] / 640.0
        image = image.copy()
        visible, counts = np.unique(image[image >= 0], return_counts=True)
        areas = dict(zip(visible.tolist(), counts.tolist(), strict=True))
        original = image.copy()
        for number, area in areas.items():
            rng = self._lasting(number, stamp)
            stuff = names[number] in STUFF
            often = max(s * (errors.stuff if stuff else 1.0), 1e-9)
            luck = rng.random(6) / often
            side, wrong, other = rng.uniform(0.0, 2.0 * np.pi), rng.random(), rng.uniform(-0.25, 0.25)
            fleeting, kind = flicker.random() / often, flicker.random()
            mine = original == number
            vanishes = min(s, 1.0) * 0.5 / (1.0 + (area / max((errors.small * scale) ** 2, 1e-9)) ** 2)
            if luck[0] < errors.missed or flicker.random() < vanishes:
                image[mine & (image == number)] = -1
                continue
            if fleeting < errors.flicker and kind < 0.5:
                image[mine & (image == number)] = -1
                continue
            choices = CONFUSED.get(self._classes[number], ("box",))
            taken_for = choices[0 if wrong < 0.65 else -1]
            if luck[1] < errors.wrong_class or fleeting < errors.flicker:
                names.append(taken_for)
                image[image == number] = len(names) - 1
                number = len(names) - 1
            if luck[2] < errors.split:
                image[mine & (image == number) & _half(mine, side, other)] = len(names)
                names.append(taken_for if stuff else names[number])
            elif luck[3] < errors.merged and not stuff:
                beside = self._beside(original, mine, number, names)
                if beside is not None:
                    image[image == beside] = number
            if luck[5] < errors.filled and not stuff:
                _fill(image, mine, number, min(errors.filled_size * s * np.sqrt(area), 40.0 * scale))
            if luck[4] < errors.leak:
                reach = errors.leak_size * s * np.sqrt(area) * (0.5 + wrong)
                _leak(image, mine, number, side, min(reach, 90.0 * scale))
        return _warped(image, s * errors.ragged * scale, flicker, self._lasting(-1, stamp)), names

    def _lasting(self, number: int, stamp: int) -> np.random.Generator:
        """Draws for an entity that stay the same for an epoch; each entity's epochs begin at a time of its own."""
        offset = 0.618 * (number + 2) % 1.0
        epoch = int(stamp / (self.errors.epoch * NANOSECONDS) + offset)
        return np.random.default_rng([self._seed, number + 1, epoch])

    def _beside(self, image: Int32, mine: np.ndarray, number: int, names: list[str]) -> int | None:
        """The thing that shares the longest border with one, if any does."""
        import cv2

        around = cv2.dilate(mine.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool) & ~mine
        near = image[around]
        found, counts = np.unique(near[near >= 0], return_counts=True)
        order = found[np.argsort(-counts, kind="stable")].tolist()
        return next((k for k in order if k != number and names[k] not in STUFF), None)


def _half(mask: np.ndarray, side: float, offset: float) -> np.ndarray:
    """(H, W), pixels on one side of a line through a mask's middle, shifted by a share of its size."""
    rows, columns = np.nonzero(mask)
    along = np.array([np.cos(side), np.sin(side)])
    spread = np.sqrt(len(rows)) * offset
    v, u = np.arange(mask.shape[0])[:, None], np.arange(mask.shape[1])
    return (u - columns.mean()) * along[0] + (v - rows.mean()) * along[1] > spread


def _leak(image: Int32, mask: np.ndarray, number: int, side: float, reach: float) -> None:
    """Let a segment take what is beside it on one side, in place."""
    import cv2

    if reach < 1.0:
        return
    near = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3) <= reach
    image[near & ~mask & _half(mask, side, 0.15)] = number


def _fill(image: Int32, mask: np.ndarray, number: int, width: float) -> None:
    """Let a segment take what is seen through its gaps, in place."""
    import cv2

    if width < 2.0:
        return
    # Grown by half the width, then shrunk by as much.
    near = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3) <= 0.5 * width
    framed = np.pad(near, 1, mode="edge").astype(np.uint8)
    closed = cv2.distanceTransform(framed, cv2.DIST_L2, 3)[1:-1, 1:-1] > 0.5 * width
    image[closed & ~mask] = number


def _warped(image: Int32, sigma: float, flicker: np.random.Generator, lasting: np.random.Generator) -> Int32:
    """The image seen through a smooth random displacement of standard deviation `sigma` pixels, part of which lasts."""
    import cv2

    height, width = image.shape
    cells = (max(height // 24, 2), max(width // 24, 2))
    maps = []
    for axis in range(2):
        small = np.sqrt(0.5) * (flicker.standard_normal(cells) + lasting.standard_normal(cells))
        smooth = cv2.resize(small.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
        grid = np.arange(width) if axis == 0 else np.arange(height)[:, None]
        maps.append((grid + sigma * smooth).astype(np.float32))
    as_float = image.astype(np.float32)  # exact for so few numbers, and what remap takes
    return cv2.remap(as_float, maps[0], maps[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE).astype(np.int32)


def _panoptic(image: Int32, names: list[str], stamp: int) -> PanopticSegments:
    present = np.unique(image[image >= 0])
    numbers = np.zeros(len(names) + 1, np.int32)
    numbers[present] = np.arange(1, len(present) + 1)
    # Confusion may have made two segments of one class of stuff: there is one of each.
    classes: list[str] = []
    for k in present.tolist():
        name = names[k]
        if name in STUFF and name in classes:
            numbers[k] = classes.index(name) + 1
        else:
            classes.append(name)
            numbers[k] = len(classes)
    return PanopticSegments(stamp, numbers[image], tuple(classes), np.full(len(classes), 0.9, np.float32))
