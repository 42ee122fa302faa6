"""A case is another one as soon as anything of the user's that it reads is another."""

import os
import sys
from pathlib import Path

import pytest

from simtrack.evaluation.instrument.belongings import belongings, sources
from simtrack.evaluation.instrument.cases import Case


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of a user's with a tracker in a module, its helper, and a package."""
    (tmp_path / "outer.py").write_text("import numpy\nfrom helper import limit\nclass T: ...\n")
    (tmp_path / "helper.py").write_text("import outer\nimport stack.parts\nlimit = 3\n")
    (tmp_path / "stack").mkdir()
    (tmp_path / "stack" / "__init__.py").write_text("")
    (tmp_path / "stack" / "parts.py").write_text("from . import missing\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_code_is_followed_through_what_it_imports_and_not_into_libraries(here: Path) -> None:
    assert sources("outer") == {
        here / name for name in ("outer.py", "helper.py", "stack/__init__.py", "stack/parts.py")
    }
    assert sources("stack.parts") == {here / "stack/__init__.py", here / "stack/parts.py"}
    assert sources("nothing_of_this_name") == set()


@pytest.mark.parametrize("changed", ["outer.py", "helper.py", "stack/parts.py"])
def test_a_tracker_that_changed_is_run_again(here: Path, changed: str) -> None:
    case = Case("workbench", tracker="outer:T")
    before = case.key
    assert before == Case("workbench", tracker="outer:T").key
    (here / changed).write_text("def broken(:\n")
    assert case.key != before


def test_programs_and_networks_and_models_belong_to_a_run(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (here / "line.pl").write_text("one")
    (here / "net").mkdir()
    (here / "net" / "boxes.onnx").write_bytes(b"1")
    (here / "models" / "mug").mkdir(parents=True)
    (here / "models" / "mug" / "mug.obj").write_text("v 0 0 0")
    monkeypatch.setenv("SIMTRACK_OBJECTS", str(here / "models"))
    stages = f"exec:{sys.executable} line.pl --fast", "net", None, "oracle"
    seen = {belongings(stages, None)}
    for path, text in (("line.pl", "two"), ("net/boxes.onnx", "22"), ("models/mug/mug.obj", "v 1 0 0 0")):
        (here / path).write_text(text)
        seen.add(belongings(stages, None))
    (here / "world").mkdir()
    (here / "world" / "scene.xml").write_text("<mujoco/>")
    seen.add(belongings(stages, here / "world" / "scene.xml"))
    os.utime(here / "world" / "scene.xml", ns=(1, 1))
    seen.add(belongings(stages, here / "world" / "scene.xml"))
    assert len(seen) == 6
