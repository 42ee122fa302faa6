"""YOLO: the rules of Ultralytics' checker, and the checker itself where it is installed."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from simtrack.datasets.frame import Category
from simtrack.datasets.writers import make_writer
from simtrack.datasets.writers.box_keypoints import NAMES, flip_index, mirror_error
from simtrack.geometry.meshes import Mesh
from tests.datasets.writers.labelled import CAMERA, FRAMES, INFO, MODELS, WEDGE, Small, contents, made

CHECKER = os.environ.get("SIMTRACK_ULTRALYTICS_PYTHON", sys.executable)
"""An interpreter that has ultralytics, which cannot live beside opencv-python-headless."""
SIZE = np.array([CAMERA.width, CAMERA.height])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("yolo"), [make_writer("yolo")]) / "yolo"


def rows(path: Path) -> list[list[float]]:
    return [[float(word) for word in line.split()] for line in path.read_text().splitlines()]


def label_files(root: Path) -> list[Path]:
    """Those that Ultralytics looks for: of every image the one where images has become labels."""
    images = sorted((root / "images").rglob("*.jpg"))
    return [Path(str(path).replace("/images/", "/labels/")).with_suffix(".txt") for path in images]


@pytest.mark.parametrize("task", ["pose", "segment"])
def test_labels_keep_to_the_rules_of_the_checker(folder: Path, task: str) -> None:
    root = folder / task
    about: dict[str, Any] = yaml.safe_load((root / "data.yaml").read_text())
    assert about["names"] == {0: "bars", 1: "can", 2: "wedge"}
    for split in ("train", "val"):
        assert len(list((root / about[split]).rglob("*.jpg"))) == FRAMES
    files = label_files(root)
    assert len(files) == 2 * FRAMES and sum(bool(path.read_text()) for path in files) > 3
    for path in files:
        found = rows(path)
        assert len({tuple(row) for row in found}) == len(found)
        for row in found:
            assert row[0] in about["names"]
            numbers = np.array(row[1:])
            if task == "pose":
                assert len(row) == 5 + 3 * about["kpt_shape"][0]
                points = np.reshape(row[5:], (-1, 3))
                assert set(points[:, 2]) <= {0.0, 1.0, 2.0} and (points[points[:, 2] == 0] == 0).all()
                numbers = np.concatenate([numbers[:4], points[:, :2].ravel()])
            else:
                assert len(numbers) >= 6 and len(numbers) % 2 == 0
            assert numbers.min() >= 0.0 and numbers.max() <= 1.0


def test_poses_are_boxes_and_corners_in_shares_of_the_image(folder: Path) -> None:
    hidden = 0
    for scene, split in enumerate(("train", "val")):
        for frame in Small().scene(scene):
            found = rows(folder / "pose" / "labels" / split / f"{scene:06d}" / f"{frame.index:06d}.txt")
            seen = [label for label in frame.targets() if label.pixels_visible >= 10]
            assert len(found) == len(seen)
            for row, label in zip(found, seen, strict=True):
                v, u = np.nonzero(frame.ids == label.instance)
                first, last = np.array([u.min(), v.min()]), np.array([u.max(), v.max()]) + 1
                assert row[0] + 1 == label.category
                np.testing.assert_allclose(row[1:3], (first + last) / 2 / SIZE, atol=1e-6)
                np.testing.assert_allclose(row[3:5], (last - first) / SIZE, atol=1e-6)
                points = np.reshape(row[5:], (9, 3))
                np.testing.assert_array_equal(points[:, 2], label.keypoint_visibility)
                known = points[:, 2] > 0
                np.testing.assert_allclose(points[known, :2] * SIZE - 0.5, label.keypoints[known], atol=1e-4)
                hidden += int((points[:, 2] == 1).sum())
    assert hidden


def test_segments_filled_as_ultralytics_fills_them_are_the_masks(folder: Path) -> None:
    holes = parts = 0
    for scene, split in enumerate(("train", "val")):
        for frame in Small().scene(scene):
            found = rows(folder / "segment" / "labels" / split / f"{scene:06d}" / f"{frame.index:06d}.txt")
            seen = [label for label in frame.targets() if label.pixels_visible >= 10]
            for row, label in zip(found, seen, strict=True):
                mask = frame.ids == label.instance
                points = (np.reshape(row[1:], (-1, 2)) * SIZE).astype(np.int32)
                again = np.zeros(mask.shape, np.uint8)
                cv2.fillPoly(again, [points], 1)  # type: ignore[call-overload]
                assert again[mask].all() and again[~mask].sum() <= 0.2 * mask.sum()  # bridges
                parts += cv2.connectedComponents(mask.astype(np.uint8))[0] > 2
                holes += cv2.connectedComponents(np.pad(~mask, 1, constant_values=True).astype(np.uint8))[0] > 2
    assert parts and holes


def test_flipping_swaps_what_a_mirror_swaps() -> None:
    index = flip_index(INFO.categories)
    assert sorted(index) == list(range(9)) and [index[k] for k in index] == list(range(9)) and index[8] == 8
    # The wedge is its own mirror image along y only, so an image of it mirrored by its camera's upright plane is one of
    # the wedge mirrored along y: corners change places with those of the other y.
    wedge = index_of(WEDGE)
    for corner, image in enumerate(wedge[:8]):
        assert (NAMES[corner][:2], NAMES[corner][4:]) == (NAMES[image][:2], NAMES[image][4:])
        assert NAMES[corner][2:4] != NAMES[image][2:4]
    turned = Mesh(WEDGE.vertices[:, [1, 0, 2]], WEDGE.faces[:, ::-1])
    assert all(
        NAMES[c][:2] != NAMES[i][:2] and NAMES[c][2:] == NAMES[i][2:] for c, i in enumerate(index_of(turned)[:8])
    )
    assert mirror_error(WEDGE, 1) < 1e-12 < 0.05 < mirror_error(WEDGE, 0)


def index_of(mesh: Mesh) -> list[int]:
    return flip_index([Category(1, replace(MODELS[2], mesh=mesh))])


def test_both_tasks_share_their_images(folder: Path) -> None:
    for path in (folder / "pose" / "images").rglob("*.jpg"):
        other = folder / "segment" / path.relative_to(folder / "pose")
        assert other.samefile(path)


@pytest.mark.parametrize(("share", "expected"), [(0.0, "images/train"), (0.5, "images/val")])
def test_there_are_always_images_to_validate_with(tmp_path: Path, share: float, expected: str) -> None:
    root = made(tmp_path, [make_writer("yolo", {"tasks": ["pose"]})], Small(replace(INFO, val_share=share), 1))
    about = yaml.safe_load((root / "yolo" / "pose" / "data.yaml").read_text())
    assert about["val"] == expected and (root / "yolo" / "pose" / expected).is_dir()
    assert not (root / "yolo" / "segment").exists()


def test_finishing_again_changes_nothing(folder: Path) -> None:
    before = contents(folder)
    make_writer("yolo").finish(folder.parent, INFO, 2)
    assert contents(folder) == before


def test_ultralytics_accepts_it(folder: Path, tmp_path: Path) -> None:
    environment = os.environ | {"YOLO_CONFIG_DIR": str(tmp_path), "YOLO_OFFLINE": "true", "YOLO_AUTOINSTALL": "false"}
    ask = subprocess.run([CHECKER, "-c", "import ultralytics"], capture_output=True, env=environment)
    if ask.returncode != 0:
        pytest.skip("ultralytics is not installed ($SIMTRACK_ULTRALYTICS_PYTHON names an interpreter that has it)")
    code = """
import sys
from ultralytics.data.dataset import YOLODataset
from ultralytics.data.utils import check_det_dataset
for task in ("pose", "segment"):
    data = check_det_dataset(f"{sys.argv[1]}/{task}/data.yaml", autodownload=False)
    for split in ("train", "val"):
        found = YOLODataset(data[split], data=data, task=task, augment=False)
        cache = found.get_labels()
        import pathlib, numpy
        stored = numpy.load(pathlib.Path(found.label_files[0]).parent.with_suffix(".cache"), allow_pickle=True).item()
        print(task, split, len(cache), *stored["results"], len(stored["msgs"]))
"""
    run = subprocess.run(
        [CHECKER, "-c", code, str(folder)], capture_output=True, text=True, env=environment, check=True
    )
    for cache in folder.rglob("*.cache"):
        cache.unlink()
    lines = [line.split() for line in run.stdout.splitlines() if line.startswith(("pose", "segment"))]
    # task, split, labels; found, missing, empty, corrupt, total; messages
    assert [line[2:] for line in lines] == [["3", "3", "0", "0", "0", "3", "0"]] * 4
