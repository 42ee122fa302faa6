import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simtrack.contracts import (
    NANOSECONDS,
    Belief,
    CameraIntrinsics,
    JointState,
    Localization,
    Relation,
    Status,
    Track,
    TrackStatus,
)
from simtrack.envs.observations import JOINTS, MODES, Encoder, Layout, Proprioception, decode
from simtrack.geometry.transforms import exp_so3, transform, transform_planar
from simtrack.objects.tiago import tiago
from simtrack.perception.scene_graph import RELATIONS

LAYOUT = Layout(("box", "relay"), 4, ("shelf", "workbench"), 30.0, CameraIntrinsics(16, 12, 14, 14, 7.5, 5.5), 8.0)
FELT = Proprioception(JointState(0, JOINTS, np.array([0.3, -0.4, 0.2])), 0.1, -0.2)
finite = st.floats(-50.0, 50.0)
vectors = st.tuples(finite, finite, finite).map(np.array)
turns = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(np.array)


def track(number: int, place: np.ndarray, turn: np.ndarray, status: TrackStatus = TrackStatus.CONFIRMED) -> Track:
    T = transform(exp_so3(turn), place)
    covariance = np.diag(np.linspace(1e-6, 1e-4, 6))
    return Track(
        number, LAYOUT.classes[number % 2], status, 5 * NANOSECONDS, T, covariance, T, np.zeros(6), 3 * NANOSECONDS,
        0.5, True, 0.0, 0.75,
    )  # fmt: skip


def belief(*tracks: Track, yaw: float = 0.2, relations: tuple[Relation, ...] = ()) -> Belief:
    where = Localization(5 * NANOSECONDS, transform_planar(1.0, 2.0, yaw), np.eye(6) * 1e-4, Status.OK)
    return Belief(5 * NANOSECONDS, where, np.eye(4), tracks, None, None, frozenset(relations))


@given(vectors, turns, st.sampled_from(list(TrackStatus)), st.floats(-3.0, 3.0))
def test_a_belief_survives_its_arrays(place: np.ndarray, turn: np.ndarray, status: TrackStatus, yaw: float) -> None:
    before = belief(track(1, place, turn, status), yaw=yaw)
    arrays = Encoder(LAYOUT).encode(before, FELT)
    assert arrays in LAYOUT.space("belief")
    after, joints = decode(arrays, LAYOUT, tiago())
    (old,), (new,) = before.tracks, after.tracks
    np.testing.assert_allclose(new.T_map_object, old.T_map_object, atol=1e-5)
    np.testing.assert_allclose(new.covariance, old.covariance, atol=1e-9)
    np.testing.assert_allclose(after.localization.T_map_base, before.localization.T_map_base, atol=1e-5)
    assert (new.id, new.class_name, new.status, new.moving) == (old.id, old.class_name, old.status, old.moving)
    assert after.stamp == before.stamp and new.last_seen == old.last_seen
    np.testing.assert_allclose(joints.positions, [0.3, -0.4, 0.2], atol=1e-6)


def test_a_track_keeps_its_slot_while_others_come_and_go() -> None:
    encoder, place = Encoder(LAYOUT), np.ones(3)
    first = encoder.encode(belief(track(1, place, place), track(2, place, place)), FELT)
    assert first["id"].tolist() == [1, 2, 0, 0]
    second = encoder.encode(belief(track(2, place, place), track(3, place, place)), FELT)
    assert second["id"].tolist() == [3, 2, 0, 0]
    assert second["mask"].tolist() == [1, 1, 0, 0]


def test_believed_tracks_get_the_room_there_is() -> None:
    doubtful = [track(k, np.ones(3), np.ones(3), TrackStatus.TENTATIVE) for k in range(1, 5)]
    arrays = Encoder(LAYOUT).encode(belief(*doubtful, track(9, np.ones(3), np.ones(3))), FELT)
    assert 9 in arrays["id"] and arrays["mask"].sum() == LAYOUT.slots


def test_relations_stand_where_subject_and_reference_have_their_rows() -> None:
    relations = (Relation("relay-1", "on", "workbench"), Relation("box-2", "in", "relay-1"), Relation("a", "on", "b"))
    tracks = track(1, np.ones(3), np.ones(3)), track(2, np.ones(3), np.ones(3))
    arrays = Encoder(LAYOUT).encode(belief(*tracks, relations=relations), FELT)["relations"]
    found = {tuple(index) for index in np.argwhere(arrays).tolist()}
    assert found == {(0, LAYOUT.slots + 1, RELATIONS.index("on")), (1, 0, RELATIONS.index("in"))}


@pytest.mark.parametrize("mode", MODES)
def test_bounds_are_finite(mode: str) -> None:
    for box in LAYOUT.space(mode).values():
        assert np.isfinite(box.low).all() and np.isfinite(box.high).all()  # type: ignore[attr-defined]


def test_arrays_are_fresh() -> None:
    encoder = Encoder(LAYOUT)
    first, second = (encoder.encode(belief(track(1, np.ones(3), np.ones(3))), FELT) for _ in range(2))
    assert not any(np.shares_memory(first[key], second[key]) for key in first)
