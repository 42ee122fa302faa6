import os
from pathlib import Path

import pytest

from simtrack import paths

REPOSITORY = Path(__file__).resolve().parents[1]


def test_a_checkout_finds_its_own_folders() -> None:
    assert paths.scene_roots() == [REPOSITORY / "scenes"]
    assert paths.generator_roots() == [REPOSITORY / "generators"]


def test_the_users_folders_come_first_and_missing_ones_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, other = tmp_path / "own", tmp_path / "other"
    own.mkdir()
    other.mkdir()
    entries = [str(own), "", str(tmp_path / "missing"), str(other), str(own)]
    monkeypatch.setenv("SIMTRACK_SCENES", os.pathsep.join(entries))
    assert paths.scene_roots() == [own, other, REPOSITORY / "scenes"]


def test_the_cache_goes_where_the_user_says_else_where_it_can(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SIMTRACK_CACHE", str(tmp_path / "own"))
    assert paths.cache_dir() == tmp_path / "own" and (tmp_path / "own").is_dir()
    monkeypatch.delenv("SIMTRACK_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert paths.cache_dir() == tmp_path / "xdg" / "simtrack"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert paths.cache_dir() == tmp_path / "home" / ".cache" / "simtrack"


def test_without_any_writable_place_the_cache_is_temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    for variable in ("SIMTRACK_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.setenv(variable, str(blocked))
    folder = paths.cache_dir()
    assert folder.is_dir() and blocked not in folder.parents
    assert paths.cache_dir() == folder
