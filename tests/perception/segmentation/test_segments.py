"""Panoptic segments do not overlap and refuse nonsense; geometric ones end where surfaces do."""

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics
from simtrack.errors import InvalidValueError
from simtrack.perception.segmentation.geometric import GeometricConfig, depth_segments
from simtrack.perception.segmentation.panoptic import PanopticSegments

CAMERA = CameraIntrinsics(160, 120, 145.0, 145.0, 79.5, 59.5)
SETTINGS = GeometricConfig(columns=160, min_pixels=3000, smoothing=1, edge_reach=3)


def wedge(slope: float) -> np.ndarray:
    """Depth of two planes that meet in the middle: towards the camera there for positive slopes, away for negative."""
    side = np.abs(np.arange(160) - 79.5) / 145.0
    return np.tile((2.0 / (1.0 - slope * side)).astype(np.float32), (120, 1))


def numbers(depth: np.ndarray) -> set[int]:
    return set(np.unique(depth_segments(depth, CAMERA, SETTINGS)[10:-10, 10:-10]).tolist()) - {0}


def test_a_pixel_belongs_to_the_mask_with_the_highest_score() -> None:
    masks = np.zeros((2, 4, 5), bool)
    masks[0, :3], masks[1, 2:] = True, True
    segments = PanopticSegments.of_masks(7, masks, ("chair", "floor"), np.array([0.4, 0.9]))
    assert segments.stamp == 7 and len(segments) == 2
    assert segments.mask(1).sum() == 10 and segments.mask(2).sum() == 10 and not (segments.image == 0).any()


@pytest.mark.parametrize(
    ("image", "classes", "scores"),
    [
        (np.full((2, 2), 3), ("cup",), [0.5]),
        (np.zeros(4), ("cup",), [0.5]),
        (np.zeros((2, 2)), ("cup", "bowl"), [0.5]),
        (np.full((2, 2), -1), ("cup",), [0.5]),
    ],
)
def test_segments_that_do_not_fit_are_refused(image: np.ndarray, classes: tuple[str, ...], scores: list[float]) -> None:
    with pytest.raises(InvalidValueError):
        PanopticSegments(0, image.astype(np.int32), classes, np.array(scores, np.float32))


def test_concave_edges_and_jumps_separate_and_convex_edges_do_not() -> None:
    assert len(numbers(wedge(0.0))) == 1
    assert len(numbers(wedge(1.0))) == 1  # the near edge of a box
    assert len(numbers(wedge(-1.0))) == 2  # the corner of a room
    step = wedge(0.0)
    step[:, 90:] += 0.3
    assert len(numbers(step)) == 2


def test_what_has_no_reading_or_is_too_far_is_in_no_segment() -> None:
    depth = wedge(0.0)
    depth[40:60, 40:60] = 0.0
    depth[:, 120:] = 6.0
    segments = depth_segments(depth, CAMERA, SETTINGS)
    assert not segments[40:60, 40:60].any() and not segments[:, 120:].any() and segments[80, 30] > 0
