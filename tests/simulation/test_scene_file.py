from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.errors import FileFormatError, SimtrackError, UnknownNameError
from simtrack.simulation.scene_file import load_scene, parse_scene, read_scene, scene_names

PATH = Path("somewhere/scene.yaml")


def change(document: dict[str, Any], where: str, value: Any) -> dict[str, Any]:
    target: Any = document
    *parents, last = where.split(".")
    for key in parents:
        target = target[int(key) if key.isdigit() else key]
    target[last] = value
    return document


def test_workbench_is_found_and_valid() -> None:
    assert "workbench" in scene_names()
    scene = load_scene("workbench")
    classes = [thing.model for thing in scene.objects]
    assert len(classes) > len(set(classes)), "two objects of one class"
    assert scene.hand is not None


def test_unknown_scene_lists_the_known() -> None:
    with pytest.raises(UnknownNameError, match=r"workbenhc.*workbench"):
        load_scene("workbenhc")


@pytest.mark.parametrize("name", ["rooms/scene.xml", "scene.yaml"])
def test_a_missing_file_is_no_unknown_scene(name: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        load_scene(tmp_path / name)


def test_users_folder_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "workbench"
    folder.mkdir()
    (folder / "scene.yaml").write_text("name: mine\nstatic: {builder: lab_room}\nrobot: {start: {x: 3, y: 3}}\n")
    monkeypatch.setenv("SIMTRACK_SCENES", str(tmp_path))
    assert load_scene("workbench").name == "mine"
    assert load_scene(folder).name == "mine"
    assert load_scene(folder / "scene.yaml").name == "mine"


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("colour", "red", r"unknown field colour; allowed: .*clutter"),
        ("static.builder", "castle", r"static\.builder.*'lab_room', 'office_floor'"),
        ("objects.0.place.yaw", [1.0, 0.0], r"objects\.0\.place.*low must not exceed high"),
        ("objects.0.place", {}, r"objects\.0\.place.*exactly one of 'on'"),
        ("objects.1.model", "materialbox", r"unique.*materialbox"),
        ("robot.torso", 0.5, r"robot\.torso.*0\.35"),
        ("robot.torso", float("nan"), r"robot\.torso.*finite"),
        ("duration", -1, r"duration.*greater than 0"),
        ("objects.0.name", "../x", r"objects\.0\.name"),
        ("mjcf", "missing.xml", r"mjcf: there is no file 'missing.xml'"),
        ("mjcf", "../../etc/passwd", r"mjcf: .*leads out of the scene's folder"),
        ("mjcf", "/etc/passwd", r"mjcf: .*leads out of the scene's folder"),
        ("hand", {"rest": [0, 0, 1], "script": [{"do": "juggle"}]}, r"hand\.script\.0.*'wait', 'carry'"),
        (
            "hand",
            {"rest": [0, 0, 1], "script": [{"do": "push", "object": "cup"}]},
            r"object 'cup'; the scene has: materialbox",
        ),
    ],
)
def test_errors_name_file_field_and_what_is_allowed(
    document: dict[str, Any], where: str, value: Any, message: str
) -> None:
    with pytest.raises(FileFormatError, match=message) as caught:
        parse_scene(change(document, where, value), PATH)
    assert str(PATH) in str(caught.value) or str(PATH.resolve()) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: x\nrobot: [1, 2\n", r"line 3: not valid YAML"),
        ("name: x\nname: y\n", r"'name' occurs twice"),
        ("a: &a [1]\nb: *a\n", r"line 2: .*aliases"),
        ("- 1\n", r"a scene is a mapping"),
        ("name: !!python/object/apply:os.system ['true']\n", r"not valid YAML"),
    ],
)
def test_broken_yaml_is_told_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_scene(path)


@settings(max_examples=60)
@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_any_bytes_are_a_scene_or_an_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.yaml"
    path.write_bytes(data)
    with pytest.raises(SimtrackError):
        read_scene(path)
