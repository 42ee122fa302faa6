"""What all tests share: an environment of their own, real sensor data where there are some, OpenGL where it works."""

import os
import subprocess
import sys
from itertools import chain, zip_longest
from pathlib import Path

import pytest
from hypothesis import settings

from tests.kernel_locks import compile_kernels_once

REPOSITORY = Path(__file__).resolve().parents[1]
WHOLE_RUNS = ("end_to_end", "cli", "benchmarks")

settings.register_profile("simtrack", deadline=None)  # machines are busy, kernels compile
settings.load_profile("simtrack")

# Folders that the user has set up must neither help nor disturb; set before simtrack is imported.
for _variable in ("SIMTRACK_SCENES", "SIMTRACK_GENERATORS", "SIMTRACK_OBJECTS"):
    os.environ.pop(_variable, None)


def _opengl_works() -> bool:
    code = "import mujoco; mujoco.GLContext(8, 8).make_current()"
    environment = os.environ | {"MUJOCO_GL": "egl"}
    # In a process of its own: a failing driver may abort.
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True).returncode == 0


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config.option, "loadscopereorder"):  # of pytest-xdist: files are handed out in the order given below
        config.option.loadscopereorder = False
    if "PYTEST_XDIST_WORKER" in os.environ:
        compile_kernels_once()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items[:] = spread(items)
    marked = [item for item in items if item.get_closest_marker("gl")]
    if marked and not _opengl_works():
        for item in marked:
            item.add_marker(pytest.mark.skip(reason="no headless OpenGL (EGL) on this machine"))


def spread(items: list[pytest.Item]) -> list[pytest.Item]:
    """The order in which files are handed out to processes.

    Files of one folder need the same kernels, which one process compiles while the others wait: so files that are
    handed out at the same time come from different halves of the suite. Whole runs in processes of their own come
    last, when there is nothing left to compile.
    """
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    whole = [path for path in files if path.relative_to(REPOSITORY).parts[1] in WHOLE_RUNS]
    parts = [path for path in files if path not in whole]
    half = (len(parts) + 1) // 2
    pairs = zip_longest(parts[:half], parts[half:])
    order = [*(path for path in chain.from_iterable(pairs) if path is not None), *whole]
    return [item for path in order for item in files[path]]


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of recordings of real sensors: $SIMTRACK_REAL_DATA, or shared/data beside the checkout."""
    folder = Path(os.environ.get("SIMTRACK_REAL_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real sensor data in {folder}; $SIMTRACK_REAL_DATA says where they are")
    return folder
