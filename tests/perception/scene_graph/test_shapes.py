"""Shapes of bodies: where water stands, and many models at once."""

from heapq import heappop, heappush

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import Float64
from simtrack.perception.scene_graph import ModelLike, model_shape, model_shapes
from simtrack.perception.scene_graph.shapes import _water_level


def priority_flood(ground: Float64) -> Float64:
    """R. Barnes, C. Lehman, D. Mulla, Computers & Geosciences 62, 2014: inwards from the shores, lowest first."""
    level = np.full((ground.shape[0] + 2, ground.shape[1] + 2), np.nan)
    level[[0, -1], :] = level[:, [0, -1]] = -np.inf
    level[1:-1, 1:-1][ground == -np.inf] = -np.inf
    shores = [(-np.inf, int(i), int(j)) for i, j in np.argwhere(level == -np.inf)]
    heights = np.pad(ground, 1)
    while shores:
        height, i, j = heappop(shores)
        for p, q in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if 0 <= p < level.shape[0] and 0 <= q < level.shape[1] and np.isnan(level[p, q]):
                level[p, q] = max(height, float(heights[p, q]))
                heappush(shores, (float(level[p, q]), p, q))
    return level[1:-1, 1:-1]


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_water_stands_up_to_the_lowest_way_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ground = rng.integers(0, 6, rng.integers(1, 25, 2)).astype(float)
    ground[rng.random(ground.shape) < rng.choice([0.0, 0.05])] = -np.inf
    np.testing.assert_array_equal(_water_level(ground), priority_flood(ground))


def test_many_shapes_are_those_of_the_single_models(models: dict[str, ModelLike]) -> None:
    assert model_shapes({}) == {}
    together = model_shapes(models)
    assert list(together) == list(models)
    for name, shape in together.items():
        alone = model_shape(models[name])
        for a, b in zip(shape.fields, alone.fields, strict=True):
            np.testing.assert_array_equal(a.heights, b.heights)
