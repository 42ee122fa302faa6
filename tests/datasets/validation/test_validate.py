"""Validation: good data sets pass; one thing that is wrong is found, and where it is is said."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics
from simtrack.datasets.engine import generate
from simtrack.datasets.frame import SceneInfo
from simtrack.datasets.validation import Validation, validate
from simtrack.datasets.validation.masks import box, decoded, edge_free
from simtrack.datasets.writers import WRITERS, make_writer
from simtrack.errors import DatasetError
from tests.datasets.tiny import InlinePool
from tests.datasets.writers.labelled import CAMERA, FRAMES, INFO, Small

RECIPE = "name: small\nworlds: [{kind: room}]\ntargets: {models: [relay]}\ncamera: {depth: %s}\n"
LARGER = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
SCENE, IMAGE = "000001", "000002"
BOP = f"bop/train_pbr/{SCENE}"


@dataclass(frozen=True)
class Factory:
    """Makes the source."""

    noise: float = 0.0
    test: bool = False

    def __call__(self) -> "Frames":
        preset = "ideal" if self.noise == 0.0 else "xtion"
        info = replace(INFO, recipe=RECIPE % preset, split="test" if self.test else "train")
        info = replace(info, intrinsics=CAMERA if self.noise == 0.0 else LARGER)
        return Frames(Small(info=info, noise=self.noise))


class Frames:
    """The small scenes as the engine takes them."""

    def __init__(self, small: Small) -> None:
        self.info, self._small = small.info, small

    def scenes(self, count: int) -> int:
        return -(-count // FRAMES)

    def scene_info(self, scene: int) -> SceneInfo:
        return self._small.scene_info(scene)

    def frames(self, scene: int) -> Any:
        return self._small.scene(scene)

    def close(self) -> None:
        pass


def made(root: Path, factory: Factory, names: tuple[str, ...] = tuple(WRITERS)) -> Path:
    writers = [make_writer(name) for name in names]
    generate(factory, writers, root, 2 * FRAMES, InlinePool)
    return root


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All formats, depth without noise."""
    return made(tmp_path_factory.mktemp("good") / "set", Factory())


def test_all_formats_are_right(good: Path) -> None:
    result = validate(good)
    assert list(map(str, result.findings)) == []
    assert result.counts == {
        "bop": 6, "bop_webdataset": 6, "coco": 6, "dope": 6, "kitti": 6, "labels": 6, "mcap": 2, "tum": 6, "yolo": 6,
    }  # fmt: skip
    assert result.images == 12
    assert result.instances == 60
    assert result.colour_offset == (0, 0)
    assert result.depth_error is not None
    assert result.depth_error[1] < 1e-3
    assert result.good


def test_test_splits_have_targets(tmp_path: Path) -> None:
    root = made(tmp_path / "set", Factory(test=True), ("bop",))
    assert validate(root).good
    path = root / "bop" / "test_targets_bop19.json"
    targets = json.loads(path.read_text())
    targets[3]["inst_count"] += 1
    path.write_text(json.dumps(targets))
    assert single(validate(root)).startswith("bop/test_targets_bop19.json: 3.inst_count")


def test_depth_is_held_against_the_recipe_s_noise(tmp_path: Path) -> None:
    assert validate(made(tmp_path / "fine", Factory(noise=0.001), ("bop",))).good
    shaken = validate(made(tmp_path / "shaken", Factory(noise=0.02), ("bop",)))
    assert {finding.field.split()[0] for finding in shaken.findings} == {"instance"}
    assert "the recipe's noise" in str(shaken.findings[0])


# --------------------------------------------------------------------------------------------- one thing that is wrong


def single(result: Validation) -> str:
    """The only finding."""
    assert len(result.findings) == 1, "\n".join(map(str, result.findings))
    return str(result.findings[0])


def edit(path: Path, change: Callable[[Any], None]) -> None:
    """Change a JSON document in a file of its own: it may be a hard link."""
    document = json.loads(path.read_text())
    change(document)
    path.unlink()
    path.write_text(json.dumps(document))


def repaint(path: Path, change: Callable[[np.ndarray], np.ndarray | None]) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    changed = change(image)
    path.unlink()
    assert cv2.imwrite(str(path), image if changed is None else changed)


