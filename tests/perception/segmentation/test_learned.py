"""The panoptic network that comes along, on films of rooms whose seeds are in no training set."""

from itertools import islice

import numpy as np
import pytest

from simtrack.errors import FileFormatError
from simtrack.evaluation.map_sources import map_source
from simtrack.perception.segmentation.learned import SHIPPED, LearnedSegmenter
from simtrack.simulation.building.rooms.film import FilmConfig
from simtrack.training.scores import panoptic_quality


def test_it_finds_walls_floor_and_things_of_unseen_rooms() -> None:
    source = map_source("rooms:977", "learned", FilmConfig(frames=24))
    assert isinstance(source.segmenter, LearnedSegmenter)
    assert source.room is not None
    classes = tuple(entity.semantic_class for entity in source.room.entities)
    pairs = []
    with source.held:
        for entry in islice(source.frames(), 0, None, 6):
            assert entry.truth is not None
            found = source.segmenter.segment(entry.frame)
            assert found.image.shape == entry.frame.depth.shape and found.stamp == entry.frame.stamp
            assert found.scores.min() >= source.segmenter.config.least_score
            pairs.append((found.image, found.classes, entry.truth.instances, classes))
    quality = panoptic_quality(pairs)
    assert quality["wall"] > 60.0 and quality["floor"] > 60.0
    things = [value for name, value in quality.items() if name not in ("wall", "floor", "ceiling")]
    assert np.mean(things) > 15.0


def test_it_is_small_and_named() -> None:
    assert SHIPPED.stat().st_size < 15_000_000
    assert {"wall", "floor", "chair", "cup"} <= set(LearnedSegmenter().classes)


def test_a_folder_without_a_network_is_refused(tmp_path) -> None:
    with pytest.raises(FileFormatError, match=r"segments\.onnx"):
        LearnedSegmenter(tmp_path)
