"""How much disk a data set will take, told before the first frame is made."""

from collections.abc import Iterable, Sequence

from simtrack.datasets.folder import SceneMarker
from simtrack.datasets.frame import DatasetInfo

COLOUR = 0.31
"""Bytes a pixel of a JPEG image, which bop, coco, yolo and dope have in common."""
OWN = {
    "bop": 0.85, "bop_webdataset": 1.16, "coco": 0.08, "yolo": 0.07, "kitti": 0.3, "tum": 2.1, "dope": 0.03,
    "mcap": 4.3, "labels": 3.5,
}  # fmt: skip
"""Bytes a pixel of a format's files but for that image. Measured on `workbench_keypoints` at 640x480, some ten objects;
kitti: points of a VLP-16, for one scan an image."""
FILES = {"bop": 22, "coco": 3, "yolo": 4, "tum": 2, "kitti": 2, "dope": 2, "labels": 2}
"""Files of a frame."""
BLOCK = 4096
"""Bytes: a file takes whole blocks of the disk."""


def expected_bytes_per_frame(info: DatasetInfo, formats: Sequence[str]) -> float:
    """Bytes of the disk that a frame takes in the given formats, about."""
    pixels = info.intrinsics.width * info.intrinsics.height
    colour = COLOUR if {"bop", "coco", "yolo", "dope"} & set(formats) else 0.0
    files = sum(FILES.get(name, 1) for name in formats)
    return pixels * (colour + sum(OWN.get(name, 1.0) for name in formats)) + 0.5 * BLOCK * files


def known_bytes_per_frame(markers: Iterable[SceneMarker]) -> float:
    """Bytes of the disk that a frame took in complete scenes, 0 without any."""
    held = list(markers)
    frames = sum(marker.frames for marker in held)
    return sum(marker.bytes + 0.5 * BLOCK * marker.files for marker in held) / frames if frames else 0.0
