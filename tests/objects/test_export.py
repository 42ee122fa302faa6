"""Exported models are what BOP's tools and other programs read."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry import meshes
from simtrack.objects import load_object
from simtrack.objects.export import export


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "new"
    written = export(["thermos", "klt3147", "klt3147"], out)
    assert sorted(written) == sorted(path for path in out.rglob("*") if path.is_file())
    return out


def test_bop_models_are_millimetres_with_outward_normals(folder: Path) -> None:
    true = load_object("klt3147")
    file = folder / "models" / "obj_000001.ply"
    ply = trimesh.load_mesh(file, process=False)
    assert isinstance(ply, trimesh.Trimesh)
    np.testing.assert_array_equal(ply.faces, true.mesh.faces)
    np.testing.assert_allclose(ply.vertices, 1000.0 * true.mesh.vertices, atol=1e-4)
    header, data = file.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property ")][:9]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
    rows = np.frombuffer(data, dtype=[("p", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)], count=len(ply.vertices))
    np.testing.assert_allclose(rows["n"], meshes.vertex_normals(true.mesh), atol=1e-6)
    assert {tuple(c) for c in rows["c"]} <= {c for c, _ in meshes.split_by_color(true.mesh)}


def test_models_info_follows_bop(folder: Path) -> None:
    info = json.loads((folder / "models" / "models_info.json").read_text())
    crate, flask = info["1"], info["2"]
    np.testing.assert_allclose([crate[f"size_{a}"] for a in "xyz"], [300.0, 200.0, 147.0], atol=1e-6)
    np.testing.assert_allclose([crate[f"min_{a}"] for a in "xyz"], [-150.0, -100.0, -73.5], atol=1e-6)
    assert crate["diameter"] == pytest.approx(1000.0 * load_object("klt3147").diameter)
    assert crate["symmetries_discrete"] == [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]
    assert "symmetries_continuous" not in crate and "symmetries_discrete" not in flask
    assert flask["symmetries_continuous"] == [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]


def test_obj_is_in_metres_with_materials(folder: Path) -> None:
    true = load_object("thermos")
    obj = trimesh.load_mesh(folder / "obj" / "thermos.obj")
    np.testing.assert_allclose(obj.extents, true.extents, atol=1e-6)
    assert obj.area == pytest.approx(meshes.area(true.visual), rel=1e-4)
    assert (folder / "obj" / "objects.mtl").read_text().count("newmtl") >= 4


def test_overview_tells_what_the_models_say(folder: Path) -> None:
    overview = json.loads((folder / "objects.json").read_text())
    assert list(overview) == ["klt3147", "thermos"]
    assert overview["klt3147"]["id"] == 1 and overview["klt3147"]["trackable"] is True
    np.testing.assert_array_equal(overview["klt3147"]["keypoints"], load_object("klt3147").keypoints)


def test_bad_requests(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="Known"):
        export(["hammer"], tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidValueError, match="folder"):
        export(["mug"], tmp_path / "file")
