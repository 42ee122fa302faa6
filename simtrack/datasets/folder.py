"""A data set's folder: who may write to it, which scenes it holds, and how a scene gets in as a whole or not at all.

``DIR/recipe.yaml`` and ``DIR/dataset.json`` say what the folder is, ``DIR/scenes/000012.json`` (`SceneMarker`) that
scene 12 is complete. A scene is made under ``DIR/.staging``. There its marker is written when all else is on disk, its
files are moved into place, and then the marker itself: a run that dies before that last step is carried on from the
marker in staging, one that dies earlier has left nothing in place.
"""

import errno
import fcntl
import hashlib
import json
import os
import re
import shutil
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from uuid import uuid4

import simtrack
from simtrack.datasets.frame import DatasetInfo
from simtrack.errors import DatasetError, FileFormatError
from simtrack.objects.model import BOX_CORNERS

MARKERS = "scenes"
STAGING = ".staging"
LOCK = ".lock"
RECIPE = "recipe.yaml"
DESCRIPTION = "dataset.json"
LAYOUT = 1
"""Version of the folder's own files."""
SYNC_THREADS = 16
SPACE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What the system says when a disk, a quota or a file is full."""

_NUMBER = re.compile(r"(?<!\d)\d{6}(?!\d)")


@dataclass(frozen=True, slots=True)
class SceneMarker:
    """What a complete scene consists of."""

    scene: int
    frames: int
    files: int
    bytes: int
    """Of all files; one that several formats share counts once."""
    digest: str
    """SHA-256 over the sorted lines ``PATH NUL SHA-256-OF-CONTENT`` of the files."""
    units: tuple[str, ...]
    """Folders and files of the scene alone, relative to the data set, sorted."""

    @staticmethod
    def of(root: Path, scene: int, frames: int, units: Sequence[str]) -> "SceneMarker":
        """Describe a scene whose units lie under `root`."""
        lines: list[bytes] = []
        size, contents = 0, dict[tuple[int, int], bytes]()
        for path in sorted(file for unit in units for file in files_under(root / unit)):
            status = path.stat()
            inode = (status.st_dev, status.st_ino)
            if inode not in contents:  # hard links are read once
                size += status.st_size
                with path.open("rb") as stream:
                    contents[inode] = hashlib.file_digest(stream, "sha256").hexdigest().encode()
            lines.append(os.fsencode(path.relative_to(root).as_posix()) + b"\0" + contents[inode])
        digest = hashlib.sha256(b"\n".join(sorted(lines))).hexdigest()
        return SceneMarker(scene, frames, len(lines), size, digest, tuple(sorted(units)))

    @staticmethod
    def read(path: Path) -> "SceneMarker":
        """Read a marker; FileFormatError if it is none."""
        data = read_json(path)
        names = {"scene": int, "frames": int, "files": int, "bytes": int, "digest": str, "units": list}
        for name, kind in names.items():
            if not isinstance(data, dict) or not isinstance(data.get(name), kind):
                raise FileFormatError(path, name, f"is missing or no {kind.__name__}")
        units = tuple(str(unit) for unit in data["units"])
        for unit in units:
            if Path(unit).is_absolute() or ".." in Path(unit).parts:
                raise FileFormatError(path, "units", f"'{unit}' leads out of the data set")
        return SceneMarker(data["scene"], data["frames"], data["files"], data["bytes"], data["digest"], units)

    def text(self) -> str:
        """The marker as it is written."""
        return json_text(asdict(self))


class DatasetFolder:
    """The folder of one data set, while one process writes to it; made by `DatasetFolder.open`."""

    def __init__(self, root: Path, info: DatasetInfo, formats: Sequence[str]) -> None:
        self.root = root
        self.info = info
        self.formats = tuple(formats)
        self.staging = root / STAGING / uuid4().hex
        """Of this run alone: what is left of a killed one may still be written to for a moment."""

    @staticmethod
    @contextmanager
    def open(root: Path, info: DatasetInfo, formats: Sequence[str]) -> "Iterator[DatasetFolder]":
        """Lock the folder, make it if it is new, and put in place what a killed run has left complete.

        Raises:
            DatasetError: it holds something else, or another process writes to it.
        """
        check_is_ours(root, info, formats)
        root.mkdir(parents=True, exist_ok=True)
        with _locked(root):
            check_is_ours(root, info, formats)
            folder = DatasetFolder(root, info, formats)
            folder._recover()
            folder.staging.mkdir(parents=True)
            folder._write(RECIPE, info.recipe)
            try:
                yield folder
            finally:
                with suppress(OSError):  # a full disk has been told of; the next run sees to the rest
                    folder._recover()

    # ------------------------------------------------------------------------------------------------- what is there

    def markers(self) -> dict[int, SceneMarker]:
        """Complete scenes by number."""
        return read_markers(self.root)

    def describe(self, scenes: int, frames: int, complete: bool) -> None:
        """Write ``dataset.json``: what the folder is to hold, and whether it holds all of it."""
        data = _identity(self.info, self.formats) | {
            "description": self.info.description,
            "split": self.info.split,
            "val_share": self.info.val_share,
            "scenes": scenes,
            "frames": frames,
            "complete": complete,
            "categories": {str(c.id): c.model.name for c in self.info.categories},
            "stuff": {str(c.id): c.name for c in self.info.stuff},
            "keypoints": "corners of the model's box by the signs of x, y, z in `cuboid_corners`, then its centre",
            "cuboid_corners": BOX_CORNERS.astype(int).tolist(),
            "units": "m in this file and in the folders of the formats what each of them prescribes (BOP: mm)",
            "pixel_centres": "at integer indices",
        }
        self._write(DESCRIPTION, json_text(data))

    def is_complete(self, scenes: int) -> bool:
        """Whether all of so many scenes and what is written once for all of them are there."""
        data = read_json(self.root / DESCRIPTION) if (self.root / DESCRIPTION).is_file() else {}
        return bool(data.get("complete")) and data.get("scenes") == scenes

    # ------------------------------------------------------------------------------------------------------- commits

    def commit(self, staged: Path, marker: SceneMarker) -> None:
        """Put a scene that lies complete and synced under `staged` into place.

        Raises:
            OSError: the disk is full, or cannot be written.
        """
        intent = staged / f"{marker.scene:06d}.json"
        _write_durably(intent, marker.text())
        self._put_in_place(staged, intent, marker)

    def _put_in_place(self, staged: Path, intent: Path, marker: SceneMarker) -> None:
        for unit in marker.units:
            source, target = staged / unit, self.root / unit
            if not source.exists():
                continue  # moved before the run was killed
            remove(target)  # of a scene whose marker was taken away
            target.parent.mkdir(parents=True, exist_ok=True)
            source.rename(target)
            _sync(target.parent)
        (self.root / MARKERS).mkdir(exist_ok=True)
        intent.rename(self.root / MARKERS / intent.name)
        _sync(self.root / MARKERS)
        remove(staged)

    def _recover(self) -> None:
        """Complete the commits that were under way, and remove everything else that is staged."""
        staging = self.root / STAGING
        for intent in sorted(staging.glob("*/*/[0-9][0-9][0-9][0-9][0-9][0-9].json")):
            try:
                marker = SceneMarker.read(intent)
            except FileFormatError:  # not all of it was written: nothing was moved yet
                continue
            self._put_in_place(intent.parent, intent, marker)
        shutil.rmtree(staging, ignore_errors=True)  # workers of a killed run may write there for another moment

    def _write(self, name: str, text: str) -> None:
        part = self.staging / name
        _write_durably(part, text)
        part.replace(self.root / name)
        _sync(self.root)


def read_markers(root: Path) -> dict[int, SceneMarker]:
    """The complete scenes of a data set by number, ascending; empty where there are none."""
    markers = (SceneMarker.read(path) for path in sorted((root / MARKERS).glob("[0-9]*.json")))
    return {marker.scene: marker for marker in markers}


def scene_units(staged: Path, scene: int) -> list[str]:
    """The topmost files and folders under `staged` whose names carry the scene's number: what a commit moves.

    Raises:
        DatasetError: a writer put a file where no name says that it belongs to the scene.
    """
    units: list[str] = []

    def visit(folder: Path) -> None:
        for path in sorted(folder.iterdir()):
            numbers = _NUMBER.findall(path.name)
            name = path.relative_to(staged).as_posix()
            if numbers and int(numbers[0]) == scene:
                units.append(name)
            elif path.is_dir() and not numbers:
                visit(path)
            else:
                raise DatasetError(
                    staged, f"a writer made {name}, which does not carry the number of scene {scene:06d}"
                )

    visit(staged)
    return units


# ------------------------------------------------------------------------------------------------------- is it the same


def _identity(info: DatasetInfo, formats: Sequence[str]) -> dict[str, object]:
    return {
        "layout": LAYOUT,
        "simtrack": simtrack.__version__,
        "name": info.name,
        "seed": info.seed,
        "formats": sorted(formats),
        "recipe_sha256": hashlib.sha256(info.recipe.encode()).hexdigest(),
    }


def check_is_ours(root: Path, info: DatasetInfo, formats: Sequence[str]) -> None:
    """Raise DatasetError unless the folder is missing, empty, or of the same recipe, seed and version."""
    if not root.exists():
        return
    if not root.is_dir():
        raise DatasetError(root, "is a file; name a folder that is new, empty, or holds this data set")
    held = {path.name for path in root.iterdir()} - {LOCK, STAGING}
    recipe = (root / RECIPE).read_text(encoding="utf-8") if (root / RECIPE).is_file() else None
    if DESCRIPTION not in held:
        if held - ({RECIPE} if recipe == info.recipe else set()):
            raise DatasetError(root, "holds other files; name a folder that is new, empty, or holds this data set")
        return
    there, here = read_json(root / DESCRIPTION), _identity(info, formats)
    if not isinstance(there, dict):
        raise FileFormatError(root / DESCRIPTION, "", "is no JSON object")
    differences = [
        f"{name} is {_short(there.get(name))} there and {_short(here[name])} here"
        for name in here
        if there.get(name) != here[name] and name != "recipe_sha256"
    ]
    if recipe != info.recipe:
        differences += _recipe_differences(recipe or "", info.recipe)
    if differences:
        shown = "; ".join(differences[:6]) + (f"; and {len(differences) - 6} more" if len(differences) > 6 else "")
        raise DatasetError(root, f"holds another data set: {shown}. Name another folder")


def _recipe_differences(there: str, here: str) -> list[str]:
    """The fields in which two recipes differ, with both values."""
    import yaml

    try:
        old, new = (dict(_flat(yaml.safe_load(text))) for text in (there, here))
    except yaml.YAMLError:
        return ["recipe.yaml there cannot be read"]
    return [
        f"recipe field {name} is {_short(old.get(name))} there and {_short(new.get(name))} here"
        for name in sorted(old.keys() | new.keys())
        if old.get(name) != new.get(name)
    ] or ["recipe.yaml is written differently there"]


def _flat(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _flat(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list) and any(isinstance(inner, Mapping) for inner in value):
        for k, inner in enumerate(value):
            yield from _flat(inner, f"{name}[{k}]")
    else:
        yield name, value


def _short(value: object) -> str:
    text = "missing" if value is None else json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


# ------------------------------------------------------------------------------------------------------------- the disk


@contextmanager
def _locked(root: Path) -> Iterator[None]:
    """Hold the folder's lock, which the system takes back when this process dies."""
    path = root / LOCK
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(descriptor, 200).decode(errors="replace").strip()
            os.close(descriptor)
            raise DatasetError(root, f"is being written to by another run ({holder or 'unknown'})") from None
        if path.exists() and path.stat().st_ino == os.fstat(descriptor).st_ino:
            break
        os.close(descriptor)  # a run that ended meanwhile removed the file that we locked
    try:
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


