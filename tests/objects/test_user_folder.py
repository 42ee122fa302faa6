"""Users' own objects, and what is said about those that cannot be used."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.errors import FileFormatError, InvalidValueError, MeshError, SimtrackError, UnknownNameError
from simtrack.geometry import meshes
from simtrack.objects import catalogue, load_object, register_folder, registry
from simtrack.objects.user_folder import ObjectSpecification, load_folder, read_specification


@pytest.fixture(autouse=True)
def forget_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_registered", {})


def write_object(folder: Path, shape: trimesh.Trimesh | None = None, **fields: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    shape = trimesh.creation.box((100.0, 60.0, 20.0)) if shape is None else shape
    shape.apply_translation((7.0, 8.0, 9.0))
    shape.export(folder / "part.stl")
    content = {"name": "bracket", "mesh": "part.stl", "scale": 0.001, "mass": 0.3} | fields
    (folder / "object.yaml").write_text(yaml.safe_dump({k: v for k, v in content.items() if v is not None}))
    return folder


def test_an_object_in_a_few_lines(tmp_path: Path) -> None:
    folder = write_object(
        tmp_path / "o", colour=[10, 200, 30], semantic_class="component", symmetries=[{"axis": [0, 0, 2]}]
    )
    assert register_folder(folder) == ("bracket",)
    model = load_object("bracket")
    np.testing.assert_allclose(model.extents, [0.1, 0.06, 0.02], atol=1e-7)
    np.testing.assert_allclose(model.mesh.bounds.sum(axis=0), 0.0, atol=1e-9)
    assert (model.mass, model.semantic_class, model.trackable) == (0.3, "component", True)
    assert model.mesh.face_colors is not None and (model.mesh.face_colors == [10, 200, 30]).all()
    np.testing.assert_allclose(model.symmetries.discrete[1], np.diag([-1.0, -1, 1, 1]), atol=1e-12)
    np.testing.assert_allclose(
        model.inertia,
        0.3 / 12 * np.diag([0.06**2 + 0.02**2, 0.1**2 + 0.02**2, 0.1**2 + 0.06**2]),
        rtol=1e-5,
        atol=1e-12,
    )


def test_density_weighs_the_solid(tmp_path: Path) -> None:
    model = load_folder(write_object(tmp_path, mass=None, density=2700.0))
    assert model.mass == pytest.approx(2700.0 * 0.1 * 0.06 * 0.02, rel=1e-6)


@pytest.mark.parametrize(("kind", "parts"), [("convex-hull", 1), ("box", 1)])
def test_collision_kinds(kind: str, parts: int, tmp_path: Path) -> None:
    model = load_folder(write_object(tmp_path, trimesh.creation.icosphere(2, 50.0), collision=kind))
    assert len(model.collision) == parts
    sphere = 4.0 / 3.0 * np.pi * 0.05**3
    assert meshes.volume(model.collision[0]) == pytest.approx(0.001 if kind == "box" else sphere, rel=0.1)


def test_convex_decomposition_keeps_a_hollow_open(tmp_path: Path) -> None:
    pytest.importorskip("coacd")
    outer, inner = trimesh.creation.box((100, 100, 50)), trimesh.creation.box((90, 90, 50))
    inner.apply_translation((0, 0, 5.0))
    model = load_folder(
        write_object(tmp_path, trimesh.boolean.difference([outer, inner], engine="manifold"), collision="coacd")
    )
    assert len(model.collision) >= 5
    for part in model.collision:
        normals = meshes.face_normals(part)
        assert np.einsum("fd,fd->f", normals, np.array([0, 0, 0.01]) - part.triangles[:, 0]).max() > 0.01


def test_four_fold_and_continuous_symmetries(tmp_path: Path) -> None:
    fields = [{"axis": [0, 0, 1], "fold": 4}, {"axis": [1, 0, 0]}]
    model = load_folder(write_object(tmp_path, trimesh.creation.box((50, 50, 20)), symmetries=fields))
    assert len(model.symmetries.discrete) == 8
    np.testing.assert_allclose(model.symmetries.discrete[0], np.eye(4))
    turned = load_folder(write_object(tmp_path, symmetries=[{"axis": [0, 0, 1], "fold": "continuous"}]))
    np.testing.assert_allclose(turned.symmetries.axes[0].offset, 0.0)


def test_folders_are_found_through_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_object(tmp_path / "first" / "a", name="first-part")
    write_object(tmp_path / "second", name="second_part")
    monkeypatch.setenv("SIMTRACK_OBJECTS", os.pathsep.join([str(tmp_path / "first"), str(tmp_path / "second")]))
    assert {"first-part", "second_part", "klt3147"} <= set(catalogue())
    assert load_object("first-part").name == "first-part"
    monkeypatch.delenv("SIMTRACK_OBJECTS")
    with pytest.raises(UnknownNameError):
        load_object("first-part")


def test_changed_files_are_read_again(tmp_path: Path) -> None:
    register_folder(write_object(tmp_path))
    before = load_object("bracket")
    write_object(tmp_path, trimesh.creation.box((50.0, 60.0, 20.0)))
    assert load_object("bracket").extents[0] == pytest.approx(0.5 * before.extents[0])


def test_open_and_oversized_meshes_are_warned_of(tmp_path: Path) -> None:
    box = trimesh.creation.box((100.0, 60.0, 20.0))
    box.update_faces(np.arange(len(box.faces)) > 1)
    with pytest.warns(UserWarning, match=r"part\.stl: is not closed"):
        model = load_folder(write_object(tmp_path, box))
    assert np.linalg.eigvalsh(model.inertia).min() > 0.0
    with pytest.warns(UserWarning, match=r"measures 100 x .* m; if it was drawn in millimetres, set 'scale: 0.001'"):
        load_folder(write_object(tmp_path, scale=1.0))
    with pytest.warns(UserWarning, match=r"measures 0.0001 x .* m; if it was drawn in metres, leave 'scale' out"):
        load_folder(write_object(tmp_path, scale=1e-6))


@pytest.mark.parametrize(
    ("fields", "field", "reason"),
    [
        ({"name": None}, "name", "required"),
        ({"name": "../evil"}, "name", "pattern"),
        ({"mesh": None}, "mesh", "required"),
        ({"scale": -1}, "scale", "greater than 0"),
        ({"scale": float("nan")}, "scale", "greater than 0|finite"),
        ({"mass": "heavy"}, "mass", "number"),
        ({"mass": 1.0, "density": 2.0}, "", "mass and density are both given"),
        ({"semantic_class": "gadget"}, "semantic_class", "known: .*multimeter"),
        ({"collision": "mesh"}, "collision", "'convex-hull', 'coacd' or 'box'"),
        ({"colour": [1, 2]}, "colour", "at least 3"),
        ({"colour": [1, 2, 300]}, r"colour\.2", "less than or equal to 255"),
        ({"symmetries": [{"axis": [0, 0, 0]}]}, r"symmetries\.0\.axis", "other than"),
        ({"weight": 3}, "weight", "unknown field; allowed: name, mesh, scale"),
        ({"mesh": "../part.stl"}, "mesh", "leads out of the folder"),
        ({"mesh": "/etc/passwd"}, "mesh", "leads out of the folder"),
    ],
)
def test_bad_fields_are_named_with_what_is_allowed(
    fields: dict[str, Any], field: str, reason: str, tmp_path: Path
) -> None:
    write_object(tmp_path, **fields)
    with pytest.raises(FileFormatError, match=rf"(?s)object\.yaml.*{field}.*({reason})"):
        load_folder(tmp_path)


def test_links_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    folder = write_object(tmp_path / "inside")
    (folder / "part.stl").rename(tmp_path / "outside.stl")
    (folder / "part.stl").symlink_to(tmp_path / "outside.stl")
    with pytest.raises(FileFormatError, match="leads out of the folder"):
        load_folder(folder)


def test_bad_meshes_are_named(tmp_path: Path) -> None:
    folder = write_object(tmp_path)
    (folder / "part.stl").unlink()
    with pytest.raises(MeshError, match=r"part\.stl: no such file.*object\.yaml"):
        load_folder(folder)
    (folder / "part.stl").write_bytes(b"")
    with pytest.raises(MeshError, match=r"part\.stl"):
        load_folder(folder)
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    with pytest.warns(UserWarning, match="not closed"), pytest.raises(MeshError, match="flat"):
        load_folder(write_object(tmp_path, flat))


def test_folders_that_hold_no_object_or_a_taken_name(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match=r"object\.yaml"):
        register_folder(tmp_path)
    with pytest.raises(FileFormatError, match="choose another name"):
        register_folder(write_object(tmp_path / "a", name="klt3147"))
    write_object(tmp_path / "a", name="twin")
    write_object(tmp_path / "b", name="twin")
    with pytest.raises(FileFormatError, match="already the name of"):
        register_folder(tmp_path)


@pytest.mark.parametrize(
    "text", ["", "[1, 2]", "name: [", "!!python/object/apply:os.system [ls]", "\x00", "a: &a [*a]"]
)
def test_broken_yaml_is_an_error_that_names_the_file(text: str, tmp_path: Path) -> None:
    (tmp_path / "object.yaml").write_text(text)
    with pytest.raises(FileFormatError, match=r"object\.yaml"):
        read_specification(tmp_path)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)


@given(st.dictionaries(st.sampled_from(list(ObjectSpecification.model_fields)), values) | values)
@settings(max_examples=40)
def test_any_content_is_a_specification_or_a_simtrack_error(
    tmp_path_factory: pytest.TempPathFactory, content: object
) -> None:
    folder = tmp_path_factory.mktemp("any")
    (folder / "object.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    try:
        read_specification(folder)
    except SimtrackError as error:
        assert "object.yaml" in str(error)
