"""A filmed room: frames are true, and the same at every call; the oracle errs as much as it is told to."""

from collections.abc import Iterator

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, RgbdFrame, Status
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.evaluation.map_sources import map_source
from simtrack.geometry.transforms import is_rigid
from simtrack.perception.mapping.panoptic.panoptic_map import PanopticMap, PanopticMapConfig
from simtrack.sensors.camera import unproject
from simtrack.simulation.building.rooms.film import FilmConfig, RoomFilm
from simtrack.simulation.building.rooms.physics import SettledRoom, settled_room
from simtrack.simulation.oracles.segmenter import OracleSegmenter


@pytest.fixture(scope="module")
def room() -> SettledRoom:
    return settled_room(101)


@pytest.fixture(scope="module")
def film(room: SettledRoom) -> Iterator[RoomFilm]:
    with RoomFilm(room, FilmConfig(frames=8, sensor="kinect_v2")) as shot:
        yield shot


def test_frames_do_not_depend_on_when_they_are_asked_for(film: RoomFilm) -> None:
    first, other, again = film.at(3), film.at(5), film.at(3)
    assert first.frame.depth.tobytes() == again.frame.depth.tobytes() != other.frame.depth.tobytes()
    assert first.frame.rgb is not None and again.frame.rgb is not None
    assert first.frame.rgb.tobytes() == again.frame.rgb.tobytes()


def test_the_camera_stays_clear_of_what_stands_there(film: RoomFilm, room: SettledRoom) -> None:
    low, high = room.plan.room.polygon.min(axis=0), room.plan.room.polygon.max(axis=0)
    for T in film.poses:
        assert is_rigid(T) and (T[:2, 3] > low + 0.3).all() and (T[:2, 3] < high - 0.3).all()


def test_true_depth_lies_on_the_entities_that_the_labels_name(film: RoomFilm, room: SettledRoom) -> None:
    seen = film.at(2)
    points = unproject(seen.depth, seen.frame.intrinsics) @ seen.T_map_camera[:3, :3].T + seen.T_map_camera[:3, 3]
    for number in np.unique(seen.instances[seen.instances >= 0]).tolist():
        low, high = room.entities[number].mesh.bounds
        own = points[seen.instances == number]
        assert (own > low - 1e-3).all() and (own < high + 1e-3).all()
    read = seen.frame.depth > 0.0
    assert read.mean() > 0.8 and np.median(np.abs(seen.frame.depth - seen.depth)[read]) < 0.02


def disagreement(film: RoomFilm, room: SettledRoom, strength: float) -> float:
    """Share of pixels whose class the oracle does not say."""
    classes = [entity.semantic_class for entity in room.entities]
    wrong = []
    for seen in film:
        oracle = OracleSegmenter(lambda stamp, s=seen: s.instances, classes, strength)
        answer = oracle.segment(seen.frame)
        said = np.array(["", *answer.classes])[answer.image]
        actual = np.array([*classes, ""])[seen.instances]
        wrong.append(float((said != actual).mean()))
        again = oracle.segment(seen.frame)
        np.testing.assert_array_equal(answer.image, again.image)
    return float(np.mean(wrong))


def test_the_oracle_is_right_at_strength_0_and_errs_more_with_more(film: RoomFilm, room: SettledRoom) -> None:
    errors = [disagreement(film, room, strength) for strength in (0.0, 0.5, 2.0)]
    assert errors[0] == 0.0 < errors[1] < errors[2]


def test_walls_and_floors_are_wrong_more_often_than_things() -> None:
    labels = np.zeros((60, 80), np.int32)
    labels[:, 40:] = 1
    frame = RgbdFrame(
        0, np.ones((60, 80), np.float32), None, CameraIntrinsics(80, 60, 70.0, 70.0, 39.5, 29.5), np.eye(4)
    )
    told = []
    for seed in range(200):
        answer = OracleSegmenter(lambda stamp: labels, ("wall", "fridge"), 1.0, seed).segment(frame)
        told.append([name in answer.classes for name in ("wall", "fridge")])
    wall, fridge = np.mean(told, axis=0).tolist()
    assert 0.1 < wall < fridge - 0.1


def test_a_room_is_mapped_from_its_film(film: RoomFilm, room: SettledRoom) -> None:
    classes = [entity.semantic_class for entity in room.entities]
    panoptic_map = PanopticMap(PanopticMapConfig.of_method("full", 0.04))
    for seen in film:
        oracle = OracleSegmenter(lambda stamp, s=seen: s.instances, classes, 0.0)
        update = panoptic_map.integrate(seen.frame, seen.T_map_camera, oracle.segment(seen.frame))
        assert update.status is Status.OK and update.blocks > 0
    found = {entity.semantic_class for entity in panoptic_map.entities()}
    assert {"floor", "wall"} <= found <= set(classes)


def test_values_that_are_none_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="kinect_v2"):
        FilmConfig(sensor="polaroid")
    with pytest.raises(InvalidValueError, match="frames"):
        FilmConfig(frames=0)
    with pytest.raises(InvalidValueError, match="strength"):
        OracleSegmenter(lambda stamp: np.zeros((1, 1), np.int32), (), strength=-1.0)
    with pytest.raises(InvalidValueError, match="furnished room"):
        map_source("workbench")
    with pytest.raises(InvalidValueError, match="oracle, none, learned, a folder"):
        map_source("rooms:1", segmenter="mask2former")
