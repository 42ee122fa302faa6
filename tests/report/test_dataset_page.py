"""The page that shows a data set: from files of BOP and of COCO, whole and usable without anything else."""

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from simtrack.datasets.inspection import Inspection, inspect, spread
from simtrack.datasets.writers import make_writer
from simtrack.errors import DatasetError
from simtrack.report.dataset_page import LAYERS, picture, render, write_dataset_page
from tests.datasets.writers.labelled import FRAMES, INFO, Small, made

NAMES = {str(category.id): category.model.name for category in INFO.categories}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = made(tmp_path_factory.mktemp("set"), [make_writer(name) for name in ("bop", "coco", "yolo")])
    about = {"name": "small", "seed": 7, "categories": NAMES, "complete": False, "scenes": 9, "description": "Things."}
    (folder / "dataset.json").write_text(json.dumps(about))
    return folder


@pytest.fixture(scope="module")
def bop(root: Path) -> Inspection:
    return inspect(root, 4)


def test_statistics_are_those_of_the_labels(bop: Inspection) -> None:
    frames = [frame for scene in range(2) for frame in Small().scene(scene)]
    labels = [label for frame in frames for label in frame.targets()]
    s = bop.statistics
    assert (s.images, s.scenes, s.classes) == (2 * FRAMES, 2, tuple(NAMES.values()))
    assert [s.classes[k] for k in s.category] == [NAMES[str(label.category)] for label in labels]
    np.testing.assert_allclose(s.fraction, [label.visible_fraction for label in labels])
    np.testing.assert_array_equal(s.pixels, [label.pixels_visible for label in labels])
    np.testing.assert_allclose(s.distance, [np.linalg.norm(label.T_camera_object[:3, 3]) for label in labels])
    for direction, label, distance in zip(s.viewpoint, labels, s.distance, strict=True):
        camera_in_object = np.linalg.inv(label.T_camera_object)[:3, 3]
        np.testing.assert_allclose(direction * distance, camera_in_object, atol=1e-9)


def test_images_carry_all_labels(bop: Inspection) -> None:
    assert [image.name for image in bop.images] == ["scene 0, image 0", "scene 0, image 2", "scene 1, image 0",
                                                    "scene 1, image 2"]  # fmt: skip
    frame = list(Small().scene(1))[2]
    image = bop.images[3]
    assert len(image.instances) == len(frame.targets())
    for seen, label in zip(image.instances, frame.targets(), strict=True):
        assert seen.visible is not None
        assert np.array_equal(seen.visible, frame.ids == label.instance)
        assert seen.box == label.box_visible
        if seen.cuboid is not None:
            np.testing.assert_allclose(seen.cuboid, label.keypoints, atol=1e-2)
    assert image.keypoints is not None
    shown = [label for label in frame.targets() if label.pixels_visible >= 10]
    points = np.concatenate([label.keypoints for label in shown])
    flags = np.concatenate([label.keypoint_visibility for label in shown])
    np.testing.assert_array_equal(image.keypoints[:, 2], flags)
    np.testing.assert_allclose(image.keypoints[flags > 0, :2], points[flags > 0], atol=1e-3)


def test_the_page_is_whole(bop: Inspection, tmp_path: Path) -> None:
    write_dataset_page(bop, tmp_path / "page.html")
    html = (tmp_path / "page.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', html), "nothing from elsewhere"
    assert "2 of 9 scenes are there" in html
    for layer in LAYERS:
        assert f'id="show-{layer}"' in html
        assert f'<g class="{layer}">' in html
    for name in NAMES.values():
        assert name in html
    for section in ("images", "classes", "distributions", "viewpoints"):
        assert f'<section id="{section}">' in html


def test_drawings_are_svg(bop: Inspection) -> None:
    colors = dict.fromkeys(NAMES.values(), "#123456")
    for image in bop.images:
        drawing = ET.fromstring(picture(image, colors))
        assert len(list(drawing)) >= 5


def test_coco_alone_is_shown(root: Path) -> None:
    found = inspect(root / "coco", 3)
    assert found.source == "COCO"
    assert len(found.images) == 3
    assert found.statistics.images == 2 * FRAMES
    labels = [label for scene in range(2) for frame in Small().scene(scene) for label in frame.targets()]
    assert len(found.statistics.category) == sum(label.pixels_visible > 0 for label in labels)
    html = render(found)
    assert 'class="keypoints"' in html
    assert '<section id="viewpoints">' not in html, "COCO knows no poses"


def test_what_cannot_be_shown_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no folder"):
        inspect(tmp_path / "nothing")
    with pytest.raises(DatasetError, match=r"neither BOP .* nor COCO"):
        inspect(tmp_path)


def test_images_are_spread_evenly() -> None:
    assert spread(10, 5) == [1, 3, 5, 7, 9]
    assert spread(3, 12) == [0, 1, 2]
    assert spread(0, 4) == []
