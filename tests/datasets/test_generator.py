"""Generated frames keep the contracts of their fields, and depend on recipe, seed and scene alone."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from simtrack.datasets.annotate import NEAR
from simtrack.datasets.frame import LabelledFrame
from simtrack.datasets.generator import Generator
from simtrack.datasets.recipe import Recipe, parse_recipe
from simtrack.errors import FileFormatError
from simtrack.geometry.transforms import is_rigid
from simtrack.sensors.camera import project

pytestmark = pytest.mark.gl

TABLE: dict[str, Any] = {
    "name": "small",
    "counts": {"frames": 6, "views_per_scene": 3},
    "worlds": [{"kind": "room"}],
    "targets": {"models": ["relay", "materialbox"], "count": [2, 3]},
    "distractors": {"models": ["mug"], "count": [1, 1], "scale": [0.7, 1.2], "primitives": {"count": [2, 2]}},
    "placement": {"kind": "drop", "area": [0.4, 0.4]},
    "textures": {"size": 64},
    "camera": {"width": 160, "height": 120, "focal": 144.0},
}


def recipe(**changes: Any) -> Recipe:
    return parse_recipe(TABLE | changes, Path("small.yaml"))


def digest(frame: LabelledFrame) -> str:
    sha = hashlib.sha256()
    for image in (frame.rgb, frame.depth, frame.clean_depth, frame.normals, frame.ids, frame.T_map_camera):
        sha.update(image.tobytes())
    for label in frame.labels:
        sha.update(label.T_camera_object.tobytes() + label.amodal.tobytes() + label.keypoints.tobytes())
    sha.update(repr((frame.names, frame.support, frame.relations)).encode())
    return sha.hexdigest()


@pytest.fixture(scope="module")
def generator() -> Iterator[Generator]:
    with Generator(recipe(), seed=3) as made:
        yield made


@pytest.fixture(scope="module")
def frames(generator: Generator) -> list[LabelledFrame]:
    return list(generator.frames(1))


def test_counts(generator: Generator, frames: list[LabelledFrame]) -> None:
    assert [generator.scenes(count) for count in (1, 3, 4, 6)] == [1, 1, 2, 2]
    assert generator.scene_info(1).frames == len(frames) == 3
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert np.all(np.diff([frame.stamp for frame in frames]) > 0)


def test_categories_cover_everything_in_a_frame(generator: Generator, frames: list[LabelledFrame]) -> None:
    known = {category.id for category in generator.info.categories} | {stuff.id for stuff in generator.info.stuff}
    assert len(known) == len(generator.info.categories) + len(generator.info.stuff)
    for frame in frames:
        assert frame.segment_categories.shape == (len(frame.names),)
        assert set(frame.segment_categories.tolist()) <= known
        assert len(set(frame.names)) == len(frame.names)
        for label in frame.labels:
            assert frame.names[label.instance] == label.name
            if label.category is not None:
                assert frame.segment_categories[label.instance] == label.category
                assert label.name.startswith(generator.info.categories[label.category - 1].model.name)


def test_images_are_of_one_world(frames: list[LabelledFrame]) -> None:
    for frame in frames:
        shape = (120, 160)
        assert frame.rgb.shape == (*shape, 3)
        assert frame.depth.shape == frame.clean_depth.shape == frame.ids.shape == shape
        assert (frame.ids >= 0).all()  # a room is closed
        assert (frame.clean_depth > NEAR).all()
        assert np.abs(np.linalg.norm(frame.normals, axis=2) - 1.0).max() < 1e-4
        read = frame.depth > 0
        assert 0.5 < read.mean() < 1.0
        assert np.median(np.abs(frame.depth - frame.clean_depth)[read]) < 0.01
        assert not np.array_equal(frame.depth, frame.clean_depth)
        assert frame.rgb.std() > 5.0


def test_labels_fit_poses(frames: list[LabelledFrame]) -> None:
    for frame in frames:
        assert is_rigid(frame.T_map_camera)
        for label in frame.labels:
            assert np.allclose(frame.T_map_camera @ label.T_camera_object, label.T_map_object, atol=1e-9)
            assert label.pixels_visible == np.count_nonzero(frame.ids == label.instance)
            assert 0.0 <= label.visible_fraction <= 1.0
            assert (label.category is None) == (len(label.keypoints) == 0)
            if label.category is not None and label.T_camera_object[2, 3] > 0.2:
                assert project(label.T_camera_object[None, :3, 3], frame.intrinsics)[0] == pytest.approx(
                    label.keypoints[8], abs=1e-6
                )


def test_the_color_of_a_thing_is_where_its_id_is(frames: list[LabelledFrame]) -> None:
    """Inside of one face colours hardly change; they do where one thing ends and another begins."""
    inside, across = [], []
    for frame in frames:
        step = np.abs(np.diff(frame.rgb.astype(int), axis=1)).sum(axis=2)
        edge = np.diff(frame.ids, axis=1) != 0
        inside.append(np.median(step[~edge]))
        across.append(np.median(step[edge]))
    assert np.mean(across) > 4 * np.mean(inside)


def test_cameras_stand_on_the_shell_and_see_a_target(frames: list[LabelledFrame]) -> None:
    for frame in frames:
        assert max(label.pixels_visible for label in frame.targets()) > 0
        eye = frame.T_map_camera[:3, 3]
        reach = [float(np.linalg.norm(label.T_map_object[:3, 3] - eye)) for label in frame.targets()]
        assert 0.3 < min(reach) < 1.6
        assert frame.clean_depth[::32, ::32].min() >= 0.3  # the clearance


def test_support_and_relations_speak_of_the_same_things(frames: list[LabelledFrame]) -> None:
    frame = frames[0]
    assert frame.support
    assert {carried for carried, _ in frame.support} == {label.name for label in frame.labels}
    for carried, carrier in frame.support:
        assert carrier in frame.names
        assert any(r.subject == carried and r.name == "on" and r.reference == carrier for r in frame.relations)


def test_bytes_do_not_depend_on_what_was_made_before(generator: Generator, frames: list[LabelledFrame]) -> None:
    expected = [digest(frame) for frame in frames]
    list(generator.frames(0))
    assert [digest(frame) for frame in generator.frames(1)] == expected
    with Generator(recipe(), seed=3) as fresh:
        assert [digest(frame) for frame in fresh.frames(1)] == expected
    with Generator(recipe(), seed=4) as other:
        assert digest(next(other.frames(1))) != expected[0]


def test_what_is_not_asked_for_changes_nothing_else(frames: list[LabelledFrame]) -> None:
    """Each purpose has a random stream of its own: other textures and another sensor leave the heap as it is."""
    changes = {"textures": {"kinds": ["checker"], "size": 64}, "camera": TABLE["camera"] | {"depth": "ideal"}}
    with Generator(recipe(**changes), seed=3) as other:
        frame = next(other.frames(1))
    assert np.array_equal(frame.ids, frames[0].ids)
    assert np.array_equal(frame.depth > 0, frame.clean_depth > 0)
    assert not np.array_equal(frame.rgb, frames[0].rgb)


def test_a_floor_an_arrangement_and_a_scene_file_work_too() -> None:
    floor = {"kind": "room", "table": None}
    bench = {"kind": "scene", "scene": "workbench", "supports": ["workbench"], "textured": ["floor"]}
    placement = {"kind": "arrange", "separation": 0.01}
    for world, support in ((floor, "room/floor"), (bench, "workbench")):
        with Generator(recipe(worlds=[world], placement=placement), seed=0) as made:
            frame = next(made.frames(0))
        assert {carrier for _, carrier in frame.support} == {support}
        assert all(label.T_map_object[2, 2] > 0.99 for label in frame.labels)
        assert any(stuff.name == "floor" for stuff in made.info.stuff)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"targets": {"models": ["relai"]}}, r"small\.yaml: targets\.models\.0: unknown object 'relai'.*relay"),
        (
            {"targets": {"models": ["relay"], "count": [5, 9], "repeat": 3}},
            r"targets\.count: 9 of 1 models; .*at most 3",
        ),
        ({"worlds": [{"kind": "scene", "scene": "attic", "supports": ["a"]}]}, r"worlds\.0\.scene: unknown scene"),
        (
            {"worlds": [{"kind": "scene", "scene": "workbench", "supports": ["sofa"]}]},
            r"worlds\.0\.supports: unknown support 'sofa'.*workbench",
        ),
        (
            {"camera": TABLE["camera"] | {"depth_noise": {"blur": 1}}},
            r"camera\.depth_noise\.blur: unknown field; allowed: .*dropout",
        ),
    ],
)
def test_what_does_not_exist_is_said_with_its_field(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        Generator(recipe(**changes), seed=0)


def test_a_scene_that_cannot_be_made_names_the_thing() -> None:
    crowded = {"targets": {"models": ["klt3147"], "count": [9, 9], "repeat": 9}, "distractors": {}}
    message = r"placement: scene 2: 'klt3147-\d' \(box .* m\) finds no free place"
    with (
        Generator(recipe(**crowded, placement={"kind": "arrange", "area": [0.4, 0.4]}), seed=0) as made,
        pytest.raises(FileFormatError, match=message),
    ):
        next(made.frames(2))
    blind = {"views": {"kind": "shell", "distance": [4.5, 4.6]}, "worlds": [{"kind": "room", "height": [2.0, 2.0]}]}
    message = r"views: scene 0, view 0: no camera .* free view .* in 200 tries"
    with Generator(recipe(**blind), seed=0) as made, pytest.raises(FileFormatError, match=message):
        next(made.frames(0))


def test_the_users_meshes_are_targets_and_open_ones_are_warned_of(tmp_path: Path) -> None:
    folder = tmp_path / "parts" / "lid"
    folder.mkdir(parents=True)
    cup = trimesh.creation.box((0.1, 0.08, 0.05))
    cup.update_faces(cup.face_normals[:, 2] < 0.5)
    cup.export(folder / "lid.stl")
    (folder / "object.yaml").write_text("name: lid\nmesh: lid.stl\n")
    mine = parse_recipe(TABLE | {"targets": {"folders": ["parts"], "count": [1, 1]}}, tmp_path / "mine.yaml")
    with pytest.warns(UserWarning, match=r"lid\.stl: is not closed .*it measures 0\.1 x 0\.08 x 0\.05 m"):
        generator = Generator(mine, seed=0)
    with generator:
        frame = next(generator.frames(0))
    (label,) = frame.targets()
    assert generator.info.categories[0].model.name == "lid"
    assert np.allclose(label.extents, (0.1, 0.08, 0.05))


def test_poses_say_where_things_are_seen(frames: list[LabelledFrame], generator: Generator) -> None:
    """A model's surface, moved to the stated pose, has the clean depth of the pixels that it projects to."""
    for frame in frames:
        for label in frame.targets():
            assert label.category is not None
            points = generator.info.categories[label.category - 1].model.mesh.vertices
            local = points @ label.T_camera_object[:3, :3].T + label.T_camera_object[:3, 3]
            u, v = np.round(project(local, frame.intrinsics)).T
            inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
            u, v, z = u[inside].astype(int), v[inside].astype(int), local[inside, 2]
            mine = frame.ids[v, u] == label.instance
            nearest = np.full(frame.ids.shape, np.inf)
            np.minimum.at(nearest, (v[mine], u[mine]), z[mine])
            met = np.isfinite(nearest)
            if np.count_nonzero(met) > 100:
                assert np.median(np.abs(nearest - frame.clean_depth)[met]) < 0.006  # a pixel is 6 mm wide there
