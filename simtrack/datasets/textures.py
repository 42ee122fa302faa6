"""Procedural textures: square, tileable images of random pattern and colours."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float32, Uint8
from simtrack.errors import FileFormatError, UnknownNameError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
MAX_IMAGES = 2000
MAX_IMAGE_BYTES = 50_000_000


def texture(kind: str, size: int, rng: np.random.Generator) -> Uint8:
    """(size, size, 3) sRGB image that repeats without a seam.

    Args:
        kind: a key of `PATTERNS`.
        size: pixels a side, a power of two from 16 on.
        rng: decides pattern and colours.

    Raises:
        UnknownNameError: no such kind; lists the known ones.
    """
    if kind not in PATTERNS:
        raise UnknownNameError("texture", kind, PATTERNS)
    low, high = _two_colors(rng)
    weight = PATTERNS[kind](size, rng)[..., None]
    grain = rng.uniform(0.0, 0.08) * (_noise(size, size // 4, 1, rng) - 0.5)[..., None]
    return np.round(255.0 * np.clip(low + (high - low) * weight + grain, 0.0, 1.0)).astype(np.uint8)


def _two_colors(rng: np.random.Generator) -> tuple[Float32, Float32]:
    """Two colours of any hue, one of them often near to the other, as in real materials."""
    first = random_color(rng)
    second = random_color(rng) if rng.random() < 0.4 else np.clip(first + rng.uniform(-0.25, 0.25), 0.02, 0.98)
    return first.astype(np.float32), np.asarray(second, np.float32)


def random_color(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """(3,) sRGB 0 to 1: any hue, mostly of low saturation and medium brightness, as surfaces have them."""
    hue, saturation, value = rng.random(), rng.beta(1.2, 2.0), 0.1 + 0.85 * rng.beta(1.6, 1.2)
    ramp = np.clip(np.abs((6.0 * hue + np.array([0.0, 4.0, 2.0])) % 6.0 - 3.0) - 1.0, 0.0, 1.0)
    return value * (1.0 - saturation * (1.0 - ramp))


# ------------------------------------------------------------------------------------------------------------- patterns


def _noise(size: int, cells: int, octaves: int, rng: np.random.Generator) -> Float32:
    """(size, size), about 0 to 1: value noise, finer octaves with half the amplitude; periodic."""
    import cv2

    total, amplitude, weight = np.zeros((size, size), np.float32), 1.0, 0.0
    for _ in range(octaves):
        cells = min(cells, size)
        lattice = np.pad(rng.random((cells, cells), dtype=np.float32), 3, mode="wrap")
        step = size // cells
        fine = cv2.resize(lattice, None, fx=step, fy=step, interpolation=cv2.INTER_CUBIC)
        total += amplitude * fine[3 * step : 3 * step + size, 3 * step : 3 * step + size]
        weight += amplitude
        cells, amplitude = 2 * cells, amplitude / 2
    return total / np.float32(weight)


def _grid(size: int) -> tuple[Float32, Float32]:
    axis = ((np.arange(size) + 0.5) / size).astype(np.float32)
    rows = np.repeat(axis[:, None], size, axis=1)
    return rows, np.ascontiguousarray(rows.T)


def _power(low: int, high: int, rng: np.random.Generator) -> int:
    return 2 ** int(rng.integers(low, high + 1))


def _plain(size: int, rng: np.random.Generator) -> Float32:
    return np.full((size, size), rng.random(), np.float32)


def _clouds(size: int, rng: np.random.Generator) -> Float32:
    clouds = _noise(size, _power(1, 4, rng), int(rng.integers(2, 6)), rng)
    return np.clip((clouds - 0.5) * np.float32(rng.uniform(1.0, 3.5)) + 0.5, 0.0, 1.0)


def _checker(size: int, rng: np.random.Generator) -> Float32:
    cells = _power(1, 4, rng)
    tiles = (np.indices((cells, cells)).sum(axis=0) % 2).astype(np.float32)
    return np.kron(tiles, np.ones((size // cells, size // cells), np.float32))


def _stripes(size: int, rng: np.random.Generator) -> Float32:
    u, v = _grid(size)
    turns = rng.integers(-12, 13, 2)
    turns[0] += not turns.any()
    wave = np.sin(2.0 * np.pi * (turns[0] * u + turns[1] * v), dtype=np.float32)
    return np.clip(wave * np.float32(rng.uniform(0.6, 8.0)) * 0.5 + 0.5, 0.0, 1.0)


def _dots(size: int, rng: np.random.Generator) -> Float32:
    u, v = _grid(size)
    cells, radius = _power(1, 4, rng), rng.uniform(0.15, 0.45)
    offsets = 0.25 * (rng.random((2, cells, cells), dtype=np.float32) - 0.5)
    row, column = (u * cells).astype(int), (v * cells).astype(int)
    x, y = (u * cells % 1.0 - 0.5 - offsets[0, row, column], v * cells % 1.0 - 0.5 - offsets[1, row, column])
    return np.clip((radius - np.hypot(x, y)) * size / cells / 2.0 + 0.5, 0.0, 1.0).astype(np.float32)


def _wood(size: int, rng: np.random.Generator) -> Float32:
    """Boards along v: rings that are stretched along the grain and bent by noise."""
    u, _ = _grid(size)
    bend = _noise(size, 2, 4, rng)
    rings = np.sin(2.0 * np.pi * (int(rng.integers(3, 14)) * u + rng.uniform(0.6, 3.0) * bend), dtype=np.float32)
    fibre = np.repeat(_noise(size, size // 2, 1, rng)[:, :1], size, axis=1)
    boards = int(rng.integers(1, 5))
    board = np.clip((u * boards).astype(int), 0, boards - 1)
    tone = rng.random(boards, dtype=np.float32)[board]
    return (0.4 * (0.5 + 0.5 * rings) + 0.35 * tone + 0.25 * fibre).astype(np.float32)


def _marble(size: int, rng: np.random.Generator) -> Float32:
    u, v = _grid(size)
    a, b = int(rng.integers(1, 5)), int(rng.integers(0, 4))
    veins = np.sin(2.0 * np.pi * (a * u + b * v + rng.uniform(0.5, 1.6) * _noise(size, 4, 5, rng)), dtype=np.float32)
    return 1.0 - np.abs(veins) ** np.float32(rng.uniform(0.3, 1.0))


def _bricks(size: int, rng: np.random.Generator) -> Float32:
    u, v = _grid(size)
    rows, columns, joint = 2 * int(rng.integers(2, 6)), int(rng.integers(2, 6)), rng.uniform(0.03, 0.1)
    row = (u * rows).astype(int)
    along = v * columns + 0.5 * (row % 2)
    tone = rng.random((rows, columns), dtype=np.float32)[row, along.astype(int) % columns]
    mortar = (u * rows % 1.0 < joint * rows / columns) | (along % 1.0 < joint)
    return np.where(mortar, 0.0, 0.4 + 0.6 * tone).astype(np.float32)


def _gradient(size: int, rng: np.random.Generator) -> Float32:
    u, v = _grid(size)
    phase = rng.random(2)
    wave = np.cos(2.0 * np.pi * (u - phase[0])) + np.cos(2.0 * np.pi * (v - phase[1]))
    return (0.5 + 0.25 * wave).astype(np.float32)


PATTERNS: dict[str, Callable[[int, np.random.Generator], Float32]] = {
    "plain": _plain,
    "noise": _clouds,
    "checker": _checker,
    "stripes": _stripes,
    "dots": _dots,
    "wood": _wood,
    "marble": _marble,
    "bricks": _bricks,
    "gradient": _gradient,
}
"""Kind -> (size, size) weights 0 to 1 between two colours."""


# --------------------------------------------------------------------------------------------------- the user's images


def image_files(folder: Path) -> tuple[Path, ...]:
    """Images of a folder, by name, at most `MAX_IMAGES`; raises FileFormatError if there are none."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file())
    if not files:
        raise FileFormatError(folder, "", f"holds no image; allowed: {', '.join(IMAGE_SUFFIXES)}")
    return tuple(files[:MAX_IMAGES])


def image_texture(path: Path, size: int, rng: np.random.Generator) -> Uint8:
    """(size, size, 3), a random square part of an image file; raises FileFormatError if it is none."""
    import cv2

    if path.stat().st_size > MAX_IMAGE_BYTES:
        raise FileFormatError(path, "", f"larger than {MAX_IMAGE_BYTES} bytes")
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise FileFormatError(path, "", "is not an image that can be read")
    height, width = image.shape[:2]
    side = max(1, int(min(height, width) * rng.uniform(0.4, 1.0)))
    top, left = int(rng.integers(height - side + 1)), int(rng.integers(width - side + 1))
    part = image[top : top + side, left : left + side]
    resized = cv2.resize(part, (size, size), interpolation=cv2.INTER_AREA if side > size else cv2.INTER_LINEAR)
    return resized.astype(np.uint8, copy=False)
