"""What the networks are shown: a whole image made small, and square windows of it, colour and depth together.

Training and detection prepare their input here, so that a network meets in a run what it was trained on.
"""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float32, Float64, Uint8

CHANNELS = 5
"""Of both networks' input: red, green, blue (-1 to 1), relative or inverse depth, whether there is a depth reading."""
WINDOW = 1.25
"""Side of the window about a box, in shares of the box's longer side."""
NEAR = 0.3
"""Metres at which the inverse depth of an image saturates."""
MIN_READINGS = 12
"""Fewest depth readings in the middle of a window for its depth to be used."""


@dataclass(frozen=True, slots=True)
class Window:
    """A square part of an image, upright."""

    u: float
    """Centre, pixels."""
    v: float
    side: float
    """Pixels."""

    def pixels_of(self, size: int) -> Float64:
        """(2, 3): from pixels (i, j, 1) of the window drawn `size` pixels wide to the image's pixels."""
        step = self.side / size
        first = 0.5 * (step - self.side)
        return np.array([[step, 0.0, self.u + first], [0.0, step, self.v + first]])


def window_about(box: Float64, scale: float = WINDOW) -> Window:
    """The window about a box (x min, y min, x max, y max), pixels."""
    u0, v0, u1, v1 = (float(value) for value in box)
    return Window(0.5 * (u0 + u1), 0.5 * (v0 + v1), max(scale * max(u1 - u0, v1 - v0), 4.0))


class Pyramid:
    """An image in several resolutions: windows are cut from the coarsest that is fine enough."""

    def __init__(self, rgb: Uint8, levels: int = 3) -> None:
        import cv2

        self._levels = [rgb]
        for _ in range(levels - 1):
            self._levels.append(np.asarray(cv2.pyrDown(self._levels[-1]), np.uint8))

    def cut(self, pixels: Float64, size: int) -> Uint8:
        """(size, size, 3), colours at image pixels ``pixels @ (i, j, 1)``; grey outside of the image.

        Args:
            pixels: (2, 3), as `Window.pixels_of` gives it, possibly turned.
            size: pixels a side.
        """
        step = float(np.sqrt(abs(np.linalg.det(pixels[:, :2]))))
        level = int(np.clip(np.floor(np.log2(max(step, 1.0) * 1.2)), 0, len(self._levels) - 1))
        return warped(self._levels[level], pixels / 2.0**level, size, smooth=True)


def warped(image: np.ndarray, pixels: Float64, size: int, *, smooth: bool, fill: int = 128) -> np.ndarray:
    """(size, size, ...) values of an image at its pixels ``pixels @ (i, j, 1)``; outside of it `fill`, smooth or 0."""
    import cv2

    flags = (cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST) | cv2.WARP_INVERSE_MAP
    border = (fill, fill, fill) if smooth else 0
    return np.asarray(
        cv2.warpAffine(image, pixels, (size, size), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=border)
    )


def shown_window(rgb: Uint8, depth: Float32, width: float) -> tuple[Float32, float]:
    """What the keypoint network sees of a window, and the window's width in metres.

    Depth is told relative to the middle of the window and in shares of its width there, so that a thing looks the same
    from near and far.

    Args:
        rgb: (S, S, 3).
        depth: (S, S), metres, 0 = no reading.
        width: of the window at 1 m distance, metres.

    Returns:
        (5, S, S), and the width at the distance of what the window shows; 0 where its depth is unknown.
    """
    size = len(rgb)
    shown = np.zeros((CHANNELS, size, size), np.float32)
    shown[:3] = coloured(rgb)
    middle = depth[size // 4 : size - size // 4, size // 4 : size - size // 4]
    readings = middle[middle > 0.0]
    if len(readings) < MIN_READINGS:
        return shown, 0.0
    reference = float(np.partition(readings, len(readings) // 2)[len(readings) // 2])
    valid = depth > 0.0
    shown[3] = np.where(valid, np.clip((depth - reference) / (reference * width), -1.0, 1.0), 0.0)
    shown[4] = valid
    return shown, reference * width


def shown_image(rgb: Uint8, depth: Float32) -> Float32:
    """(5, H, W) of what the box network sees of a small image; depth (H, W) in metres, 0 = no reading."""
    valid = depth > 0.0
    shown = np.zeros((CHANNELS, *depth.shape), np.float32)
    shown[:3] = coloured(rgb)
    shown[3] = np.where(valid, np.minimum(NEAR / np.maximum(depth, 1e-3), 1.0), 0.0)
    shown[4] = valid
    return shown


def coloured(rgb: Uint8) -> Float32:
    """(3, H, W), -1 to 1, of an image (H, W, 3)."""
    return (rgb.transpose(2, 0, 1).astype(np.float32) - 127.5) / 127.5


def reduced(rgb: Uint8, depth: Float32, width: int, height: int) -> tuple[Uint8, Float32]:
    """An image made smaller, with its depth (nearest reading); sizes in pixels."""
    import cv2

    size = (width, height)
    small = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    return small, np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), np.float32)


def conditions(class_index: int, classes: int, metric_width: float, diameter: float) -> Float32:
    """(classes + 2,): which class the keypoint network is to find, and how large the window is beside such an object.

    Args:
        class_index: of the class.
        classes: number of them.
        metric_width: of the window, metres, 0 = unknown.
        diameter: of the object, metres.
    """
    values = np.zeros(classes + 2, np.float32)
    values[class_index] = 1.0
    if metric_width > 0.0:
        values[classes] = 1.0
        values[classes + 1] = np.clip(np.log(metric_width / diameter), -2.0, 2.0)
    return values
