"""Images as files: encoded once a frame, and one file on disk for all formats that want the same.

PNG spends most of its time on trying filters and searching for repetitions. Here each kind of image has the one filter
that suits it and run lengths instead of a search, which is several times as fast; the files are smaller too, because
sensor noise has no repetitions and masks have nothing else.
"""

import os
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol
from weakref import WeakValueDictionary

import numpy as np

from simtrack.contracts import Float32
from simtrack.datasets.frame import LabelledFrame
from simtrack.datasets.writers.masks import Mask

MAX_DEPTH = np.iinfo(np.uint16).max
"""Largest value of a depth PNG."""


class Encoding(Protocol):
    """A way to turn a frame into an image file; hashable."""

    @property
    def suffix(self) -> str:
        """Of the file's name, with the dot."""
        ...

    def encode(self, frame: LabelledFrame) -> bytes:
        """The file's content."""
        ...


@dataclass(frozen=True, slots=True)
class ColourJpeg:
    """The colour image as JPEG, its chroma at half the resolution."""

    quality: int = 95
    suffix: str = ".jpg"

    def encode(self, frame: LabelledFrame) -> bytes:
        """The file's content."""
        import cv2

        return _encode(".jpg", cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, self.quality])


@dataclass(frozen=True, slots=True)
class ColourPng:
    """The colour image without loss."""

    suffix: str = ".png"

    def encode(self, frame: LabelledFrame) -> bytes:
        """The file's content."""
        import cv2

        return _png(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR), cv2.IMWRITE_PNG_FILTER_PAETH)


@dataclass(frozen=True, slots=True)
class DepthPng:
    """The sensor's depth as 16-bit PNG."""

    per_metre: float
    """Steps in a metre; what is deeper than 65535 of them is written as no reading."""
    suffix: str = ".png"

    def steps(self, frame: LabelledFrame) -> np.ndarray:
        """(H, W) uint16, the values in the file; 0 = no reading."""
        return depth_steps(frame.depth, self.per_metre)

    def encode(self, frame: LabelledFrame) -> bytes:
        """The file's content."""
        import cv2

        return _png(self.steps(frame), cv2.IMWRITE_PNG_FILTER_UP)


def depth_steps(depth: Float32, per_metre: float) -> np.ndarray:
    """(H, W) uint16 nearest to `depth` (H, W) in metres; 0 = no reading, or deeper than 16 bits reach."""
    scaled = depth * np.float32(per_metre)
    return np.where(scaled < MAX_DEPTH + 0.5, np.rint(scaled), 0.0).astype(np.uint16)


def mask_png(mask: Mask) -> bytes:
    """A mask as 8-bit PNG of 0 and 255. Only its window is compressed: the rows above and below are known bytes."""
    (height, width), (left, top) = mask.shape, mask.at
    window = np.zeros((mask.pixels.shape[0], 1 + width), np.uint8)  # rows begin with the number of their filter: none
    window[:, 1 + left : 1 + left + mask.pixels.shape[1]] = mask.pixels * np.uint8(255)
    rows = window.tobytes()
    above, below = top * (1 + width), (height - top - len(window)) * (1 + width)
    checksum = _adler_of_zeros(zlib.adler32(rows, _adler_of_zeros(1, above)), below)
    body = b"\x78\x01" + _zeros(above) + _deflated(rows) + _zeros(below) + b"\x03\x00" + checksum.to_bytes(4, "big")
    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + b"\x08\x00\x00\x00\x00"
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def _deflated(data: bytes) -> bytes:
    """Deflate blocks that end at a byte and that need nothing before them: they can be strung together."""
    stream = zlib.compressobj(1, zlib.DEFLATED, -zlib.MAX_WBITS, zlib.DEF_MEM_LEVEL, zlib.Z_RLE)
    return stream.compress(data) + stream.flush(zlib.Z_FULL_FLUSH)


@lru_cache(maxsize=4096)
def _zeros(count: int) -> bytes:
    return _deflated(bytes(count)) if count else b""


def _adler_of_zeros(checksum: int, count: int) -> int:
    """Adler-32 after so many zero bytes more."""
    low, high = checksum & 0xFFFF, checksum >> 16
    return low | (high + count * low) % 65521 << 16


def _chunk(kind: bytes, data: bytes) -> bytes:
    return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(data, zlib.crc32(kind)).to_bytes(4, "big")


def label_png(red_green_blue: np.ndarray) -> bytes:
    """(H, W, 3) uint8 ids, colour coded, as PNG."""
    import cv2

    return _png(cv2.cvtColor(red_green_blue, cv2.COLOR_RGB2BGR), cv2.IMWRITE_PNG_FILTER_SUB)


def _png(image: np.ndarray, row_filter: int) -> bytes:
    import cv2

    runs = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    # The filter comes last: setting the level resets it.
    return _encode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1, *runs, cv2.IMWRITE_PNG_FILTER, row_filter])


def _encode(suffix: str, image: np.ndarray, parameters: Sequence[int]) -> bytes:
    import cv2

    good, data = cv2.imencode(suffix, image, parameters)
    assert good, "encoding an image of 8 or 16 bits cannot fail"
    return data.tobytes()


class SharedImages:
    """The encoded images of the frame that is being written; the writers of one scene have it in common."""

    def __init__(self) -> None:
        self._frame: LabelledFrame | None = None
        self._contents: dict[Encoding, bytes] = {}
        self._files: dict[Encoding, Path] = {}

    @staticmethod
    def of(staging: Path) -> "SharedImages":
        """That of all scene writers in this process that write to `staging`; each keeps it as long as it lives."""
        return _OPEN.setdefault(staging.resolve(), SharedImages())

    def content(self, frame: LabelledFrame, encoding: Encoding) -> bytes:
        """The encoded image."""
        if frame is not self._frame:
            self._frame, self._contents, self._files = frame, {}, {}
        if encoding not in self._contents:
            self._contents[encoding] = encoding.encode(frame)
        return self._contents[encoding]

    def save(self, frame: LabelledFrame, encoding: Encoding, path: Path) -> None:
        """Put the encoded image at `path`: a hard link to where it was saved first, or a copy where links fail."""
        content = self.content(frame, encoding)
        first = self._files.setdefault(encoding, path)
        if first is path or not linked(first, path):
            path.write_bytes(content)


_OPEN: WeakValueDictionary[Path, SharedImages] = WeakValueDictionary()


def linked(source: Path, target: Path) -> bool:
    """Make `target` another name of the file `source`; False where the file system has no (more) links."""
    try:
        os.link(source, target)
    except OSError:
        return False
    return True
