"""The rehearsal of a first run: when there is one, and that it never stands in a run's way."""

import importlib.util
import os
from pathlib import Path

from simtrack.evaluation import rehearsal

KERNEL = "import numba\n\n@numba.njit(cache=True)\ndef twice(x):\n    return 2 * x\n"


def test_a_function_counts_as_kept_while_its_source_stays_as_it_was_compiled(tmp_path: Path):
    source = tmp_path / "kernel_of_a_test.py"
    source.write_text(KERNEL)
    spec = importlib.util.spec_from_file_location(source.stem, source)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert not rehearsal._kept(module.twice)
    assert module.twice(2) == 4
    assert rehearsal._kept(module.twice)
    later = source.stat().st_mtime + 3600
    os.utime(source, (later, later))
    assert not rehearsal._kept(module.twice)


def test_what_goes_wrong_in_it_is_left_to_the_run(monkeypatch):
    monkeypatch.setattr(rehearsal, "compiled", lambda: False)
    said = []
    rehearsal.rehearse("no such scene", "embree", lambda what, thing: said.append(what))
    assert said == []


def test_what_was_compiled_is_not_rehearsed(monkeypatch):
    monkeypatch.setattr(rehearsal, "compiled", lambda: True)
    monkeypatch.setattr(rehearsal.subprocess, "Popen", None)
    rehearsal.rehearse("workbench", "embree", lambda what, thing: None)
