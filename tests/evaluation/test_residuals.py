"""Residuals beside a map, and their quantiles from a histogram."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.evaluation.residuals import BIN, LIMIT, Residuals, map_residuals
from simtrack.geometry.meshes import box_mesh
from simtrack.geometry.transforms import transform
from simtrack.perception.localization.measurement import Measurement
from simtrack.raycast import RayScene, TriangleMesh


@settings(max_examples=60)
@given(
    values=st.lists(st.floats(-2.0 * LIMIT, 2.0 * LIMIT, width=32), min_size=1, max_size=60),
    share=st.floats(0.01, 1.0),
)
def test_quantiles_are_those_of_the_sample(values: list[float], share: float) -> None:
    residuals = Residuals()
    for part in np.array_split(values, 3):
        residuals.add(part)
    residuals.add([np.nan, np.inf])
    exact = np.quantile(np.minimum(np.abs(values), LIMIT), share, method="inverted_cdf")
    assert residuals.count == len(values)
    value = residuals.quantile(share).value
    assert value is not None and abs(value - exact) <= BIN + 1e-9


def test_of_nothing_there_is_no_quantile() -> None:
    metric = Residuals().quantile(0.5)
    assert metric.value is None and metric.reason


def test_distances_are_measured_along_the_ray_and_from_the_plane() -> None:
    """A wall at x = 2, seen from two places, readings 10 cm behind it and past it."""
    wall = box_mesh((1.0, 4.0, 4.0))
    scene = RayScene()
    scene.add(TriangleMesh((wall.vertices + [2.5, 0.0, 0.0]).astype(np.float32), wall.faces))
    directions = np.array([[1.0, 0.0, 0.0], [np.sqrt(0.5), np.sqrt(0.5), 0.0], [-1.0, 0.0, 0.0]], np.float32)
    ranges = np.array([2.1, np.sqrt(8.0) - 0.1, 1.0], np.float32)
    shots = Measurement(0, np.zeros((3, 3), np.float32), directions, ranges, ranges, np.arange(3, dtype=np.int32))
    found = map_residuals(shots, np.eye(4), scene)
    np.testing.assert_array_equal(found.covered, [True, True, False])
    np.testing.assert_allclose(found.along[:2], [0.1, -0.1], atol=1e-5)
    np.testing.assert_allclose(found.planes[:2], [0.1, 0.1 * np.sqrt(0.5)], atol=1e-5)
    nearer = map_residuals(shots, transform(None, (0.3, 0.0, 0.0)), scene)
    assert nearer.along[0] == pytest.approx(0.4, abs=1e-5)
