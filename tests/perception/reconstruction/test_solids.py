"""Overlaps and resting heights of convex pieces."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import Float64
from simtrack.geometry.meshes import box_mesh, convex_hull
from simtrack.perception.reconstruction.solids import Solid, overlap, resting_rise, rise

UP = np.array([0.0, 0.0, 1.0])


def box(size: tuple[float, float, float], centre: tuple[float, float, float]) -> Float64:
    return box_mesh(size).vertices + centre


def test_boxes_rest_on_each_other_where_their_faces_meet() -> None:
    upper, lower = box((0.1, 0.1, 0.2), (0.0, 0.0, 1.0)), box((1.0, 1.0, 0.5), (0.3, 0.0, 0.0))
    assert rise(upper, lower) == pytest.approx(0.25 - 0.9)
    assert rise(upper + [2.0, 0.0, 0.0], lower) is None


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_after_its_rise_a_piece_touches_and_does_not_overlap(seed: int) -> None:
    rng = np.random.default_rng(seed)
    upper = convex_hull(rng.normal(0.0, 0.2, (12, 3))).vertices
    lower = convex_hull(rng.normal(0.0, 0.3, (12, 3))).vertices
    needed = rise(upper, lower)
    assert needed is not None
    clear, in_it = (Solid.of([upper + (needed + step) * UP]) for step in (1e-6, -0.01))
    assert overlap(clear, Solid.of([lower]))[0] == pytest.approx(0.0, abs=1e-12)
    assert overlap(in_it, Solid.of([lower]))[0] > 0.0


def test_what_is_beside_or_above_does_not_lift() -> None:
    shelf = Solid.of([box((1.0, 0.3, 0.02), (0.0, 0.0, 0.49)), box((1.0, 0.3, 0.02), (0.0, 0.0, 0.99))])
    cup = Solid.of([box((0.08, 0.08, 0.1), (0.0, 0.0, 0.56))])
    assert resting_rise(cup, {"shelf": shelf}, (-0.2, 0.04)) == pytest.approx(-0.01)
    assert resting_rise(cup.moved(-0.02 * UP), {"shelf": shelf}, (-0.2, 0.04)) == pytest.approx(0.01)
    assert resting_rise(cup.moved(np.array([2.0, 0.0, 0.0])), {"shelf": shelf}, (-0.2, 0.04)) is None


def test_overlap_of_boxes_is_their_common_box() -> None:
    first, second = Solid.of([box((1.0, 1.0, 1.0), (0.0, 0.0, 0.0))]), Solid.of([box((1.0, 1.0, 1.0), (0.9, 0.0, 0.0))])
    volume, depth = overlap(first, second)
    assert volume == pytest.approx(0.1)
    assert depth == pytest.approx(0.1)
    assert overlap(first, second.moved(np.array([0.2, 0.0, 0.0]))) == (0.0, 0.0)
