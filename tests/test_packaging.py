"""The wheel, built, installed somewhere else and run from there: nothing may still need the checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    # Without isolation, so that nothing is downloaded: the build backend is one of the dev tools.
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(REPOSITORY)]
    subprocess.run(command, check=True, capture_output=True)
    (path,) = out.glob("simtrack-*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("installed")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(target)]
    subprocess.run([*command, str(wheel)], check=True, capture_output=True)
    return target


def run(installed: Path, *arguments: str) -> str:
    """Output of this Python with the installed package before all others, in an empty folder outside the checkout."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("SIMTRACK_")}
    environment |= {"PYTHONPATH": str(installed), "SIMTRACK_CACHE": str(installed / "cache")}
    cwd = installed / "elsewhere"
    cwd.mkdir(exist_ok=True)
    done = subprocess.run([sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_the_package_and_its_data_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = (archive.read(name).decode() for name in names if name.endswith(".dist-info/METADATA"))
        (entry_points,) = (archive.read(name).decode() for name in names if name.endswith("/entry_points.txt"))
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"simtrack"}
    tracked = subprocess.run(
        ["git", "ls-files", "scenes", "generators"], cwd=REPOSITORY, capture_output=True, text=True
    )
    expected = {f"simtrack/_data/{name}" for name in tracked.stdout.split()} | {"simtrack/py.typed"}
    assert expected <= set(names)
    assert not [name for name in names if name.endswith((".pyc", ".nbc", ".nbi", ".mcap"))]
    assert "License-Expression: BSD-3-Clause" in metadata
    assert "simtrack = simtrack.cli.main:main" in entry_points


def test_the_installed_package_finds_its_own_data(installed: Path) -> None:
    code = (
        "import simtrack, simtrack.paths as p; print(simtrack.__file__); print(*p.scene_roots(), *p.generator_roots())"
    )
    package, roots = run(installed, "-c", code).splitlines()
    assert Path(package).is_relative_to(installed)
    assert roots == f"{installed / 'simtrack/_data/scenes'} {installed / 'simtrack/_data/generators'}"


def test_the_command_line_runs_from_the_wheel(installed: Path) -> None:
    from simtrack.simulation.scene_file import scene_names

    listing = run(installed, "-m", "simtrack", "scenes")
    assert scene_names() and all(name in listing for name in scene_names())
    assert "run" in run(installed, "-m", "simtrack", "--help")


def test_scenes_and_objects_load_from_the_wheel(installed: Path) -> None:
    code = (
        "from simtrack.objects import load_object\n"
        "from simtrack.simulation.scene_file import load_scene, scene_names\n"
        "for name in scene_names():\n"
        "    print(load_scene(name).name)\n"
        "print(len(load_object('klt3147').mesh.faces))\n"
    )
    *scenes, faces = run(installed, "-c", code).split()
    assert "workbench" in scenes and int(faces) > 1000
