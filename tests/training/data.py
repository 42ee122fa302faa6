"""A data set as `simtrack generate` writes it, of a brick before a wall: two scenes of two images."""

import json
from pathlib import Path

import numpy as np

from simtrack.objects.model import BOX_CORNERS

WIDTH, HEIGHT = 160, 120


def write_dataset(root: Path, *, scenes: int = 2, name: str = "relay") -> Path:
    """One object of the catalogue, drawn as a bright rectangle; scenes 0 (held out), 1, ..."""
    import cv2

    about = {"categories": {"1": name}, "cuboid_corners": BOX_CORNERS.astype(int).tolist()}
    (root / "scenes").mkdir(parents=True)
    (root / "dataset.json").write_text(json.dumps(about))
    rng = np.random.default_rng(0)
    for scene in range(scenes):
        folder = root / "bop" / "train_pbr" / f"{scene:06d}"
        for part in ("rgb", "depth", "mask_visib"):
            (folder / part).mkdir(parents=True)
        cameras, poses, infos = {}, {}, {}
        for image in range(2):
            u, v = (int(x) for x in rng.integers(50, 90, 2))
            rgb, mask = np.full((HEIGHT, WIDTH, 3), 60, np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
            mask[v - 15 : v + 15, u - 20 : u + 20] = 255
            rgb[mask > 0] = (40, 160, 220)
            cv2.imwrite(str(folder / "rgb" / f"{image:06d}.png"), rgb)
            cv2.imwrite(str(folder / "depth" / f"{image:06d}.png"), np.full((HEIGHT, WIDTH), 5000, np.uint16))
            cv2.imwrite(str(folder / "mask_visib" / f"{image:06d}_000000.png"), mask)
            K = [150.0, 0, 79.5, 0, 150.0, 59.5, 0, 0, 1]
            cameras[str(image)] = {"cam_K": K, "depth_scale": 0.1}
            t = [(u - 79.5) / 150 * 500, (v - 59.5) / 150 * 500, 500.0]
            poses[str(image)] = [{"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": t, "obj_id": 1}]
            box = [u - 20, v - 15, 39, 29]
            infos[str(image)] = [{"bbox_obj": box, "px_count_visib": 1200, "visib_fract": 1.0}]
        for kind, content in (("camera", cameras), ("gt", poses), ("gt_info", infos)):
            (folder / f"scene_{kind}.json").write_text(json.dumps(content))
        (root / "scenes" / f"{scene:06d}.json").write_text("{}")
    return root
