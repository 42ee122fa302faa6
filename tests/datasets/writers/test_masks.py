"""Masks as run lengths, PNG and polygons: each comes back as it was."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from simtrack.datasets.writers.images import mask_png
from simtrack.datasets.writers.masks import Mask, compressed_rle, polygon, uncompressed_rle

pycocotools = pytest.importorskip("pycocotools.mask")


@st.composite
def masks(draw: st.DrawFn) -> tuple[Mask, np.ndarray]:
    """A mask with a window somewhere, and the same as a whole image."""
    height, width = draw(st.integers(1, 14)), draw(st.integers(1, 14))
    h, w = draw(st.integers(0, height)), draw(st.integers(0, width))
    pixels = draw(arrays.arrays(np.bool_, (h, w)))
    v, u = draw(st.integers(0, height - h)), draw(st.integers(0, width - w))
    whole = np.zeros((height, width), np.bool_)
    whole[v : v + h, u : u + w] = pixels
    return Mask(pixels, (u, v), (height, width)), whole


@given(masks())
def test_run_lengths_are_those_of_coco(given: tuple[Mask, np.ndarray]) -> None:
    mask, whole = given
    reference = pycocotools.encode(np.asfortranarray(whole.astype(np.uint8)))
    ours = compressed_rle(mask)
    assert ours == {"size": list(whole.shape), "counts": reference["counts"].decode()}
    counts = uncompressed_rle(mask)["counts"]
    assert sum(counts) == whole.size
    values = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    assert (values.reshape(whole.shape, order="F") == whole).all()


def test_run_lengths_of_large_images_need_several_characters() -> None:
    whole = np.zeros((1200, 1600), np.bool_)
    whole[600:900, 300:1500:7] = True
    ours = compressed_rle(Mask(whole[600:900, 300:1500], (300, 600), whole.shape))
    assert ours["counts"] == pycocotools.encode(np.asfortranarray(whole.astype(np.uint8)))["counts"].decode()


@given(masks())
def test_a_mask_comes_back_from_its_png(given: tuple[Mask, np.ndarray]) -> None:
    mask, whole = given
    image = cv2.imdecode(np.frombuffer(mask_png(mask), np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None and image.dtype == np.uint8 and image.shape == whole.shape
    assert (image == np.where(whole, 255, 0)).all()


def filled(points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    image = np.zeros(shape, np.uint8)
    cv2.fillPoly(image, [points.astype(np.int32)], 1)  # type: ignore[call-overload]
    return image > 0


@given(masks())
def test_polygons_cover_the_mask_and_little_else(given: tuple[Mask, np.ndarray]) -> None:
    mask, whole = given
    if not whole.any():
        return
    points = polygon(mask)
    assert len(points) >= 3
    again = filled(points, whole.shape)
    assert again[whole].all()
    parts, _ = cv2.connectedComponents(whole.astype(np.uint8), connectivity=8)
    holes, _ = cv2.connectedComponents(np.pad(~whole, 1, constant_values=True).astype(np.uint8), connectivity=4)
    bridges = (parts - 2) + (holes - 2)
    assert (again & ~whole).sum() <= bridges * sum(whole.shape)
    if bridges == 0:
        assert (again == whole).all()


def test_holes_and_parts_survive_in_one_polygon() -> None:
    whole = np.zeros((80, 120), np.uint8)
    cv2.circle(whole, (40, 40), 30, 1, -1)
    cv2.circle(whole, (40, 40), 15, 0, -1)
    cv2.rectangle(whole, (90, 20), (110, 60), 1, -1)
    again = filled(polygon(Mask(whole > 0, (0, 0), whole.shape)), whole.shape)
    assert again[whole > 0].all()
    assert (again & (whole == 0)).sum() <= 30  # a bridge of 19 pixels over the gap, and one that may cross the hole
    assert again[40, 35:45].sum() <= 2
