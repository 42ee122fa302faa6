"""A data set with YOLO and BOP parts, of boxes that turn symmetrically from image to image."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.contracts import CameraIntrinsics
from simtrack.datasets.writers.box_keypoints import NAMES
from simtrack.geometry.transforms import apply, transform
from simtrack.objects import load_object
from simtrack.objects.model import BOX_CORNERS
from simtrack.sensors.camera import project
from tests.training.data import HEIGHT, WIDTH

CAMERA = CameraIntrinsics(WIDTH, HEIGHT, 150.0, 150.0, 79.5, 59.5)
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
ABOUT = "pose/data.yaml"


def write_yolo_dataset(
    root: Path, *, name: str = "klt3147", train: int = 2, val: int = 1, images: int = 2, bop: bool = True
) -> Path:
    """One object before a wall, whose right half is seen: unturned in even images, turned by 180 degrees about z in odd
    ones, in which the image's left edge cuts it."""
    import cv2
    import yaml

    model = load_object(name)
    about: dict[str, Any] = {"categories": {"1": name}, "cuboid_corners": BOX_CORNERS.astype(int).tolist()}
    (root / "scenes").mkdir(parents=True)
    (root / "dataset.json").write_text(json.dumps(about))
    rng = np.random.default_rng(0)
    for scene in range(train + val):
        split, number = "train" if scene < train else "val", f"{scene:06d}"
        folders = {kind: root / "yolo" / "pose" / kind / split / number for kind in ("images", "labels")}
        for folder in (*folders.values(), root / "bop" / "train_pbr" / number):
            folder.mkdir(parents=True)
        content: dict[str, dict[str, Any]] = {"camera": {}, "gt": {}, "gt_info": {}}
        for image in range(images):
            x, y = rng.uniform(-0.1, 0.1, 2)
            T = transform(HALF_TURN, (-0.62, y, 1.2)) if image % 2 else transform(None, (x, y, 1.2))
            pixels = project(apply(T, model.keypoints), CAMERA)
            whole, last = pixels.min(axis=0).round().astype(int), pixels.max(axis=0).round().astype(int)
            first = np.array([max(0, (whole[0] + last[0]) // 2), whole[1]])
            rgb = rng.integers(0, 60, (HEIGHT, WIDTH, 3)).astype(np.uint8)
            rgb[first[1] : last[1] + 1, first[0] : last[0] + 1] = (40, 160, 220)
            cv2.imwrite(str(folders["images"] / f"{image:06d}.jpg"), rgb)
            size = np.array([WIDTH, HEIGHT])
            words = [0, *((first + last + 1) / 2 / size), *((last + 1 - first) / size)]
            points = np.column_stack([(pixels + 0.5) / size, np.full(len(pixels), 2)])
            points[(pixels < -0.5).any(axis=1)] = 0.0
            words += points.ravel().tolist()
            (folders["labels"] / f"{image:06d}.txt").write_text(" ".join(f"{word:.6f}" for word in words) + "\n")
            content["camera"][str(image)] = {"cam_K": [150.0, 0, 79.5, 0, 150.0, 59.5, 0, 0, 1], "depth_scale": 0.1}
            pose = {"cam_R_m2c": T[:3, :3].ravel().tolist(), "cam_t_m2c": (1000 * T[:3, 3]).tolist(), "obj_id": 1}
            content["gt"][str(image)] = [pose]
            boxes = {"bbox_visib": first, "bbox_obj": whole}
            info = {key: [*low.tolist(), *(last - low).tolist()] for key, low in boxes.items()}
            content["gt_info"][str(image)] = [{**info, "px_count_visib": 1200}]
        for kind, entries in content.items():
            (root / "bop" / "train_pbr" / number / f"scene_{kind}.json").write_text(json.dumps(entries))
        (root / "scenes" / f"{number}.json").write_text("{}")
    (root / "bop" / "camera.json").write_text(json.dumps({"width": WIDTH, "height": HEIGHT}))
    if not bop:
        (root / "bop").rename(root / "elsewhere")
    about = {"train": "images/train", "val": "images/val" if val else "images/train", "names": {0: name}}
    about |= {"kpt_shape": [len(NAMES), 3], "kpt_names": {0: list(NAMES)}, "flip_idx": list(range(len(NAMES)))}
    (root / "yolo" / ABOUT).write_text(yaml.safe_dump(about))
    return root


def contents(root: Path) -> dict[str, bytes]:
    """Of all files below a folder."""
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}
