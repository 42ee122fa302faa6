"""Laws of optimization-based alignment: Eqs. 11-14 of the reconstruction paper."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon, box
from shapely.affinity import rotate, translate

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.perception.reconstruction.alignment import (
    AlignmentConfig,
    AlignmentProblem,
    PlanePairs,
    PointPairs,
    solve,
)
from simtrack.perception.reconstruction.residuals import footprint_outside


def unit_rows(rng: np.random.Generator, count: int) -> Float64:
    rows = rng.normal(size=(count, 3))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def random_problem(seed: int, *, tied: bool = True, points: bool = True) -> AlignmentProblem:
    rng = np.random.default_rng(seed)
    return AlignmentProblem(
        footprint=np.array([[-0.5, -0.4], [0.5, 0.6]]),
        height=1.1,
        extents=rng.uniform(0.4, 1.2, 3),
        tied=tied,
        planes=PlanePairs(unit_rows(rng, 5), rng.normal(size=5), unit_rows(rng, 5), rng.normal(size=5), rng.random(5)),
        points=PointPairs(rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), unit_rows(rng, 9), rng.random(9))
        if points
        else None,
        start=np.zeros(4),
        config=AlignmentConfig(),
    )


@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans())
@settings(max_examples=30)
def test_jacobian_equals_finite_differences(seed: int, tied: bool, points: bool) -> None:
    problem = random_problem(seed, tied=tied, points=points)
    unknowns = np.random.default_rng(seed + 1).normal(0.0, 0.3, 4)
    step = 1e-6 * np.eye(4)
    differences = [(problem.residuals(unknowns + h) - problem.residuals(unknowns - h)) / 2e-6 for h in step]
    assert np.allclose(problem.jacobian(unknowns), np.stack(differences, axis=1), atol=1e-6)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50)
def test_area_outside_is_that_of_polygons(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half, centre, yaw = rng.uniform(0.1, 1.0, 2), rng.uniform(-0.7, 0.7, 2), float(rng.uniform(-4.0, 4.0))
    outside, _ = footprint_outside(np.array([[-0.5, -0.4], [0.5, 0.6]]), half, centre, yaw)
    turned = rotate(box(*-half, *half), yaw, origin=(0.0, 0.0), use_radians=True)
    assert isinstance(turned, Polygon)
    whole = translate(turned, *centre)
    assert outside == pytest.approx(whole.difference(box(-0.5, -0.4, 0.5, 0.6)).area, abs=1e-9)


def test_height_follows_from_the_support_plane() -> None:
    standing, hanging = random_problem(0), random_problem(0, tied=False)
    for scale in (0.5, 1.0, 1.7):
        low = standing.centre_height(scale) - 0.5 * scale * standing.extents[2]
        assert low == pytest.approx(-0.5 * standing.height)  # the lower side of the box
        assert hanging.centre_height(scale) == 0.0


@pytest.mark.parametrize("seed", range(4))
def test_finds_the_transform_that_made_the_entity(seed: int) -> None:
    rng = np.random.default_rng(seed)
    extents = rng.uniform(0.4, 1.2, 3)
    truth = np.array([rng.normal(0.0, 0.2), rng.normal(0.0, 0.15), *rng.normal(0.0, 0.05, 2)])
    scale, c, s = np.exp(truth[0]), np.cos(truth[1]), np.sin(truth[1])
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    height = scale * extents[2]
    p = np.array([*truth[2:], 0.0])
    points, normals, offsets = rng.normal(size=(60, 3)), unit_rows(rng, 60), rng.normal(size=6)
    planes = PlanePairs(normals[:6] @ R.T, scale * offsets - normals[:6] @ R.T @ p, normals[:6], offsets, np.ones(6))
    pairs = PointPairs(scale * points @ R.T + p, points, normals, np.full(60, 0.2))
    footprint = np.array([[-9.0, -9.0], [9.0, 9.0]])
    config = AlignmentConfig(prior_weight=1e-6)
    problem = AlignmentProblem(footprint, float(height), extents, True, planes, pairs, np.zeros(4), config)
    assert np.allclose(solve(problem, np.zeros(4)), truth, atol=1e-4)


def test_config_is_validated() -> None:
    with pytest.raises(InvalidValueError, match=r"AlignmentConfig\.reach"):
        AlignmentConfig(reach=0.0)
    with pytest.raises(InvalidValueError, match=r"AlignmentConfig\.rounds"):
        AlignmentConfig(rounds=-1)
