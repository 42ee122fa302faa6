"""Writers of data-set formats, by name. Several can write at once: images that they have in common are one file each.

========================  =========================================================================================
``bop``                   BOP, scene by scene: models, poses, masks, visibility, targets
``bop_webdataset``        the same as shards of a webdataset
``coco``                  COCO: instances, keypoints of boxes, panoptic segments
``yolo``                  YOLO (Ultralytics): pose and segment
``kitti``                 lidar scans as KITTI's, labels by point as SemanticKITTI's
``tum``                   RGB-D sequences as TUM's
``dope``                  DOPE's training data
``mcap``                  ROS 2 logs, one a scene
``labels``                plain arrays and JSON: everything, among it normals, clean depth, support, relations
========================  =========================================================================================

What a format wants in one file for all scenes is put together at the end, line by line, from what each scene left in
the hidden folder ``.fragments`` of the format; shards of webdatasets are second names (hard links) of each scene's
archives in ``.scenes``. Copies that do not keep hard links are larger (``cp -a``, ``rsync -aH`` and ``tar`` do).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from simtrack.datasets.writer import DatasetWriter
from simtrack.datasets.writers.bop import BopOptions, BopWriter
from simtrack.datasets.writers.bop_webdataset import BopWebdatasetOptions, BopWebdatasetWriter
from simtrack.datasets.writers.coco import CocoOptions, CocoWriter
from simtrack.datasets.writers.dope import DopeOptions, DopeWriter
from simtrack.datasets.writers.kitti import KittiOptions, KittiWriter
from simtrack.datasets.writers.labels import LabelsOptions, LabelsWriter
from simtrack.datasets.writers.mcap import McapDatasetWriter, McapOptions
from simtrack.datasets.writers.tum import TumOptions, TumWriter
from simtrack.datasets.writers.yolo import YoloOptions, YoloWriter
from simtrack.errors import UnknownNameError
from simtrack.simulation.strict_file import Strict, validated


@dataclass(frozen=True, slots=True)
class WriterFactory:
    """Makes the writers of one format."""

    options: type[Strict]
    """What can be set, validated."""
    make: Callable[[Any], DatasetWriter]
    """Takes an instance of `options`."""


WRITERS: Mapping[str, WriterFactory] = {
    BopWriter.name: WriterFactory(BopOptions, BopWriter),
    BopWebdatasetWriter.name: WriterFactory(BopWebdatasetOptions, BopWebdatasetWriter),
    CocoWriter.name: WriterFactory(CocoOptions, CocoWriter),
    YoloWriter.name: WriterFactory(YoloOptions, YoloWriter),
    KittiWriter.name: WriterFactory(KittiOptions, KittiWriter),
    TumWriter.name: WriterFactory(TumOptions, TumWriter),
    DopeWriter.name: WriterFactory(DopeOptions, DopeWriter),
    McapDatasetWriter.name: WriterFactory(McapOptions, McapDatasetWriter),
    LabelsWriter.name: WriterFactory(LabelsOptions, LabelsWriter),
}
"""Format -> how its writer is made."""


def make_writer(name: str, options: Mapping[str, Any] | None = None, path: Path = Path("options")) -> DatasetWriter:
    """The writer of a format.

    Args:
        name: a key of `WRITERS`.
        options: fields of the format's options; the others have their defaults.
        path: of the file that the options stand in, for messages.

    Raises:
        UnknownNameError: no such format.
        FileFormatError: an option that does not exist or is out of range.
    """
    if name not in WRITERS:
        raise UnknownNameError("writer", name, WRITERS)
    factory = WRITERS[name]
    return factory.make(validated(factory.options, dict(options or {}), path, f"writer {name}"))
