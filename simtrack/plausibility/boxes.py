"""Which axis-aligned boxes come near each other: the broad phase of both engines' distance queries."""

import numpy as np

from simtrack.contracts import Bool, Float64


def near_pairs(low: Float64, high: Float64, limit: float, chosen: Bool) -> list[tuple[int, int]]:
    """Pairs i < j of (N, 3) boxes that are at most `limit` metres apart along each axis, one of them `chosen` (N,)."""
    apart = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(axis=2)
    near = np.triu(apart <= limit, 1) & (chosen[:, None] | chosen[None])
    return [(int(i), int(j)) for i, j in np.argwhere(near)]
