"""Bootstrap statistics of few runs: intervals of medians, and paired differences between methods.

Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13 (percentile intervals); pairs keep what seeds
have in common, which is most of what differs between runs.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

DRAWS = 4000
CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Estimate:
    """A median over runs with its percentile interval."""

    median: float
    low: float
    high: float
    count: int


def estimate(values: npt.ArrayLike, confidence: float = CONFIDENCE) -> Estimate | None:
    """Median of a sample and its bootstrap interval; None of an empty sample. One value is its own interval."""
    sample = np.asarray(values, dtype=np.float64)
    if not sample.size:
        return None
    medians = np.median(_draws(sample), axis=1)
    low, high = np.quantile(medians, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Estimate(float(np.median(sample)), float(low), float(high), sample.size)


@dataclass(frozen=True, slots=True)
class Difference:
    """How much one method's values exceed another's on the same seeds, in the mean."""

    mean: float
    low: float
    high: float
    count: int
    """Pairs."""

    @property
    def significant(self) -> bool:
        """Whether the interval leaves out zero; never of fewer than five pairs, whose interval says too little."""
        return self.count >= LEAST_PAIRS and (self.low > 0.0 or self.high < 0.0)


LEAST_PAIRS = 5
"""With fewer pairs the 2.5 % quantile of their mean is the smallest of them too often to mean anything."""


def difference(ours: npt.ArrayLike, theirs: npt.ArrayLike, confidence: float = CONFIDENCE) -> Difference | None:
    """Paired bootstrap of two equally long samples; None of empty ones."""
    gaps = np.asarray(ours, dtype=np.float64) - np.asarray(theirs, dtype=np.float64)
    if not gaps.size:
        return None
    means = _draws(gaps).mean(axis=1)
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Difference(float(gaps.mean()), float(low), float(high), gaps.size)


def _draws(sample: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(DRAWS, N), drawn with replacement, always the same way."""
    return sample[np.random.default_rng(0).integers(0, sample.size, (DRAWS, sample.size))]
