"""What all tests share: an environment of their own, real sensor data where there are some, OpenGL where it works."""

import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]

# Folders that the user has set up must neither help nor disturb; set before simtrack is imported.
for _variable in ("SIMTRACK_SCENES", "SIMTRACK_GENERATORS", "SIMTRACK_OBJECTS"):
    os.environ.pop(_variable, None)


def _opengl_works() -> bool:
    code = "import mujoco; mujoco.GLContext(8, 8).make_current()"
    environment = os.environ | {"MUJOCO_GL": "egl"}
    # In a process of its own: a failing driver may abort.
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True).returncode == 0


def pytest_collection_modifyitems(items: Iterable[pytest.Item]) -> None:
    marked = [item for item in items if item.get_closest_marker("gl")]
    if marked and not _opengl_works():
        for item in marked:
            item.add_marker(pytest.mark.skip(reason="no headless OpenGL (EGL) on this machine"))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of recordings of real sensors: $SIMTRACK_REAL_DATA, or shared/data beside the checkout."""
    folder = Path(os.environ.get("SIMTRACK_REAL_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real sensor data in {folder}; $SIMTRACK_REAL_DATA says where they are")
    return folder
