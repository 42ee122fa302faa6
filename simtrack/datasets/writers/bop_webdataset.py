"""BOP as webdataset: https://github.com/thodan/bop_toolkit, bop_toolkit_lib/dataset/bop_webdataset.py.

Each scene is archived by whoever makes it, in parts that are named when all scenes are there: a shard holds images of
one scene, in their order. Archives carry neither times nor owners.
"""

import json
import tarfile
from pathlib import Path
from typing import BinaryIO

from pydantic import Field

from simtrack.datasets.frame import DatasetInfo, LabelledFrame, SceneInfo
from simtrack.datasets.writers.bop import BopOptions, image_entries, write_camera, write_models
from simtrack.datasets.writers.images import SharedImages, linked
from simtrack.datasets.writers.masks import uncompressed_rle, visible_mask, whole_mask
from simtrack.datasets.writers.streams import compact, scene_name, write_whole

PARTS = ".scenes"
"""Folder of the archives by scene, of which shards are other names."""


class BopWebdatasetOptions(BopOptions):
    """What a recipe may say of the writer."""

    images_per_shard: int = Field(default=1000, ge=1, le=1000)
    """At most."""


class BopWebdatasetWriter:
    """Writes shards; see `simtrack.datasets.writer.DatasetWriter`."""

    name = "bop_webdataset"

    def __init__(self, options: BopWebdatasetOptions) -> None:
        self.options = options

    def begin(self, root: Path, info: DatasetInfo) -> None:
        """Write the models and the camera."""
        write_models(root / self.name, info)
        write_camera(root / self.name, info.intrinsics, self.options)

    def open_scene(self, staging: Path, info: DatasetInfo, scene: SceneInfo) -> "BopWebdatasetSceneWriter":
        """Start a scene."""
        return BopWebdatasetSceneWriter(staging, self, info, scene)

    def finish(self, root: Path, info: DatasetInfo, scenes: int) -> None:
        """Number the shards and say which image lies in which."""
        folder = root / self.name / self.options.split_folder(info)
        for stale in folder.glob("shard-*.tar"):
            stale.unlink()
        index = folder / ".key_to_shard.json.part"
        shard, separator = 0, "{\n"
        with index.open("w", encoding="utf-8", newline="\n") as stream:
            for scene in range(scenes):
                parts = folder / PARTS / scene_name(scene)
                for part, keys in enumerate(json.loads((parts / "keys.json").read_text(encoding="utf-8"))):
                    target = folder / f"shard-{shard:06d}.tar"
                    if not linked(parts / f"{part}.tar", target):
                        target.write_bytes((parts / f"{part}.tar").read_bytes())
                    for key in keys:
                        stream.write(f'{separator}"{key}":{shard}')
                        separator = ",\n"
                    shard += 1
            stream.write("\n}\n" if separator == ",\n" else "{}\n")
        index.replace(folder / "key_to_shard.json")


class BopWebdatasetSceneWriter:
    """Writes the archives of one scene."""

    def __init__(self, staging: Path, writer: BopWebdatasetWriter, info: DatasetInfo, scene: SceneInfo) -> None:
        self._options, self._images = writer.options, SharedImages.of(staging)
        self._folder = staging / writer.name / writer.options.split_folder(info) / PARTS / scene_name(scene.scene)
        self._folder.mkdir(parents=True)
        self._keys: list[list[str]] = []
        self._archive: BinaryIO | None = None

    def write(self, frame: LabelledFrame) -> None:
        """Write a frame."""
        if self._archive is None or len(self._keys[-1]) >= self._options.images_per_shard:
            self._next_archive()
        self._keys[-1].append(frame.key)
        options = self._options
        camera, poses, infos = image_entries(frame, options)
        self._add(frame, f"rgb{options.colour.suffix}", self._images.content(frame, options.colour))
        self._add(frame, f"depth{options.depth.suffix}", self._images.content(frame, options.depth))
        targets = frame.targets()
        documents = {
            "camera": camera,
            "gt": poses,
            "gt_info": infos,
            "mask": {str(k): uncompressed_rle(whole_mask(label)) for k, label in enumerate(targets)},
            "mask_visib": {str(k): uncompressed_rle(visible_mask(frame, label)) for k, label in enumerate(targets)},
        }
        for name, document in documents.items():
            self._add(frame, f"{name}.json", compact(document).encode())

    def close(self) -> None:
        """Complete the last archive."""
        self._end_archive()
        write_whole(self._folder / "keys.json", compact(self._keys) + "\n")

    def _next_archive(self) -> None:
        self._end_archive()
        self._archive = (self._folder / f"{len(self._keys)}.tar").open("wb")
        self._keys.append([])

    def _end_archive(self) -> None:
        if self._archive is not None:
            end = self._archive.tell() + 2 * tarfile.BLOCKSIZE
            self._archive.write(bytes(2 * tarfile.BLOCKSIZE + -end % tarfile.RECORDSIZE))
            self._archive.close()

    def _add(self, frame: LabelledFrame, extension: str, content: bytes) -> None:
        assert self._archive is not None
        member = tarfile.TarInfo(f"{frame.key}.{extension}")
        member.size = len(content)
        # tarfile's own writer remembers every member.
        self._archive.write(member.tobuf(tarfile.USTAR_FORMAT) + content + bytes(-len(content) % tarfile.BLOCKSIZE))
