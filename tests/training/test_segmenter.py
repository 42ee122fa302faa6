"""The panoptic segmenter's training: a step of it, carried on, and its file in the segmenter; films as data sets."""

import json
from pathlib import Path

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, RgbdFrame
from simtrack.datasets.room_films import (
    ABOUT,
    FIRST_SEED,
    NAME,
    RoomFilmsConfig,
    filmed_images,
    filmed_rooms,
    write_room_films,
)
from simtrack.errors import DatasetError, FileFormatError, InvalidValueError
from simtrack.training.config import TrainingConfig
from simtrack.training.scores import panoptic_quality

CLASSES = ("chair", "cup", "floor")
K = CameraIntrinsics(64, 64, 55.0, 55.0, 31.5, 31.5)


def write_films(root: Path, rooms: int = 3) -> Path:
    """Rooms of two images: a chair and a cup before a floor."""
    import cv2

    (root / ABOUT).parent.mkdir(parents=True)
    (root / ABOUT).write_text(json.dumps({"name": NAME}))
    rng = np.random.default_rng(0)
    for seed in range(rooms):
        folder = root / "rooms" / str(FIRST_SEED + seed)
        folder.mkdir(parents=True)
        intrinsics = {name: getattr(K, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        (folder / "room.json").write_text(json.dumps({"classes": ["floor", "chair", "cup"], "intrinsics": intrinsics}))
        for number in range(2):
            entities = np.ones((64, 64), np.uint16)
            u = int(rng.integers(4, 30))
            entities[10:40, u : u + 24], entities[48:58, 40:50] = 2, 3
            depth = np.where(entities > 1, 1500, 2000).astype(np.uint16)
            colors = np.array([[0, 0, 0], [90, 90, 90], [30, 60, 200], [220, 220, 40]], np.uint8)
            for suffix, image in ((".jpg", colors[entities]), (".depth.png", depth), (".segments.png", entities)):
                cv2.imwrite(str(folder / f"{number:04d}{suffix}"), image)
    return root


def test_quality_is_of_matches_and_half_of_what_is_missed_and_wrong() -> None:
    entities = np.repeat(np.array([0, 0, 1, 2], np.int32)[None], 4, axis=0)
    perfect = (entities + 1, ("floor", "chair", "cup"), entities, ("floor", "chair", "cup"))
    assert panoptic_quality([perfect]) == {"floor": 100.0, "chair": 100.0, "cup": 100.0}
    confused = (entities + 1, ("floor", "cup", "cup"), entities, ("floor", "chair", "cup"))
    quality = panoptic_quality([perfect, confused])
    assert quality["floor"] == 100.0 and quality["chair"] == pytest.approx(100 / 1.5)
    assert quality["cup"] == pytest.approx(200 / 2.5)


def test_films_are_written_once_and_read_back(tmp_path: Path) -> None:
    config = RoomFilmsConfig(images=2, a_room=2, reduction=8)
    assert write_room_films(tmp_path / "films", config) == 2
    room = filmed_rooms(tmp_path / "films")[0]
    before = {path: path.stat().st_mtime_ns for path in room.iterdir()}
    images = list(filmed_images(room))
    assert len(images) == 2 and images[0].depth.shape == (60, 80)
    assert {"floor", "wall"} <= {images[0].classes[k] for k in np.unique(images[0].entities) if k >= 0}
    write_room_films(tmp_path / "films", config)
    assert {path: path.stat().st_mtime_ns for path in room.iterdir()} == before
    with pytest.raises(DatasetError, match="other settings"):
        write_room_films(tmp_path / "films", RoomFilmsConfig(images=2, a_room=2, reduction=4))
    (room / "room.json").write_text("{}")
    with pytest.raises(FileFormatError, match="classes"):
        list(filmed_images(room))
    with pytest.raises(DatasetError, match="rooms_panoptic"):
        filmed_rooms(tmp_path)
    with pytest.raises(InvalidValueError, match="images"):
        RoomFilmsConfig(images=0)


def test_a_network_trains_carries_on_and_its_file_segments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch", reason="training needs the extra train")
    pytest.importorskip("onnx", reason="networks are written with onnx, of the extra train")
    from simtrack.perception.segmentation.learned import LearnedSegmenter
    from simtrack.training import segment_task, segmenter

    monkeypatch.setattr(segment_task.SegmentTask, "batch_size", 2)
    monkeypatch.setattr(segmenter, "SAMPLES", 4)
    config = TrainingConfig(write_films(tmp_path / "films"), tmp_path / "out")
    assert segmenter.train_segmenter(config).stat().st_size < 15_000_000
    monkeypatch.setattr(segmenter, "SAMPLES", 8)
    path = segmenter.train_segmenter(config)
    found = LearnedSegmenter(tmp_path / "out")
    assert found.classes == CLASSES and path.is_file()
    depth = np.full((128, 128), 2.0, np.float32)
    frame = RgbdFrame(3, depth, None, CameraIntrinsics(128, 128, 110.0, 110.0, 63.5, 63.5), np.eye(4))
    segments = found.segment(frame)
    assert segments.image.shape == depth.shape and segments.stamp == 3 and set(segments.classes) <= set(CLASSES)
    (tmp_path / "out" / "classes.json").write_text('["dragon"]')
    with pytest.raises(DatasetError, match="dragon"):
        segmenter.train_segmenter(config)
