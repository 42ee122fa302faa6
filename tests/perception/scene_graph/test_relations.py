from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import Float64, MapEntity, Room
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.transforms import exp_so3, look_at, transform
from simtrack.perception.scene_graph import (
    DIRECTIONS,
    RELATIONS,
    Body,
    Interior,
    RelationConfig,
    box_shape,
    map_entity_shape,
    relation_margin,
    relation_margins,
)
from simtrack.perception.scene_graph.rooms import RoomIndex, room_margins

CONFIG = RelationConfig()
MIRRORED = {"left-of": "right-of", "right-of": "left-of"}


def random_body(rng: np.random.Generator, *, upright: bool = False) -> Body:
    turn = np.array([0.0, 0.0, rng.uniform(-3, 3)]) if upright else rng.uniform(-2, 2, 3)
    return Body(box_shape(rng.uniform(0.03, 0.4, 3)), transform(exp_so3(turn), rng.uniform(-0.5, 0.5, 3)))


def random_pair(seed: int) -> list[Body]:
    rng = np.random.default_rng(seed)
    return [random_body(rng), random_body(rng)]


def random_pose(seed: int) -> Float64:
    rng = np.random.default_rng(seed)
    return transform(exp_so3(rng.uniform(-2, 2, 3)), rng.uniform(-3, 3, 3))


def holds(name: str, pair: list[Body], *, strict: bool = False, projection: bool = True) -> bool:
    return relation_margin(pair[0], name, pair[1], CONFIG, strict=strict, projection=projection) >= 0.0


pairs = st.integers(0, 2**32 - 1).map(random_pair)
poses = st.integers(0, 2**32 - 1).map(random_pose)
UNIT = box_shape(np.array([0.1, 0.1, 0.1]))


def at(*xyz: float, turn: float = 0.0) -> Body:
    return Body(UNIT, transform(exp_so3(np.array([0.0, 0.0, turn])), xyz))


@pytest.mark.parametrize(
    ("name", "offset"),
    [
        ("above", (0, 0, 0.2)),
        ("below", (0, 0, -0.2)),
        ("left-of", (0, 0.2, 0)),
        ("right-of", (0, -0.2, 0)),
        ("in-front-of", (0.2, 0, 0)),
        ("behind", (-0.2, 0, 0)),
    ],
)
@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("projection", [False, True])
def test_directions_follow_the_axes_of_the_reference(
    name: str, offset: tuple[float, float, float], strict: bool, projection: bool
) -> None:
    margins = relation_margins([at(*offset), at(0, 0, 0)], CONFIG, strict=strict, projection=projection)[0, 1]
    assert {d for d in DIRECTIONS if margins[RELATIONS.index(d)] >= 0.0} == {name}


def test_a_turned_reference_takes_its_sides_along() -> None:
    assert relation_margin(at(0.2, 0, 0), "left-of", at(0, 0, 0, turn=-np.pi / 2), CONFIG) >= 0.0
    assert relation_margin(at(0.2, 0, 0), "left-of", at(0, 0, 0), CONFIG) < 0.0


def test_projection_ends_after_three_and_a_half_lengths() -> None:
    # The face lies at 0.05, the region ends at 0.05 + 0.35; a target of 0.1 that reaches in by 1 cm is met.
    assert relation_margin(at(0, 0.439, 0), "left-of", at(0, 0, 0), CONFIG) == pytest.approx(0.001)
    assert relation_margin(at(0, 0.441, 0), "left-of", at(0, 0, 0), CONFIG) == pytest.approx(-0.001)
    assert relation_margin(at(0, 0.9, 0), "left-of", at(0, 0, 0), CONFIG, projection=False) > 0.0
    assert relation_margin(at(0, 0.35, 0), "left-of", at(0, 0, 0), CONFIG, strict=True) == pytest.approx(0.0)