def of_bop(name: str, change: Callable[[Any], None]) -> Callable[[Path], None]:
    return lambda root: edit(root / BOP / f"{name}.json", lambda d: change(d["2"]))


def line(path: str, number: int, text: str | None) -> Callable[[Path], None]:
    """Replace a line of a text file."""

    def change(root: Path) -> None:
        lines = (root / path).read_text().splitlines()
        lines[number : number + 1] = [] if text is None else [text]
        (root / path).unlink()
        (root / path).write_text("".join(entry + "\n" for entry in lines))

    return change


def moved(pose: dict[str, Any], millimetres: float) -> None:
    pose["cam_t_m2c"][0] += millimetres


def set_pixel(value: int) -> Callable[[np.ndarray], None]:
    def change(image: np.ndarray) -> None:
        image[1, 1] = value

    return change


def coco(name: str, change: Callable[[Any], None]) -> Callable[[Path], None]:
    return lambda root: edit(root / "coco" / "annotations" / f"{name}_train.json", change)


def bigger(entry: dict[str, Any], name: str, by: float = 1) -> None:
    entry[name] += by


def first_number(values: list[Any], by: float = 1) -> None:
    values[0] += by


Corruption = tuple[str, Callable[[Path], object], str]
CORRUPTIONS: list[Corruption] = [
    ("scene_gt of another image", of_bop("scene_gt", lambda e: moved(e[0], 30.0)), f"{BOP}/mask"),
    ("obj_id", of_bop("scene_gt", lambda e: e[4].update(obj_id=9)), f"{BOP}/scene_gt.json: 2.4.obj_id: found 9"),
    ("no rotation", of_bop("scene_gt", lambda e: first_number(e[4]["cam_R_m2c"])), "2.4.cam_R_m2c"),
    ("K", of_bop("scene_camera", lambda e: first_number(e["cam_K"])), "2.cam_K (fx): found 91, expected 90"),
    ("depth_scale", of_bop("scene_camera", lambda e: bigger(e, "depth_scale")), "2.depth_scale"),
    ("world", of_bop("scene_camera", lambda e: e.pop("cam_t_w2c")), "2.cam_t_w2c"),
    ("px_count_all", of_bop("scene_gt_info", lambda e: bigger(e[0], "px_count_all", 40)), "2.0.px_count_all"),
    ("px_count_valid", of_bop("scene_gt_info", lambda e: bigger(e[0], "px_count_valid")), "2.0.px_count_valid"),
    ("px_count_visib", of_bop("scene_gt_info", lambda e: bigger(e[0], "px_count_visib")), "2.0.px_count_visib"),
    ("visib_fract", of_bop("scene_gt_info", lambda e: bigger(e[0], "visib_fract", -0.01)), "2.0.visib_fract"),
    ("bbox_visib", of_bop("scene_gt_info", lambda e: first_number(e[0]["bbox_visib"])), "2.0.bbox_visib"),
    ("bbox_obj", of_bop("scene_gt_info", lambda e: first_number(e[0]["bbox_obj"], -2)), "2.0.bbox_obj"),
    ("missing field", of_bop("scene_gt_info", lambda e: e[0].pop("visib_fract")), "2.0.visib_fract: found nothing"),
    ("missing entry", of_bop("scene_gt_info", lambda e: e.pop()), "2 (length): found 4, expected 5"),
    ("no JSON", lambda root: (root / BOP / "scene_gt.json").write_text("{"), f"{BOP}/scene_gt.json"),
    ("no mask", lambda root: (root / BOP / f"mask/{IMAGE}_000000.png").unlink(), "no such file"),
    ("stray mask", lambda root: shutil.copy(
        root / BOP / f"mask/{IMAGE}_000000.png", root / BOP / f"mask/{IMAGE}_000007.png"), "an entry in scene_gt"),
    ("shifted mask", lambda root: repaint(
        root / BOP / f"mask/{IMAGE}_000000.png", lambda m: np.roll(m, 1, axis=1)), "it fits best shifted by 1, 0"),
    ("grey mask", lambda root: repaint(root / BOP / f"mask/{IMAGE}_000000.png", set_pixel(128)), "0 and 255 only"),
    ("mask pixel", lambda root: repaint(root / BOP / f"mask_visib/{IMAGE}_000001.png", set_pixel(255)), "outside of"),
    ("depth", lambda root: repaint(root / BOP / f"depth/{IMAGE}.png", lambda d: np.where(
        d > 0, d + 15, 0).astype(np.uint16)), "depth up to 1.5"),
    ("8-bit depth", lambda root: repaint(
        root / BOP / f"depth/{IMAGE}.png", lambda d: d.astype(np.uint8)), "depth is a 16-bit grey PNG"),
    ("small image", lambda root: repaint(root / BOP / f"rgb/{IMAGE}.jpg", lambda i: i[:-1]), "rgb/000002.jpg: (size)"),
    ("no image", lambda root: (root / BOP / f"rgb/{IMAGE}.jpg").write_bytes(b"JFIF"), "neither a PNG nor a JPEG"),
    ("camera", lambda root: edit(root / "bop/camera.json", lambda d: d.pop("fx")), "camera.json: fx: found nothing"),
    ("diameter", lambda root: edit(root / "bop/models/models_info.json", lambda d: bigger(d["1"], "diameter")),
     "models/models_info.json: 1.diameter"),
    ("model", lambda root: (root / "bop/models/obj_000002.ply").unlink(), "models/obj_000002.ply"),
    ("symmetry", lambda root: edit(root / "bop/models/models_info.json", lambda d: d["1"].update(
        symmetries_discrete=[[0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]])), "expected a symmetry"),
    ("scene_gt_coco", lambda root: edit(
        root / BOP / "scene_gt_coco.json", lambda d: bigger(d["annotations"][0], "area")), "scene_gt_coco.json: annot"),
    ("shard", lambda root: (root / "bop_webdataset/train_pbr/shard-000001.tar").write_bytes(b"no archive"),
     "shard-000001.tar"),
    ("key_to_shard", lambda root: edit(root / "bop_webdataset/train_pbr/key_to_shard.json", lambda d: d.update(
        {f"{SCENE}_{IMAGE}": 9})), f"key_to_shard.json: {SCENE}_{IMAGE}: found 9"),
    ("area", coco("instances", lambda d: bigger(d["annotations"][1], "area")), "annotations.1.area"),
    ("bbox", coco("instances", lambda d: first_number(d["annotations"][1]["bbox"])), "annotations.1.bbox"),
    ("RLE", coco("instances", lambda d: d["annotations"][1]["segmentation"].update(counts="Q0")), "run lengths"),
    ("category", coco("instances", lambda d: d["annotations"][1].update(category_id=77)), "annotations.1.category_id"),
    ("image_id", coco("instances", lambda d: d["annotations"][1].update(image_id=77)), "annotations.1.image_id"),
    ("annotation id", coco("instances", lambda d: d["annotations"][1].update(
        id=d["annotations"][0]["id"])), "several times"),
    ("keypoint", coco("keypoints", lambda d: d["annotations"][1]["keypoints"].__setitem__(slice(0, 3), [5000, 0, 2])),
     "annotations.1.keypoints.0"),
    ("num_keypoints", coco("keypoints", lambda d: bigger(d["annotations"][1], "num_keypoints")), "num_keypoints"),
    ("skeleton", coco("keypoints", lambda d: d["categories"][0]["skeleton"].append([1, 10])), "skeleton"),
    ("file_name", coco("instances", lambda d: d["images"][0].update(file_name="x.jpg")), "coco/images/x.jpg"),
    ("segment", coco("panoptic", lambda d: bigger(d["annotations"][0]["segments_info"][0], "area")), "(id 1).area"),
    ("panoptic id", coco("panoptic", lambda d: d["annotations"][0]["segments_info"].pop(0)), "in one of file"),
    ("YOLO class", line(f"yolo/pose/labels/val/{SCENE}/{IMAGE}.txt", 0, "9" + " 0.5 0.5 0.1 0.1" + " 0 0 0" * 9),
     "class: found 9"),
    ("YOLO range", line(f"yolo/pose/labels/val/{SCENE}/{IMAGE}.txt", 0, "0 0.5 0.5 0.1 0.1 1.2 0.5 2" + " 0 0 0" * 8),
     "shares of the image"),
    ("YOLO columns", line(f"yolo/pose/labels/val/{SCENE}/{IMAGE}.txt", 0, "0 0.5 0.5 0.1 0.1"), "4 numbers"),
    ("YOLO hidden", line(f"yolo/pose/labels/val/{SCENE}/{IMAGE}.txt", 0, "0 .5 0.5 0.1 0.1"), "numbers"),
    ("YOLO polygon", line(f"yolo/segment/labels/val/{SCENE}/{IMAGE}.txt", 0, "0 0.5 0.5 0.1 0.1 0.2"), "5 numbers"),
    ("YOLO label", lambda root: (root / f"yolo/pose/labels/val/{SCENE}/{IMAGE}.txt").unlink(), "no such file"),
    ("YOLO flip", line("yolo/pose/data.yaml", 6, "flip_idx: [0, 0, 3, 2, 5, 4, 7, 6, 8]"), "flip_idx"),
    ("KITTI scan", lambda root: (root / f"kitti/sequences/{SCENE}/velodyne/{IMAGE}.bin").write_bytes(b"12345"),
     "no multiple of 16"),
    ("KITTI labels", lambda root: (root / f"kitti/sequences/{SCENE}/labels/{IMAGE}.label").write_bytes(b"\0\0\0\0"),
     "(number): found 1"),
    ("KITTI poses", line(f"kitti/sequences/{SCENE}/poses.txt", 1, None), "expected 3 lines of 12"),
    ("TUM pose", line(f"tum/{SCENE}/groundtruth.txt", 3, "1.1 0 0 0 1 0 0 1"), "pose 2, quaternion"),
    ("TUM listing", line(f"tum/{SCENE}/depth.txt", 2, "1.0 depth/none.png"), "no such file"),
    ("MCAP", lambda root: cut(root / f"mcap/{SCENE}.mcap"), f"mcap/{SCENE}.mcap"),
    ("labels", lambda root: edit(root / f"labels/{SCENE}/{IMAGE}.json", lambda d: first_number(
        d["objects"][0]["keypoints"][0])), "objects.0.keypoints: found points 1 px off"),
    ("label pose", lambda root: edit(root / f"labels/{SCENE}/{IMAGE}.json", lambda d: bigger(
        d["objects"][5], "visible_fraction", -0.1)), "objects.5.visible_fraction"),
    ("trajectory", line(f"labels/{SCENE}/trajectory.csv", 2, None), "trajectory.csv: stamp"),
    ("DOPE", lambda root: edit(root / f"dope/{SCENE}/{IMAGE}.json", lambda d: first_number(
        d["objects"][0]["projected_cuboid"][3])), "objects.0.projected_cuboid: found points 1 px off"),
]  # fmt: skip


