import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.boxes import OrientedBox, proximity
from simtrack.geometry.transforms import exp_so3, transform


def random_box(rng: np.random.Generator, spread: float = 1.0, turned: bool = True) -> OrientedBox:
    rotation = exp_so3(rng.uniform(-3.0, 3.0, 3)) if turned else np.eye(3)
    return OrientedBox(transform(rotation, rng.uniform(-spread, spread, 3)), rng.uniform(0.02, 1.0, 3))


seeds = st.integers(0, 2**32 - 1)
boxes = st.builds(lambda seed, turned: random_box(np.random.default_rng(seed), turned=turned), seeds, st.booleans())
poses = st.builds(
    lambda seed: transform(
        exp_so3(np.random.default_rng(seed).uniform(-3, 3, 3)), np.random.default_rng(seed + 1).uniform(-5, 5, 3)
    ),
    seeds,
)


def least_squares_distance(a: OrientedBox, b: OrientedBox) -> float:
    """Distance as a convex quadratic programme over both boxes' own coordinates."""
    system = np.hstack([a.T_map_box[:3, :3], -b.T_map_box[:3, :3]])
    half = 0.5 * np.concatenate([a.extents, b.extents])
    offset = b.T_map_box[:3, 3] - a.T_map_box[:3, 3]
    return float(np.sqrt(2.0 * lsq_linear(system, offset, (-half, half), tol=1e-14).cost))


def moved(box: OrientedBox, T: Float64) -> OrientedBox:
    return OrientedBox(T @ box.T_map_box, box.extents)


def inflated(box: OrientedBox) -> OrientedBox:
    return OrientedBox(box.T_map_box, box.extents + 1e-9)


@settings(max_examples=40)
@given(boxes, boxes)
def test_distance_solves_the_quadratic_programme(a: OrientedBox, b: OrientedBox) -> None:
    assert proximity(a, b).distance == pytest.approx(least_squares_distance(a, b), abs=1e-6)


@settings(max_examples=100)
@given(boxes, boxes)
def test_closest_points_lie_in_the_boxes_at_that_distance(a: OrientedBox, b: OrientedBox) -> None:
    found = proximity(a, b)
    assert inflated(a).contains(found.point_a[None]).all()
    assert inflated(b).contains(found.point_b[None]).all()
    assert np.linalg.norm(found.point_a - found.point_b) == pytest.approx(found.distance, abs=1e-9)


@settings(max_examples=60)
@given(boxes, boxes, seeds)
def test_no_pair_of_points_is_closer_or_farther(a: OrientedBox, b: OrientedBox, seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = proximity(a, b)
    points = []
    for box in (a, b):
        local = rng.uniform(-0.5, 0.5, (200, 3)) * box.extents
        points.append(local @ box.T_map_box[:3, :3].T + box.T_map_box[:3, 3])
    gaps = np.linalg.norm(points[0][:, None] - points[1][None], axis=2)
    assert found.distance <= gaps.min() + 1e-9
    assert found.maximum >= gaps.max() - 1e-9
    assert np.linalg.norm(found.farthest_a - found.farthest_b) == pytest.approx(found.maximum)


@settings(max_examples=60)
@given(boxes, boxes, poses)
def test_distance_is_symmetric_and_keeps_under_rigid_motion(a: OrientedBox, b: OrientedBox, T: Float64) -> None:
    signed = proximity(a, b).signed
    assert proximity(b, a).signed == pytest.approx(signed, abs=1e-9)
    assert proximity(moved(a, T), moved(b, T)).signed == pytest.approx(signed, abs=1e-9)


@settings(max_examples=60)
@given(boxes, boxes, boxes)
def test_detour_over_a_third_box_is_not_shorter(a: OrientedBox, b: OrientedBox, c: OrientedBox) -> None:
    way = proximity(a, b).distance + 2.0 * np.linalg.norm(0.5 * b.extents) + proximity(b, c).distance
    assert proximity(a, c).distance <= way + 1e-9


@settings(max_examples=60)
@given(boxes, boxes, seeds)
def test_penetration_is_the_shortest_way_apart(a: OrientedBox, b: OrientedBox, seed: int) -> None:
    depth = -proximity(a, b).signed
    if depth <= 0.0:
        return
    directions = np.random.default_rng(seed).normal(size=(50, 3))
    for direction in directions / np.linalg.norm(directions, axis=1)[:, None]:
        assert proximity(moved(a, transform(None, direction * depth * 0.999)), b).distance == 0.0


def test_penetration_of_aligned_boxes_is_their_overlap() -> None:
    a = OrientedBox(np.eye(4), np.array([1.0, 1.0, 1.0]))
    b = OrientedBox(transform(None, (0.7, 0.1, 0.0)), np.array([1.0, 1.0, 1.0]))
    assert proximity(a, b).signed == pytest.approx(-0.3)


@pytest.mark.parametrize("extents", [[1.0, 0.0, 1.0], [1.0, np.nan, 1.0], [1.0, 1.0], [1.0, -1.0, 1.0]])
def test_impossible_extents_are_refused(extents: list[float]) -> None:
    with pytest.raises(InvalidValueError, match="extents"):
        OrientedBox(np.eye(4), np.array(extents))


def test_mirrored_pose_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="T_map_box"):
        OrientedBox(np.diag([1.0, -1.0, 1.0, 1.0]), np.ones(3))
