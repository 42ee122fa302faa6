"""What the outcome of a run depends on that is not simtrack's: code of stages, programs, networks, meshes of users."""

import ast
import hashlib
import importlib.util
import os
import shlex
import shutil
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

from simtrack.perception.detection.loading import KEYPOINTS, is_image_detector
from simtrack.perception.foreign.loading import EXEC

FOLDERS = ("SIMTRACK_OBJECTS", "SIMTRACK_CAD")
"""Environment variables that name folders of users' models."""


def belongings(stages: Iterable[str | None], attached: Path | None) -> str:
    """Hash of the users' files that a run reads.

    Code counts by its content: of a stage's module or package and of all that it imports, as long as that is not
    installed. Of models, networks and an attached MJCF file's folder, names, sizes and times count.

    Args:
        stages: as given on the command line; those that are None or names of simtrack's own tell nothing.
        attached: the scene's MJCF file, if it has one.
    """
    sha = hashlib.sha256()
    for given in filter(None, stages):
        if given.startswith(EXEC):
            for path in _program(given.removeprefix(EXEC)):
                sha.update(path.read_bytes())
        elif is_image_detector(given):
            from simtrack.perception.detection.keypoint_detector import SHIPPED

            _stat(sha, SHIPPED if given == KEYPOINTS else Path(given))
        elif ":" in given:
            for path in sorted(sources(given.partition(":")[0])):
                sha.update(path.read_bytes())
    folders = [Path(entry) for name in FOLDERS for entry in os.environ.get(name, "").split(os.pathsep) if entry]
    for folder in [*folders, *([attached.parent] if attached else [])]:
        _stat(sha, folder)
    return sha.hexdigest()[:16]


def sources(module: str) -> set[Path]:
    """Files of a module, or of its whole package, and of everything it imports that is not installed."""
    found: set[Path] = set()
    todo = [module.partition(".")[0]]
    met = {"simtrack", *todo}
    while todo:
        name = todo.pop()
        files = _files(_spec(name), installed_too=name == module.partition(".")[0])
        found |= files
        for imported in {top for path in files for top in _imports(path)} - met:
            met.add(imported)
            todo.append(imported)
    return found


def _spec(name: str) -> ModuleSpec | None:
    with suppress(ImportError, ValueError):
        return PathFinder.find_spec(name, [str(Path.cwd()), *sys.path]) or importlib.util.find_spec(name)
    return None


def _files(spec: ModuleSpec | None, installed_too: bool) -> set[Path]:
    if spec is None:
        return set()
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    files = {path for folder in folders for path in folder.rglob("*.py")}
    if not folders and spec.has_location and spec.origin is not None and spec.origin.endswith(".py"):
        files = {Path(spec.origin)}
    installed = [Path(sysconfig.get_path(kind)) for kind in ("stdlib", "platstdlib", "purelib", "platlib")]
    return {path for path in files if installed_too or not any(path.is_relative_to(place) for place in installed)}


def _imports(path: Path) -> Iterator[str]:
    """Top-level names that a file imports; none if it cannot be read: running it will tell."""
    with suppress(SyntaxError, ValueError, OSError):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Import):
                yield from (alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                yield node.module.partition(".")[0]


def _program(command: str) -> Iterator[Path]:
    """The program and those of its arguments that are files."""
    with suppress(ValueError):
        words = shlex.split(command)
        for word in [shutil.which(words[0]), *words[1:]] if words else []:
            if word is not None and Path(word).is_file():
                yield Path(word)


def _stat(sha: "hashlib._Hash", place: Path) -> None:
    for path in sorted(place.rglob("*")) if place.is_dir() else [place]:
        if path.is_file():
            status = path.stat()
            sha.update(f"{path.relative_to(place.parent)}|{status.st_size}|{status.st_mtime_ns}\n".encode())
