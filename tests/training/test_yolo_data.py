"""What YOLOv8 learns from: held-out images, keypoints of objects that look alike, and what is refused."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from simtrack.errors import DatasetError, FileFormatError
from simtrack.training.yolo_data import YoloData, prepare_yolo
from tests.training.yolo_data import ABOUT, contents, write_yolo_dataset


def labels(data: YoloData) -> dict[str, np.ndarray]:
    root = data.path.parent / "labels"
    return {str(path.relative_to(root)): np.loadtxt(path, ndmin=2) for path in sorted(root.rglob("*.txt"))}


@pytest.mark.parametrize(("train", "val"), [(2, 1), (22, 0)])
def test_what_is_held_out_is_not_learned_from(tmp_path: Path, train: int, val: int) -> None:
    root = write_yolo_dataset(tmp_path / "data", train=train, val=val, images=1)
    data = prepare_yolo(root, tmp_path / "out")
    about = yaml.safe_load(data.path.read_text())
    images = {}
    for split in ("train", "val"):
        found = [path for folder in sorted((Path(about["path"]) / about[split]).iterdir()) for path in folder.iterdir()]
        images[split] = {path.resolve() for path in found}
        assert len(images[split]) == len(found) == data.images[split] > 0
        assert all((tmp_path / "out" / "labels" / split / p.parent.name / f"{p.stem}.txt").is_file() for p in found)
    assert not images["train"] & images["val"]
    assert images["train"] | images["val"] == {path.resolve() for path in (root / "yolo").rglob("*.jpg")}
    if not val:
        assert {path.parent.name for path in images["val"]} == {"000000", "000020"}


def test_the_data_set_stays_as_it_is_and_nothing_old_stays_in_the_folder(tmp_path: Path) -> None:
    root = write_yolo_dataset(tmp_path / "data")
    before = contents(root)
    other = prepare_yolo(write_yolo_dataset(tmp_path / "other", train=4), tmp_path / "out")
    assert other.images["train"] == 8
    data = prepare_yolo(root, tmp_path / "out")
    assert contents(root) == before and contents(tmp_path / "other")
    assert data.images == {"train": 4, "val": 2} and len(labels(data)) == 6


def test_a_view_of_what_looks_alike_has_one_set_of_keypoints(tmp_path: Path) -> None:
    root = write_yolo_dataset(tmp_path / "data")
    found = labels(prepare_yolo(root, tmp_path / "out"))
    for name, (row,) in found.items():
        (raw,) = np.loadtxt(root / "yolo" / "pose" / "labels" / name, ndmin=2)
        points, given = (np.reshape(numbers[5:], (9, 3)) for numbers in (row, raw))
        # The x axis points to the right, as it does in even images; half a turn swaps corners across the middle.
        turned = [3, 2, 1, 0, 7, 6, 5, 4, 8] if name.endswith("1.txt") else list(range(9))
        np.testing.assert_allclose(points, given[turned], atol=1e-5)
        pairs = [(a, a + 1) for a in range(0, 8, 2) if points[a, 2] and points[a + 1, 2]]
        assert all(points[b, 0] > points[a, 0] for a, b in pairs)
        assert len(pairs) == 4 or name.endswith("1.txt")


def test_boxes_are_of_whole_objects_as_far_as_they_are_in_the_image(tmp_path: Path) -> None:
    root = write_yolo_dataset(tmp_path / "data", name="relay")
    cut = 0
    for name, (row,) in labels(prepare_yolo(root, tmp_path / "out")).items():
        (raw,) = np.loadtxt(root / "yolo" / "pose" / "labels" / name, ndmin=2)
        np.testing.assert_allclose(row[5:], raw[5:], atol=1e-6)
        (left, top), (right, bottom) = row[1:3] - row[3:5] / 2, row[1:3] + row[3:5] / 2
        u, v, known = np.reshape(row[5:], (9, 3)).T
        # Corners are labelled half a pixel from the edges of their pixels, rounded to the nearest one.
        tolerance = 1.01 / np.array([160, 120])
        if known.all():
            np.testing.assert_allclose([left, right], [u.min(), u.max()], atol=tolerance[0])
        else:
            cut += 1
            assert left == pytest.approx(0.0, abs=1e-6)
        np.testing.assert_array_less(np.abs([right - u[known > 0].max(), bottom - v[known > 0].max()]), tolerance)
        assert row[3] > raw[3] and top <= v[known > 0].min() + tolerance[1]
    assert cut


def test_labels_are_kept_where_there_are_no_poses(tmp_path: Path) -> None:
    root = write_yolo_dataset(tmp_path / "data", name="relay", bop=False)
    for name, rows in labels(prepare_yolo(root, tmp_path / "out")).items():
        np.testing.assert_allclose(rows, np.loadtxt(root / "yolo" / "pose" / "labels" / name, ndmin=2), atol=1e-6)


def about(key: str, value: object) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        path = root / "yolo" / ABOUT
        path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {key: value}))

    return spoil


def label(text: str | None) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        for path in (root / "yolo" / "pose" / "labels" / "train").rglob("*.txt"):
            path.unlink() if text is None else path.write_text(text)

    return spoil


MEAN = "0 0.5 0.5 0.2 0.2" + " 0.5 0.5 2" * 9 + "\n"


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda root: shutil.rmtree(root / "yolo"), "no yolo/pose/data.yaml to learn from; add yolo"),
        (about("names", ["klt3147"]), "names: expected names of the classes 0, 1"),
        (about("kpt_shape", [17, 3]), r"kpt_shape: is \[17, 3\]; expected \[9, 3\]"),
        (about("kpt_names", {0: [str(k) for k in range(9)]}), "kpt_names: missing or in another order"),
        (about("kpt_names", None), "kpt_names: missing or in another order"),
        (about("names", {0: "klt3147", 1: "mug"}), "kpt_names"),
        (about("train", "../images"), "expected a folder in images"),
        (lambda root: shutil.rmtree(root / "yolo/pose/images/val"), "0 held out; at least one of each"),
        (lambda root: shutil.rmtree(root / "scenes"), "0 complete scenes for training"),
        (label(""), "no training image shows klt3147; generate more"),
        (label(None), "no such file; expected the labels of an image"),
        (label("0 0.5 0.5"), "line 1: 3 numbers; expected 32"),
        (label(MEAN.replace("0 ", "4 ", 1)), "expected 32, the first one a class below 1"),
        (label(MEAN.replace("0.2", "x")), "line 1: could not convert"),
        (label(MEAN), "klt3147 with the box .* is not in the BOP part"),
        (lambda root: shutil.rmtree(root / "bop"), "no BOP part to take poses and keypoints from; add bop"),
        (lambda root: shutil.rmtree(root / "bop/train_pbr/000001"), "its BOP part lacks scene 000001"),
        (lambda root: (root / "bop/camera.json").write_text("{}"), "expected the images' size"),
        (lambda root: (root / "bop/train_pbr/000001/scene_gt.json").write_text("{}"), "no complete entry"),
        (about("names", {0: "nobody"}), "no model of one of its objects"),
    ],
)
def test_what_cannot_be_learned_from_is_told(tmp_path: Path, spoil: Callable[[Path], None], told: str) -> None:
    root = write_yolo_dataset(tmp_path / "data")
    spoil(root)
    with pytest.raises((DatasetError, FileFormatError), match=told):
        prepare_yolo(root, tmp_path / "out")
