"""Frames of a drive: the robot's eye, its lidar and its odometry, with the truth of the simulation as labels."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simtrack.contracts import NANOSECONDS
from simtrack.datasets.frame import LabelledFrame
from simtrack.datasets.generator import Generator
from simtrack.datasets.recipe import Recipe, parse_recipe
from simtrack.errors import FileFormatError
from simtrack.geometry.transforms import inverse, is_rigid

pytestmark = [pytest.mark.gl, pytest.mark.slow]


def recipe(**views: Any) -> Recipe:
    document = {
        "name": "log",
        "worlds": [{"kind": "scene", "scene": "workbench"}],
        "views": {"kind": "drive", "duration": 0.65, "rate": 5.0, "agent": "fixed-gaze"} | views,
        "camera": {"width": 160, "height": 120, "focal": 144.0},
    }
    return parse_recipe(document, Path("log.yaml"))


def digest(frame: LabelledFrame) -> str:
    sha = hashlib.sha256()
    for image in (frame.rgb, frame.depth, frame.clean_depth, frame.normals, frame.ids, frame.T_map_camera):
        sha.update(image.tobytes())
    if frame.lidar is not None:
        sha.update(frame.lidar.instances.tobytes() + frame.lidar.scan.ranges.tobytes())
    sha.update(repr((frame.odometry, frame.joints, frame.support, frame.relations)).encode())
    return sha.hexdigest()


@pytest.fixture(scope="module")
def generator() -> Iterator[Generator]:
    with Generator(recipe(), seed=1) as made:
        yield made


@pytest.fixture(scope="module")
def frames(generator: Generator) -> list[LabelledFrame]:
    assert generator.scene_info(2).static_map is not None
    assert generator.scene_info(2).robot is not None
    return list(generator.frames(2))


def test_as_many_frames_as_said_at_the_rate_asked(generator: Generator, frames: list[LabelledFrame]) -> None:
    assert len(frames) == generator.scene_info(2).frames == 4
    assert generator.scenes(11) == 3
    assert np.allclose(np.diff([frame.stamp for frame in frames]), NANOSECONDS / 5, atol=10)


def test_ids_and_labels_are_of_the_scene(generator: Generator, frames: list[LabelledFrame]) -> None:
    known = {category.id for category in generator.info.categories} | {stuff.id for stuff in generator.info.stuff}
    names = {category.model.name for category in generator.info.categories}
    assert names == {"klt3147", "materialbox", "multimeter", "relay", "screwdriver", "powerdrill"}
    for frame in frames:
        assert set(frame.segment_categories.tolist()) <= known
        assert len(frame.targets()) == 8
        assert len(frame.labels) == 14
        for label in frame.labels:
            assert frame.names[label.instance] == label.name
            assert label.pixels_visible == np.count_nonzero(frame.ids == label.instance)
            assert np.allclose(frame.T_map_camera @ label.T_camera_object, label.T_map_object, atol=1e-9)
        assert any(label.pixels_visible > 20 for label in frame.targets())
        assert {"workbench"} <= {carrier for _, carrier in frame.support}


def test_measured_and_clean_depth_are_of_one_view(frames: list[LabelledFrame]) -> None:
    for frame in frames:
        both = (frame.depth > 0) & (frame.clean_depth > 0)
        assert both.mean() > 0.5
        assert np.median(np.abs(frame.depth - frame.clean_depth)[both]) < 0.02


def test_the_robot_carries_the_camera_and_the_lidar(frames: list[LabelledFrame]) -> None:
    for frame in frames:
        assert frame.T_map_base is not None
        assert is_rigid(frame.T_map_base)
        assert 0.8 < (inverse(frame.T_map_base) @ frame.T_map_camera)[2, 3] < 1.8
        assert frame.joints
        assert frame.odometry is not None
        assert frame.odometry.stamp <= frame.stamp
    scans = [frame.lidar for frame in frames if frame.lidar is not None]
    assert len(scans) >= 2
    assert len({scan.scan.stamp for scan in scans}) == len(scans)  # no scan twice
    for lidar in scans:
        assert lidar.instances.shape == lidar.scan.ranges.shape
        assert (lidar.instances[np.isfinite(lidar.scan.ranges)] >= 0).all()  # what returned has met something
        assert 0.2 < (inverse(frames[0].T_map_base) @ lidar.T_map_lidar)[2, 3] < 2.0  # type: ignore[arg-type]


def test_a_drive_repeats_to_the_byte_whatever_came_before(generator: Generator, frames: list[LabelledFrame]) -> None:
    expected = [digest(frame) for frame in frames]
    next(generator.frames(0))
    assert [digest(frame) for frame in generator.frames(2)] == expected


def test_an_unknown_agent_lists_the_known_ones() -> None:
    with pytest.raises(FileFormatError, match=r"views\.agent: unknown agent 'taxi'.*explorer"):
        Generator(recipe(agent="taxi"), seed=0)
