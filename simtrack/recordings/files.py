"""Files of data from outside: read whole within stated bounds, and never from outside of their folder."""

import math
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import FileFormatError
from simtrack.geometry.transforms import is_rigid, orthonormal

MAX_FILE_BYTES = 2**27
"""Largest image, table or point cloud that is read."""
MAX_PIXELS = 2**25
"""Largest image: that of a camera of 32 megapixels."""


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """The content of a regular file of at most `limit` bytes. Raises `FileFormatError`."""
    try:
        if not path.is_file():
            raise FileFormatError(path, "", "no such file")
        if path.stat().st_size > limit:
            raise FileFormatError(path, "", f"is larger than {limit} bytes")
        return path.read_bytes()
    except OSError as error:
        raise FileFormatError(path, "", f"cannot be read: {error.strerror or error}") from error


def read_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """(line number from 1, words) of a text file, without empty lines and comments behind ``#``."""
    try:
        text = read_bytes(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise FileFormatError(path, "", f"is not text: {error}") from error
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if words:
            yield number, words


def numbers(words: list[str], count: int, path: Path, where: str) -> list[float]:
    """`count` finite numbers. Raises `FileFormatError`, which says so."""
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise FileFormatError(path, where, f"expected {count} numbers: {error}") from error
    if len(values) != count or not all(map(math.isfinite, values)):
        raise FileFormatError(path, where, f"expected {count} finite numbers, found {' '.join(words)[:80]!r}")
    return values


def rigid(values: list[float], path: Path, where: str) -> Float64:
    """(4, 4) of the 12 or 16 numbers of a rigid transform, row by row, to the precision of printed numbers."""
    T = np.eye(4)
    T.reshape(-1)[: len(values)] = values
    if not is_rigid(T, tolerance=1e-2):
        raise FileFormatError(path, where, "not a rigid transform: expected a rotation and a translation, rows of 4")
    for _ in range(4):
        T[:3, :3] = orthonormal(T[:3, :3])
    return T


def inside(folder: Path, name: str, path: Path, where: str) -> Path:
    """The file `name` of a folder, which may not lie outside of it, nor be a link to outside.

    Raises:
        FileFormatError: it does; `path` and `where` say who named it.
    """
    root = folder.resolve()
    try:
        found = (root / name).resolve()
    except (OSError, ValueError, RuntimeError) as error:  # NUL bytes, endless links
        raise FileFormatError(path, where, f"{name[:80]!r} is no file name") from error
    if not found.is_relative_to(root):
        raise FileFormatError(path, where, f"{name[:80]!r} leads out of {folder}; only files inside it are read")
    return folder / name


def read_depth(path: Path, scale: float, missing: int | None = None) -> np.ndarray:
    """(H, W) float32 metres, 0 = no reading, of a 16-bit PNG file, see `decoded_depth`."""
    return decoded_depth(read_bytes(path), path, scale, missing)


def decoded_depth(data: bytes, path: Path, scale: float, missing: int | None = None) -> np.ndarray:
    """(H, W) float32 metres, 0 = no reading, of a 16-bit PNG.

    Args:
        data: the image.
        path: where it comes from, for messages.
        scale: metres that 1 stands for.
        missing: a value beside 0 that stands for no reading.
    """
    image = decoded_image(data, path)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise FileFormatError(path, "", f"{image.dtype} image of shape {image.shape}; depth is a 16-bit grey PNG")
    depth = image.astype(np.float32) * np.float32(scale)
    if missing is not None:
        depth[image == missing] = 0.0
    return depth


def read_rgb(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 of a PNG or JPEG file, see `decoded_rgb`."""
    return decoded_rgb(read_bytes(path), path)


def decoded_rgb(data: bytes, path: Path) -> np.ndarray:
    """(H, W, 3) uint8 of a PNG or JPEG image; grey ones have three equal channels."""
    image = decoded_image(data, path)
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (3, 4)):
        raise FileFormatError(path, "", f"{image.dtype} image of shape {image.shape}; colour has 8 bits a channel")
    if image.ndim == 2:
        return np.repeat(image[:, :, None], 3, axis=2)
    return np.ascontiguousarray(image[:, :, 2::-1])


def decoded_image(data: bytes, path: Path) -> np.ndarray:
    """The image as OpenCV decodes it, BGR, once its header has claimed no more than `MAX_PIXELS`."""
    import cv2

    size = image_size(data)
    if size is None:
        raise FileFormatError(path, "", "is neither a PNG nor a JPEG image, or its header is damaged")
    if not 0 < size[0] * size[1] <= MAX_PIXELS:
        raise FileFormatError(path, "", f"claims {size[0]} x {size[1]} pixels, at most {MAX_PIXELS} are allowed")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise FileFormatError(path, "", f"cannot be decoded: {error.err or error}") from error
    if image is None:
        raise FileFormatError(path, "", "is a damaged image")
    return image


def image_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) that the header of a PNG or JPEG image claims, None if it is neither."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR" and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return width, height
    at = 2
    while data[:2] == b"\xff\xd8" and at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # SOF: the frame's header
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        at += 1 if marker == 0xFF else 2 + struct.unpack(">H", data[at + 2 : at + 4])[0]
    return None
