"""Functional rooms in the cache: made once, whole, however many processes want them at a time."""

from pathlib import Path

import pytest

from simtrack.perception.reconstruction.body_tree import BodyTree
from simtrack.simulation.building.rooms import functional
from simtrack.simulation.building.rooms.functional import functional_room


def test_two_processes_may_make_the_same_room_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def write_scene(tree: BodyTree, folder: Path) -> None:
        made.append(folder)
        if len(made) == 1:  # another process begins and is first
            assert functional_room(3, "open-kitchen").read_text() == "2"
        folder.mkdir()
        (folder / "scene.xml").write_text(str(len(made)))

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("SIMTRACK_CACHE", raising=False)
    monkeypatch.setattr(functional, "settled_room", lambda seed, kind: None)
    monkeypatch.setattr(functional, "room_tree", lambda room: None)
    monkeypatch.setattr(functional, "write_scene", write_scene)
    file = functional_room(3, "open-kitchen")
    assert file.read_text() == "2" and len(set(made)) == 2
    assert functional_room(3, "open-kitchen") == file and len(made) == 2, "kept"
    assert list(file.parent.parent.iterdir()) == [file.parent], "nothing is left lying about"
