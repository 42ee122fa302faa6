"""BOP: every field computed again from images and poses, by other means than the writer's."""

import json
import tarfile
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from simtrack.datasets.writers import make_writer
from simtrack.geometry.meshes import Mesh
from tests.datasets.writers.labelled import CAMERA, FRAMES, INFO, MODELS, Small, contents, made, silhouette_on_canvas

coco = pytest.importorskip("pycocotools.coco")
coco_mask = pytest.importorskip("pycocotools.mask")

# pycocotools was built for the numpy before the installed one
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])


def load(path: Path) -> Any:
    return json.loads(path.read_text())


def image(path: Path) -> np.ndarray:
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert found is not None, path
    return found


def matrix(rotation: list[float], translation: list[float]) -> np.ndarray:
    """(4, 4), metres, of BOP's nine numbers and three millimetres."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.reshape(rotation, (3, 3)), np.array(translation) / 1000.0
    return T


def ply(path: Path) -> Mesh:
    """The model in metres, as another library reads it."""
    found = trimesh.load(path, process=False, force="mesh")
    assert isinstance(found, trimesh.Trimesh)
    return Mesh(np.asarray(found.vertices) / 1000.0, np.asarray(found.faces, np.int32))


def bop_box(mask: np.ndarray, offset: tuple[int, int] = (0, 0)) -> list[int]:
    """bop_toolkit's box: [min, min, max - min, max - min]."""
    v, u = np.nonzero(mask)
    return [u.min() - offset[0], v.min() - offset[1], u.max() - u.min(), v.max() - v.min()]


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Without noise in depth."""
    return made(tmp_path_factory.mktemp("bop"), [make_writer("bop")], Small(noise=0.0)) / "bop"


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("bop")
    return made(root, [make_writer("bop"), make_writer("bop_webdataset", {"images_per_shard": 2})])


@pytest.mark.parametrize("scene", [0, 1])
def test_every_field_of_an_image(noisy: Path, scene: int) -> None:
    folder = noisy / "bop" / "train_pbr" / f"{scene:06d}"
    camera, gt, info = (load(folder / f"{name}.json") for name in ("scene_camera", "scene_gt", "scene_gt_info"))
    assert list(camera) == list(gt) == list(info) == [str(k) for k in range(FRAMES)]
    models = {number: ply(noisy / "bop" / "models" / f"obj_{number:06d}.ply") for number in range(1, len(MODELS) + 1)}
    seen = truncated = 0
    for frame in Small().scene(scene):
        key, shape = str(frame.index), (CAMERA.height, CAMERA.width)
        np.testing.assert_array_equal(np.reshape(camera[key]["cam_K"], (3, 3)), K)
        T_camera_map = matrix(camera[key]["cam_R_w2c"], camera[key]["cam_t_w2c"])
        np.testing.assert_allclose(T_camera_map @ frame.T_map_camera, np.eye(4), atol=1e-12)
        depth = image(folder / "depth" / f"{frame.index:06d}.png")
        assert depth.dtype == np.uint16 and camera[key]["depth_scale"] == 0.1
        np.testing.assert_allclose(depth * 1e-4, frame.depth, atol=0.501e-4)
        assert (depth == 0).sum() == (frame.depth == 0).sum() > 0
        assert image(folder / "rgb" / f"{frame.index:06d}.jpg").shape == (*shape, 3)
        targets = [label for label in frame.labels if label.category is not None]
        assert len(gt[key]) == len(info[key]) == len(targets) == 5
        claimed = np.zeros(shape, int)
        for number, (pose, about, label) in enumerate(zip(gt[key], info[key], targets, strict=True)):
            T_camera_object = matrix(pose["cam_R_m2c"], pose["cam_t_m2c"])
            np.testing.assert_allclose(frame.T_map_camera @ T_camera_object, label.T_map_object, atol=1e-9)
            assert pose["obj_id"] == label.category
            whole, visible = (image(folder / k / f"{frame.index:06d}_{number:06d}.png") for k in ("mask", "mask_visib"))
            assert whole.dtype == visible.dtype == np.uint8 and whole.shape == visible.shape == shape
            assert set(np.unique(whole)) | set(np.unique(visible)) <= {0, 255}
            canvas = silhouette_on_canvas(models[pose["obj_id"]], T_camera_object, CAMERA)
            inside = canvas[shape[0] : 2 * shape[0], shape[1] : 2 * shape[1]]
            # The model file is rounded to float32 millimetres: a pixel whose ray grazes an edge may differ.
            assert (inside ^ (whole > 0)).sum() <= 2
            assert abs(int(canvas.sum()) - about["px_count_all"]) <= 3
            assert about["px_count_valid"] == ((whole > 0) & (depth > 0)).sum()
            assert about["px_count_visib"] == (visible > 0).sum()
            assert not ((visible > 0) & (whole == 0)).any()
            claimed += visible > 0
            np.testing.assert_array_equal(visible > 0, frame.ids == label.instance)
            fraction = about["px_count_visib"] / about["px_count_all"] if about["px_count_all"] else 0.0
            assert about["visib_fract"] == pytest.approx(fraction)
            if about["px_count_visib"]:
                seen += 1
                assert about["bbox_visib"] == bop_box(visible)
                np.testing.assert_allclose(about["bbox_obj"], bop_box(canvas, (shape[1], shape[0])), atol=1)
                truncated += int(canvas.sum() > inside.sum())
            else:
                assert about["bbox_visib"] == about["bbox_obj"] == [-1, -1, -1, -1]
        assert claimed.max() == 1
    assert seen >= 8 and truncated >= 1


def test_depth_is_that_of_the_models_at_their_poses(exact: Path) -> None:
    folder = exact / "train_pbr" / "000000"
    camera, gt = load(folder / "scene_camera.json"), load(folder / "scene_gt.json")
    compared = 0
    for key, poses in gt.items():
        depth = image(folder / "depth" / f"{int(key):06d}.png") * camera[key]["depth_scale"]
        for number, pose in enumerate(poses):
            visible = image(folder / "mask_visib" / f"{int(key):06d}_{number:06d}.png") > 0
            mesh = ply(exact / "models" / f"obj_{pose['obj_id']:06d}.ply")
            T = matrix(pose["cam_R_m2c"], pose["cam_t_m2c"])
            surface = trimesh.Trimesh(mesh.vertices @ T[:3, :3].T + T[:3, 3], mesh.faces, process=False)
            v, u = np.nonzero(visible)
            rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))], axis=1)
            if len(rays):
                points, index, _ = surface.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
                errors = np.abs(points[:, 2] * 1000.0 - depth[v[index], u[index]])
                assert len(index) >= 0.97 * len(rays)  # rays at edges may slip through
                assert np.quantile(errors, 0.95) <= 0.06 and np.median(errors) < 0.05
                compared += len(index)
    assert compared > 2000


def test_coco_of_a_scene_holds_the_visible_masks(noisy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = noisy / "bop" / "train_pbr" / "000001"
    index = coco.COCO(str(folder / "scene_gt_coco.json"))
    gt, info = load(folder / "scene_gt.json"), load(folder / "scene_gt_info.json")
    assert [entry["id"] for entry in index.dataset["annotations"]] == list(range(1, len(index.anns) + 1))
    found = 0
    for number in index.getImgIds():
        about = index.loadImgs([number])[0]
        assert (folder / about["file_name"]).is_file()
        annotations = iter(index.loadAnns(index.getAnnIds([number])))
        for k, (pose, state) in enumerate(zip(gt[str(number)], info[str(number)], strict=True)):
            if not state["px_count_visib"]:
                continue
            annotation = next(annotations)
            name = f"{number:06d}_{k:06d}.png"
            visible, whole = image(folder / "mask_visib" / name) > 0, image(folder / "mask" / name) > 0
            np.testing.assert_array_equal(index.annToMask(annotation) > 0, visible)
            assert annotation["category_id"] == pose["obj_id"] and annotation["area"] == visible.sum()
            box = bop_box(whole)
            assert annotation["bbox"] == [box[0], box[1], box[2] + 1, box[3] + 1]
            assert annotation["ignore"] == (state["visib_fract"] < 0.1) and annotation["iscrowd"] == 0
            found += 1
        assert next(annotations, None) is None
    assert found >= 8
    capsys.readouterr()


def test_models_are_in_millimetres_with_normals_colours_and_symmetries(exact: Path) -> None:
    for folder in ("models", "models_eval"):
        table = load(exact / folder / "models_info.json")
        assert list(table) == ["1", "2", "3"]
        for number, model in enumerate(MODELS, start=1):
            entry, path = table[str(number)], exact / folder / f"obj_{number:06d}.ply"
            header = path.read_bytes().split(b"end_header")[0].decode()
            for name in ("nx", "ny", "nz", "red", "green", "blue"):
                assert f" {name}\n" in header
            vertices = ply(path).vertices * 1000.0
            low, size = vertices.min(axis=0), np.ptp(vertices, axis=0)
            np.testing.assert_allclose([entry[f"min_{a}"] for a in "xyz"], low, atol=1e-3)
            np.testing.assert_allclose([entry[f"size_{a}"] for a in "xyz"], size, atol=1e-3)
            np.testing.assert_allclose(low, -0.5 * size, atol=1e-3)
            farthest = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1).max()
            assert entry["diameter"] == pytest.approx(farthest, abs=1e-2)
            for symmetry in entry.get("symmetries_discrete", []):
                moved = vertices @ np.reshape(symmetry, (4, 4))[:3, :3].T + np.reshape(symmetry, (4, 4))[:3, 3]
                gaps = np.linalg.norm(moved[:, None] - vertices[None], axis=-1).min(axis=1)
                assert gaps.max() < 1e-2 and not np.allclose(np.reshape(symmetry, (4, 4)), np.eye(4))
            assert len(entry.get("symmetries_continuous", [])) == len(model.symmetries.axes)
    assert load(exact / "camera.json") == {
        "fx": 90.0, "fy": 88.0, "cx": 47.5, "cy": 35.5, "width": 96, "height": 72, "depth_scale": 0.1
    }  # fmt: skip


def test_a_test_split_says_what_is_to_be_found(tmp_path: Path) -> None:
    source = Small(replace(INFO, split="test"))
    root = made(tmp_path, [make_writer("bop", {"split_type": "plain"})], source) / "bop"
    rows = load(root / "test_targets_bop19.json")
    for row in rows:
        folder = root / "test" / f"{row['scene_id']:06d}"
        gt, info = (load(folder / f"{name}.json")[str(row["im_id"])] for name in ("scene_gt", "scene_gt_info"))
        counted = [p for p, i in zip(gt, info, strict=True) if p["obj_id"] == row["obj_id"] and i["visib_fract"] >= 0.1]
        assert len(counted) == row["inst_count"] > 0
    assert len({(r["scene_id"], r["im_id"], r["obj_id"]) for r in rows}) == len(rows)
    assert load(root / "test_targets_bop24.json") == [
        {"scene_id": scene, "im_id": k} for scene in (0, 1) for k in range(FRAMES)
    ]
    rgb = image(root / "test" / "000000" / "rgb" / "000000.png")[..., ::-1]
    np.testing.assert_array_equal(rgb, next(iter(source.scene(0))).rgb)


def test_depth_that_16_bits_cannot_hold_is_no_reading(tmp_path: Path) -> None:
    source = Small(frames=1, stretch=8.0)
    folder = made(tmp_path, [make_writer("bop")], source, 1) / "bop" / "train_pbr" / "000000"
    depth, frame = image(folder / "depth" / "000000.png"), next(iter(source.scene(0)))
    far = frame.depth > 6.5535
    assert 0 < far.sum() < far.size and (depth[far] == 0).all() and (depth[(frame.depth > 0) & ~far] > 0).all()
    for number, about in enumerate(load(folder / "scene_gt_info.json")["0"]):
        whole = image(folder / "mask" / f"000000_{number:06d}.png") > 0
        assert about["px_count_valid"] == (whole & (depth > 0)).sum()


def test_shards_say_what_the_scenes_say(noisy: Path) -> None:
    folder, scenes = noisy / "bop_webdataset" / "train_pbr", noisy / "bop" / "train_pbr"
    where = load(folder / "key_to_shard.json")
    assert list(where) == [f"{scene:06d}_{k:06d}" for scene in (0, 1) for k in range(FRAMES)]
    assert sorted(path.name for path in folder.glob("*.tar")) == [f"shard-{k:06d}.tar" for k in range(4)]
    for key, shard in where.items():
        scene, number = key.split("_")
        with tarfile.open(folder / f"shard-{shard:06d}.tar") as archive:
            members = archive.getmembers()
            assert len({member.name.split(".")[0] for member in members}) <= 2
            assert all(member.mtime == 0 and member.isfile() for member in members)
            held = {m.name.split(".", 1)[1]: archive.extractfile(m) for m in members if m.name.startswith(key)}
            files = {name: stream.read() for name, stream in held.items() if stream is not None}
        assert files["rgb.jpg"] == (scenes / scene / "rgb" / f"{number}.jpg").read_bytes()
        assert files["depth.png"] == (scenes / scene / "depth" / f"{number}.png").read_bytes()
        for name in ("camera", "gt", "gt_info"):
            assert json.loads(files[f"{name}.json"]) == load(scenes / scene / f"scene_{name}.json")[str(int(number))]
        for name in ("mask", "mask_visib"):
            for k, code in json.loads(files[f"{name}.json"]).items():
                decoded = coco_mask.decode(coco_mask.frPyObjects(code, *code["size"]))
                expected = image(scenes / scene / name / f"{number}_{int(k):06d}.png") > 0
                np.testing.assert_array_equal(decoded > 0, expected)


def test_shards_are_whole_archives(noisy: Path) -> None:
    for path in (noisy / "bop_webdataset" / "train_pbr").glob("*.tar"):
        content = path.read_bytes()
        assert len(content) % 10240 == 0 and content[-1024:] == bytes(1024)
        with tarfile.open(fileobj=BytesIO(content), mode="r:", ignore_zeros=False) as archive:
            assert len(archive.getnames()) in (7, 14)


def test_finishing_again_changes_nothing(noisy: Path) -> None:
    before = contents(noisy)
    for name in ("bop", "bop_webdataset"):
        make_writer(name, {"images_per_shard": 2} if name != "bop" else {}).finish(noisy, INFO, 2)
    assert contents(noisy) == before
