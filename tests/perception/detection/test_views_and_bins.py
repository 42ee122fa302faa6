"""How an image becomes a network's input, and its answer a place in the image again."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.perception.detection.bins import BEFORE, BINS, decoded, place_of, position_of
from simtrack.perception.detection.boxes import STRIDE, boxes_of_regions, decoded_boxes, overlap
from simtrack.perception.detection.views import (
    Pyramid,
    Window,
    conditions,
    reduced,
    shown_image,
    shown_window,
    warped,
    window_about,
)

SIZE = 64


@given(u=st.floats(60, 180), v=st.floats(60, 180), side=st.floats(20, 110))
@settings(max_examples=20)
def test_a_window_shows_the_pixels_that_it_says(u: float, v: float, side: float) -> None:
    ramp = np.broadcast_to(np.arange(240, dtype=np.uint8)[None, :, None], (240, 240, 3)).copy()
    pixels = Window(u, v, side).pixels_of(SIZE)
    cut = Pyramid(ramp).cut(pixels, SIZE)
    expected = pixels[0, 0] * np.arange(SIZE) + pixels[0, 2]
    inside = (expected > 8) & (expected < 230)
    assert np.abs(cut[SIZE // 2, inside, 0] - expected[inside]).max() < 1.6
    # The window's corners are its side apart about its centre: half a pixel before the first, after the last.
    edges = pixels[0, 0] * np.array([-0.5, SIZE - 0.5]) + pixels[0, 2]
    assert np.allclose(edges, [u - side / 2, u + side / 2])


@given(scale=st.floats(0.5, 2.0), seed=st.integers(0, 99))
@settings(max_examples=15)
def test_a_thing_looks_the_same_from_near_and_far(scale: float, seed: int) -> None:
    """Twice as far away and twice as large, everything is seen alike."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 255, (SIZE, SIZE, 3), np.uint8)
    depth = (1.0 + 0.05 * rng.standard_normal((SIZE, SIZE))).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = 0.0
    near, near_width = shown_window(rgb, depth, 0.2)
    far, far_width = shown_window(rgb, depth * np.float32(scale), 0.2)
    assert np.allclose(near, far, atol=1e-4)
    assert np.isclose(far_width, scale * near_width)


def test_without_readings_depth_is_unknown() -> None:
    rgb, depth = np.zeros((SIZE, SIZE, 3), np.uint8), np.zeros((SIZE, SIZE), np.float32)
    depth[0] = 1.0  # readings at the rim tell nothing of the middle
    shown, width = shown_window(rgb, depth, 0.2)
    assert width == 0.0
    assert not shown[3:].any()
    assert not conditions(1, 3, width, 0.2)[3:].any()
    assert conditions(1, 3, 0.2, 0.2).tolist() == [0, 1, 0, 1, 0]


def test_small_images_keep_readings_and_gaps() -> None:
    depth = np.zeros((48, 64), np.float32)
    depth[:, 32:] = 2.0
    small, less = reduced(np.full((48, 64, 3), 200, np.uint8), depth, 32, 24)
    shown = shown_image(small, less)
    assert set(np.unique(less)) == {0.0, 2.0}  # never a mean of a reading and a gap
    assert np.array_equal(shown[4] > 0, less > 0)
    assert np.allclose(shown[3][less > 0], 0.15)


@given(st.floats(-BEFORE + 0.05, 1.0 + BEFORE - 0.05))
@settings(max_examples=30)
def test_a_coordinate_is_read_back_from_its_bins(place: float) -> None:
    assert np.isclose(place_of(position_of(np.float64(place))), place)
    bins = np.arange(BINS)
    sharp = -0.5 * ((bins - position_of(place)) / 1.3) ** 2
    found, sigma = decoded(np.stack([sharp, 0.1 * sharp]))
    assert np.allclose(found, place, atol=0.02 * np.array([1, 10]) / 10 + 0.004)
    assert sigma[1] > 2.0 * sigma[0]  # less certain


def test_the_larger_of_two_modes_is_taken_and_both_make_it_uncertain() -> None:
    logits = np.full(BINS, -20.0)
    logits[[20, 70]] = 2.0, 1.5
    place, sigma = decoded(logits[None])
    assert np.isclose(place[0], place_of(np.float64(20)), atol=1e-3)
    assert sigma[0] > 0.3


def test_boxes_of_one_object_become_one() -> None:
    logits, sides = np.full((2, 6, 8), -9.0), np.zeros((8, 6, 8))
    logits[0, 2, 2], logits[0, 2, 4], logits[1, 2, 3] = 2.0, 1.0, 3.0
    sides[:] = np.log(5.0)
    sides[4:] = np.log(2.0)  # of class 1
    found = decoded_boxes(logits, sides, threshold=0.5)
    assert [box.class_index for box in found] == [1, 0]  # best first; two near ones of one class are one
    assert np.allclose(found[0].corners, (np.array([1, 0, 5, 4]) + 0.5) * STRIDE - 0.5)
    assert np.allclose(found[1].corners, (np.array([-3, -3, 7, 7]) + 0.5) * STRIDE - 0.5)
    assert overlap(found[1].corners, found[1].corners) == 1.0
    assert decoded_boxes(logits, sides, threshold=0.99) == []
    sides[:4] = np.log(3.0)  # side by side they may be two
    assert [box.class_index for box in decoded_boxes(logits, sides, threshold=0.5)] == [1, 0, 0]


def test_a_window_is_square_about_its_box() -> None:
    window = window_about(np.array([10.0, 20.0, 50.0, 40.0]), 1.5)
    assert (window.u, window.v, window.side) == (30.0, 30.0, 60.0)
    image = np.zeros((60, 60), np.float32)
    image[30, 30] = 1.0
    assert warped(image, window.pixels_of(60), 60, smooth=False)[30, 30] == 1.0


def test_regions_are_boxes_of_the_classes_that_have_a_centre_in_them() -> None:
    logits = np.full((3, 30, 40), -9.0, np.float32)
    logits[1, 10, 20], logits[2, 11, 20], logits[0, 2, 2] = 0.0, 2.0, 3.0
    scale = np.array([4.0, 4.0])  # a cell is 16 pixels of the image
    around = np.array([310.0, 150.0, 350.0, 200.0])
    found = boxes_of_regions(logits, [around], scale, 0.1)
    assert [box.class_index for box in found] == [2, 1]
    assert [box.score for box in found] == [float(1.0 / (1.0 + np.exp(-2.0))), 0.5]
    assert all(np.array_equal(box.corners, around - 0.5) for box in found)
    narrow, empty, outside = np.array([310.0, 150, 317, 200]), around + 100.0, around + 1000.0
    assert boxes_of_regions(logits, [narrow, empty, outside, -outside[[2, 3, 0, 1]]], scale, 0.1) == []
    assert boxes_of_regions(logits, [around], scale, 0.9) == []
