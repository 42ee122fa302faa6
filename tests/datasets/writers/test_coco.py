"""COCO as its own tools read it."""

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from simtrack.datasets.writers import make_writer
from simtrack.datasets.writers.coco import panoptic
from simtrack.objects.model import BOX_EDGES
from simtrack.sensors.camera import project
from tests.datasets.writers.labelled import CAMERA, FRAMES, INFO, MODELS, Small, contents, made, write

coco = pytest.importorskip("pycocotools.coco")
cocoeval = pytest.importorskip("pycocotools.cocoeval")

pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

SPLITS = {"train": 0, "val": 1}
"""Split -> the scene that is in it."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("coco"), [make_writer("coco")]) / "coco"


def load(folder: Path, part: str, split: str) -> Any:
    return coco.COCO(str(folder / "annotations" / f"{part}_{split}.json"))


@pytest.mark.parametrize("split", SPLITS)
def test_instances_are_what_is_seen(folder: Path, split: str) -> None:
    index = load(folder, "instances", split)
    assert {c["id"]: c["name"] for c in index.cats.values()} == {c.id: c.model.name for c in INFO.categories}
    images = index.loadImgs(index.getImgIds())
    assert [image["file_name"] for image in images] == [f"{SPLITS[split]:06d}/{k:06d}.jpg" for k in range(FRAMES)]
    for frame, image in zip(Small().scene(SPLITS[split]), images, strict=True):
        found = cv2.imread(str(folder / "images" / image["file_name"]))
        assert found is not None and found.shape == (image["height"], image["width"], 3)
        seen = [label for label in frame.targets() if (frame.ids == label.instance).any()]
        annotations = index.loadAnns(index.getAnnIds([image["id"]]))
        assert len(annotations) == len(seen) >= 3
        for label, annotation in zip(seen, annotations, strict=True):
            mask = frame.ids == label.instance
            np.testing.assert_array_equal(index.annToMask(annotation) > 0, mask)
            v, u = np.nonzero(mask)
            assert annotation["bbox"] == [u.min(), v.min(), u.max() - u.min() + 1, v.max() - v.min() + 1]
            assert annotation["area"] == mask.sum() and annotation["iscrowd"] == 0
            assert annotation["category_id"] == label.category


def test_ids_count_through_all_splits(folder: Path) -> None:
    sets = [load(folder, "instances", split).dataset for split in SPLITS]
    for kind in ("images", "annotations"):
        ids = [entry["id"] for data in sets for entry in data[kind]]
        assert ids == list(range(1, len(ids) + 1))


@pytest.mark.parametrize("split", SPLITS)
def test_keypoints_are_the_corners_of_the_boxes(folder: Path, split: str) -> None:
    index = load(folder, "keypoints", split)
    for category in index.cats.values():
        assert len(set(category["keypoints"])) == 9
        assert [tuple(edge) for edge in category["skeleton"]] == [(a + 1, b + 1) for a, b in BOX_EDGES]
        for a, b in category["skeleton"]:
            one, other = category["keypoints"][a - 1], category["keypoints"][b - 1]
            assert sum(x != y for x, y in zip(one, other, strict=True)) == 1  # an edge changes one sign
    outside = hidden = 0
    for frame, number in zip(Small().scene(SPLITS[split]), index.getImgIds(), strict=True):
        seen = [label for label in frame.targets() if label.pixels_visible]
        for label, annotation in zip(seen, index.loadAnns(index.getAnnIds([number])), strict=True):
            points = np.reshape(annotation["keypoints"], (9, 3))
            corners = MODELS[annotation["category_id"] - 1].keypoints
            T = label.T_camera_object
            expected = project(corners @ T[:3, :3].T + T[:3, 3], CAMERA)
            labelled = points[:, 2] > 0
            assert annotation["num_keypoints"] == labelled.sum()
            np.testing.assert_allclose(points[labelled, :2], expected[labelled], atol=5.1e-4)
            assert (points[~labelled] == 0).all()
            inside = ((expected > -0.5) & (expected < [CAMERA.width - 0.5, CAMERA.height - 0.5])).all(axis=1)
            np.testing.assert_array_equal(labelled, inside)
            outside, hidden = outside + int((~inside).sum()), hidden + int((points[:, 2] == 1).sum())
    assert outside and hidden


@pytest.mark.parametrize("part", ["bbox", "segm", "keypoints"])
def test_the_labels_score_full_marks_as_their_own_detections(folder: Path, part: str) -> None:
    index = load(folder, "keypoints", "train")
    found = [a | {"score": 0.9} for a in index.dataset["annotations"] if a["num_keypoints"] >= 5]
    results = index.loadRes(json.loads(json.dumps(found)))
    judge = cocoeval.COCOeval(index, results, part)
    judge.params.kpt_oks_sigmas = np.full(9, 0.05)
    judge.params.imgIds = sorted({a["image_id"] for a in found})
    judge.evaluate()
    pairs = [entry for entry in judge.evalImgs if entry is not None and entry["aRng"] == judge.params.areaRng[0]]
    matched = sum(int((entry["dtMatches"][-1] > 0).sum()) for entry in pairs)
    assert matched == len(found) > 5


@pytest.mark.parametrize("split", SPLITS)
def test_panoptic_images_and_their_segments_agree(folder: Path, split: str) -> None:
    data = json.loads((folder / "annotations" / f"panoptic_{split}.json").read_text())
    categories = {c["id"]: c for c in data["categories"]}
    assert {c["name"]: c["isthing"] for c in data["categories"]} == {
        "bars": 1, "can": 1, "wedge": 1, "floor": 0, "pole": 1
    }  # fmt: skip
    assert [a["image_id"] for a in data["annotations"]] == [image["id"] for image in data["images"]]
    for frame, annotation in zip(Small().scene(SPLITS[split]), data["annotations"], strict=True):
        bgr = cv2.imread(str(folder / "panoptic" / annotation["file_name"]), cv2.IMREAD_UNCHANGED)
        assert bgr is not None
        ids = bgr.astype(int) @ [65536, 256, 1]
        segments = {segment["id"]: segment for segment in annotation["segments_info"]}
        assert set(segments) == set(np.unique(ids)) - {0}
        np.testing.assert_array_equal(ids == 0, frame.ids < 0)
        stuff = [s["category_id"] for s in segments.values() if not categories[s["category_id"]]["isthing"]]
        assert len(stuff) == len(set(stuff))
        for number, segment in segments.items():
            mask = ids == number
            v, u = np.nonzero(mask)
            assert segment["area"] == mask.sum() and segment["iscrowd"] == 0
            assert segment["bbox"] == [u.min(), v.min(), u.max() - u.min() + 1, v.max() - v.min() + 1]
            assert set(frame.segment_categories[frame.ids[mask]]) == {segment["category_id"]}
            if categories[segment["category_id"]]["isthing"]:
                assert len(np.unique(frame.ids[mask])) == 1


def test_many_instances_need_more_than_one_byte() -> None:
    frame = next(iter(Small().scene(0)))
    rng = np.random.default_rng(0)
    ids = rng.integers(-1, 70_000, frame.ids.shape).astype(np.int32)
    categories = np.where(np.arange(70_000) % 3, 1, 4).astype(np.int32)
    wide = replace(frame, ids=ids, names=tuple(map(str, range(70_000))), segment_categories=categories)
    image, segments = panoptic(wide, {1})
    numbers = image.astype(int) @ [1, 256, 65536]
    stuff = (ids >= 0) & (ids % 3 == 0)
    np.testing.assert_array_equal(numbers[~stuff], ids[~stuff] + 1)
    assert set(numbers[stuff]) == {1} and len(segments) == len(set(np.unique(numbers)) - {0})


def test_parts_can_be_chosen(tmp_path: Path) -> None:
    root = made(tmp_path, [make_writer("coco", {"parts": ["keypoints"], "image": "png", "min_pixels": 250})]) / "coco"
    assert [path.name for path in sorted((root / "annotations").iterdir())] == [
        "keypoints_train.json", "keypoints_val.json"
    ]  # fmt: skip
    assert not (root / "panoptic").exists()
    index = load(root, "keypoints", "train")
    areas = [annotation["area"] for annotation in index.anns.values()]
    seen = [label.pixels_visible for frame in Small().scene(0) for label in frame.targets()]
    assert min(areas) >= 250 and len(areas) == sum(pixels >= 250 for pixels in seen) < sum(p > 0 for p in seen)
    image = cv2.imread(str(root / "images" / "000000" / "000000.png"))
    assert image is not None
    np.testing.assert_array_equal(image[..., ::-1], next(iter(Small().scene(0))).rgb)


def test_finishing_again_or_after_an_interruption_changes_nothing(tmp_path: Path) -> None:
    writer = make_writer("coco")
    root = made(tmp_path / "a", [writer])
    before = contents(root)
    annotations = root / "coco" / "annotations"
    (annotations / "instances_train.json").write_text("{")
    (annotations / ".instances_train.json.images").write_text("left over")
    (annotations / "instances_old.json").write_text("{}")
    writer.finish(root, INFO, 2)
    assert contents(root) == before
    other = tmp_path / "b"
    write(other, [make_writer("coco")], Small(), [1, 0])
    writer.finish(other, INFO, 2)
    assert contents(other) == before


def test_finishing_takes_no_more_memory_for_more_scenes(folder: Path, tmp_path: Path) -> None:
    left = (folder / ".fragments" / "000000.jsonl").read_bytes()
    peaks = []
    for scenes in (80, 400):
        root = tmp_path / str(scenes)
        (root / "coco" / ".fragments").mkdir(parents=True)
        for scene in range(scenes):
            (root / "coco" / ".fragments" / f"{scene:06d}.jsonl").write_bytes(left)
        tracemalloc.start()
        make_writer("coco").finish(root, INFO, scenes)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 20 * len(left)  # of 320 more scenes
