"""Users' own CAD models: meshes and URDF files, and what is said about broken ones."""

from pathlib import Path

import numpy as np
import pytest

from simtrack.errors import FileFormatError, MeshError, UnknownNameError
from simtrack.objects.cad import cad_classes, cad_models

URDF = """<robot name="larder">
  <link name="case"><visual><geometry><box size="0.6 0.6 1.0"/></geometry></visual></link>
  <link name="top"><visual><geometry><box size="0.6 0.6 0.02"/></geometry></visual></link>
  <link name="leaf"><visual><origin xyz="-0.3 -0.01 0"/><geometry><box size="0.6 0.02 1.0"/></geometry></visual>
    <collision><origin xyz="-0.3 -0.01 0"/><geometry><box size="0.6 0.02 1.0"/></geometry></collision></link>
  <joint name="lid" type="fixed"><parent link="case"/><child link="top"/><origin xyz="0 0 0.51"/></joint>
  <joint name="hinge" type="revolute"><parent link="case"/><child link="leaf"/><origin xyz="0.3 -0.302 0"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="1.5"/><dynamics friction="0.3"/></joint>
</robot>"""
CUBE = "".join(f"v {x} {y} {z}\n" for z in (0, 0.2) for y in (0, 0.2) for x in (0, 0.3)) + "".join(
    f"f {a} {b} {c}\n"
    for a, b, c in (
        (1, 3, 4), (1, 4, 2), (5, 6, 8), (5, 8, 7), (1, 2, 6), (1, 6, 5), (3, 7, 8), (3, 8, 4), (1, 5, 7), (1, 7, 3),
        (2, 4, 8), (2, 8, 6),
    )
)  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SIMTRACK_CAD", str(tmp_path))
    monkeypatch.setenv("SIMTRACK_CACHE", str(tmp_path / "cache"))
    (tmp_path / "larder").mkdir()
    return tmp_path


def test_a_urdf_becomes_an_articulated_model_of_a_new_class(folder: Path) -> None:
    (folder / "larder" / "mine.urdf").write_text(URDF)
    assert "larder" in cad_classes()
    (model,) = cad_models("larder")
    assert [part.name for part in model.parts] == ["case", "leaf"], "fixed links are one part"
    assert np.allclose(model.extents, [0.6, 0.622, 1.02], atol=1e-6)
    (joint,) = model.joints
    assert (joint.kind, joint.upper, joint.friction) == ("revolute", 1.5, 0.3)
    assert "openable" in model.affordances
    opened = model.mesh({"hinge": 1.5}).bounds
    assert opened[0, 1] < model.mesh().bounds[0, 1] - 0.5, "the door swings to the front"
    again = cad_models("larder")[0]
    assert np.array_equal(again.parts[0].mesh.vertices, model.parts[0].mesh.vertices)


def test_a_mesh_becomes_a_rigid_model_with_convex_parts(folder: Path) -> None:
    (folder / "larder" / "crate.obj").write_text(CUBE)
    (model,) = cad_models("larder")
    assert not model.articulated and np.allclose(model.mesh().bounds.sum(axis=0), 0.0, atol=1e-9)
    assert np.allclose(model.extents, [0.3, 0.2, 0.2]) and len(model.planes) == 6
    assert len(model.parts[0].convex) == 1 and model.mass == pytest.approx(500.0 * 0.012)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('type="revolute"', 'type="floating"', "fixed, revolute"),
        ('<child link="leaf"/>', '<child link="flap"/>', "is no link"),
        ('upper="1.5"', 'upper="-1"', "must be less than upper"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', "direction"),
        ('<box size="0.6 0.6 1.0"/>', '<mesh filename="../../secret.obj"/>', "there is no file"),
        ('<box size="0.6 0.6 1.0"/>', '<box size="0.6 nan 1.0"/>', "finite"),
        ("</robot>", "", "not valid XML"),
        ('<robot name="larder">', '<!DOCTYPE a [<!ENTITY b "c">]><robot>', "document type"),
        ('<parent link="case"/><child link="leaf"/>', '<parent link="leaf"/><child link="leaf"/>', "circle"),
    ],
)
def test_broken_urdf_files_are_refused_with_the_reason(folder: Path, old: str, new: str, reason: str) -> None:
    assert old in URDF
    (folder / "larder" / "bad.urdf").write_text(URDF.replace(old, new))
    with pytest.raises(FileFormatError, match=reason):
        cad_models("larder")


def test_absurd_sizes_and_unknown_classes_are_refused(folder: Path) -> None:
    (folder / "larder" / "crate.obj").write_text(CUBE.replace("0.3", "300"))
    with pytest.raises(MeshError, match="metres"):
        cad_models("larder")
    with pytest.raises(UnknownNameError, match="larder"):
        cad_models("pantry")
