"""Convex decomposition: native code that crashes or hangs takes nothing along, and what went wrong is said."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from simtrack.errors import FileFormatError, MeshError
from simtrack.geometry.meshes import Mesh, box_mesh, volume
from simtrack.objects.decomposition import convex_parts
from simtrack.objects.user_folder import load_folder

BOX = box_mesh((0.1, 0.2, 0.3))


def pretend(behaviour: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have child processes find a coacd that does this when it is run."""
    (folder / "coacd.py").write_text(
        "import os, time\n"
        "Mesh = lambda vertices, faces: (vertices, faces)\n"
        "set_log_level = print\n"
        f"def run_coacd(mesh, **settings):\n    {behaviour}\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(folder))


@pytest.mark.parametrize(
    ("behaviour", "reason"),
    [
        ("os.abort()", r"crashes on it \(SIGABRT\)"),
        ("raise RuntimeError('assertion failed: no volume')", "fails on it .*assertion failed: no volume"),
        ("time.sleep(600)", "takes longer than 0.2 s"),
        ("return []", "no convex parts"),
    ],
)
def test_a_failure_is_an_error_that_names_the_mesh(
    behaviour: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend(behaviour, tmp_path, monkeypatch)
    with pytest.raises(MeshError, match=f"crate.stl.*{reason}"):
        convex_parts(BOX, "crate.stl", time_limit=0.2 if "sleep" in behaviour else 60.0)


def test_a_user_is_told_which_field_to_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend("os.abort()", tmp_path, monkeypatch)
    trimesh.Trimesh(BOX.vertices, BOX.faces).export(tmp_path / "part.stl")
    (tmp_path / "object.yaml").write_text(yaml.safe_dump({"name": "crate", "mesh": "part.stl", "collision": "coacd"}))
    with pytest.raises(FileFormatError, match=r"object\.yaml: collision: .*SIGABRT.*allowed.*: convex-hull, box"):
        load_folder(tmp_path)


def test_parts_are_closed_and_make_up_the_mesh() -> None:
    pytest.importorskip("coacd")
    legs = [box_mesh((0.02, 0.02, 0.1)), box_mesh((0.1, 0.02, 0.02))]
    corner = Mesh(
        np.concatenate([legs[0].vertices, legs[1].vertices + (0.3, 0.0, 0.0)]),
        np.concatenate([legs[0].faces, legs[1].faces + len(legs[0].vertices)]),
    )
    parts = convex_parts(corner, "two blocks")
    assert len(parts) == 2
    assert sum(map(volume, parts)) == pytest.approx(volume(corner), rel=0.2)