def sync_tree(root: Path) -> None:
    """Bring all files and folders below `root` to the disk.

    Several threads wait at once, so that the file system brings many of them along with one write of its journal. (A
    call for the file system as a whole would also wait for what others write.)
    """
    from concurrent.futures import ThreadPoolExecutor

    files = {path.stat().st_ino: path for path in files_under(root)}  # hard links once
    folders = [Path(folder) for folder, _, _ in os.walk(root)]
    with ThreadPoolExecutor(SYNC_THREADS) as threads:
        list(threads.map(_sync, [*files.values(), *folders]))


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_durably(path: Path, text: str) -> None:
    with path.open("w", encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())


def files_under(path: Path) -> Iterator[Path]:
    """The file itself, or all files below a folder."""
    if path.is_dir():
        for folder, _, names in os.walk(path):
            yield from (Path(folder, name) for name in names)
    elif path.exists():
        yield path


def remove(path: Path) -> None:
    """Remove a file or a folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def read_json(path: Path) -> dict:
    """Read a JSON object; FileFormatError if it is none."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FileFormatError(path, "", f"cannot be read as JSON: {error}") from error
    if not isinstance(data, dict):
        raise FileFormatError(path, "", "is no JSON object")
    return data


def json_text(data: object) -> str:
    """JSON whose bytes depend on the values alone."""
    return json.dumps(data, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