@settings(max_examples=150)
@given(pairs, poses)
def test_object_centred_directions_keep_under_rigid_motion(pair: list[Body], T: Float64) -> None:
    moved = [replace(body, T_map=T @ body.T_map) for body in pair]
    skip = RELATIONS.index("on")  # gravity decides that one
    before, after = relation_margins(pair, CONFIG), relation_margins(moved, CONFIG)
    np.testing.assert_allclose(np.delete(before, skip, 2), np.delete(after, skip, 2), atol=1e-9)


@settings(max_examples=100)
@given(pairs, st.booleans(), st.booleans())
def test_mirroring_the_frames_swaps_left_and_right(pair: list[Body], strict: bool, projection: bool) -> None:
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    mirrored = [replace(body, T_map=flip @ body.T_map @ flip) for body in pair]
    before = relation_margins(pair, CONFIG, strict=strict, projection=projection)[0, 1]
    after = relation_margins(mirrored, CONFIG, strict=strict, projection=projection)[0, 1]
    for name in DIRECTIONS:
        other = MIRRORED.get(name, name)
        assert before[RELATIONS.index(name)] == pytest.approx(after[RELATIONS.index(other)], abs=1e-9)


@settings(max_examples=150)
@given(pairs)
def test_strict_implies_relaxed_and_projection_implies_half_space(pair: list[Body]) -> None:
    for name in DIRECTIONS:
        for projection in (False, True):
            if holds(name, pair, strict=True, projection=projection):
                assert holds(name, pair, strict=False, projection=projection)
        for strict in (False, True):
            if holds(name, pair, strict=strict, projection=True):
                assert holds(name, pair, strict=strict, projection=False)
    if holds("in", pair, strict=True):
        assert holds("in", pair)


@settings(max_examples=100)
@given(pairs)
def test_opposite_strict_directions_exclude_each_other(pair: list[Body]) -> None:
    for name, opposite in (("above", "below"), ("left-of", "right-of"), ("in-front-of", "behind")):
        assert not (
            holds(name, pair, strict=True, projection=False) and holds(opposite, pair, strict=True, projection=False)
        )


@settings(max_examples=100)
@given(pairs)
def test_distances_relate_near_touching_and_intersects(pair: list[Body]) -> None:
    margins = relation_margins(pair, CONFIG)
    for name in ("near", "touching", "intersects"):
        k = RELATIONS.index(name)
        assert margins[0, 1, k] == margins[1, 0, k]
    near, touching, intersects = margins[0, 1, -3:] >= 0.0
    assert near or not touching
    assert touching or not intersects


@settings(max_examples=100)
@given(pairs, st.integers(0, 2**32 - 1))
def test_margin_bounds_the_motion_that_changes_a_relation(pair: list[Body], seed: int) -> None:
    margins = relation_margins(pair, CONFIG)[0, 1]
    direction = np.random.default_rng(seed).normal(size=3)
    direction /= np.linalg.norm(direction)
    for name in (*DIRECTIONS, "near", "touching", "intersects"):
        margin = margins[RELATIONS.index(name)]
        T = pair[0].T_map.copy()
        T[:3, 3] += 0.999 * abs(margin) * direction
        after = relation_margin(replace(pair[0], T_map=T), name, pair[1], CONFIG)
        assert (after >= 0.0) == (margin >= 0.0), name


# ---------------------------------------------------------------------------------------------------------- on and in


def standing(shape_height: float, x: float = 0.0, y: float = 0.0, lift: float = 0.0, side: float = 0.1) -> Body:
    shape = box_shape(np.array([side, side, shape_height]))
    return Body(shape, transform(None, (x, y, 0.5 * shape_height + lift)))


