"""What a panoptic network is shown and answers: perfect answers give back the truth; the input mirrors as the image."""

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics
from simtrack.datasets.room_films import FilmedImage
from simtrack.errors import InvalidValueError
from simtrack.perception.segmentation.panoptic_network import (
    CHANNELS,
    MULTIPLE,
    STRIDE,
    DecodingConfig,
    decoded_segments,
    mirrored,
    shown_scene,
)
from simtrack.training.segment_samples import IGNORED, segment_sample

CAMERA = CameraIntrinsics(128, 96, 110.0, 110.0, 63.5, 47.5)
CLASSES = ("chair", "cup", "floor")


def image() -> FilmedImage:
    """Two chairs side by side and a cup on a floor."""
    entities = np.zeros((96, 128), np.int32)
    entities[20:60, 20:50], entities[20:60, 50:90], entities[68:88, 96:116] = 1, 2, 3
    rng = np.random.default_rng(0)
    depth = np.where(entities > 0, 1.5, 2.0).astype(np.float32)
    rgb = rng.integers(0, 255, (96, 128, 3), np.uint8)
    return FilmedImage(rgb, depth, entities, CAMERA, ("floor", "chair", "chair", "cup"))


def test_the_truth_as_answers_gives_the_truth() -> None:
    truth = image()
    index = {name: k for k, name in enumerate(CLASSES)}
    shown, classes, heat, offsets = segment_sample(truth, index)
    assert shown.shape == (CHANNELS, 96, 128) and classes.shape == (96 // STRIDE, 128 // STRIDE)
    assert (classes != IGNORED).all() and (heat > 0.999).sum() == 3
    logits = np.where(classes == np.arange(3)[:, None, None], 8.0, 0.0).astype(np.float32)
    found = decoded_segments(7, (logits, heat, np.nan_to_num(offsets)), CLASSES, (96, 128))
    assert sorted(found.classes) == ["chair", "chair", "cup", "floor"] and found.stamp == 7
    for number in range(4):
        mask = truth.entities == number
        best = np.bincount(found.image[mask]).argmax()
        overlap = (mask & (found.image == best)).sum() / (mask | (found.image == best)).sum()
        assert found.classes[best - 1] == truth.classes[number] and overlap > 0.75


def test_nothing_found_is_no_segment() -> None:
    flat = np.zeros((3, 24, 32), np.float32)
    found = decoded_segments(0, (flat, flat[:1], flat[:2]), CLASSES, (96, 128))
    assert len(found) == 0 and not found.image.any()


def test_the_mirrored_scene_is_what_is_shown_of_the_mirrored_image() -> None:
    truth = image()
    shown = shown_scene(truth.rgb, truth.depth, CAMERA)
    other = shown_scene(truth.rgb[:, ::-1].copy(), truth.depth[:, ::-1].copy(), CAMERA)
    np.testing.assert_allclose(mirrored(shown), other, atol=2e-5)


def test_images_are_padded_and_readings_that_are_missing_are_told() -> None:
    depth = np.full((50, 70), 2.0, np.float32)
    depth[:10] = 0.0
    shown = shown_scene(None, depth, CameraIntrinsics(70, 50, 60.0, 60.0, 34.5, 24.5))
    assert shown.shape[1] % MULTIPLE == 0 and shown.shape[2] % MULTIPLE == 0
    assert not shown[9, :10].any() and shown[9, 10:50, :70].all() and not shown[:, 50:].any()


@pytest.mark.parametrize("wrong", [{"peak": 2.0}, {"most_things": 0}, {"least_score": -0.1}])
def test_settings_outside_their_domain_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(wrong))):
        DecodingConfig(**wrong)  # type: ignore[arg-type]
