"""Files that are written as frames come, so that memory does not grow with their number."""

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TextIO

from simtrack.datasets.frame import DatasetInfo

FRAGMENTS = ".fragments"
"""Folder in a format's own folder: what each scene leaves for the files that are written once for all scenes."""


def compact(value: Any) -> str:
    """JSON without spaces; raises ValueError for numbers that JSON has not."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def scene_name(scene: int) -> str:
    """``000012``."""
    return f"{scene:06d}"


def split_of(info: DatasetInfo, scene: int) -> str:
    """The split that a scene belongs to where a format has one: the data set's own, or val for a share of train."""
    return "val" if info.split == "train" and info.is_val(scene) else info.split


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file that is either there as a whole or not at all."""
    part = path.with_name(f".{path.name}.part")
    part.write_bytes(content.encode() if isinstance(content, str) else content)
    part.replace(path)


class JsonObject:
    """A JSON object with one line an entry, written entry by entry."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8", newline="\n")
        self._separator = "{\n"

    def add(self, key: str | int, value: Any) -> None:
        """Append an entry."""
        self._file.write(f'{self._separator}"{key}":{compact(value)}')
        self._separator = ",\n"

    def close(self) -> None:
        """Complete the object."""
        self._file.write("\n}\n" if self._separator == ",\n" else "{}\n")
        self._file.close()


class CocoFile:
    """A COCO file with one line an image and an annotation; annotations wait in a file beside it until the end.

    Nothing is at `path` before `close`.
    """

    def __init__(self, path: Path, head: dict[str, Any]) -> None:
        """`head` is what comes before the images: info, licenses, categories."""
        self._path = path
        self._images = self._part("images").open("w", encoding="utf-8", newline="\n")
        self._annotations = self._part("annotations").open("w+", encoding="utf-8", newline="\n")
        self._images.write(compact(head)[:-1])
        self._begun = {"images": False, "annotations": False}

    def add_image(self, entry: str) -> None:
        """Append an image, as JSON."""
        self._add(self._images, "images", entry)

    def add_annotation(self, entry: str) -> None:
        """Append an annotation, as JSON."""
        self._add(self._annotations, "annotations", entry)

    def close(self) -> None:
        """Put the file together."""
        for name, stream in (("images", self._images), ("annotations", self._annotations)):
            stream.write("\n]" if self._begun[name] else f',"{name}":[]')
        self._annotations.seek(0)
        shutil.copyfileobj(self._annotations, self._images)
        self._images.write("}\n")
        self.discard()
        self._part("images").replace(self._path)

    def discard(self) -> None:
        """Release the files, of which only what `close` puts in place remains."""
        self._images.close()
        self._annotations.close()
        self._part("annotations").unlink(missing_ok=True)

    def _add(self, stream: TextIO, name: str, entry: str) -> None:
        stream.write((",\n" if self._begun[name] else f',"{name}":[\n') + entry)
        self._begun[name] = True

    def _part(self, name: str) -> Path:
        return self._path.with_name(f".{self._path.name}.{name}")


def fragments(folder: Path, scenes: Iterable[int], suffix: str) -> Iterable[tuple[int, Path]]:
    """(scene, file) of what scenes left in the format's `folder`, in order."""
    return ((scene, folder / FRAGMENTS / f"{scene_name(scene)}{suffix}") for scene in scenes)
