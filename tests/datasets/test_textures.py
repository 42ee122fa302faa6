"""Textures repeat without a seam and depend on their random stream alone."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from simtrack.datasets.textures import PATTERNS, image_files, image_texture, random_color, texture
from simtrack.errors import FileFormatError, UnknownNameError


@pytest.mark.parametrize("kind", PATTERNS)
@pytest.mark.parametrize("seed", range(3))
def test_textures_repeat_without_a_seam(kind: str, seed: int) -> None:
    image = texture(kind, 128, np.random.default_rng(seed)).astype(float)
    for axis in (0, 1):
        inside = np.abs(np.diff(image, axis=axis)).mean(axis=(1 - axis, 2))
        across = np.abs(np.take(image, 0, axis) - np.take(image, -1, axis)).mean()
        assert across <= inside.max() + 2.0


@pytest.mark.parametrize("kind", PATTERNS)
def test_equal_streams_give_equal_bytes_and_others_do_not(kind: str) -> None:
    images = [texture(kind, 64, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])
    assert images[0].shape == (64, 64, 3)
    assert images[0].dtype == np.uint8


def test_colors_cover_the_range() -> None:
    rng = np.random.default_rng(0)
    colors = np.array([random_color(rng) for _ in range(2000)])
    assert colors.min() >= 0.0
    assert colors.max() <= 1.0
    assert np.abs(colors.mean(axis=0) - colors.mean()).max() < 0.03  # no hue is favoured
    assert colors.std() > 0.15


def test_an_unknown_kind_lists_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown texture 'silk'.*marble"):
        texture("silk", 64, np.random.default_rng(0))


def test_the_users_images_are_square_parts_of_files(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"holds no image; allowed: \.png"):
        image_files(tmp_path)
    ramp = np.repeat(np.arange(200, dtype=np.uint8)[:, None, None], 300, axis=1).repeat(3, axis=2)
    cv2.imwrite(str(tmp_path / "ramp.png"), ramp)
    (tmp_path / "broken.jpg").write_bytes(b"no image")
    broken, good = image_files(tmp_path)
    part = image_texture(good, 64, np.random.default_rng(0))
    assert part.shape == (64, 64, 3)
    assert (np.diff(part[:, 0, 0].astype(int)) >= 0).all()  # the right way up
    with pytest.raises(FileFormatError, match="not an image"):
        image_texture(broken, 64, np.random.default_rng(0))