def cut(path: Path) -> None:
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data[: len(data) // 2])


def part(good: Path, root: Path, name: str) -> Path:
    """A copy of one format with what stands beside."""
    shutil.copytree(good / name, root / name, copy_function=shutil.copy)
    for file in ("recipe.yaml", "dataset.json"):
        shutil.copy(good / file, root / file)
    edit(root / "dataset.json", lambda d: d.update(formats=[name], complete=False))
    return root


@pytest.mark.parametrize(("corrupt", "words"), [pytest.param(c, w, id=name) for name, c, w in CORRUPTIONS])
def test_what_is_wrong_is_found(good: Path, tmp_path: Path, corrupt: Callable[[Path], object], words: str) -> None:
    for name in WRITERS:
        root = part(good, tmp_path / name, name)
        try:
            corrupt(root)
        except FileNotFoundError:  # it concerns another format
            shutil.rmtree(root)
            continue
        findings = [str(finding) for finding in validate(root).findings if finding.field != "complete"]
        assert any(words in finding for finding in findings), findings
        return
    pytest.fail("nothing was corrupted")


BESIDE: list[Corruption] = [
    ("dataset.json", lambda root: edit(root / "dataset.json", lambda d: d.update(complete=False)), "complete"),
    ("recipe", lambda root: (root / "recipe.yaml").write_text("name: small\n"), "recipe_sha256"),
    ("marker", lambda root: (root / f"scenes/{SCENE}.json").unlink(), "scenes: found [0], expected [0, 1]"),
    ("format", lambda root: edit(root / "dataset.json", lambda d: d["formats"].append("nif")), "formats: found nif"),
    ("folder", lambda root: shutil.rmtree(root / "kitti"), "kitti: found nothing, expected a folder"),
]


@pytest.mark.parametrize(("corrupt", "words"), [pytest.param(c, w, id=name) for name, c, w in BESIDE])
def test_what_is_wrong_beside_the_formats_is_found(
    good: Path, tmp_path: Path, corrupt: Callable[[Path], object], words: str
) -> None:
    root = tmp_path / "set"
    shutil.copytree(good, root, copy_function=shutil.copy)
    corrupt(root)
    findings = [str(finding) for finding in validate(root, sample=0).findings]
    assert any(words in finding for finding in findings), findings


def test_any_changed_byte_is_found(good: Path, tmp_path: Path) -> None:
    """What no rule forbids is told by the scene's digest."""
    root = tmp_path / "set"
    shutil.copytree(good, root, copy_function=shutil.copy)
    path = root / "labels" / SCENE / "trajectory.csv"
    rows = list(csv.reader(path.read_text().splitlines()))
    rows[1][1] = "0.123456789"
    path.write_text("".join(",".join(row) + "\n" for row in rows))
    assert single(validate(root)).startswith(f"scenes/{SCENE}.json: digest")


def test_a_pose_off_by_a_pixel_is_found(good: Path, tmp_path: Path) -> None:
    """One pixel is 8 mm here; silhouette, visible part and depth tell."""
    root = part(good, tmp_path, "bop")
    edit(root / BOP / "scene_gt.json", lambda d: moved(d["2"][0], 9.0))
    findings = "\n".join(map(str, validate(root).findings))
    assert "fits best shifted by -1, 0" in findings
    assert f"{BOP}/mask/{IMAGE}_" in findings


def test_colours_that_do_not_fit_the_masks_are_found(good: Path, tmp_path: Path) -> None:
    root = part(good, tmp_path, "bop")
    for path in sorted(root.glob("bop/train_pbr/*/rgb/*.jpg")):
        repaint(path, lambda image: np.roll(image, 1, axis=0))
    findings = [str(f) for f in validate(root).findings if f.field.startswith("colour")]
    assert findings, "edges are one row lower"
    assert "0, 1 pixels" in findings[0]


# ------------------------------------------------------------------------------------------------------------ of others


def test_a_bop_data_set_of_others_is_checked(good: Path, tmp_path: Path) -> None:
    """Without anything that simtrack writes beside: no digest, no recipe, another camera for each image."""
    root = tmp_path / "lm"
    shutil.copytree(good / "bop", root)
    (root / "camera.json").unlink()
    result = validate(root)
    assert result.good
    assert result.counts == {"bop": 6}
    edit(root / f"train_pbr/{SCENE}/scene_gt.json", lambda d: moved(d["2"][0], 40.0))
    assert not validate(root).good


@pytest.mark.parametrize("name", ["coco", "kitti", "tum", "mcap", "labels", "dope", "yolo"])
def test_formats_are_found_by_themselves(good: Path, name: str) -> None:
    result = validate(good / name)
    assert result.good
    assert list(result.counts) == [name]


def test_folders_without_a_data_set_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="is no folder"):
        validate(tmp_path / "nothing")
    (tmp_path / "set").mkdir()
    with pytest.raises(DatasetError, match=r"none of the formats.*bop.*coco"):
        validate(tmp_path / "set")


# ---------------------------------------------------------------------------------------------------------------- masks


def test_run_lengths_are_those_of_pycocotools() -> None:
    masks = pytest.importorskip("pycocotools.mask")
    rng = np.random.default_rng(3)
    for density in (0.0, 0.02, 0.5, 1.0):
        mask = rng.random((13, 29)) < density
        encoded = masks.encode(np.asfortranarray(mask.astype(np.uint8)))
        assert np.array_equal(decoded((13, 29), encoded["counts"].decode()), mask)
    with pytest.raises(ValueError, match="add up to"):
        decoded((4, 4), [3, 3])


def test_edges_of_masks() -> None:
    mask = np.zeros((10, 12), bool)
    mask[2:8, 0:6] = True
    assert box(mask) == (0, 2, 5, 7)
    assert box(edge_free(mask, 1)) == (0, 3, 4, 6), "the image's border is no edge"
    assert CAMERA.width == 96
