"""simtrack reconstruct: the folder is whole or not there; refusals are clear."""

from pathlib import Path

import pytest
from test_command import refused

from simtrack.cli.reconstruct import FILES, new_folder
from simtrack.errors import InvalidValueError, OutputExistsError


def test_what_is_interrupted_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), new_folder(tmp_path / "out", overwrite=False) as work:
        (work / "scene.urdf").write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_replacement_leaves_the_old_results(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "scene.urdf").write_text("old")
    with pytest.raises(RuntimeError), new_folder(out, overwrite=True) as work:
        (work / "scene.urdf").write_text("new")
        raise RuntimeError
    assert (out / "scene.urdf").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_overwriting_replaces_own_files_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "meshes").mkdir(parents=True)
    (out / "meshes" / "old.obj").write_text("old")
    (out / "notes.txt").write_text("the user's")
    (out / FILES[-1]).write_text("old")
    with new_folder(out, overwrite=True) as work:
        (work / "meshes").mkdir()
        (work / "meshes" / "new.obj").write_text("new")
    assert sorted(str(path.relative_to(out)) for path in out.rglob("*")) == ["meshes", "meshes/new.obj", "notes.txt"]


def test_existing_folders_and_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputExistsError, match="--overwrite"), new_folder(tmp_path, overwrite=False):
        pass
    with pytest.raises(InvalidValueError, match="a folder"), new_folder(tmp_path / "file", overwrite=True):
        pass


def test_sources_that_are_none_are_named(tmp_path: Path) -> None:
    assert "Known:" in refused("reconstruct", "nowhere", "--out", tmp_path / "x")
    assert "true or partial" in refused("reconstruct", "rooms:7", "--entities", "tracked", "--out", tmp_path / "x")
    (tmp_path / "empty").mkdir()
    assert "graph.json" in refused("reconstruct", tmp_path / "empty", "--out", tmp_path / "x")
    assert not (tmp_path / "x").exists()
