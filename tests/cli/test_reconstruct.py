"""simtrack reconstruct: the folder is whole or not there; refusals are clear."""

from pathlib import Path

import pytest

from simtrack.cli.folders import new_folder
from simtrack.cli.main import main
from simtrack.cli.reconstruct import FILES, FOLDERS
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
    with new_folder(out, True, FILES, FOLDERS) as work:
        (work / "meshes").mkdir()
        (work / "meshes" / "new.obj").write_text("new")
    assert sorted(str(path.relative_to(out)) for path in out.rglob("*")) == ["meshes", "meshes/new.obj", "notes.txt"]


def test_existing_folders_and_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputExistsError, match="--overwrite"), new_folder(tmp_path, overwrite=False):
        pass
    with pytest.raises(InvalidValueError, match="a folder"), new_folder(tmp_path / "file", overwrite=True):
        pass


def test_sources_that_are_none_are_refused_and_leave_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    for source, more, said in (
        ("nowhere", [], "Known:"),
        ("rooms:7", ["--entities", "tracked"], "true or partial"),
        (str(tmp_path / "empty"), [], "graph.json"),
    ):
        assert main(["reconstruct", source, "--out", str(tmp_path / "x"), *more]) == 2
        assert said in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]