def test_resting_hovering_and_standing_beside() -> None:
    base = standing(0.2, side=0.4)
    assert relation_margin(standing(0.1, lift=0.2), "on", base, CONFIG) == pytest.approx(CONFIG.on_distance)
    assert relation_margin(standing(0.1, lift=0.215), "on", base, CONFIG) == pytest.approx(0.005)
    assert relation_margin(standing(0.1, lift=0.23), "on", base, CONFIG) == pytest.approx(-0.01)
    assert relation_margin(standing(0.1, lift=0.195), "on", base, CONFIG) == pytest.approx(0.015)
    assert relation_margin(standing(0.2, x=0.249), "on", base, CONFIG) < -0.01
    assert relation_margin(standing(0.2, x=0.25), "on", base, CONFIG) < -0.01
    assert relation_margin(base, "on", standing(0.1, lift=0.2), CONFIG) < -0.01


def test_a_wide_body_rests_on_a_thin_one() -> None:
    plate = Body(box_shape(np.array([0.5, 0.5, 0.03])), transform(None, (0.0, 0.0, 0.065)))
    pin = Body(box_shape(np.array([0.3, 0.01, 0.05])), transform(None, (0.0, 0.0, 0.025)))
    assert relation_margin(plate, "on", pin, CONFIG) == pytest.approx(CONFIG.on_distance)
    assert relation_margin(pin, "on", plate, CONFIG) < 0.0


def test_a_fallen_body_carries_on_the_side_that_is_up() -> None:
    fallen = Body(box_shape(np.array([0.1, 0.1, 0.4])), transform(exp_so3(np.array([np.pi / 2, 0, 0])), (0, 0, 0.05)))
    assert relation_margin(standing(0.1, lift=0.1, y=0.1), "on", fallen, CONFIG) == pytest.approx(CONFIG.on_distance)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.floats(-3.0, 3.0))
def test_on_keeps_when_the_scene_turns_about_the_vertical(seed: int, yaw: float) -> None:
    rng = np.random.default_rng(seed)
    pair = [random_body(rng, upright=True), random_body(rng, upright=True)]
    T = transform(exp_so3(np.array([0.0, 0.0, yaw])), rng.uniform(-2, 2, 3))
    before = relation_margin(pair[0], "on", pair[1], CONFIG)
    moved = [replace(body, T_map=T @ body.T_map) for body in pair]
    assert relation_margin(moved[0], "on", moved[1], CONFIG) == pytest.approx(before, abs=5e-3)


def test_in_a_container_below_the_rim_and_above_the_floor() -> None:
    interior = Interior(np.array([0.0, 0.0, 0.01]), np.array([0.36, 0.26, 0.13]))
    tub = Body(box_shape(np.array([0.4, 0.3, 0.15]), interior=interior), transform(None, (0, 0, 0.075)))
    assert relation_margin(standing(0.1, lift=0.02), "in", tub, CONFIG) > 0.01
    assert relation_margin(standing(0.3, lift=0.02), "in", tub, CONFIG) > 0.01
    assert relation_margin(standing(0.3, lift=0.02), "in", tub, CONFIG, strict=True) < 0.0
    assert relation_margin(standing(0.1, lift=0.15), "in", tub, CONFIG) < -0.01
    assert relation_margin(standing(0.1, x=0.25, lift=0.02), "in", tub, CONFIG) < -0.01
    assert relation_margin(standing(0.05, lift=-0.06), "in", tub, CONFIG) < -0.01


def test_only_containers_hold_things() -> None:
    assert relation_margin(standing(0.1), "in", standing(0.3, side=0.3), CONFIG) < 0.0


def test_map_entities_support_on_their_declared_faces() -> None:
    faces = tuple((transform(None, (0.0, 0.0, z)), np.array([0.4, 1.0])) for z in (0.5, 1.0))
    shelf = MapEntity("shelf", "shelf", transform(None, (0, 0, 1.0)), np.array([0.4, 1.0, 2.0]), supports=faces)
    shape = map_entity_shape(shelf, CONFIG.container_classes, CONFIG.layout_classes)
    body = Body(shape, shelf.T_map_entity)
    for lift, rests in ((0.5, True), (1.0, True), (0.75, False), (2.0, False)):
        assert (relation_margin(standing(0.1, lift=lift), "on", body, CONFIG) >= 0.0) == rests
    assert relation_margin(standing(0.1, lift=0.5), "in", body, CONFIG) >= 0.0
    assert relation_margin(standing(0.1, x=0.5, lift=0.5), "in", body, CONFIG) < 0.0


