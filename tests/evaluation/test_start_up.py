"""How long a start takes is counted from the process's, and what makes it slow is told."""

import gc
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from simtrack import paths
from simtrack.evaluation.start_up import cold_start_told, process_start, relax_collector, warm_up
from simtrack.geometry.meshes import Mesh, cylinder_mesh, subdivide_to
from simtrack.objects.cache import cached_decimation


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SIMTRACK_CACHE", str(tmp_path))
    assert paths.cache_dir() == tmp_path
    return tmp_path


def test_the_process_started_before_now_and_once() -> None:
    assert process_start() < time.monotonic()
    assert process_start() == pytest.approx(process_start(), abs=0.05)


def test_a_new_process_is_young() -> None:
    code = (
        "import time; from simtrack.evaluation.start_up import process_start; print(time.monotonic(), process_start())"
    )
    begun = time.monotonic()
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=Path.cwd())
    now, start = map(float, answer.stdout.split())
    assert begun - 0.05 <= start <= now


def test_what_is_compiled_is_told_once_it_is_not_cached() -> None:
    @njit
    def answer(x):
        return 6 * x

    told: list[tuple[str, str]] = []
    with cold_start_told(lambda what, thing: told.append((what, thing))):
        assert answer(7) == 42
        assert answer(7) == 42
    assert told == [("compiling (first run only)", "answer")]
    answer(1.5)
    assert len(told) == 1


def test_what_is_kept_is_told_when_it_is_made(empty_cache: Path) -> None:
    mesh = subdivide_to(cylinder_mesh(0.1, 0.2, segments=60, color=(10, 20, 30)), 2000)
    told: list[tuple[str, str]] = []
    with cold_start_told(lambda what, thing: told.append((what, thing))):
        first = cached_decimation("drum", mesh, 1000)
        again = cached_decimation("drum", mesh, 1000)
        other = cached_decimation("drum", mesh, 800)
    assert told == [("simplifying object models (kept for later runs)", "drum")] * 2
    assert len(list((empty_cache / "objects").iterdir())) == 2
    for a, b in ((first.vertices, again.vertices), (first.faces, again.faces), (first.face_colors, again.face_colors)):
        np.testing.assert_array_equal(a, b)
    assert len(other.faces) < len(first.faces) < len(mesh.faces)


def test_a_light_mesh_and_a_damaged_file_are_no_trouble(empty_cache: Path) -> None:
    mesh = cylinder_mesh(0.1, 0.2, segments=60)
    assert cached_decimation("drum", mesh, len(mesh.faces)) is mesh
    mesh = subdivide_to(mesh, 1000)
    expected = cached_decimation("drum", mesh, 500)
    for file in (empty_cache / "objects").iterdir():
        file.write_bytes(b"not a mesh")
    found = cached_decimation("drum", mesh, 500)
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    assert isinstance(found, Mesh)


def test_the_collector_works_as_before_once_a_start_is_over() -> None:
    thresholds = gc.get_threshold()
    restore = relax_collector()
    assert gc.get_threshold()[0] > thresholds[0]
    restore()
    assert gc.get_threshold() == thresholds


def test_warming_up_needs_no_opengl() -> None:
    warm_up(opengl=False)
