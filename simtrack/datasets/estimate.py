"""How much disk a data set will take, told before the first frame is made."""

from collections.abc import Sequence

from simtrack.datasets.frame import DatasetInfo

BYTES_PER_PIXEL = {"bop": 1.0, "bop_web": 1.0, "coco": 0.4, "yolo": 0.0, "kitti": 0.0, "tum": 1.0, "mcap": 5.0}
"""Of a format's files; images that another format has written already are not counted again."""


def expected_bytes_per_frame(info: DatasetInfo, formats: Sequence[str]) -> float:
    """Bytes that a frame takes in the given formats, about."""
    pixels = info.intrinsics.width * info.intrinsics.height
    return pixels * sum(BYTES_PER_PIXEL.get(name, 1.0) for name in formats)
