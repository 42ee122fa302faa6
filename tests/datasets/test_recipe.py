"""Recipes: the shipped ones hold, and whatever is wrong with one is said with file, field and what is allowed."""

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from simtrack.datasets.recipe import DriveViews, Recipe, load_recipe, parse_recipe, recipe_names
from simtrack.errors import FileFormatError, UnknownNameError

PATH = Path("somewhere/mine.yaml")
SHIPPED = ("bop_pbr_like", "clutter_user_meshes", "closed_loop_log", "workbench_keypoints")
GOOD: dict[str, Any] = {
    "name": "mine",
    "worlds": [{"kind": "room"}],
    "targets": {"models": ["relay"], "count": [1, 2]},
    "views": {"kind": "shell"},
}


def changed(where: str, value: Any) -> dict[str, Any]:
    """A good recipe with one field of another value."""
    document = copy.deepcopy(GOOD)
    *path, last = where.split(".")
    at: Any = document
    for key in path:
        at = at[int(key)] if isinstance(at, list) else at.setdefault(key, {})
    at[last] = value
    return document


def test_the_shipped_recipes_hold_and_describe_themselves() -> None:
    assert set(SHIPPED) <= set(recipe_names())
    for name in recipe_names():
        recipe = load_recipe(name)
        assert recipe.name == name
        assert len(recipe.description) > 80


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("colour", 1, r"unknown field colour; allowed: .*camera, counts.*worlds"),
        ("camera.focus", 1, r"mine\.yaml: camera: unknown field focus; allowed: depth, .*focal"),
        ("camera.width", 10, r"camera\.width: .*greater than or equal to 32 \(given: 10\)"),
        ("camera.depth", "kinect9", r"camera\.depth: unknown preset 'kinect9'; allowed: .*xtion"),
        ("counts.frames", 0, r"counts\.frames"),
        ("views", {"kind": "orbit"}, r"views: .*'shell', 'drive'"),
        ("views.distance", [2.0, 1.0], r"views.*distance is \[low, high\]"),
        ("targets.count", [3, 1], r"targets: .*count is \[low, high\]"),
        ("targets", {}, r"targets need at least one of 'models' and 'folders'"),
        ("targets.folders", ["nowhere"], r"targets\.folders\.0: there is no folder .*nowhere"),
        ("textures.images", "nowhere", r"textures\.images: there is no folder"),
        ("textures.kinds", ["silk"], r"textures\.kinds\.0: .*'wood'"),
        ("distractors.count", [0, 2], r"distractors\.count is above 0"),
        ("distractors.primitives", {"kinds": []}, r"kinds"),
        ("lights.ambient", [0.0, 3.0], r"lights\.ambient\.1: .*less than or equal to 1"),
        ("worlds", [], r"worlds: .*at least 1"),
        ("worlds", [{"kind": "scene", "scene": "workbench"}], r"need 'supports'"),
        ("renderer", "blender", r"renderer: .*'mujoco' or 'pyrender'"),
        ("writers", ["bop", "dicom"], r"writers\.dicom.*'bop'"),
        ("writers", [], r"writers: .*at least 1"),
        ("writers", {"bop": {"colour": 1}}, r"writers\.bop: unknown field colour; allowed"),
        ("name", "../up", r"name: "),
    ],
)
def test_what_is_wrong_is_said_with_field_and_what_is_allowed(where: str, value: Any, message: str) -> None:
    with pytest.raises(FileFormatError, match=message) as caught:
        parse_recipe(changed(where, value), PATH)
    assert caught.value.path.name == PATH.name


def test_drives_show_the_scene_file_as_it_is() -> None:
    drive = {"name": "log", "worlds": [{"kind": "scene", "scene": "workbench"}], "views": {"kind": "drive"}}
    assert isinstance(parse_recipe(drive, PATH).views, DriveViews)
    for extra in ({"lights": {}}, {"targets": {"models": ["relay"]}}, {"effects": {"bayer_noise": True}}):
        with pytest.raises(FileFormatError, match=r"show a scene file as it is; leave out .*lights"):
            parse_recipe(drive | extra, PATH)
    with pytest.raises(FileFormatError, match="need worlds of kind 'scene'"):
        parse_recipe(drive | {"worlds": [{"kind": "room"}]}, PATH)


def test_a_list_of_writers_takes_their_defaults() -> None:
    assert parse_recipe(changed("writers", ["coco", "bop"]), PATH).writers == {"coco": {}, "bop": {}}


def test_the_canonical_text_tells_recipes_apart_and_reads_back() -> None:
    first, second = parse_recipe(GOOD, PATH), parse_recipe(changed("camera.width", 320), PATH)
    assert first.canonical() == parse_recipe(GOOD | {"val_share": 0.1}, PATH).canonical()
    assert first.canonical() != second.canonical()
    assert parse_recipe(yaml.safe_load(second.canonical()), PATH) == second


def test_recipes_are_found_by_name_and_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(GOOD))
    assert load_recipe(tmp_path / "mine.yaml").path == tmp_path / "mine.yaml"
    with pytest.raises(UnknownNameError, match=r"unknown recipe 'mine'.*workbench_keypoints"):
        load_recipe("mine")
    monkeypatch.setenv("SIMTRACK_GENERATORS", str(tmp_path))
    assert load_recipe("mine").name == "mine"


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@given(st.sampled_from(sorted(Recipe.model_fields)), PLAIN)
def test_any_plain_data_gives_a_recipe_or_a_told_error(field: str, value: Any) -> None:
    try:
        assert isinstance(parse_recipe(GOOD | {field: value}, PATH), Recipe)
    except FileFormatError as error:
        assert str(PATH) in str(error)
