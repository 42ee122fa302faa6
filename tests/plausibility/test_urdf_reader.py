"""Reading any URDF: what is wrong is a clear finding, never an exception; what is right comes back as it was."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from simtrack.geometry.meshes import box_mesh
from simtrack.perception.reconstruction.files import write_obj, write_scene
from simtrack.plausibility.urdf_reader import read_urdf
from tests.plausibility.scenes import kitchen

INERTIAL = '<inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>'
BOX = '<collision><geometry><box size=".2 .2 .2"/></geometry></collision>'
LINK = f'<link name="base">{INERTIAL}{BOX}</link>'
DOOR = f'<link name="door">{INERTIAL}{BOX}</link>'
ENDS = '<parent link="base"/><child link="door"/>'


def written(folder: Path, content: str) -> Path:
    path = folder / "file.urdf"
    path.write_text(f'<robot name="r">{content}</robot>')
    return path


def mesh_link(filename: str, scale: str = "1 1 1") -> str:
    mesh = f'<mesh filename="{filename}" scale="{scale}"/>'
    return f'<link name="base">{INERTIAL}<collision><geometry>{mesh}</geometry></collision></link>'


def test_what_was_written_is_read_again(tmp_path: Path) -> None:
    tree = kitchen()
    again, findings = read_urdf(write_scene(tree, tmp_path).urdf)
    assert again is not None
    assert not [finding for finding in findings if finding.severity != "note"]
    poses = again.forward({"hinge": 0.4})
    for name, T in tree.forward({"hinge": 0.4}).items():
        assert np.allclose(poses[name], T, atol=1e-8)
    for body in tree.bodies:
        other = again.by_name[body.name]
        assert other.mass == pytest.approx(body.mass)
        assert np.allclose(np.asarray(other.inertia), np.asarray(body.inertia) * (body.mass > 0), atol=1e-7)
        assert other.friction == pytest.approx(body.friction)
        assert len(other.collision) == len(body.collision)
        for a, b in zip(other.collision, body.collision, strict=True):
            assert np.allclose(np.ptp(a.corners(), axis=0), np.ptp(b.corners(), axis=0), atol=1e-8)


@pytest.mark.parametrize(
    ("content", "severity", "kind", "says"),
    [
        (mesh_link("gone.obj"), "unreadable", "missing-mesh", "gone.obj"),
        (mesh_link("../../etc/secret.obj"), "unreadable", "path-leads-out", "leads out"),
        (mesh_link("file:" + "///etc/secret.obj"), "unreadable", "path-leads-out", "leads out"),
        (mesh_link("package://other/../../secret.obj"), "unreadable", "path-leads-out", "leads out"),
        (mesh_link("broken.obj"), "unreadable", "bad-mesh", "broken.obj"),
        (mesh_link("cube.obj", "0 1 1"), "unreadable", "format", "flattens"),
        (mesh_link("cube.obj", "1000 1000 1000"), "problem", "absurd-scale", "millimetres"),
        (LINK.replace(".2 .2 .2", ".2 nan .2"), "unreadable", "format", "finite"),
        (LINK.replace(".2 .2 .2", ".2 -1 .2"), "unreadable", "format", "positive"),
        (LINK.replace(".01", "0"), "problem", "zero-inertia", "without inertia"),
        (LINK.replace('ixx=".01"', 'ixx="5"'), "warning", "impossible-inertia", "principal moments"),
        (LINK.replace('mass value="1"', 'mass value="1e6"'), "warning", "absurd-mass", "kg/m^3"),
        (LINK.replace('mass value="1"', 'mass value="-1"'), "unreadable", "format", "negative"),
        (LINK + LINK, "unreadable", "format", "twice"),
        (LINK + DOOR, "unreadable", "format", "no parent"),
        (LINK + DOOR + f'<joint name="j" type="hinge">{ENDS}</joint>', "unreadable", "format", "revolute"),
        (LINK + DOOR + f'<joint name="j" type="revolute">{ENDS}</joint>', "problem", "unreachable-joint", "limits"),
        (
            LINK + DOOR + f'<joint name="j" type="revolute">{ENDS}<limit lower="1" upper="-1"/></joint>',
            "problem",
            "unreachable-joint",
            "above",
        ),
        (
            LINK + DOOR + f'<joint name="j" type="prismatic">{ENDS}<axis xyz="0 0 0"/><limit upper="1"/></joint>',
            "problem",
            "unreachable-joint",
            "axis",
        ),
        (
            LINK + DOOR.replace('"1"', '"0"', 1) + f'<joint name="j" type="continuous">{ENDS}</joint>',
            "problem",
            "zero-mass",
            "joint moves it",
        ),
        (LINK + f'<joint name="j" type="fixed">{ENDS}</joint>', "unreadable", "format", "'door'"),
        (LINK + f'<joint name="j" type="fixed">{ENDS.replace("door","base")}</joint>', "unreadable", "format", "cycle"),
        ("", "unreadable", "format", "one or more"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_a_clear_finding(tmp_path: Path, content: str, severity: str, kind: str, says: str) -> None:
    write_obj(tmp_path / "cube.obj", box_mesh((1.0, 1.0, 1.0)))
    (tmp_path / "broken.obj").write_text("v 0 0 0\nf 1 2 3\n")
    tree, findings = read_urdf(written(tmp_path, content))
    assert (tree is None) == (severity == "unreadable")
    (finding,) = [found for found in findings if found.kind == kind and found.severity == severity]
    assert says in str(finding)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("<robot", "XML"),
        ("<sdf/>", "<robot>"),
        ('<!DOCTYPE r [<!ENTITY a "aaaa">]><robot name="r">&a;</robot>', "entities"),
        ('<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:macro/></robot>', "xacro"),
    ],
)
def test_what_is_no_urdf_is_told(tmp_path: Path, content: str, says: str) -> None:
    path = tmp_path / "file.urdf"
    path.write_text(content)
    tree, findings = read_urdf(path)
    assert tree is None and says in findings[0].message


def test_a_huge_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "file.urdf"
    with path.open("wb") as file:
        file.truncate(30_000_000)
    tree, findings = read_urdf(path)
    assert tree is None and "larger" in findings[0].message


def test_a_link_to_outside_is_refused_and_another_root_allows_it(tmp_path: Path) -> None:
    inner = tmp_path / "robots" / "urdf"
    inner.mkdir(parents=True)
    write_obj(tmp_path / "robots" / "cube.obj", box_mesh((1.0, 1.0, 1.0)))
    (inner / "linked.obj").symlink_to(tmp_path / "robots" / "cube.obj")
    for filename in ("linked.obj", "../cube.obj", "package://robots/cube.obj"):
        path = written(inner, mesh_link(filename))
        kind = "missing-mesh" if filename.startswith("package") else "path-leads-out"
        assert {finding.kind for finding in read_urdf(path)[1]} == {kind}, filename
        assert read_urdf(path, tmp_path / "robots")[0] is not None, filename


def test_groups_of_an_obj_are_convex_parts_of_their_own(tmp_path: Path) -> None:
    lines = []
    for k, x in enumerate((0.0, 3.0)):
        cube = box_mesh((1.0, 1.0, 1.0))
        lines += [f"o part{k}", *(f"v {a + x} {b} {c}" for a, b, c in cube.vertices)]
        lines += [f"f {a} {b} {c}" for a, b, c in cube.faces + 1 + 8 * k]
    (tmp_path / "two.obj").write_text("\n".join(lines))
    tree, _ = read_urdf(written(tmp_path, mesh_link("two.obj", "0.1 0.1 0.1")))
    assert tree is not None
    assert [np.ptp(shape.corners()[:, 0]) for shape in tree.bodies[0].collision] == pytest.approx([0.1, 0.1])


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_files_never_raise(tmp_path: Path, data: st.DataObject) -> None:
    joint = f'<joint name="j" type="revolute">{ENDS}<limit lower="0" upper="1"/></joint>'
    good = f'<robot name="r">{LINK}{DOOR}{joint}</robot>'
    start = data.draw(st.integers(0, len(good) - 1))
    end = data.draw(st.integers(start, min(len(good), start + 40)))
    put = data.draw(st.sampled_from(["", "nan", "-1", '"', "<", "link", "1e999", "\x00", "é"]))
    path = tmp_path / "file.urdf"
    path.write_text(good[:start] + put + good[end:], encoding="utf-8")
    tree, findings = read_urdf(path)
    assert (tree is None) == any(finding.severity == "unreadable" for finding in findings)