# ------------------------------------------------------------------------------------------------------------- viewers


def test_seen_from_the_other_side_left_is_right() -> None:
    reference, target = at(0, 0, 0), at(0, 0.2, 0)
    for eye, name in ((-2.0, "left-of"), (2.0, "right-of")):
        viewer = look_at(np.array([eye, 0.0, 0.5]), np.zeros(3))
        seen = {d for d in DIRECTIONS if relation_margin(target, d, reference, CONFIG, viewer=viewer) >= 0.0}
        assert seen == {name}


def test_in_front_is_towards_the_viewer() -> None:
    viewer = look_at(np.array([0.0, -2.0, 0.3]), np.zeros(3))
    seen = {d for d in DIRECTIONS if relation_margin(at(0, -0.2, 0), d, at(0, 0, 0), CONFIG, viewer=viewer) >= 0.0}
    assert seen == {"in-front-of"}


def test_a_viewer_straight_above_goes_by_his_image() -> None:
    viewer = look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3), up=np.array([1.0, 0.0, 0.0]))
    assert relation_margin(at(0, 0.2, 0), "left-of", at(0, 0, 0), CONFIG, viewer=viewer) >= 0.0
    assert relation_margin(at(0.2, 0, 0), "behind", at(0, 0, 0), CONFIG, viewer=viewer) >= 0.0


# ------------------------------------------------------------------------------------------------------ rooms, errors


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_room_margins_agree_with_shapely(seed: int) -> None:
    from shapely import Point, Polygon

    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 9))
    polygon = rng.uniform(0.5, 3.0, 9)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = rng.uniform(-3, 3, (30, 2))
    shape = Polygon(polygon)
    expected = [shape.exterior.distance(Point(p)) * (1 if shape.contains(Point(p)) else -1) for p in points]
    if shape.is_valid:
        np.testing.assert_allclose(room_margins(points, Room("r", polygon)), expected, atol=1e-9)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_points_are_in_the_room_in_which_they_lie_deepest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-3, 2, (6, 2))
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    rooms = [Room(str(k), corner + rng.uniform(0.5, 3) * square, height=2.0) for k, corner in enumerate(corners)]
    points, nowhere, leave = rng.uniform((-3, -3, -1), (3, 3, 3), (40, 3)), np.full(40, -1), 0.1
    margins = np.stack([room_margins(points, room) for room in rooms], axis=1)
    margins[(points[:, 2] < -0.5) | (points[:, 2] > 2.0)] = -np.inf
    deepest = np.where(margins.max(axis=1) >= 0.0, margins.argmax(axis=1), -1)
    index = RoomIndex(rooms)
    np.testing.assert_array_equal(index.assign(points, nowhere, leave), deepest)
    current = rng.integers(-1, 6, 40)
    stays = (current >= 0) & (margins[np.arange(40), current] >= -leave)
    np.testing.assert_array_equal(index.assign(points, current, leave), np.where(stays, current, deepest))
    assert RoomIndex([]).assign(points, nowhere, leave).tolist() == nowhere.tolist()


def test_unknown_relation_lists_the_known() -> None:
    with pytest.raises(UnknownNameError, match="left-of"):
        relation_margin(at(0, 0, 0), "beside", at(1, 0, 0), CONFIG)


@pytest.mark.parametrize(("name", "value"), [("near_range", 0.0), ("leave_margin", -0.1), ("on_distance", np.nan)])
def test_impossible_thresholds_are_refused(name: str, value: float) -> None:
    thresholds: dict[str, Any] = {name: value}
    with pytest.raises(InvalidValueError, match=name):
        RelationConfig(**thresholds)
