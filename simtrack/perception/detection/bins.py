"""Coordinates as distributions over bins (SimCC): which bin a coordinate lies in, and back."""

from typing import TypeVar

import numpy as np

from simtrack.contracts import Float64

BINS = 96
"""For each coordinate."""
BEFORE = 0.25
"""The bins begin and end this share of a window's side outside of it."""
LEAST_SIGMA = 0.01
"""Standard deviations are never taken to be less than this, in shares of the window's side."""
REACH = 3
"""Bins about the most likely one whose mean is the coordinate."""

Coordinates = TypeVar("Coordinates")


def position_of(places: Coordinates) -> Coordinates:
    """Positions, in bins, of coordinates in shares of a window's side; arrays or tensors."""
    return (places + BEFORE) * (BINS / (1.0 + 2.0 * BEFORE)) - 0.5  # type: ignore[operator]


def place_of(positions: Coordinates) -> Coordinates:
    """Inverse of `position_of`."""
    return (positions + 0.5) * ((1.0 + 2.0 * BEFORE) / BINS) - BEFORE  # type: ignore[operator]


def decoded(logits: np.ndarray) -> tuple[Float64, Float64]:
    """Coordinates and their standard deviations, in shares of the window's side.

    Args:
        logits: (..., bins).

    Returns:
        (...,) means about the most likely bins, and (...,) standard deviations of the whole distributions.
    """
    values = np.exp(logits.astype(float) - logits.max(axis=-1, keepdims=True))
    values /= values.sum(axis=-1, keepdims=True)
    bins = np.arange(logits.shape[-1])
    near = values * (np.abs(bins - logits.argmax(axis=-1)[..., None]) <= REACH)
    positions = (near * bins).sum(axis=-1) / near.sum(axis=-1)
    variance = (values * (bins - positions[..., None]) ** 2).sum(axis=-1)
    return place_of(positions), np.sqrt(variance) * (1.0 + 2.0 * BEFORE) / BINS
