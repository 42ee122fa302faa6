"""Data sets made ready for training, and those that cannot be."""

import json
from pathlib import Path

import numpy as np
import pytest

from simtrack.errors import DatasetError, FileFormatError
from simtrack.training.config import TrainingConfig
from simtrack.training.detector import make_task, prepared
from simtrack.training.shards import BACKGROUND, CROPS, IMAGE_WIDTH, IMAGES, Shards, prepare
from simtrack.training.source import images, open_source
from tests.training.data import WIDTH, write_dataset


def test_records_say_what_the_labels_say(tmp_path: Path) -> None:
    source = open_source(write_dataset(tmp_path / "data"))
    prepare(source, tmp_path / "shards")
    small = Shards(tmp_path / "shards", "images", IMAGES, held_out=False)
    crops = Shards(tmp_path / "shards", "crops", CROPS, held_out=False)
    wanted = list(images(source, source.scenes[1]))
    assert len(small) == len(wanted) == 2
    for k, image in enumerate(wanted):
        record, label = small[k], image.labels[0]
        assert record["classes"].tolist()[:2] == [0, BACKGROUND]
        assert np.allclose(record["boxes"][0], (label.box + 0.5) * IMAGE_WIDTH / WIDTH - 0.5)
    of_class = [crops[k] for k in range(len(crops)) if crops[k]["class_index"] == 0]
    assert len(of_class) == 2
    for record, image in zip(of_class, wanted, strict=True):
        assert np.allclose(record["T_camera_object"], image.labels[0].T_camera_object)
        middle = record["rgb"][48, 48]
        assert record["mask"][48, 48]
        assert abs(int(middle[0]) - 220) < 3  # red last in the file, first here
        assert np.isclose(record["depth"][48, 48], 0.5, atol=1e-3)
        share = record["mask"].mean()
        assert np.isclose(share, 1200 / record["window"][2] ** 2, rtol=0.1)


def test_what_is_there_is_not_made_again(tmp_path: Path) -> None:
    source = open_source(write_dataset(tmp_path / "data"))
    prepare(source, tmp_path / "shards")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "shards").iterdir()}
    told: list[tuple[int, int]] = []
    prepare(source, tmp_path / "shards", lambda done, of: told.append((done, of)))
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "shards").iterdir()} == before
    assert told == [(1, 2), (2, 2)]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda about: about.update(cuboid_corners=about["cuboid_corners"][::-1]), "keypoints in another order"),
        (lambda about: about.pop("cuboid_corners"), "keypoints in another order"),
        (lambda about: about.pop("categories"), "categories"),
        (lambda about: about.update(categories={"1": "no_such_thing"}), "no model of its object 'no_such_thing'"),
    ],
)
def test_data_sets_with_other_keypoints_or_objects_are_refused(tmp_path: Path, change, told: str) -> None:
    path = write_dataset(tmp_path / "data") / "dataset.json"
    about = json.loads(path.read_text())
    change(about)
    path.write_text(json.dumps(about))
    with pytest.raises((FileFormatError, DatasetError), match=told):
        open_source(path.parent)


def test_folders_that_are_no_data_sets_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="simtrack generate"):
        open_source(tmp_path)
    root = write_dataset(tmp_path / "data")
    (root / "bop").rename(root / "coco")
    with pytest.raises(DatasetError, match="add bop to the recipe's writers"):
        open_source(root)


def test_damaged_scenes_are_told_of(tmp_path: Path) -> None:
    source = open_source(write_dataset(tmp_path / "data"))
    (source.scenes[1] / "scene_gt.json").write_text("{}")
    with pytest.raises(FileFormatError, match="image 0 has no complete entry"):
        list(images(source, source.scenes[1]))
    (source.scenes[0] / "rgb" / "000000.png").unlink()
    with pytest.raises(FileFormatError, match="no such file"):
        list(images(source, source.scenes[0]))


def test_a_share_is_held_out_and_must_be_there(tmp_path: Path) -> None:
    source = open_source(write_dataset(tmp_path / "data", scenes=1))
    prepare(source, tmp_path / "shards")
    with pytest.raises(DatasetError, match="at least 2 scenes"):
        Shards(tmp_path / "shards", "crops", CROPS, held_out=False)


def test_a_class_without_samples_is_told_of(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="training needs the extra train")
    root = write_dataset(tmp_path / "data")
    about = json.loads((root / "dataset.json").read_text())
    about["categories"]["2"] = "multimeter"
    (root / "dataset.json").write_text(json.dumps(about))
    config = TrainingConfig(root, tmp_path / "out")
    source = prepared(config)
    with pytest.raises(DatasetError, match="no image shows multimeter well enough"):
        make_task("keypoints", source, tmp_path / "out" / "shards")


def test_a_folder_of_another_detector_is_refused(tmp_path: Path) -> None:
    prepared(TrainingConfig(write_dataset(tmp_path / "a"), tmp_path / "out"))
    with pytest.raises(DatasetError, match="choose another --out"):
        prepared(TrainingConfig(write_dataset(tmp_path / "b", name="multimeter"), tmp_path / "out"))
