"""Where scenes, recipes and caches lie: in a checkout, in an installed wheel, and wherever the user says."""

import os
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def scene_roots() -> list[Path]:
    """Existing folders that hold scenes, the first to be searched first.

    ``$SIMTRACK_SCENES`` (separated as ``$PATH`` is), then ``scenes/`` of a checkout or of the installed package.
    """
    return _roots("scenes", "SIMTRACK_SCENES")


def generator_roots() -> list[Path]:
    """Existing folders that hold data-set recipes, the first to be searched first.

    ``$SIMTRACK_GENERATORS`` (separated as ``$PATH`` is), then ``generators/`` of a checkout or the installed package.
    """
    return _roots("generators", "SIMTRACK_GENERATORS")


def _roots(kind: str, variable: str) -> list[Path]:
    candidates = [Path(entry).expanduser() for entry in os.environ.get(variable, "").split(os.pathsep) if entry]
    checkout = _PACKAGE.parent
    if (checkout / "pyproject.toml").is_file():
        # Without this condition an unrelated site-packages/scenes would be taken for ours.
        candidates.append(checkout / kind)
    candidates.append(_PACKAGE / "_data" / kind)
    return list(dict.fromkeys(path.resolve() for path in candidates if path.is_dir()))


def cache_dir() -> Path:
    """Writable folder for what can be computed again, created if missing.

    ``$SIMTRACK_CACHE``, else ``$XDG_CACHE_HOME/simtrack``, else ``~/.cache/simtrack``; where none of them can be
    written, a temporary folder that lives as long as the process's temporary space.
    """
    return _cache_dir(os.environ.get("SIMTRACK_CACHE", ""), os.environ.get("XDG_CACHE_HOME", ""))


@cache
def _cache_dir(own: str, xdg: str) -> Path:
    candidates = [Path(own).expanduser()] if own else []
    if Path(xdg).is_absolute():  # the XDG specification says to ignore relative paths
        candidates.append(Path(xdg) / "simtrack")
    with suppress(RuntimeError):  # no home directory can be determined
        candidates.append(Path.home() / ".cache" / "simtrack")
    for folder in candidates:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK | os.X_OK):
            return folder.resolve()
    return Path(tempfile.mkdtemp(prefix="simtrack-cache-"))
